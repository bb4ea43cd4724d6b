"""A receipt for people: the headline, what was spent as a table, and what was found, a row each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from flows.publish.receipt import Receipt, is_pending
from flows.tasks.scores import format_worst_class
from flows.terminal.figures import (
    counted,
    format_area,
    format_bytes,
    format_count,
    format_metres,
    format_percent,
    format_points,
    format_seconds,
    three_digits,
)
from pipeline.ground.field_places import M2_PER_HECTARE, SECONDS_PER_HOUR
from pipeline.planning.uniform_scans import format_scan

COST_LABELS = {
    "capture_s": ("time at the camera", format_seconds),
    "lines": ("lines", format_count),
    "samples": ("samples on the field", format_count),
    "bytes_raw": ("raw data", format_bytes),
    "bytes_stored": ("stored data", format_bytes),
    "tokens": ("model's tokens", format_count),
    "multiply_adds": ("model's multiply-adds", format_count),
}
MOST_CHANGES = 4  # in words
LEADING = 3  # classes of a plot in words
FOREIGN = 0.2  # fraction of a map that is unknown from which on its weights are the wrong ones


def cost_rows(savings: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return what was spent against everything, a row each: a saving with its label, figures in words."""
    return [
        {**savings[name], "label": label, "done": show(savings[name]["done"]), "full": show(savings[name]["full"])}
        for name, (label, show) in COST_LABELS.items()
        if name in savings  # a raster takes no line and no second
    ]


def print_table(receipt: Receipt, console: Console) -> None:
    """Print the savings to the terminal, and what became of a prior map or of weights that do not know the field."""
    table = Table(header_style="dim", box=SIMPLE_HEAD, show_edge=False)
    for name in ("cost", "this survey", "everything", "ratio"):
        table.add_column(name, justify="left" if name == "cost" else "right", no_wrap=name != "cost")
    for row in cost_rows(receipt["savings"]):
        table.add_row(row["label"], row["done"], row["full"], format_percent(row["ratio"]))
    console.print(table)
    for name, words in finding_rows({name: receipt[name] for name in ("memory", "unknown") if name in receipt}):
        if name != "unknown" or receipt["unknown"]["fraction"] > FOREIGN:
            console.print(escape(f"{name} {words}"))


def headline(receipt: Receipt, captured_again: float | None = None) -> str:
    """Return the run in a few sentences for a farmer, plain text: how long, how good, and where it is worst.

    ``captured_again`` is the fraction of the field that was captured in detail, 0..1; None leaves it out.
    """
    savings, scan = receipt["savings"], receipt.get("plan", {}).get("kind") in ("scan", "raster")
    words = []
    if captured_again == 0:
        words.append(
            "The camera captured again at nothing: no run of fine lines fits into the time left, or is worth it."
        )
    elif captured_again is not None:
        words.append(f"The camera captured again at {format_percent(captured_again)} of the field.")
    if (capture := savings.get("capture_s")) is None:
        read, stored = (format_percent(savings[name]["ratio"]) for name in ("multiply_adds", "bytes_stored"))
        words.append(
            f"The raster's pixels were taken as they are: its map took {read} of the multiply-adds of reading every "
            f"pixel, and {stored} of the bytes of keeping them."
        )
    else:
        usual = f"every line of {receipt['settings']['camera']['exposure_ms']:g} ms" if scan else "a scan of everything"
        best = capture.get("full_scan")
        whole = f"the cheapest scan that is nearly as good as any ({best})" if best else usual
        done, full = (format_seconds(capture[name]) for name in ("done", "full"))
        words.append(f"Capture took {done} instead of {full} for {whole} ({format_percent(capture['ratio'])}).")
    if is_pending(receipt):
        words.append("The map is not judged yet: its accuracy is added once it is.")
    if (accuracy := receipt.get("accuracy")) is not None:
        alone = scan and "kept" not in receipt  # everything is read
        others = (
            {} if alone else {"the coarse pass alone gives": accuracy["none"], "detail everywhere": accuracy["all"]}
        )
        beside = [f"{name} {format_points(one['miou'])}" for name, one in others.items() if one["miou"] is not None]
        right = format_points(accuracy.get("overall_accuracy"))
        words.append(
            f"The map scores {format_points(accuracy['miou'])} of 100 against the truth ({right} % of its pixels are "
            f"right){'; ' if beside else ''}{', '.join(beside)}."
        )
        words.append(format_worst_class(accuracy, alone=alone))
    return " ".join(filter(None, words))


