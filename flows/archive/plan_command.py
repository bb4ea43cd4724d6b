"""What `spectralzoom plan` shows: stage by stage what a survey would do, why, and about how long it would take."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from flows.archive.forecast import StageForecast, forecast
from flows.settings.survey_settings import Settings
from flows.terminal.figures import format_bytes, format_seconds
from flows.terminal.shown_text import on_stdout
from storage.archive.whole_files import to_json

MOST_LETTERS = 250  # of a reason
COLOURS = {"cached": "green", "to run": "bold", "blocked": "yellow", "skipped": "dim"}


def run_plan(settings: Settings, *, as_json: bool = False) -> int:
    """Tell on stdout what a survey of these settings would run; nothing is run or written."""
    content = plan_content(settings)
    if as_json:
        sys.stdout.write(to_json(content))
    else:
        show_plan(content, on_stdout())
    return 0


def plan_content(settings: Settings) -> dict[str, Any]:
    """The forecast as plain tables, with sums of what is known (``estimated`` of ``to_make`` stages).

    ``refused`` says why this machine would not begin the survey; None where it would.
    """
    found = forecast(settings)
    rows = found.stages
    ahead = [row for row in rows if row.state in ("to run", "blocked")]
    return {
        "archive": settings.out,
        "stages": [_row(row) for row in rows],
        "to_make": len(ahead),
        "estimated": sum(row.seconds is not None for row in ahead),
        "seconds": _sum(ahead, "seconds"),
        "bytes": _sum(ahead, "size"),
        "refused": found.refused,
    }


def _row(row: StageForecast) -> dict[str, Any]:
    return {"bytes" if name == "size" else name: value for name, value in asdict(row).items()}


def _sum(rows: Sequence[StageForecast], name: str) -> float | None:
    """Sum of what is known; None where there are rows and nothing is known of any."""
    known = [getattr(row, name) for row in rows if getattr(row, name) is not None]
    return sum(known) if known or not rows else None


def show_plan(content: dict[str, Any], console: Console) -> None:
    """Print the forecast as a table."""
    table = Table(header_style="dim", box=SIMPLE_HEAD, collapse_padding=True)
    for name in ("stage", "state", "why"):
        table.add_column(name, overflow="fold", no_wrap=name != "why")
    for name in ("about", "size"):
        table.add_column(name, justify="right", no_wrap=True)
    for row in content["stages"]:
        ahead = row["state"] in ("to run", "blocked")
        figures = (format_seconds(row["seconds"]), format_bytes(row["bytes"])) if ahead else ("", "")
        state = f"[{COLOURS[row['state']]}]{row['state']}[/]"
        table.add_row(row["stage"], state, escape(_short(row["why"])), *figures)
    console.print(table)
    console.print(escape(_sentence(content)), highlight=False, soft_wrap=True)
    if content["refused"] is not None:
        console.print(f"[yellow]refused here[/]: {escape(content['refused'])}", highlight=False, soft_wrap=True)


def _sentence(content: dict[str, Any]) -> str:
    count, known = content["to_make"], content["estimated"]
    if not count:
        return "everything is stored: the survey would only publish a run"
    if not known:
        return f"{count} stages to make; the archive has no record of what such stages took"
    about = f"about {format_seconds(content['seconds'])} and {format_bytes(content['bytes'])}"
    rest = "" if known == count else f" without {count - known} stages of which there is no record"
    return f"{count} stages to make, {about} by the archive's own records{rest}"


def _short(text: str) -> str:
    return text if len(text) <= MOST_LETTERS else f"{text[: MOST_LETTERS - 3]}..."
