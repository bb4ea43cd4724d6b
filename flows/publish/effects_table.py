"""Print the effects of a simulated rig as a table: their error bounds, the seconds saved, and the reason."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.markup import escape

from flows.terminal.figures import format_seconds
from flows.terminal.progress import table
from pipeline.simulator.selection.choice import UNIT_NAMES

COLOURS = {"on": "green", "off": "dim"}
_KEY = "left out: largest change of a stored number without the effect [{unit}]; error: that by the chosen variant."
Row = Mapping[str, Any]


def print_effects(effects: Iterable[Row], total: Row, console: Console) -> None:
    """Print a row for every effect of the rig, their magnitudes and reasons, and the totals."""
    rows = list(effects)
    there = [row for row in rows if row["reason"] != "absent"]
    columns = ("effect", "computed", "left out", "error", "CPU")
    console.print(table(columns, (_figures(row, total) for row in there), left=2, whole=columns))
    console.print(escape(_KEY.format(unit=UNIT_NAMES[total["unit"]])), style="dim")
    for row in there:
        console.print(f"[bold]{escape(row['name'])}[/]: {escape(format_row(row))}")
    absent = [f"{row['name']} ({row['magnitude']})" for row in rows if row["reason"] == "absent"]
    if absent:
        console.print(f"[bold]Absent[/]: {escape(', '.join(absent))}.")
    for sentence in format_total(total):
        console.print(escape(sentence))


def _figures(row: Row, total: Row) -> list[str]:
    """Return the cells of a row: name, variant, change without it, error bound, seconds."""
    most, bound = total["tolerance"], row["bound"]
    beyond = row["state"] == "off" and most is not None and (bound is None or bound > most)
    colour = "yellow" if beyond else COLOURS[row["state"]]
    return [
        escape(row["name"]),
        f"[{colour}]{escape(row['variant'] or 'off')}[/]",
        format_change(row["left_out"]),
        format_change(row["bound"]),
        "" if not row["cost_s"] else "< 0.01 s" if row["cost_s"] < 0.01 else format_seconds(row["cost_s"]),
    ]


def format_row(row: Row) -> str:
    """Return the magnitude of an effect, and the reason for its state where its figures do not give it."""
    said = {
        "exact": "",
        "needed": "",
        "small": "",
        "unseen": "not visible in the scene: ",
        "spent": "tolerance used for effects that save more: ",
        "asked": "asked for: ",
        "unasked": "not asked for: ",
        "always": "always there: ",
        "absent": "absent: ",
    }[row["reason"]]
    magnitude: str = row["magnitude"]
    return said + magnitude.removeprefix(f"{row['name']}: ")


def format_change(value: float | None) -> str:
    """Return a change in units of the tolerance; None, a change without a bound, is 'none'."""
    return "none" if value is None else f"{value:.2g}"


def format_total(total: Mapping[str, Any]) -> Sequence[str]:
    """Return sentences on the effects computed, the error bound against the tolerance, and the seconds saved."""
    unit, count = UNIT_NAMES[total["unit"]], total["on"] + total["off"]
    tolerance = "any number of" if total["tolerance"] is None else f"{total['tolerance']:g}"
    words = [f"Effects computed: {total['on']} of {count} (asked: {total['asked']}, tolerance {tolerance} {unit})."]
    if total["bound"] is None:
        words.append("The error of the omitted effects has no bound.")
    else:
        words.append(f"Omitted and simplified effects change a stored number by at most {total['bound']:.2g} {unit}.")
    exact = format_seconds(max(total["saved_s"], 0.0))
    words.append(f"Saved processor time against all effects in full: about {exact}.")
    return words
