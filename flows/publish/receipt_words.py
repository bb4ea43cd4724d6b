"""A receipt in words: the headline that a farmer reads, and the findings, for the terminal and for pages."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from flows.publish.findings import FOREIGN, MOST_CHANGES, ground_words, zone_words
from flows.publish.receipt import Receipt, is_pending
from flows.tasks.scores import worst_class_words
from flows.terminal.figures import (
    area_words,
    format_count,
    format_metres,
    format_percent,
    format_points,
    format_seconds,
    three_digits,
)
from pipeline.ground.field_places import SECONDS_PER_HOUR
from pipeline.planning.plain_scans import scan_words


def headline(receipt: Receipt, looked_twice: float | None = None) -> str:
    """The run in a few sentences that a farmer reads, plain text: how long, how good, and where it is worst.

    ``looked_twice`` is the share of the field that was captured in detail, 0..1; None leaves it out.
    """
    savings, kind = receipt["savings"], receipt.get("plan", {}).get("kind")
    plain = kind in ("scan", "raster")
    if looked_twice == 0:
        twice = "The camera looked twice at nothing: no run of fine lines fits into the time left, or is worth it. "
    else:
        twice = (
            "" if looked_twice is None else f"The camera looked twice at {format_percent(looked_twice)} of the field. "
        )
    capture = savings.get("capture_s")
    seen = _raster_words(savings) if capture is None else _capture_words(capture, receipt["settings"], plain=plain)
    text = f"{twice}{seen}"
    accuracy = receipt.get("accuracy")
    if accuracy is None:
        return f"{text} The map is not judged yet: its accuracy is added once it is." if is_pending(receipt) else text
    whole = plain and "kept" not in receipt  # of which everything is read
    every = None if whole else accuracy["all"]["miou"]
    coarse = "" if whole else f"; the coarse look alone gives {format_points(accuracy['none']['miou'])}"
    detail = "" if every is None else f", detail everywhere {format_points(every)}"
    right = accuracy.get("overall_accuracy")
    pixels = "" if right is None else f" ({format_points(right)} % of its pixels are right)"
    return (
        f"{text} The map scores {format_points(accuracy['miou'])} of 100 against the truth{pixels}{coarse}"
        f"{detail}. {worst_class_words(accuracy, alone=whole)}"
    ).rstrip()


def _raster_words(savings: Mapping[str, Any]) -> str:
    """What reading and keeping a raster took beside all of its pixels."""
    read, stored = (format_percent(savings[name]["ratio"]) for name in ("multiply_adds", "bytes_stored"))
    return (
        f"The raster's pixels were taken as they are: its map took {read} of the multiply-adds of reading every pixel, "
        f"and {stored} of the bytes of keeping them."
    )


def _capture_words(capture: Mapping[str, Any], settings: Mapping[str, Any], *, plain: bool) -> str:
    """How long capture took beside the cheapest scan of everything that is nearly as good as any.

    Where the weights have no record that tells which, and in receipts of before, beside every line as long exposed as
    the camera does.
    """
    done, full, share = (*map(format_seconds, (capture["done"], capture["full"])), format_percent(capture["ratio"]))
    every = f"every line of {settings['camera']['exposure_ms']:g} ms"
    if "every_line_s" not in capture:
        return f"Capture took {done} instead of {full} for {every if plain else 'a scan of everything'} ({share})."
    before = format_seconds(capture["every_line_s"])
    return (
        f"Capture took {done}, {share} of the {full} of the cheapest scan that is nearly as good as any "
        f"({capture['full_scan']}); {every}, which savings were told against before, takes {before}."
    )


def sentences(found: Mapping[str, Any]) -> list[str]:
    """The findings in words, for the terminal and the report."""
    words = []
    if field := found.get("field"):
        words.append(_field_words(field))
    if plan := found.get("plan"):
        if plan["kind"] in ("full", "scan", "raster") and plan["reason"]:
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
    if recording := found.get("recording"):
        words.append(_recording_words(recording))
    if look := found.get("look"):
        words.append(_look_words(look))
    if kept := found.get("kept"):
        words.append(_kept_words(kept, found.get("accuracy")))
    if memory := found.get("memory"):
        words.append(_memory_words(memory))
    if unknown := found.get("unknown"):
        words.append(_unknown_words(unknown, found.get("accuracy")))
    if expected := found.get("expected"):
        words.append(
            f"By what it says of itself the map scores about {format_points(expected['miou'])} ±"
            f" {format_points(expected['error'])}, with no label asked."
        )
    if scans := found.get("scans"):
        words.append(_scans_words(scans, read_whole="kept" not in found))
    elif plan and plan["kind"] != "raster":
        words.append(
            "The weights have no record of plain scans, so that seconds are told beside every line at full exposure; "
            "train --darkest-ms 3 makes one, by scenes kept for validation."
        )
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
    if field["view_deg"] is None:
        width, height = field["size_px"]
        view = f"The field is {format_count(width)} x {format_count(height)} px"
    else:
        across, down = field["view_deg"]
        view = f"The field is {across:.3g} x {down:.3g} degrees of the view"
    if field["ground_pixel_m"] is None:
        return f"{view}."
    if field["hectares_per_hour"] is None:  # a raster took no time
        return f"{view}: {area_words(field['hectares'])} at {format_metres(field['ground_pixel_m'])} a pixel."
    away = "" if field["range_m"] is None else f", {format_metres(field['range_m']['median'])} away in the middle"
    pace = field["hectares_per_hour"]
    return (
        f"{view}{away}: {area_words(field['hectares'])} at {format_metres(field['ground_pixel_m'])} a pixel, "
        f"{three_digits(pace)} ha an hour of the camera ({three_digits(SECONDS_PER_HOUR / pace)} s a hectare)."
    )


def _recording_words(recording: Mapping[str, Any]) -> str:
    """What was read of a recording, and what zooming would have saved a camera."""
    read, taken = recording["lines_read"], recording["lines_recorded"]
    done_s, full_s = recording["passes_s"], recording["full_scan_s"]
    own = "the recorded scan" if recording["full_scan_is"] == "recorded" else "a scan of every line"
    saved = f", {format_percent(1 - done_s / full_s)} less" if 0 < done_s < full_s else ""
    return (
        f"Of {format_count(taken)} recorded lines {format_count(read)} were read. A camera would take "
        f"{format_seconds(done_s)} for these passes, by the cost model, and {format_seconds(full_s)} for {own}{saved}."
    )


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


def _kept_words(kept: Mapping[str, Any], accuracy: Mapping[str, Any] | None) -> str:
    """What part of a plain scan is kept and read in detail, what that takes, and what it cost the map."""
    read, stored = (kept[name]["done"] / kept[name]["everything"] for name in ("multiply_adds", "bytes"))
    seats = kept["seats"] / kept["of_seats"] if kept["of_seats"] else 0.0
    text = (
        f"{format_percent(seats)} of the seats are kept and read in detail, for {format_percent(read)} of the "
        f"multiply-adds of reading everything and {format_percent(stored)} of the bytes of keeping it."
    )
    every = accuracy["all"]["miou"] if accuracy and accuracy.get("all") else None
    if accuracy is None or every is None or accuracy["miou"] is None:
        return text
    lost = every - accuracy["miou"]
    by = "cost" if lost >= 0 else "gained"
    return f"{text} That {by} {format_points(abs(lost))} points of mIoU: everything read scores {format_points(every)}."


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


def _scans_words(scans: Mapping[str, Mapping[str, Any]], *, read_whole: bool) -> str:
    """What the weights' record expects of the plain scan that was taken, or would have of one in the same seconds."""

    def told(scan: Mapping[str, Any]) -> str:
        return f"{scan_words(scan['step'], scan['exposure_ms'])}, {scan['seconds']:.1f} s"

    def points(scan: Mapping[str, Any]) -> str:
        spread = scan.get("expected_spread")
        return format_points(scan["expected_miou"]) + ("" if spread is None else f" ± {format_points(spread)}")

    words, taken, best, reference = [], *(scans.get(name) for name in ("taken", "best_in_time", "reference"))
    if taken is not None:
        read = "" if read_whole else ", read whole,"
        words.append(f"By the weights' record such a scan{read} scores about {points(taken)}.")
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
