"""The manifest of simulated effects for people: a table for the terminal, and what it comes to in sentences."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from flows.terminal.figures import DASH, format_seconds
from pipeline.simulator.selection.choice import UNIT_WORDS

WIDE = 100  # characters, from which words fit into the table
COLOURS = {"on": "green", "off": "dim"}
_KEY = (
    "left out: what any stored number would change by at most without the effect [{unit}]; error: by what is done"
    " instead of the exact; measured: the same on the worst lines of the scene."
)
Row = Mapping[str, Any]


def print_effects(effects: Iterable[Row], total: Row, console: Console) -> None:
    """Print a row for every effect that the rig has, what it has none of, and below what all come to.

    On a narrow terminal the words stand below the table.
    """
    rows = list(effects)
    there = [row for row in rows if row["reason"] != "absent"]
    wide = console.width >= WIDE
    table = Table(header_style="dim", box=SIMPLE_HEAD, collapse_padding=True, pad_edge=wide)
    for name in ("effect", "computed", "left out", "error", "measured", "CPU", *(["why"] if wide else [])):
        figure = name in ("left out", "error", "measured", "CPU")
        table.add_column(name, justify="right" if figure else "left", no_wrap=name != "why", overflow="fold")
    for row in there:
        table.add_row(*_figures(row, total), *([escape(_words(row))] if wide else []))
    console.print(table)
    console.print(escape(_KEY.format(unit=UNIT_WORDS[total["unit"]])), style="dim", highlight=False)
    if not wide:
        for row in there:
            console.print(f"[bold]{escape(row['name'])}[/]: {escape(_words(row))}", highlight=False)
    absent = [f"{row['name']} ({row['magnitude']})" for row in rows if row["reason"] == "absent"]
    if absent:
        console.print(f"[bold]Not there[/]: {escape(', '.join(absent))}.", highlight=False)
    for sentence in total_words(total):
        console.print(escape(sentence), highlight=False)


def _figures(row: Row, total: Row) -> list[str]:
    """Name, variant or off, what leaving it out would change, what is changed, measured, seconds."""
    beyond = row["state"] == "off" and total["tolerance"] is not None and not _within(row["bound"], total["tolerance"])
    colour = "yellow" if beyond else COLOURS[row["state"]]
    return [
        escape(row["name"]),
        f"[{colour}]{escape(row['variant'] or 'off')}[/]",
        format_change(row["left_out"], endless=True),
        format_change(row["bound"], endless=True),
        "" if row["measured"] is None else format_change(row["measured"]),
        _cpu(row["cost_s"]),
    ]


def _within(bound: float | None, tolerance: float) -> bool:
    return bound is not None and bound <= tolerance


def _cpu(seconds: float) -> str:
    """Nothing where nothing is spent; never a bare 0."""
    if not seconds:
        return ""
    return "< 0.01 s" if seconds < 0.01 else format_seconds(seconds)


def _words(row: Row) -> str:
    """How large an effect is, and why it is nevertheless there or left out where its figures do not tell."""
    said = {
        "exact": "",
        "needed": "",
        "small": "",
        "unseen": "the scene shows nothing of it: ",
        "spent": "the tolerance is spent where it saves more: ",
        "asked": "asked for: ",
        "unasked": "not asked for: ",
        "always": "always there: ",
    }[row["reason"]]
    magnitude: str = row["magnitude"]
    return said + magnitude.removeprefix(f"{row['name']}: ")


def format_change(value: float | None, *, endless: bool = False) -> str:
    """A change in units of the tolerance; what is not there is a dash, or where ``endless`` has no bound at all."""
    if value is None:
        return "none" if endless else DASH
    return f"{value:.2g}"


def total_words(total: Mapping[str, Any]) -> Sequence[str]:
    """What was asked for and what is left out, against the tolerance, and the seconds that this saves."""
    unit, count = UNIT_WORDS[total["unit"]], total["on"] + total["off"]
    tolerance = "any number of" if total["tolerance"] is None else f"{total['tolerance']:g}"
    words = [f"{total['on']} of {count} effects are computed (asked: {total['asked']}, tolerance {tolerance} {unit})."]
    if total["bound"] is None:
        words.append("What is left out has no bound.")
    else:
        measured = "" if total["measured"] is None else f", measured on the worst lines {total['measured']:.2g}"
        if total["measured"] is not None and total["measured"] > total["bound"]:
            measured += ", more by what arithmetic makes of light with such contrasts"
        words.append(
            f"What is left out or cheapened changes a stored number by at most {total['bound']:.2g} {unit}{measured}."
        )
    exact, cheap = (format_seconds(max(total[name], 0.0)) for name in ("saved_s", "saved_cheap_s"))
    words.append(
        f"That saves about {exact} of CPU for the coarse pass and a scan of everything against all effects in full, "
        f"{cheap} against all as cheap as a tenth of the tolerance lets them be."
    )
    return words
