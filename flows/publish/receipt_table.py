"""A receipt in words: headline and findings, and the tables that a survey or a simulation ends with on a terminal."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from flows.publish.ground_findings import ground_words
from flows.publish.receipt import Accuracy, Receipt, Savings, is_pending
from flows.publish.zone_findings import plot_rows, zone_words
from flows.survey.scores import SHOWN, SHOWN_WORDS, definitions_differ, false_class_words, worst_class_words
from flows.terminal.figures import (
    DASH,
    area_words,
    format_bytes,
    format_count,
    format_metres,
    format_percent,
    format_points,
    format_seconds,
    three_digits,
)
from pipeline.ground.field_scale import SECONDS_PER_HOUR
from pipeline.planning.plain_scans import scan_words
from pipeline.simulator.selection.choice import UNIT_WORDS


def headline(receipt: Receipt, looked_twice: float | None = None) -> str:
    """The run in a few sentences that a farmer reads, plain text: how long, how good, and where it is worst.

    ``looked_twice`` is the share of the field that was captured in detail, 0..1; None leaves it out.
    """
    capture, plain = receipt["savings"]["capture_s"], receipt.get("plan", {}).get("kind") == "scan"
    if looked_twice == 0:
        twice = "The camera looked twice at nothing: no run of fine lines fits into the time left, or is worth it. "
    else:
        twice = (
            "" if looked_twice is None else f"The camera looked twice at {format_percent(looked_twice)} of the field. "
        )
    everything = (
        f"every line of {receipt['settings']['camera']['exposure_ms']:g} ms" if plain else "a scan of everything"
    )
    text = (
        f"{twice}Capture took {format_seconds(capture['done'])} instead of {format_seconds(capture['full'])} "
        f"for {everything} ({format_percent(capture['ratio'])})."
    )
    accuracy = receipt.get("accuracy")
    if accuracy is None:
        return f"{text} The map is not judged yet: its accuracy is added once it is." if is_pending(receipt) else text
    every = None if plain else accuracy["all"]["miou"]
    coarse = "" if plain else f"; the coarse look alone gives {format_points(accuracy['none']['miou'])}"
    detail = "" if every is None else f", detail everywhere {format_points(every)}"
    right = accuracy.get("overall_accuracy")
    pixels = "" if right is None else f" ({format_points(right)} % of its pixels are right)"
    return (
        f"{text} The map scores {format_points(accuracy['miou'])} of 100 against the truth{pixels}{coarse}"
        f"{detail}. {worst_class_words(accuracy, alone=plain)}"
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


def cost_rows(savings: Savings) -> list[dict[str, Any]]:
    """What was spent against everything, a row each: `Saving` with ``label``, and ``done`` and ``full`` in words."""
    entries: Mapping[str, Any] = savings
    rows = [
        {**entries[name], "label": label, "done": show(entries[name]["done"]), "full": show(entries[name]["full"])}
        for name, (label, show) in COST_LABELS.items()
    ]
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


def sentences(found: Mapping[str, Any]) -> list[str]:
    """The findings in words, for the terminal and the report."""
    words = []
    if field := found.get("field"):
        words.append(_field_words(field))
    if plan := found.get("plan"):
        if plan["kind"] in ("full", "scan") and plan["reason"]:
            words.append(_sentence(plan["reason"]))
        if plan["out_of_reach"]:
            words.append(f"{plan['out_of_reach']} places worth a second look lie beyond the mirror's range.")
        if plan.get("spared_s"):
            share = f" ({format_percent(plan['spared_share'])} of the full scan's)" if plan["spared_share"] else ""
            words.append(
                f"The threshold of {plan['threshold']:g} a second left {plan['spared_s']:.1f} s{share} unspent: no "
                f"further run of lines pays."
            )
        if plan["lines"]:
            words.append(_sentence(plan["orientation"]["sentence"]))
    if look := found.get("look"):
        words.append(_look_words(look))
    if memory := found.get("memory"):
        words.append(_memory_words(memory))
    if unknown := found.get("unknown"):
        words.append(_unknown_words(unknown, found.get("accuracy")))
    if scans := found.get("scans"):
        words.append(_scans_words(scans))
    for name, one in found.get("pointing", {}).items():
        if isinstance(one, Mapping) and (told := _pointing_words(name, one)):
            words.append(told)
    for sweep, facts in found.get("lines", {}).items():
        told = ", ".join(f"{count} {what}" for what, count in facts.items() if count)
        words.append(f"Sweep {sweep}: lines {told}; what they would have shown is left out.")
    if "zones" in found:
        words.append(zone_words(found["zones"]))
    if "ground" in found:
        words.append(ground_words(found["ground"]))
    return words


def _field_words(field: Mapping[str, Any]) -> str:
    """How large the field is and how finely it was seen; in metres and hectares where something says how large."""
    across, down = field["view_deg"]
    view = f"The field is {across:.3g} x {down:.3g} degrees of the view"
    if field["ground_pixel_m"] is None:
        return f"{view}."
    away = "" if field["range_m"] is None else f", {format_metres(field['range_m']['median'])} away in the middle"
    pace = field["hectares_per_hour"]
    return (
        f"{view}{away}: {area_words(field['hectares'])} at {format_metres(field['ground_pixel_m'])} a pixel, "
        f"{three_digits(pace)} ha an hour of the camera ({three_digits(SECONDS_PER_HOUR / pace)} s a hectare)."
    )


FOREIGN = 0.2  # share of a map that is unknown from which on its weights are the wrong ones


def _unknown_words(unknown: Mapping[str, Any], accuracy: Mapping[str, Any] | None) -> str:
    """How much of a map is unlike what the weights were trained on, and what to do about much of it."""
    text = (
        f"{format_percent(unknown['share'])} of the map is unknown, unlike all that the weights were trained on; of "
        f"what they know it would be about {format_percent(unknown['rate'])}."
    )
    if accuracy and accuracy.get("unknown_px"):
        text += f" {format_count(accuracy['unknown_px'])} such pixels have a label and count as wrong."
    if unknown["share"] > FOREIGN:
        text += (
            " These weights do not know this field: train some on labelled scenes of it"
            " (spectralzoom train DATASET), or leave the class out with --unknown off."
        )
    return text


def _look_words(look: Mapping[str, Any]) -> str:
    """Which part of a remembered field was looked at, and why."""
    seen = format_percent(look["share"])
    rest = "the rest is as remembered" if look["remembers"] else "of the rest nothing is known"
    text = f"Lines {look['lines']} were looked at, {seen} of the field; {rest}."
    if "expected_gain" in look:
        wrong = format_percent(look["expected_wrong"])
        text += f" There most was to be mended: about {wrong} of what is remembered was expected to be wrong."
    if look.get("due_left"):
        text += f" {format_count(look['due_left'])} of {format_count(look['due'])} seats that were due had to wait."
    return text


MOST_CHANGES = 4  # told in words


def _memory_words(memory: Mapping[str, Any]) -> str:
    """What became of the memory that the map goes on from."""
    since = f"{memory['run']}, {days_words(memory['days'])}"
    alike = "nothing" if memory["agreement"] is None else format_percent(memory["agreement"])
    if memory["put_aside"] == "turned":
        return (
            f"What {since}, left was put aside: the rig was turned since, by {abs(memory['turned_deg']):.1f} degrees."
        )
    if memory["put_aside"]:
        return (
            f"What {since}, left was put aside: today's look shows {alike} of the field as it is remembered, as of "
            f"another field, or a rig that was moved."
        )
    share = format_percent(memory["changed_px"] / memory["compared_px"]) if memory["compared_px"] else "nothing"
    most = [f"{old.replace('_', ' ')} to {new.replace('_', ' ')}" for _, old, new in memory["changes"][:MOST_CHANGES]]
    what = f": {', '.join(most)}" if most else ""
    beside = float(np.hypot(*memory["shift_px"]))
    since += f", which lay {beside:.0f} px beside it" if beside else ""
    return f"The map goes on from {since}: today's look agrees with {alike} of it, and {share} changed{what}."


def days_words(days: float) -> str:
    """How long ago a look was."""
    if days < 1:
        return f"{24 * days:.1f} hours earlier"
    return f"{days:.1f} days earlier" if days < 10 else f"{days:.0f} days earlier"


def _scans_words(scans: Mapping[str, Mapping[str, Any]]) -> str:
    """What the weights' record expects of the plain scan that was taken, or would have of one in the same seconds."""

    def told(scan: Mapping[str, Any]) -> str:
        return f"{scan_words(scan['step'], scan['exposure_ms'])}, {scan['seconds']:.1f} s"

    def points(scan: Mapping[str, Any]) -> str:
        spread = scan.get("expected_spread")
        return format_points(scan["expected_miou"]) + ("" if spread is None else f" ± {format_points(spread)}")

    words, taken, best, reference = [], *(scans.get(name) for name in ("taken", "best_in_time", "reference"))
    if taken is not None:
        words.append(f"By the weights' record such a scan scores about {points(taken)}.")
    elif best is not None:
        words.append(
            f"One plain scan in the same seconds ({told(best)}) scores about {points(best)} by the weights' record."
        )
    if reference is not None:
        words.append(
            f"The cheapest that is nearly as good as any ({told(reference)}) scores about {points(reference)}."
        )
    return " ".join(words)


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:] + ("" if text.endswith(".") else ".")


def _pointing_words(name: str, one: Mapping[str, Any]) -> str:
    put = [float(np.hypot(*offset)) for sweep, offset in one["sweeps"].items() if sweep not in one["not_found"]]
    left, text = one["residual_rms_px"], ""
    if len(one["sweeps"]) == 1 and one["held"] in one["sweeps"]:
        text = f"The {name} pass is one sweep, which has no seam to be put right by."
    elif put:
        rest = "" if left is None else f"; {left:.2f} px rms are left at the seams"
        text = f"The {name} sweeps were put right by up to {max(put):.1f} px{rest}."
    if one["not_found"]:
        text += f" Nothing could be told of {', '.join(one['not_found'])}: left where the mirror reported."
    if one["too_narrow"]:
        text += f" {len(one['too_narrow'])} overlaps were too narrow to compare."
    if one.get("partly_seen"):
        text += (
            f" {one['partly_seen']} chosen places were not seen whole; what is missing of them is mapped by the coarse "
            f"look."
        )
    return text.strip()


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
    if not wide:
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
        format_change(row["left_out"], endless=True),
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