def finding_rows(found: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the findings of a receipt as rows of a table: what is said of which thing."""
    rows = [
        *(
            (label, words)
            for key, label, words_of in _ROWS
            if (part := found.get(key)) and (words := words_of(part, found))
        ),
        *(
            (f"pointing, {name}", words)
            for name, one in found.get("pointing", {}).items()
            if isinstance(one, Mapping) and (words := _format_pointing(one))
        ),
        *(
            (
                f"sweep {name}",
                f"lines {', '.join(f'{count} {what}' for what, count in facts.items() if count)}: left out",
            )
            for name, facts in found.get("lines", {}).items()
        ),
    ]
    if "scans" not in found and found.get("plan", {}).get("kind", "raster") != "raster":
        words = "the weights have no scan performance table, so that seconds stand beside every line at full exposure"
        rows.append(("uniform scans", f"{words}; train --darkest-ms 3 makes one, by scenes kept for validation"))
    return [(label, words) for label, words in rows if words]


def _format_field(field: Mapping[str, Any], _: object) -> str:
    if field["view_deg"] is None:
        size = " x ".join(map(format_count, field["size_px"])) + " px"
    else:
        size = f"{field['view_deg'][0]:.3g} x {field['view_deg'][1]:.3g} degrees of the view"
    if field["ground_pixel_m"] is None:
        return size
    away = "" if field["range_m"] is None else f", {format_metres(field['range_m']['median'])} away in the middle"
    ground = f"{size}{away}: {format_area(field['hectares'])} at {format_metres(field['ground_pixel_m'])} a pixel"
    pace = field["hectares_per_hour"]
    if pace is None:  # a raster took no time
        return ground
    return (
        f"{ground}, {three_digits(pace)} ha an hour of the camera ({three_digits(SECONDS_PER_HOUR / pace)} s a hectare)"
    )


def _format_plan(plan: Mapping[str, Any], _: object) -> str:
    parts = [plan["reason"] if plan["kind"] in ("full", "scan", "raster") else f"{plan['lines']} fine lines"]
    if plan["out_of_reach"]:
        parts.append(f"{plan['out_of_reach']} places worth a second pass lie beyond the mirror's range")
    return "; ".join(filter(None, parts))


def _format_recording(recording: Mapping[str, Any], _: object) -> str:
    done_s, full_s = recording["passes_s"], recording["full_scan_s"]
    own = "the recorded scan" if recording["full_scan_is"] == "recorded" else "a scan of every line"
    saved = f", {format_percent(1 - done_s / full_s)} less" if 0 < done_s < full_s else ""
    return (
        f"{format_count(recording['lines_read'])} of {format_count(recording['lines_recorded'])} recorded lines were "
        f"read; a camera would take {format_seconds(done_s)} for these passes, by the cost model, and "
        f"{format_seconds(full_s)} for {own}{saved}"
    )


def _format_extent(scan_pass: Mapping[str, Any], _: object) -> str:
    rest = "the rest is as before" if scan_pass["remembers"] else "of the rest nothing is known"
    text = f"lines {scan_pass['lines']}, {format_percent(scan_pass['fraction'])} of the field; {rest}"
    if "expected_gain" in scan_pass:
        text += f"; about {format_percent(scan_pass['expected_wrong'])} of the prior map was expected to be wrong there"
    if scan_pass.get("due_left"):
        text += f"; {format_count(scan_pass['due_left'])} of {format_count(scan_pass['due'])} places that were due had to wait"
    return text


def _format_kept(kept: Mapping[str, Any], found: Mapping[str, Any]) -> str:
    read, stored = (kept[name]["done"] / kept[name]["everything"] for name in ("multiply_adds", "bytes"))
    fraction = kept["patches"] / kept["of_patches"] if kept["of_patches"] else 0.0
    text = (
        f"{format_percent(fraction)} of the patches, for {format_percent(read)} of the multiply-adds of reading everything"
        f" and {format_percent(stored)} of the bytes of keeping it"
    )
    accuracy = found.get("accuracy") or {}
    every = (accuracy.get("all") or {}).get("miou")
    return text if every is None else f"{text}; everything read scores {format_points(every)}"


def _format_prior_map(memory: Mapping[str, Any], _: object) -> str:
    since, shift = f"{memory['run']}, {format_days(memory['days'])}", float(np.hypot(*memory["shift_px"]))
    if memory["put_aside"] == "turned":
        return f"{since}: put aside, the rig was turned since by {abs(memory['turned_deg']):.1f} degrees"
    alike = "nothing" if memory["agreement"] is None else format_percent(memory["agreement"])
    if memory["put_aside"]:
        return f"{since}: put aside, today's capture agrees with {alike} of it: another field, or a rig that was moved"
    fraction = format_percent(memory["changed_px"] / memory["compared_px"]) if memory["compared_px"] else "nothing"
    most = ", ".join(f"{_spaced(old)} to {_spaced(new)}" for _, old, new in memory["changes"][:MOST_CHANGES])
    beside = f", which lay {shift:.0f} px beside it" if shift else ""
    return f"{since}{beside}: today's capture agrees with {alike} of it, {fraction} changed{': ' if most else ''}{most}"


def format_days(days: float) -> str:
    """Return how long ago a capture was."""
    if days < 1:
        return f"{24 * days:.1f} hours earlier"
    return f"{days:.1f} days earlier" if days < 10 else f"{days:.0f} days earlier"


def _format_unknown(unknown: Mapping[str, Any], found: Mapping[str, Any]) -> str:
    text = (
        f"{format_percent(unknown['fraction'])} of the map is unknown, unlike all that the weights were trained on; of"
        f" what they know it would be about {format_percent(unknown['rate'])}"
    )
    if pixels := (found.get("accuracy") or {}).get("unknown_px"):
        text += f"; {format_count(pixels)} such pixels have a label and count as wrong"
    if unknown["fraction"] > FOREIGN:
        text += (
            ". These weights do not know this field: train some on labelled scenes of it (spectralzoom train DATASET), "
            "or leave the class out with --unknown off"
        )
    return text


def _format_scans(scans: Mapping[str, Mapping[str, Any]], found: Mapping[str, Any]) -> str:
    own = "this one, read whole" if "kept" in found else "this one"
    titles = {"taken": own, "best_in_time": "best in the same seconds", "reference": "nearly as good as any"}
    return "; ".join(
        f"{title}: {format_scan(one['step'], one['exposure_ms'])}, {one['seconds']:.1f} s, about "
        f"{format_points(one['expected_miou'])} ± {format_points(one.get('expected_spread'))}"
        for name, title in titles.items()
        if (one := scans.get(name)) is not None
    )


def _format_zones(zones: Mapping[str, Any], _: object) -> str:
    ground = "" if zones["kept_m2"] is None else f", {format_area(zones['kept_m2'] / M2_PER_HECTARE)}"
    no_go = f"; no-go zones touch {format_count(zones['no_go_px'])} px" if zones["no_go_px"] else ""
    fraction = format_percent(zones["kept_px"] / zones["field_px"])
    return f"{format_count(zones['kept_px'])} px, {fraction} of the field{ground}{no_go}; of the rest no map is drawn"


def _format_ground(ground: Mapping[str, Any], _: object) -> str:
    areas = ", ".join(f"{_spaced(name)} {format_area(area)}" for name, area in ground["areas_ha"].items() if area)
    words = [f"{ground['crs']}, {ground['resolution_m']:.4g} m a pixel: {areas}"]
    if changes := ground.get("changes_ha"):
        largest = [f"{_spaced(old)} to {_spaced(new)} {format_area(area)}" for area, old, new in changes[:MOST_CHANGES]]
        words.append(f"{format_area(sum(area for area, _, _ in changes))} changed: {', '.join(largest)}")
    older = [(int(days), area) for days, area in ground.get("older_ha", {}).items() if area]
    words += [f"{format_area(area)} last captured more than {counted(days, 'day')} ago" for days, area in older]
    return "; ".join(words)


def _format_pointing(one: Mapping[str, Any]) -> str:
    put = [float(np.hypot(*offset)) for sweep, offset in one["sweeps"].items() if sweep not in one["not_found"]]
    parts = []
    if len(one["sweeps"]) == 1 and one["held"] in one["sweeps"]:
        parts.append("one sweep, which has no seam to be put right by")
    elif put:
        parts.append(f"put right by up to {max(put):.1f} px")
        parts += (
            [] if one["residual_rms_px"] is None else [f"{one['residual_rms_px']:.2f} px rms are left at the seams"]
        )
    if one["not_found"]:
        parts.append(f"{', '.join(one['not_found'])} left where the mirror reported: nothing was found")
    if one["too_narrow"]:
        parts.append(f"{counted(len(one['too_narrow']), 'overlap')} too narrow to compare")
    if one.get("partly_seen"):
        parts.append(f"{counted(one['partly_seen'], 'chosen place')} not seen whole, mapped there by the coarse pass")
    return "; ".join(parts)


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


def _spaced(name: str) -> str:
    return name.replace("_", " ")


_ROWS: Sequence[tuple[str, str, Any]] = (
    ("field", "field", _format_field),
    ("plan", "plan", _format_plan),
    ("recording", "recording", _format_recording),
    ("extent", "captured", _format_extent),
    ("kept", "kept in detail", _format_kept),
    ("memory", "goes on from", _format_prior_map),
    ("unknown", "unknown", _format_unknown),
    (
        "expected",
        "expected score",
        lambda one, _: f"about {format_points(one['miou'])} ± {format_points(one['error'])}, with no label asked",
    ),
    ("scans", "uniform scans", _format_scans),
    ("zones", "zones", _format_zones),
    ("ground", "on the ground", _format_ground),
)
