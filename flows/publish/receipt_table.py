"""A receipt for people: the headline, what was spent as a table, and what was found, a row each."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape

from flows.publish.receipt import Receipt, hectares_of_classes, is_pending
from flows.tasks.scene import TRAINING_SCENE
from flows.tasks.scores import format_prediction, format_worst_class
from flows.terminal.figures import (
    counted,
    format_area,
    format_bytes,
    format_count,
    format_megabytes,
    format_metres,
    format_percent,
    format_points,
    format_seconds,
    three_digits,
)
from flows.terminal.progress import table
from pipeline.ground.field_places import M2_PER_HECTARE
from pipeline.planning.uniform_scans import format_scan

COST_LABELS = {
    "capture_s": ("time at the camera", format_seconds),
    "lines": ("lines", format_count),
    "samples": ("samples on the field", format_count),
    "patches": ("patches read in full", format_count),
    "multiply_adds": ("model's multiply-adds", format_count),
}
BYTE_LABELS = {
    "captured": "bytes captured",
    "written": "bytes written",
    "kept": "bytes kept",
    "moved_bucket": "bytes moved, bucket",
    "moved_workers": "bytes moved, workers",
}
MOST_CHANGES = 4  # in words
LEAST_REFERENCE = 100_000  # bytes from which on all are told in MB
LEADING = 3  # classes of a plot in words
FOREIGN = 0.2  # fraction of a map that is unknown from which on its weights are the wrong ones
FOREIGN_WORDS = (
    "These weights do not know this field: train some on labelled scenes of it (spectralzoom train DATASET), or leave "
    "the class out with --unknown off"
)


def cost_rows(savings: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return what was spent against everything, a row each: a saving with its label, figures in words."""
    return [
        {**savings[name], "label": label, "done": show(savings[name]["done"]), "full": show(savings[name]["full"])}
        for name, (label, show) in COST_LABELS.items()
        if name in savings  # a raster takes no line and no second
    ]


