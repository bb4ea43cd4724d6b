"""A receipt in words: its headline, and the tables that a survey ends with on a terminal."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, cast

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from flows.figures import format_bytes, format_count, format_percent, format_points, format_seconds
from flows.receipt import Accuracy, Receipt, Saving, Savings, is_pending


def headline(receipt: Receipt, looked_twice: float | None = None) -> str:
    """The run in one to three sentences that a farmer reads, plain text.

    ``looked_twice`` is the share of the field that was captured in detail, 0..1; None leaves it out.
    """
    capture = receipt["savings"]["capture_s"]
    if looked_twice == 0:
        twice = "The camera looked twice at nothing: no run of fine lines fits into the time left, or is worth it. "
    else:
        twice = (
            "" if looked_twice is None else f"The camera looked twice at {format_percent(looked_twice)} of the field. "
        )
    text = (
        f"{twice}Capture took {format_seconds(capture['done'])} instead of {format_seconds(capture['full'])} "
        f"for a scan of everything ({format_percent(capture['ratio'])})."
    )
    accuracy = receipt.get("accuracy")
    if accuracy is None:
        return f"{text} The map is not judged yet: its accuracy is added once it is." if is_pending(receipt) else text
    every = accuracy["all"]["miou"]
    detail = "" if every is None else f", detail everywhere {format_points(every)}"
    return (
        f"{text} The map scores {format_points(accuracy['miou'])} of 100 against the truth; the coarse look alone "
        f"gives {format_points(accuracy['none']['miou'])}{detail}."
    )


COST_LABELS = {
    "capture_s": ("time at the camera", format_seconds),
    "lines": ("lines", format_count),
    "samples": ("samples on the field", format_count),
    "bytes_raw": ("raw data", format_bytes),
    "bytes_stored": ("stored data", format_bytes),
    "tokens": ("tokens of the model", format_count),
    "multiply_adds": ("multiply-adds of the model", format_count),
}


def print_table(receipt: Receipt, console: Console) -> None:
    """Print the receipt's three tables to the terminal: savings, accuracy (with labels), stages."""
    console.print(_savings_table(receipt["savings"]))
    if "accuracy" in receipt:
        console.print(_accuracy_table(receipt["accuracy"]))
    console.print(_stages_table(receipt["stages"]))


def _table(title: str, *columns: str) -> Table:
    """A table whose first column is text and whose others are figures."""
    table = Table(title=title, title_justify="left", title_style="bold", header_style="dim", box=SIMPLE_HEAD)
    for number, column in enumerate(columns):
        table.add_column(column, justify="left" if number == 0 else "right", no_wrap=number > 0)
    return table


def _savings_table(savings: Savings) -> Table:
    table = _table("Savings", "cost", "this survey", "everything", "ratio", "everything is")
    for name, (label, show) in COST_LABELS.items():
        entry = cast("Saving", savings[name])  # type: ignore[literal-required]
        table.add_row(label, show(entry["done"]), show(entry["full"]), format_percent(entry["ratio"]), entry["full_is"])
    if "segment_wall_s" in savings:
        done, full = savings["segment_wall_s"]["done"], savings["segment_wall_s"]["full"]
        ratio = format_percent(done / full) if full else "-"
        table.add_row("time of the model", format_seconds(done), format_seconds(full), ratio, "measured")
    return table


def _accuracy_table(accuracy: Accuracy) -> Table:
    table = _table("Accuracy against the truth", "seats", "mIoU", "spread")
    table.add_row("none: the coarse look alone", format_points(accuracy["none"]["miou"]), "")
    table.add_row("[bold]this survey[/bold]", f"[bold]{format_points(accuracy['miou'])}[/bold]", "")
    for policy, control in accuracy["controls"].items():
        spread = "" if control["spread"] is None else f"± {format_points(control['spread'])}"
        table.add_row(f"{control_seats(accuracy)} placed by {escape(policy)}", format_points(control["miou"]), spread)
    table.add_row("all: detail everywhere", format_points(accuracy["all"]["miou"]), "")
    table.add_row("gap from none to all closed", format_percent(accuracy["gap_closed"]), "")
    return table


def control_seats(accuracy: Mapping[str, Any]) -> str:
    """How the controls' seats are called: their share of all, each free of the others."""
    share = accuracy.get("controls_mode", {}).get("share_of_seats")
    return "other seats," if share is None else f"{format_percent(share)} of the seats, free,"


def _stages_table(stages: Iterable[Mapping[str, Any]]) -> Table:
    table = _table("Stages", "stage", "state", "wall", "peak memory", "written")
    colours = {"ran": "green", "cached": "cyan", "skipped": "dim", "failed": "bold red"}
    for stage in stages:
        state = f"[{colours[stage['state']]}]{stage['state']}[/]"
        peak, wrote = format_bytes(stage["peak_rss_bytes"]), format_bytes(stage["bytes_out"])
        table.add_row(escape(stage["name"]), state, format_seconds(stage["wall_s"]), peak, wrote)
    return table
