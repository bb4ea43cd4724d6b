"""The verb `survey`: surveys by settings files and flags, one after the other."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from spectralzoom.flows.settings.flags import NO_FLAGS, AsJson, SurveyFlags, by_setting
from spectralzoom.flows.settings.load import load_settings
from spectralzoom.flows.terminal.processes import format_failure
from spectralzoom.flows.terminal.progress import print_json, say, stderr
from spectralzoom.pipeline.errors import SurveyStopped

Verbose = Annotated[
    bool, Parameter(name=("--verbose", "-v"), negative="", help="Print all savings, stages and effects.")
]


def survey(*settings: Path, flags: SurveyFlags = NO_FLAGS, as_json: AsJson = False, verbose: Verbose = False) -> int:
    """Survey a field: capture it in one or two passes, map its classes, and publish a receipt and a report.

    If a survey fails, the next ones still run. The exit code is that of the last failure. With --json several surveys
    are the list `surveys`, with `settings` and `error` of one that failed.

    Parameters
    ----------
    settings
        Settings files (TOML), surveyed one after the other; flags override each. Default: none.
    """
    from spectralzoom.flows.survey_command import run_survey

    every = [load_settings(file, by_setting(flags)) for file in settings or (None,)]
    printed: list[dict[str, Any]] = []
    code = 0
    try:
        for number, requested in enumerate(every):
            if len(every) > 1:
                stderr.print(f"survey {number + 1} of {len(every)}: {settings[number]}", markup=False, soft_wrap=True)
            try:
                printed.append(run_survey(requested, stderr, verbose=verbose).receipt)
            except SurveyStopped as stopped:
                printed.append({"until": stopped.until, "stored": stopped.uri, "archive": stopped.archive})
                stderr.print(f"{stopped}", markup=False, soft_wrap=True)
            except Exception as error:
                if len(every) == 1 or isinstance(error, BrokenPipeError):
                    raise
                message, code = format_failure(error)
                say(f"{settings[number]}: {message}")
                printed.append({"settings": str(settings[number]), "error": message})
    finally:  # also after Ctrl-C
        if as_json and printed:
            print_json(printed[0] if len(every) == 1 else {"surveys": printed})
    return code
