"""Format a receipt for people: the savings as a table, the score, and the findings, one row for each part."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape

from flows.publish.receipt import Receipt
from flows.tasks.scene import TRAINING_SCENE
from flows.tasks.scores import format_prediction, format_worst_class
from flows.terminal.figures import (
    counted,
    format_area,
    format_bytes,
    format_count,
    format_metres,
    format_percent,
    format_points,
    format_seconds,
    spaced,
    three_digits,
)
from flows.terminal.progress import table
from pipeline.ground.field_places import M2_PER_HECTARE
from pipeline.planning.uniform_scans import format_scan
from pipeline.simulator.selection.choice import UNIT_NAMES

COST_LABELS: Mapping[str, tuple[str, Callable[[float | None], str]]] = {
    "capture_s": ("capture time", format_seconds),
    "multiply_adds": ("multiply-adds", format_count),
    "lines": ("lines", format_count),
    "samples": ("samples on the field", format_count),
    "patches": ("patches read in full", format_count),
}
BYTE_LABELS = {"kept": "bytes kept", "captured": "bytes captured", "written": "bytes written"}
LEADING = ("capture time", "bytes kept", "multiply-adds")  # of the rows, those printed at the end of a survey
LEAST_REFERENCE = 100_000  # bytes; with a smaller reference, rows are not in MB
SMALL_RUN = 2_000_000  # bytes kept, most of which do not depend on the field
MOST_NAMED = 4  # changes of class in a row
LEAST_LOSS = 0.0005  # of expected mIoU, below which it rounds to 0.0 points
FOREIGN = 0.2  # fraction of patches unlike the training data above which the weights do not fit the field
FOREIGN_WORDS = "These weights do not know this field: train some on labelled scenes of it (spectralzoom train DATASET)"


def saving_rows(receipt: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return costs and bytes of a run against the reference, one row each, with formatted figures.

    A raster has no capture. Bytes are in MB, so that rows compare, unless the reference is smaller than a tenth of one.
    """
    rows = [
        {"label": label, "done": show(one["done"]), "full": show(one["full"]), "ratio": one["ratio"]}
        for name, (label, show) in COST_LABELS.items()
        if (one := receipt["savings"].get(name)) is not None
    ]
    full = receipt["data_bytes"]["reference"]
    show_bytes = format_bytes if full < LEAST_REFERENCE else lambda size: f"{three_digits(size / 1e6)} MB"
    for name, label in BYTE_LABELS.items():
        done = receipt["data_bytes"][name]
        ratio = done / full if full else None
        rows.append({"label": label, "done": show_bytes(done), "full": show_bytes(full), "ratio": ratio})
    return sorted(rows, key=lambda row: LEADING.index(row["label"]) if row["label"] in LEADING else len(LEADING))


def format_reference(receipt: Mapping[str, Any]) -> str:
    """Return a sentence on the reference, and on the cheapest good uniform scan where the weights have a record.

    With the points that the scan taken is expected to lose, and the reason why a small field keeps many bytes.
    """
    capture = receipt["savings"].get("capture_s", {})
    lines = f"line at {receipt['settings']['camera']['exposure_ms']:g} ms, stored as captured" if capture else "pixel"
    words = f"Reference: every {lines}, read by the full network."
    if receipt["data_bytes"]["reference"] < receipt["data_bytes"]["kept"] < SMALL_RUN:
        words += " Bytes kept exceed it: records of the stores take 0.2 MB or more, however small the field is."
    names = [stage["name"] for stage in receipt["stages"]]
    if "capture_fine" in names:
        between = receipt["stages"][names.index("capture_coarse") + 1 : names.index("capture_fine")]
        times = [stage["wall_s"] for stage in between]
        if times and None not in times:  # stages that were stored before have none
            words += f" The decision between the passes took {format_seconds(sum(times))}, beside the capture time."
    if capture.get("uniform") is None:
        return words
    scan = f"{format_seconds(capture['uniform'])} ({capture['uniform_scan']})"
    words += f" A uniform scan with nearly the best score takes {scan}."
    taken = receipt.get("scans", {}).get("taken")
    if taken and not is_foreign(receipt) and format_prediction(taken["expected_miou"], taken.get("expected_spread")):
        lost = receipt["scans"]["reference"]["expected_miou"] - taken["expected_miou"]
        words += f" This survey is expected to score {format_points(lost)} points less." if lost >= LEAST_LOSS else ""
    return words


