"""The manifest of simulated effects for people: a table for the terminal, and what it comes to in sentences."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from flows.figures import DASH, format_seconds
from pipeline.simulator.manifest import UNIT_WORDS

COLOURS = {"on": "green", "off": "dim"}


def print_effects(effects: Iterable[Mapping[str, Any]], total: Mapping[str, Any], console: Console) -> None:
    """Print a row for every effect, and below what all come to."""
    table = Table(header_style="dim", box=SIMPLE_HEAD, collapse_padding=True)
    for name in ("effect", "state", "variant", "bound", "measured", "CPU", "why"):
        figure = name in ("bound", "measured", "CPU")
        table.add_column(name, justify="right" if figure else "left", no_wrap=name != "why", overflow="fold")
    for effect in effects:
        colour = COLOURS[effect["state"]]
        table.add_row(
            escape(effect["name"]), f"[{colour}]{effect['state']}[/]", escape(effect["variant"] or ""),
            format_change(effect["bound"], endless=True), format_change(effect["measured"]),
            format_seconds(effect["cost_s"]) if effect["cost_s"] else "", escape(effect["why"]),
        )  # fmt: skip
    console.print(table)
    for sentence in total_words(total):
        console.print(escape(sentence), highlight=False)


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
        measured = "" if total["measured"] is None else f", measured on the worst chips {total['measured']:.2g}"
        words.append(
            f"What is left out or cheapened changes a number by at most {total['bound']:.2g} {unit}{measured}."
        )
    exact, cheap = (format_seconds(max(total[name], 0.0)) for name in ("saved_s", "saved_cheap_s"))
    words.append(
        f"That saves about {exact} of CPU for the coarse pass and a scan of everything against all effects in full, "
        f"{cheap} against all as cheap as a tenth of the tolerance lets them be."
    )
    return words