def byte_rows(receipt: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the bytes of a run against the reference, a row each.

    They are in MB, so that rows compare, but where the reference is smaller than a tenth of one. Bytes moved have a row
    where some were.
    """
    told, rows = receipt["data_bytes"], []
    full = told["reference"]
    show = format_bytes if full is not None and full < LEAST_REFERENCE else format_megabytes
    for name, label in BYTE_LABELS.items():
        done = told[name]
        if done == 0 and name.startswith("moved"):
            continue
        words = "not counted" if done is None else show(done)
        ratio = None if done is None or not full else done / full
        rows.append({"label": label, "done": words, "full": show(full), "ratio": ratio})
    return rows


def format_reused(receipt: Mapping[str, Any]) -> str:
    """Return what of the bytes kept was found in the archive and not built; empty where all was built."""
    reused = receipt["data_bytes"]["reused"]
    if not reused:
        return ""
    size = format_megabytes(sum(reused.values()))
    return f"Reused, found and not written again: {counted(len(reused), 'store')}, {size} of the bytes kept."


def print_table(receipt: Receipt, console: Console) -> None:
    """Print the savings to the terminal, and what became of a prior map or of weights that do not know the field."""
    columns = ("cost", "this survey", "everything", "ratio")
    costs = [*cost_rows(receipt["savings"]), *byte_rows(receipt)]
    rows = [[row["label"], row["done"], row["full"], format_percent(row["ratio"])] for row in costs]
    console.print(table(columns, rows, whole=columns[1:]))
    if "capture_s" in receipt["savings"]:
        usual = f"{receipt['settings']['camera']['exposure_ms']:g} ms"
        console.print(f"Everything: every line of {usual}, kept as captured, each of its patches read in full.")
    if reused := format_reused(receipt):
        console.print(escape(reused))
    for name, words in finding_rows({name: receipt[name] for name in ("memory", "unknown") if name in receipt}):
        if name != "unknown" or receipt["unknown"]["fraction"] > FOREIGN:
            console.print(escape(f"{name}: {words}"))


def headline(receipt: Receipt, captured_again: float | None = None) -> str:
    """Return the run in a few sentences for a farmer, plain text: how long, how good, and where it is worst.

    ``captured_again`` is the fraction of the field that was captured in detail, 0..1; None leaves it out.
    """
    savings, scan = receipt["savings"], receipt.get("plan", {}).get("kind") in ("scan", "raster")
    words = []
    if captured_again == 0:
        words.append("The camera captured nothing again: no run of fine lines fits into the time left, or pays.")
    elif captured_again is not None:
        words.append(f"The camera captured {format_percent(captured_again)} of the field again.")
    if (capture := savings.get("capture_s")) is None:
        read = format_percent(savings["multiply_adds"]["ratio"])
        words.append(
            f"The raster's pixels were taken as they are: its map took {read} of the multiply-adds of reading every "
            "pixel."
        )
    else:
        usual = f"every line of {receipt['settings']['camera']['exposure_ms']:g} ms"
        done, full = (format_seconds(capture[name]) for name in ("done", "full"))
        words.append(f"Capture took {done} instead of {full} for {usual} ({format_percent(capture['ratio'])}).")
        if capture.get("uniform") is not None:
            least = f"{format_seconds(capture['uniform'])} ({capture['uniform_scan']})"
            words.append(f"The cheapest uniform scan that is nearly as good as any takes {least}.")
    if is_pending(receipt):
        words.append("The map is not judged yet: its accuracy is added once it is.")
    if (accuracy := receipt.get("accuracy")) is not None:
        alone = scan and "kept" not in receipt  # everything is read
        others = {} if alone else {"the overview alone gives": accuracy["none"], "a full reading": accuracy["all"]}
        beside = [f"{name} {format_points(one['miou'])}" for name, one in others.items() if one["miou"] is not None]
        right = format_points(accuracy.get("overall_accuracy"))
        seen = f" on {TRAINING_SCENE[receipt['training_scene']]}" if "training_scene" in receipt else ""
        words.append(
            f"The map scores {format_points(accuracy['miou'])} of 100 against the truth{seen} ({right} % of its pixels "
            f"are right){'; ' if beside else ''}{', '.join(beside)}."
        )
        words.append(format_worst_class(accuracy, alone=alone))
    return " ".join(filter(None, words))


def finding_rows(found: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the findings of a receipt as rows of a table: label, and figures with their names.

    Of a field that the weights do not know no score is predicted: their record is of others.
    """
    foreign = (found.get("unknown") or {}).get("fraction", 0.0) > FOREIGN
    if foreign and "scans" in found:
        scans = {name: {**scan, "expected_miou": None} for name, scan in found["scans"].items()}
        found = {**found, "scans": scans}
    rows = [
        (_LABELS.get(part, part), _figures(part, found.get(part))) for part in dict.fromkeys(f[0] for f in _FIGURES)
    ]
    rows += [
        (f"pointing, {name}", _figures("pass", one))
        for name, one in found.get("pointing", {}).items()
        if isinstance(one, Mapping)
    ]
    rows += [
        (f"sweep {name}", f"lines {', '.join(f'{count} {what}' for what, count in facts.items() if count)}: left out")
        for name, facts in found.get("lines", {}).items()
    ]
    if "scans" not in found and found.get("plan", {}).get("kind", "raster") != "raster":
        words = "the weights have no scan performance table, so that seconds stand beside every line at full exposure"
        rows.append(("uniform scans", f"{words}; train --min-exposure-ms 3 makes one, by scenes kept for validation"))
    if foreign:
        rows.append(("weights", FOREIGN_WORDS))
    return [(label, words) for label, words in rows if words]


def _figures(part: str, found: Mapping[str, Any] | None) -> str:
    """Return the figures of a part that say something, in words; None, 0 and what is empty say nothing."""
    largest = [one[1:] for one in _FIGURES if one[0] == part] if found else []
    return "; ".join(
        filter(None, (words.format(show(found[name])) for name, words, show in largest if found and found.get(name)))
    )


def format_days(days: float) -> str:
    """Return how long ago a capture was."""
    if days < 1:
        return f"{24 * days:.1f} hours earlier"
    return f"{days:.1f} days earlier" if days < 10 else f"{days:.0f} days earlier"


def plot_rows(plots: Sequence[Mapping[str, Any]]) -> list[dict[str, str]]:
    """Return the table of plots in words: name, ground, leading classes, confidence."""

    def leading(fractions: Mapping[str, float | None]) -> str:
        known = sorted(((fraction, name) for name, fraction in fractions.items() if fraction), key=lambda one: -one[0])
        return ", ".join(f"{_spaced(name)} {format_percent(fraction)}" for fraction, name in known[:LEADING])

    return [
        {
            "plot": plot["plot"],
            "area": f"{format_count(plot['pixels'])} px"
            if plot["area_m2"] is None
            else format_area(plot["area_m2"] / M2_PER_HECTARE),
            "classes": leading(plot["fractions"]) if plot["mapped_pixels"] else "not mapped",
            "confidence": format_percent(plot["confidence"]),
        }
        for plot in plots
    ]


def area_rows(receipt: Mapping[str, Any]) -> list[dict[str, str]]:
    """Return the classes of a map as a table in words: name, pixels, share of the pixels that have a class, hectares.

    Hectares are left out where nothing says how large a pixel is.
    """
    pixels: Mapping[str, int] = (receipt.get("areas") or {}).get("px", {})
    hectares, every = hectares_of_classes(receipt), sum(pixels.values())
    return [
        {"class": _spaced(name), "pixels": format_count(count), "share": format_percent(count / every)}
        | ({} if hectares is None else {"area": format_area(hectares.get(name, 0.0))})
        for name, count in pixels.items()
        if count
    ]


def _spaced(name: str) -> str:
    return name.replace("_", " ")


def _areas(areas: Mapping[str, float]) -> str:
    return ", ".join(f"{_spaced(name)} {format_area(area)}" for name, area in areas.items() if area)


def _pixels(pixels: Mapping[str, int]) -> str:
    every = sum(pixels.values())
    shown = (
        f"{_spaced(name)} {format_count(count)} px ({format_percent(count / every)})"
        for name, count in pixels.items()
        if count
    )
    return ", ".join(shown) or "no pixel has a class"


def _changes(changes: Sequence[Sequence[Any]]) -> str:
    most = [f"{_spaced(old)} to {_spaced(new)} {format_area(area)}" for area, old, new in changes[:MOST_CHANGES]]
    return f"{format_area(sum(area for area, _, _ in changes))} changed: {', '.join(most)}"


def _older(areas: Mapping[str, float]) -> str:
    return "; ".join(
        f"{format_area(area)} last captured more than {counted(int(days), 'day')} ago"
        for days, area in areas.items()
        if area
    )


def _fraction(cost: Mapping[str, float]) -> str:
    return format_percent(cost["done"] / cost["everything"])


def _scan(scan: Mapping[str, Any]) -> str:
    words = f"{format_scan(scan['step'], scan['exposure_ms'])}, {scan['seconds']:.1f} s"
    score, spread = scan["expected_miou"], scan.get("expected_spread")
    if score is None:  # of a field that the weights do not know
        return words
    if not (predicted := format_prediction(score, spread)):
        return f"{words}, no score predicted: scenes differ by {format_points(spread)} points (one standard deviation)"
    return f"{words}, about {predicted}"


def _most_px(sweeps: Mapping[str, Sequence[float]]) -> str:
    return f"{max(float(np.hypot(down, across)) for down, across in sweeps.values()):.1f}"


# parts of a receipt whose rows are called otherwise
_LABELS = {
    **{"extent": "captured", "kept": "read in detail", "memory": "prior map", "expected": "expected score"},
    **{"scans": "uniform scans", "ground": "on the ground", "areas": "classes"},
}
# part of a receipt, figure, its words and its form, in the order of rows and of words
_FIGURES: Sequence[tuple[str, str, str, Callable[[Any], Any]]] = (
    ("field", "view_deg", "{} degrees of the view", lambda one: f"{one[0]:.3g} x {one[1]:.3g}"),
    ("field", "range_m", "{} away in the middle", lambda one: format_metres(one["median"])),
    ("field", "hectares", "{}", format_area),
    ("field", "ground_pixel_m", "{} a pixel", format_metres),
    ("field", "hectares_per_hour", "{} ha an hour of the camera", three_digits),
    ("plan", "reason", "{}", str),
    ("plan", "lines", "{} fine lines", format_count),
    ("plan", "out_of_reach", "{} patches worth a second pass lie beyond the mirror's range", format_count),
    ("recording", "lines_read", "{} lines were read", format_count),
    ("recording", "lines_recorded", "{} are recorded", format_count),
    ("recording", "passes_s", "a camera would take {} for these passes, by the cost model", format_seconds),
    ("recording", "full_scan_s", "{} for a scan of every line", format_seconds),
    ("extent", "lines", "lines {}", str),
    ("extent", "fraction", "{} of the field", format_percent),
    ("extent", "remembers", "the rest is unchanged", bool),
    ("extent", "expected_wrong", "about {} of the prior map was expected to be wrong there", format_percent),
    ("extent", "due_left", "{} places that were due had to wait", format_count),
    ("kept", "patches", "{} patches", format_count),
    ("kept", "multiply_adds", "{} of the multiply-adds of reading everything", _fraction),
    ("memory", "run", "{}", str),
    ("memory", "days", "{}", format_days),
    ("memory", "shift_px", "{}", lambda one: f"lay {np.hypot(*one):.0f} px beside it" if any(one) else ""),
    ("memory", "turned_deg", "{}", lambda one: f"turned by {abs(one):.1f} degrees" if abs(one) >= 1 else ""),
    ("memory", "put_aside", "put aside: {}", str),
    ("memory", "agreement", "today's capture agrees with {} of it", format_percent),
    ("memory", "differing_px", "{} px differ from it", format_count),
    ("memory", "expected_differing_px", "two maps of the same ground would differ at about {}", format_count),
    ("memory", "changed_px", "{} px changed beyond that", format_count),
    ("unknown", "fraction", "{} of the map is unknown, unlike all that the weights were trained on", format_percent),
    ("unknown", "rate", "of what they know it would be about {}", format_percent),
    ("expected", "miou", "about {}, with no label asked", format_points),
    ("expected", "error", "error {}", format_points),
    ("expected", "not_predicted", "no score predicted: {}", str),
    ("scans", "taken", "this one, read whole: {}", _scan),
    ("scans", "best_in_time", "best in the same seconds: {}", _scan),
    ("scans", "reference", "nearly as good as any: {}", _scan),
    ("areas", "ha", "{}", _areas),
    ("areas", "px", "{}", _pixels),
    ("zones", "kept_px", "{} px are mapped", format_count),
    ("zones", "kept_m2", "{}", lambda one: format_area(one / M2_PER_HECTARE)),
    ("zones", "no_go_px", "no-go zones touch {} px", format_count),
    ("ground", "crs", "{}", str),
    ("ground", "resolution_m", "{:.4g} m a pixel", float),
    ("ground", "changes_ha", "{}", _changes),
    ("ground", "older_ha", "{}", _older),
    ("pass", "sweeps", "put right by up to {} px", _most_px),
    ("pass", "residual_rms_px", "{:.2f} px rms are left at the seams", float),
    ("pass", "not_found", "{} left where the mirror reported: nothing was found", ", ".join),
    ("pass", "too_narrow", "{} too narrow to compare", lambda one: counted(len(one), "overlap")),
    ("pass", "partly_seen", "{} chosen patches not captured whole", format_count),
)
