"""A receipt in words: its headline, and the tables that a survey ends with on a terminal."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, cast

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from flows.publish.receipt import Accuracy, Receipt, Saving, Savings, is_pending
from flows.survey.scores import SHOWN, SHOWN_WORDS, definitions_differ, false_class_words, worst_class_words
from flows.terminal.figures import format_bytes, format_count, format_percent, format_points, format_seconds


def headline(receipt: Receipt, looked_twice: float | None = None) -> str:
    """The run in a few sentences that a farmer reads, plain text: how long, how good, and where it is worst.

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
    right = accuracy.get("overall_accuracy")
    pixels = "" if right is None else f" ({format_points(right)} % of its pixels are right)"
    return (
        f"{text} The map scores {format_points(accuracy['miou'])} of 100 against the truth{pixels}; the coarse look "
        f"alone gives {format_points(accuracy['none']['miou'])}{detail}. {worst_class_words(accuracy)}"
    ).rstrip()


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
    rows = score_rows(accuracy)
    before = definitions_differ([score for _, score in rows])
    table = _table("Accuracy against the truth", "seats", "mIoU", "spread", "overall", *([SHOWN] if before else []))
    for label, score in rows:
        spread = "" if score.get("spread") is None else f"± {format_points(score['spread'])}"
        cells = [format_points(score["miou"]), spread, format_points(score.get("overall_accuracy"))]
        cells += [format_points(score.get("miou_of_shown_classes"))] if before else []
        table.add_row(*([label, *cells] if score is not accuracy else (f"[bold]{cell}[/]" for cell in (label, *cells))))
    table.add_row("gap from none to all closed", format_percent(accuracy["gap_closed"]))
    words = [score_words(accuracy, before=before), false_class_words(accuracy)]
    table.caption, table.caption_justify = escape("\n".join(filter(None, words))), "left"
    return table


def score_rows(accuracy: Accuracy) -> list[tuple[str, Mapping[str, Any]]]:
    """The maps that a receipt has scores of, and what a terminal calls them."""
    seats = control_seats(accuracy)
    return [
        ("none: the coarse look alone", accuracy["none"]),
        ("this survey", accuracy),
        *((f"{seats} placed by {escape(policy)}", control) for policy, control in accuracy["controls"].items()),
        ("all: detail everywhere", accuracy["all"]),
    ]


def score_words(accuracy: Accuracy, *, before: bool) -> str:
    """What the scores are means of, for whoever reads the table; ``before``: it has the definition of before too."""
    count = sum(iou is not None for iou in accuracy["per_class_iou"].values())
    words = f"mIoU: mean over the {count} classes of the truth. Overall: share of pixels that are right."
    return f"{words} {SHOWN_WORDS}" if before else words


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
