"""The verb `survey`: surveys by settings files and flags, one after the other."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter
from rich.markup import escape

from spectralzoom.flows.settings.flags import NO_FLAGS, AsJson, HelpAll, SurveyFlags, by_setting, print_every_flag
from spectralzoom.flows.settings.settings import Settings, load_settings
from spectralzoom.flows.terminal.processes import format_failure
from spectralzoom.flows.terminal.progress import print_json, say, stderr, table
from spectralzoom.pipeline.errors import SurveyStopped

Verbose = Annotated[
    bool, Parameter(name=("--verbose", "-v"), negative="", help="Print all savings, stages and effects.")
]


def survey(
    *settings: Path,
    flags: SurveyFlags = NO_FLAGS,
    as_json: AsJson = False,
    verbose: Verbose = False,
    help_all: HelpAll = False,
) -> int:
    """Survey a field: capture it in one or two passes, map its classes, and publish a receipt and a report.

    If a survey fails, the next ones still run. The exit code is that of the last failure. With --json several surveys
    are the list `surveys`, with `settings` and `error` of one that failed. A folder or a pattern as --scene, such as
    "tiles/*.tif", is one run for each scene, and a table of all at the end.

    Parameters
    ----------
    settings
        Settings files (TOML), surveyed one after the other; flags override each. Default: none.
    """
    if help_all:
        return print_every_flag()
    from spectralzoom.flows.cli.tiles import COLUMNS, tiles_of  # numpy and readers take a second
    from spectralzoom.flows.opening.recorded_field import usual_of_recording

    files = settings or (None,)
    loaded = [(str(file), load_settings(file, by_setting(flags), usual=usual_of_recording)) for file in files]
    every = [(name, tile) for name, one in loaded for tile in tiles_of(one)]
    tiled = len(every) > len(files)
    ends: list[End] = []
    try:
        for number, (file, requested) in enumerate(every, 1):
            name = requested.scene if tiled else file
            if len(every) > 1:
                stderr.print(f"survey {number} of {len(every)}: {name}", markup=False, soft_wrap=True)
            ends.append(_survey_one(name, requested, alone=len(every) == 1, tiled=tiled, verbose=verbose))
        if tiled:
            stderr.print(table(COLUMNS, [list(map(escape, end.row)) for end in ends], left=2, whole=COLUMNS[2:3]))
    finally:  # also after Ctrl-C
        if as_json and ends:
            print_json(ends[0].content if len(every) == 1 else {"surveys": [end.content for end in ends]})
    return next((end.code for end in reversed(ends) if end.code), 0)


@dataclass(frozen=True)
class End:
    """Outcome of one survey of several: content for JSON, row of the table of tiles, exit code."""

    content: Mapping[str, Any]
    row: Sequence[str]
    code: int = 0


def _survey_one(name: str, requested: Settings, *, alone: bool, tiled: bool, verbose: bool) -> End:
    """Run one survey; an error is printed, and raised if the survey is alone."""
    from spectralzoom.flows.cli.tiles import tile_row
    from spectralzoom.flows.survey_command import run_survey

    started = time.perf_counter()
    try:
        published = run_survey(requested, stderr, verbose=verbose, summary=not tiled)
        row = tile_row(name, published, time.perf_counter() - started) if tiled else []
        return End(published.receipt, row)
    except SurveyStopped as stopped:
        stderr.print(f"{stopped}", markup=False, soft_wrap=True)
        content = {"until": stopped.until, "stored": stopped.uri, "archive": stopped.archive}
        return End(content, [name, f"stopped after {stopped.until}", "", stopped.uri])
    except Exception as error:
        if alone or isinstance(error, BrokenPipeError):
            raise
        message, code = format_failure(error)
        say(f"{name}: {message}")
        return End({"settings": name, "error": message}, [name, "failed", "", message], code)
