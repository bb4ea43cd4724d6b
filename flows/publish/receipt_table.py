"""A receipt in tables: those that a survey or a simulation ends with on a terminal, and their rows for pages."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from flows.publish.findings import plot_rows
from flows.publish.receipt import Accuracy, Receipt, Savings
from flows.tasks.scores import SHOWN, SHOWN_WORDS, definitions_differ, false_class_words
from flows.terminal.figures import DASH, format_bytes, format_count, format_percent, format_points, format_seconds
from pipeline.simulator.selection.choice import UNIT_WORDS

COST_LABELS = {
    "capture_s": ("time at the camera", format_seconds),
    "lines": ("lines", format_count),
    "samples": ("samples on the field", format_count),
    "bytes_raw": ("raw data", format_bytes),
    "bytes_stored": ("stored data", format_bytes),
    "tokens": ("tokens of the model", format_count),
    "multiply_adds": ("multiply-adds of the model", format_count),
}


def cost_rows(savings: Savings) -> list[dict[str, Any]]:
    """What was spent against everything, a row each: `Saving` with ``label``, and ``done`` and ``full`` in words."""
    entries: Mapping[str, Any] = savings
    rows = [
        {**entries[name], "label": label, "done": show(entries[name]["done"]), "full": show(entries[name]["full"])}
        for name, (label, show) in COST_LABELS.items()
        if name in entries  # a raster takes no line and no second
    ]
    capture = entries.get("capture_s", {})
    if (before := capture.get("every_line_s")) is not None:
        told = {"full": format_seconds(before), "ratio": capture["done"] / before if before else None}
        rows.insert(1, {**rows[0], **told, "label": "beside every line at full exposure, as before"})
    if "segment_wall_s" in savings:
        done, full = savings["segment_wall_s"]["done"], savings["segment_wall_s"]["full"]
        times = {"done": format_seconds(done), "full": format_seconds(full), "full_is": "measured"}
        rows.append({**times, "label": "time of the model", "ratio": done / full if full else None})
    return rows


def print_table(receipt: Receipt, console: Console) -> None:
    """Print the receipt's three tables to the terminal: savings, accuracy (with labels), stages."""
    table = _table("Savings", "cost", "this survey", "everything", "ratio", "everything is")
    for row in cost_rows(receipt["savings"]):
        table.add_row(row["label"], row["done"], row["full"], format_percent(row["ratio"]), row["full_is"])
    console.print(table)
    if "accuracy" in receipt:
        console.print(_accuracy_table(receipt["accuracy"]))
    if "plots" in receipt:
        table = _table("Plots", "plot", "area", "classes", "confidence")
        for plot in plot_rows(receipt["plots"]):
            table.add_row(*(escape(cell) for cell in plot.values()))
        console.print(table)
    table = _table("Stages", "stage", "state", "wall", "peak memory", "written")
    colours = {"ran": "green", "cached": "cyan", "skipped": "dim", "failed": "bold red"}
    for stage in receipt["stages"]:
        state = f"[{colours[stage['state']]}]{stage['state']}[/]"
        peak, wrote = format_bytes(stage["peak_rss_bytes"]), format_bytes(stage["bytes_out"])
        table.add_row(escape(stage["name"]), state, format_seconds(stage["wall_s"]), peak, wrote)
    console.print(table)


def _table(title: str, *columns: str) -> Table:
    table = Table(title=title, title_justify="left", title_style="bold", header_style="dim", box=SIMPLE_HEAD)
    for number, column in enumerate(columns):
        table.add_column(column, justify="left" if number == 0 else "right", no_wrap=number > 0)
    return table


def _accuracy_table(accuracy: Accuracy) -> Table:
    seats = control_seats(accuracy)
    rows: list[tuple[str, Mapping[str, Any]]] = [
        ("none: the coarse look alone", accuracy["none"]),
        ("this survey", accuracy),
        *((f"{seats} placed by {escape(policy)}", control) for policy, control in accuracy["controls"].items()),
        ("all: detail everywhere", accuracy["all"]),
    ]
    before = definitions_differ([score for _, score in rows])
    table = _table("Accuracy against the truth", "seats", "mIoU", "spread", "overall", *([SHOWN] if before else []))
    for label, score in rows:
        spread = "" if score.get("spread") is None else f"± {format_points(score['spread'])}"
        cells = [format_points(score["miou"]), spread, format_points(score.get("overall_accuracy"))]
        cells += [format_points(score.get("miou_of_shown_classes"))] if before else []
        table.add_row(*([label, *cells] if score is not accuracy else (f"[bold]{cell}[/]" for cell in (label, *cells))))
    table.add_row("gap from none to all closed", format_percent(accuracy["gap_closed"]))
    count = sum(iou is not None for iou in accuracy["per_class_iou"].values())
    words = [f"mIoU: mean over the {count} classes of the truth. Overall: share of pixels that are right."]
    words = [f"{words[0]} {SHOWN_WORDS}" if before else words[0], false_class_words(accuracy)]
    table.caption, table.caption_justify = escape("\n".join(filter(None, words))), "left"
    return table


def control_seats(accuracy: Mapping[str, Any]) -> str:
    """How the controls' seats are called: their share of all, each free of the others."""
    share = accuracy.get("controls_mode", {}).get("share_of_seats")
    return "other seats," if share is None else f"{format_percent(share)} of the seats, free,"


WIDE = 100  # characters, from which words fit into the table
COLOURS = {"on": "green", "off": "dim"}
_KEY = (
    "left out: what any stored number would change by at most without the effect [{unit}]; error: by what is done"
    " instead of the exact; measured: the same on the worst lines of the scene."
)
Row = Mapping[str, Any]


def print_effects(effects: Iterable[Row], total: Row, console: Console) -> None:
    """Print a row for every effect of the rig and what all come to; words stand below a narrow terminal's table."""
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
    console.print(escape(_KEY.format(unit=UNIT_WORDS[total["unit"]])), style="dim")
    if not wide and not total.get("unweighed"):
        for row in there:
            console.print(f"[bold]{escape(row['name'])}[/]: {escape(_words(row))}")
    absent = [f"{row['name']} ({row['magnitude']})" for row in rows if row["reason"] == "absent"]
    if absent:
        console.print(f"[bold]Not there[/]: {escape(', '.join(absent))}.")
    for sentence in total_words(total):
        console.print(escape(sentence))


def _figures(row: Row, total: Row) -> list[str]:
    """Name, variant or off, what leaving it out would change, what is changed, measured, seconds."""
    most, bound = total["tolerance"], row["bound"]
    beyond = row["state"] == "off" and most is not None and (bound is None or bound > most)
    colour = "yellow" if beyond else COLOURS[row["state"]]
    return [
        escape(row["name"]),
        f"[{colour}]{escape(row['variant'] or 'off')}[/]",
        DASH if total.get("unweighed") else format_change(row["left_out"], endless=True),
        format_change(row["bound"], endless=True),
        "" if row["measured"] is None else format_change(row["measured"]),
        "" if not row["cost_s"] else "< 0.01 s" if row["cost_s"] < 0.01 else format_seconds(row["cost_s"]),
    ]


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
        "unweighed": "",
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
    if total.get("unweighed"):
        return [*words[:1], "On a scene so small choosing takes longer than it can save: nothing was looked at."]
    exact, cheap = (format_seconds(max(total[name], 0.0)) for name in ("saved_s", "saved_cheap_s"))
    words.append(
        f"That saves about {exact} of CPU in all sweeps decided on against all effects in full, "
        f"{cheap} against all as cheap as a tenth of the tolerance lets them be."
    )
    return words
