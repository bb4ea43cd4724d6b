"""Print the effects of a simulated rig as a table: their error bounds, the seconds saved, and the reason."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.markup import escape

from flows.terminal.figures import DASH, format_seconds
from flows.terminal.progress import table
from pipeline.simulator.selection.choice import UNIT_NAMES

Row = Mapping[str, Any]


def print_effects(effects: Iterable[Row], total: Row, console: Console) -> None:
    """Print a row for every effect that the rig has, with its error bound and the reason for its state; the totals."""
    cells = [
        [
            escape(row["name"]),
            escape(row["variant"] or "off"),
            escape(row["why"] or ""),
            format_change(row["bound"], endless=True),
            format_change(row["measured"]),
        ]
        for row in effects
        if row["reason"] != "absent"
    ]
    columns = ("effect", "computed", "why", "error", "measured")
    console.print(table(columns, cells, left=3, whole=("effect", "computed", "error", "measured")))
    for sentence in format_total(total):
        console.print(escape(sentence))


def format_change(value: float | None, *, endless: bool = False) -> str:
    """Return a change in units of the tolerance; None is a dash, or 'none' where ``endless``: there is no bound."""
    if value is None:
        return "none" if endless else DASH
    return f"{value:.2g}"


def format_total(total: Mapping[str, Any]) -> Sequence[str]:
    """Return sentences on the effects computed, the error bound against the tolerance, and the seconds saved."""
    unit, count = UNIT_NAMES[total["unit"]], total["on"] + total["off"]
    tolerance = "any number of" if total["tolerance"] is None else f"{total['tolerance']:g}"
    words = [f"Effects computed: {total['on']} of {count} (asked: {total['asked']}, tolerance {tolerance} {unit})."]
    if total["bound"] is None:
        words.append("The error of the omitted effects has no bound.")
    else:
        measured = "" if total["measured"] is None else f", measured on the worst lines {total['measured']:.2g}"
        words.append(
            f"Omitted and simplified effects change a stored number by at most {total['bound']:.2g} {unit}{measured}."
        )
    exact = format_seconds(max(total["saved_s"], 0.0))
    words.append(f"Saved processor time against all effects in full: about {exact}.")
    return words