def format_score(receipt: Mapping[str, Any]) -> str:
    """Return the score of the map in one or two sentences: against labels, else as its own probabilities expect."""
    if (accuracy := shown_accuracy(receipt)) is not None:
        scene = f" on {TRAINING_SCENE[receipt['training_scene']]}" if "training_scene" in receipt else ""
        right = format_points(accuracy.get("overall_accuracy"))
        score = f"mIoU {format_points(accuracy['miou'])} of 100 against the labels{scene} ({right} % of pixels correct)"
        plan = receipt.get("plan", {})
        alone = accuracy.get("none") is None or (plan.get("kind") in ("scan", "raster") and "kept" not in receipt)
        full = "" if alone else f"; the full network on every patch gives {format_points(accuracy['all']['miou'])}"
        return f"{score}{full}. {format_worst_class(accuracy, alone=alone)}".rstrip()
    if is_foreign(receipt):
        unlike = format_percent(receipt["unlike"]["fraction"])
        return f"{unlike} of the field is unlike the training data. {FOREIGN_WORDS}."
    expected = receipt.get("expected") or {}
    if predicted := format_prediction(expected.get("miou"), expected.get("error")):
        return f"Expected mIoU {predicted} of 100, estimated from the map's own probabilities."
    if receipt["settings"].get("accuracy") is False:
        return "The accuracy was left out; the same survey with --accuracy adds it in a new run."
    return "The score is not known: there are no labels."


