"""Define the verb `survey`, and flags of settings for the verbs that take them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, make_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from flows.cli.app import AsJson, say, stderr
from flows.settings.documents import about, toml_value
from flows.settings.load import FLAGS, SURVEY, TABLES, load_settings
from flows.terminal.processes import format_failure
from flows.terminal.progress import print_json
from pipeline.errors import NothingToMend
from pipeline.lazy import deferred

if TYPE_CHECKING:
    import flows.publish.survey_command as survey_command
else:
    survey_command = deferred("flows.publish.survey_command")

IN_TABLES = {flag: setting for setting, flag in FLAGS.items()}
_IN_TABLES = {name: place.partition(".") for name, place in IN_TABLES.items()}
_DECLARED = SURVEY | {name: TABLES[table][key] for name, (table, _, key) in _IN_TABLES.items()}


def _flags(names: Iterable[str]) -> Any:
    """Return a dataclass of flags for these settings; None stands for a flag that is not given."""
    made = []
    for name in names:
        one = _DECLARED[name]
        kind: Any = bool if one.kind is bool else str
        help_text = about(one) + ("" if one.item.default is None else f"; default: {toml_value(one).strip(chr(34))}")
        made.append((name, Annotated[kind | None, Parameter(help=help_text)], None))
    return make_dataclass("Flags", made, frozen=True, kw_only=True)


_RENDERING = ("effects", "seed", "day", "hour", "interest", "sky", "light_fraction", "bands", "wavelengths")
_Every: Any = _flags(name for name in _DECLARED if name not in TABLES or name in IN_TABLES)
_OfRendering: Any = _flags(_RENDERING)
_OfSimulation: Any = _flags((*_RENDERING, "tol", "size", "exposure_ms", "workers"))


@Parameter(name="*")
class SurveyFlags(_Every):  # type: ignore[misc]
    """Flags of all settings of a survey."""


@Parameter(name="*")
class RenderingFlags(_OfRendering):  # type: ignore[misc]
    """Flags of the simulated rig and its light."""


@Parameter(name="*")
class SimulationFlags(_OfSimulation):  # type: ignore[misc]
    """Flags of a simulated scan."""


def by_setting(flags: Any) -> dict[str, object]:
    """Return the values of flags by setting, for `load_settings`."""
    return {IN_TABLES.get(name, name): value for name, value in asdict(flags).items()}


NO_FLAGS = SurveyFlags()
Verbose = Annotated[
    bool, Parameter(name=("--verbose", "-v"), negative="", help="Print all savings, stages and effects.")
]
NO_SIMULATION_FLAGS = SimulationFlags()
NO_RENDERING_FLAGS = RenderingFlags()


def survey(*settings: Path, flags: SurveyFlags = NO_FLAGS, as_json: AsJson = False, verbose: Verbose = False) -> int:
    """Survey a field: capture it in one or two passes, map its classes, and publish a receipt and a report.

    If a survey fails, the next ones still run. The exit code is that of the last failure. With --json several surveys
    are the list `surveys`, with `settings` and `error` of one that failed.

    Parameters
    ----------
    settings
        Settings files (TOML), surveyed one after the other; flags override each. Default: none.
    """
    every = [load_settings(file, by_setting(flags)) for file in settings or (None,)]
    printed: list[dict[str, Any]] = []
    code = 0
    try:
        for number, requested in enumerate(every):
            if len(every) > 1:
                stderr.print(f"survey {number + 1} of {len(every)}: {settings[number]}", markup=False, soft_wrap=True)
            try:
                printed.append(survey_command.run_survey(requested, stderr, verbose=verbose).receipt)
            except NothingToMend as skipped:
                printed.append({"captured": False, "run": skipped.run, "why": str(skipped)})
                stderr.print(f"{skipped}", markup=False, soft_wrap=True)
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