def shown_accuracy(receipt: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """Return the accuracy; after a revisit without the maps to compare, which lack the prior map."""
    accuracy = receipt.get("accuracy")
    if accuracy is None or receipt.get("prior_map") is None:
        return accuracy
    return {name: value for name, value in accuracy.items() if name not in ("none", "all")}


def headline(receipt: Receipt, captured_again: float | None = None) -> str:
    """Return the score, the capture time and the fraction of the field captured again, as plain sentences.

    ``captured_again`` is the fraction of the field that was captured again, 0..1; None leaves it out.
    """
    sentences = [format_score(receipt)]
    if (capture := receipt["savings"].get("capture_s")) is not None:
        done, full = (format_seconds(capture[name]) for name in ("done", "full"))
        sentences.append(f"Capture time: {done} ({format_percent(capture['ratio'])} of the reference, {full}).")
    if captured_again is not None:
        sentences.append(f"Captured again: {format_percent(captured_again)} of the field.")
    return " ".join(sentences)


def print_summary(receipt: Receipt, console: Console, *, verbose: bool = False) -> None:
    """Print the score, the leading savings and their reference, saturation, lost lines, and the state of a prior map.

    With ``verbose`` print all savings, the stages that ran or were read from the archive, and the effects.
    """
    console.print(escape(format_score(receipt)))
    rows = [row for row in saving_rows(receipt) if verbose or row["label"] in LEADING]
    cells = [[row["label"], row["done"], row["full"], format_percent(row["ratio"])] for row in rows]
    columns = ("", "this survey", "reference", "fraction")
    console.print(table(columns, cells, whole=columns[1:]))
    console.print(escape(format_reference(receipt)))
    shown = {part: receipt[part] for part in ("signal", "lines", "prior_map") if receipt.get(part)}
    for name, words in finding_rows(shown):
        if verbose or name != COMPARISON:
            console.print(escape(f"{name}: {words}"), soft_wrap=True)  # numbers have spaces
    if not verbose:
        return
    stages = [
        [escape(one["name"]), one["state"], format_seconds(one["wall_s"]), format_bytes(one["bytes_out"])]
        for one in receipt["stages"]
    ]
    console.print(table(("stage", "state", "wall time", "written"), stages, left=2))
    if "effects_total" in receipt:
        print_effects(receipt["effects"], receipt["effects_total"], console)


def print_effects(effects: Iterable[Mapping[str, Any]], total: Mapping[str, Any], console: Console) -> None:
    """Print a row for every effect that the rig has, with its error bound and the reason for its state; the totals."""
    cells = [
        [escape(row["name"]), escape(row["variant"] or "off"), escape(format_reason(row)), format_change(row["bound"])]
        for row in effects
        if row["reason"] != "absent"
    ]
    console.print(table(("effect", "computed", "why", "error"), cells, left=3, whole=("effect", "computed", "error")))
    for sentence in format_total(total):
        console.print(escape(sentence))


REASONS = {
    "exact": "",
    "needed": "",
    "small": "",
    "unseen": "not visible in the scene: ",
    "spent": "tolerance used for effects that save more: ",
    "asked": "asked for: ",
    "unasked": "not asked for: ",
    "always": "always there: ",
    "absent": "absent: ",
}


def format_reason(row: Mapping[str, Any]) -> str:
    """Return the magnitude of an effect, and the reason for its state where its figures do not give it."""
    return REASONS[row["reason"]] + str(row["magnitude"]).removeprefix(f"{row['name']}: ")


def format_change(value: float | None) -> str:
    """Return a change in units of the tolerance; None, a change without a bound, is 'none'."""
    return "none" if value is None else f"{value:.2g}"


def format_total(total: Mapping[str, Any]) -> Sequence[str]:
    """Return sentences on the effects computed, the error bound against the tolerance, and the seconds saved."""
    unit = UNIT_NAMES[total["unit"]]
    count = total["on"] + total["off"]
    tolerance = "any number of" if total["tolerance"] is None else f"{total['tolerance']:g}"
    words = [f"Effects computed: {total['on']} of {count} (asked: {total['asked']}, tolerance {tolerance} {unit})."]
    if total["bound"] is None:
        words.append("The error of the omitted effects has no bound.")
    else:
        words.append(f"Omitted and simplified effects change a stored number by at most {total['bound']:.2g} {unit}.")
    exact = format_seconds(max(total["saved_s"], 0.0))
    words.append(f"Saved processor time against all effects in full: about {exact}.")
    return words


def is_foreign(found: Mapping[str, Any]) -> bool:
    """Return whether so much of the field is unlike the training data that the weights do not fit it."""
    return ((found.get("unlike") or {}).get("fraction") or 0.0) > FOREIGN


def finding_rows(found: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the findings of a receipt as rows of a table: label, and figures with their names.

    Zeros and what is empty are left out. With weights that do not fit the field, no score is predicted.
    """
    if is_foreign(found) and "scans" in found:
        found = {**found, "scans": {name: {**scan, "expected_miou": None} for name, scan in found["scans"].items()}}
    rows = [(label, _figures(found.get(part), names)) for label, (part, names) in _SHOWN.items()]
    for name, one in found.get("pointing", {}).items():
        if isinstance(one, Mapping):
            rows.append((f"pointing, {name}", _figures(one, _OF_POINTING)))
    for name, facts in found.get("lines", {}).items():
        counts = ", ".join(f"{count} {what}" for what, count in facts.items() if count)
        rows.append((f"sweep {name}", f"lines left out: {counts}"))
    if is_foreign(found):
        rows.append(("weights", FOREIGN_WORDS))
    return [(label, words) for label, words in rows if words]


def _figures(found: Mapping[str, Any] | None, names: str) -> str:
    """Return the named figures of a part."""
    shown = [(name, found[name]) for name in names.split() if found and found.get(name)]
    return "; ".join(words for name, value in shown if (words := _figure(name, value)))


def _figure(name: str, value: Any) -> str:
    """Return a figure with its label, both by the name that it has in a receipt, which ends in its unit."""
    if name in _FORMATS:
        return _FORMATS[name](value)
    if name in _FRACTIONS:
        return f"{spaced(name)} {format_percent(value)}"
    label, _, unit = name.rpartition("_")
    if unit in _UNITS:
        return f"{spaced(label)} {_UNITS[unit](value)}"
    if isinstance(value, list | tuple):
        return f"{spaced(name)} {', '.join(map(str, value))}"
    number = value if isinstance(value, str) else format_count(value) if isinstance(value, int) else three_digits(value)
    return f"{spaced(name)} {number}"


def format_days(days: float) -> str:
    """Return how long ago a capture was."""
    if days < 1:
        return f"{24 * days:.1f} hours earlier"
    return f"{days:.1f} days earlier" if days < 10 else f"{days:.0f} days earlier"


def _scan(scan: Mapping[str, Any]) -> str:
    words = f"{format_scan(scan['step'], scan['exposure_ms'])}, {scan['seconds']:.1f} s"
    predicted = format_prediction(scan["expected_miou"], scan.get("expected_spread"))
    return f"{words}, expected mIoU {predicted}" if predicted else words


# rows of the findings: the part of the receipt, and its figures that are shown, in order
COMPARISON = "comparison"
_SHOWN: Mapping[str, tuple[str, str]] = {
    "field": ("field", "view_deg range_m hectares ground_pixel_m hectares_per_hour"),
    "plan": ("plan", "reason lines"),
    "recording": ("recording", "lines_read lines_recorded passes_s full_scan_s"),
    "signal": ("signal", "saturated"),
    "pixels": ("pixels", "px_no_reading map_without_a_class"),
    "captured": ("extent", "patches_touched lines expected_wrong due_left"),
    "full network": ("kept", "patches multiply_adds"),
    "prior map": ("prior_map", "run days changed_px changes"),
    COMPARISON: ("prior_map", "agreement compared_px differing_px expected_differing_px"),
    "training": ("unlike", "fraction"),
    "expected mIoU": ("expected", "miou error not_predicted"),
    "uniform scans": ("scans", "taken best_in_time reference"),
    "classes": ("areas", "ha"),
    "zones": ("zones", "kept_px kept_m2"),
    "on the ground": ("ground", "crs resolution_m changes_ha"),
}
_OF_POINTING = "sweeps residual_rms_px not_found too_narrow partly_seen"
_FRACTIONS = ("patches_touched", "expected_wrong", "agreement")
_UNITS: Mapping[str, Callable[[Any], str]] = {
    "px": lambda value: f"{format_count(value) if isinstance(value, int) else f'{value:.2f}'} px",
    "s": format_seconds,
    "m": lambda value: format_metres(value["median"] if isinstance(value, Mapping) else value),
    "m2": lambda value: format_area(value / M2_PER_HECTARE),
    "deg": lambda value: f"{' x '.join(f'{one:.3g}' for one in np.atleast_1d(value))} degrees",
}
_FORMATS: Mapping[str, Callable[[Any], str]] = {
    **dict.fromkeys(("run", "crs", "reason", "not_predicted"), str),
    "days": format_days,
    "hectares": format_area,
    "fraction": lambda fraction: f"{format_percent(fraction)} of the field is unlike the training data of the weights",
    "saturated": lambda fraction: (
        f"{format_percent(fraction)} of the spectra have saturated bands; a shorter exposure avoids them"
    ),
    "changes": lambda pairs: ", ".join(
        f"{spaced(old)} to {spaced(new)} {format_count(px)} px" for px, _, old, new in pairs[:MOST_NAMED]
    ),
    "miou": lambda miou: f"{format_points(miou)} of 100",
    "error": lambda error: f"standard deviation {format_points(error)}",
    "due_left": lambda count: f"{format_count(count)} patches beyond --max-age left",
    "taken": lambda scan: f"this one: {_scan(scan)}",
    "best_in_time": lambda scan: f"best in the same time: {_scan(scan)}",
    "reference": lambda scan: f"cheapest near the best: {_scan(scan)}",
    "patches": lambda count: f"{format_count(count)} patches read in full",
    "multiply_adds": lambda did: f"multiply-adds {format_percent(did['done'] / did['everything'])} of those for all",
    "ha": lambda areas: ", ".join(f"{spaced(name)} {format_area(area)}" for name, area in areas.items() if area),
    "changes_ha": lambda changes: ", ".join(
        f"{spaced(old)} to {spaced(new)} {format_area(area)}" for area, old, new in changes[:MOST_NAMED]
    ),
    "sweeps": lambda sweeps: f"corrected by up to {max(math.hypot(*one) for one in sweeps.values()):.1f} px",
    "too_narrow": lambda value: f"{counted(len(value), 'overlap')} too narrow to compare",
}
