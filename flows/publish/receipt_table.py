"""Format a receipt for people: the savings as a table, the score, and the findings, one row for each part."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.markup import escape

from spectralzoom.flows.publish.class_sentence import class_sentence
from spectralzoom.flows.publish.receipt import Receipt
from spectralzoom.flows.publish.scores import format_prediction, format_worst_class, warnings_of
from spectralzoom.flows.terminal.figures import (
    counted,
    format_area,
    format_bytes,
    format_count,
    format_days,
    format_metres,
    format_percent,
    format_points,
    format_seconds,
    spaced,
    three_digits,
)
from spectralzoom.flows.terminal.progress import show_warnings, table
from spectralzoom.models.evaluation.taught_labels import TRAINING_SCENE
from spectralzoom.pipeline.planning.uniform_scans import format_scan
from spectralzoom.pipeline.simulator.selection.choice import UNIT_NAMES

BYTES = ("kept", "captured", "written")
COST_LABELS: Mapping[str, tuple[str, Callable[[float | None], str]]] = {
    "capture_s": ("capture time", format_seconds),
    "pause_s": ("pause between passes", format_seconds),
    "multiply_adds": ("multiply-adds", format_count),
    "lines": ("lines", format_count),
    "samples": ("samples on the field", format_count),
    "patches": ("patches read in full", format_count),
    **{name: (f"bytes {name}", format_bytes) for name in BYTES},
}
LEADING = (
    "capture time",
    "pause between passes",
    "bytes kept",
    "multiply-adds",
)  # of the rows, those printed at the end of a survey
BETWEEN_PASSES = ("condense_coarse", "register_coarse", "locate", "rectify", "read_overview", "score")  # stages
MOST_NAMED = 4  # changes of class in a row
SATURATED = "of the spectra have saturated bands; a shorter exposure avoids them"


def saving_rows(receipt: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return costs and bytes of a run against the reference, one row each, with formatted figures.

    The reference is the cheapest uniform scan with nearly the best score, if the weights have a table of scans, else
    the full scan. ``control`` is the uniform scan of the same seconds, if it was measured.
    """
    data, reference = receipt["data_bytes"], receipt.get("scans", {}).get("reference")
    raw = data["reference"] if reference is None else reference["bytes_raw"]
    full = {**dict.fromkeys(BYTES, raw), **({} if reference is None else {"capture_s": reference["seconds"]})}
    done = {**receipt["savings"], **{name: {"done": data[name]} for name in BYTES}}
    if (pause_s := pause_seconds(receipt)) is not None:
        done["pause_s"] = {"done": pause_s}
    rows = []
    for name, (label, show) in COST_LABELS.items():
        if (one := done.get(name)) is None:
            continue
        most = full.get(name, one.get("full"))
        row: dict[str, Any] = {"label": label, "done": show(one["done"]), "full": "" if most is None else show(most)}
        control = receipt.get("control", {}).get(name)
        row |= {"ratio": one["done"] / most if most else None, "control": "" if control is None else show(control)}
        rows.append(row)
    return sorted(rows, key=lambda row: LEADING.index(row["label"]) if row["label"] in LEADING else len(LEADING))


def pause_seconds(receipt: Mapping[str, Any]) -> float | None:
    """Return the wall time of the stages between two passes; None for one pass, or if some were found."""
    spent = {one["name"]: one["wall_s"] for one in receipt["stages"]}
    between = [wall_s for name, wall_s in spent.items() if name in BETWEEN_PASSES]
    return sum(between) if "capture_fine" in spent and None not in between else None


def format_reference(receipt: Mapping[str, Any]) -> str:
    """Return a sentence on the reference: the cheapest uniform scan with nearly the best score, or the full scan."""
    capture = receipt["savings"].get("capture_s", {})
    read = " and read in full" if "patches" in receipt["savings"] else ""
    if not capture:
        return f"Reference: every pixel, stored{read}."
    if capture.get("uniform") is None:
        lines = f"every line at {receipt['settings']['camera']['exposure_ms']:g} ms"
        return f"Reference: {lines}, stored as captured{read}."
    return f"Reference: the cheapest good uniform scan ({capture['uniform_scan']}), stored as captured{read}."


def format_score(receipt: Mapping[str, Any]) -> str:
    """Return the score of the map in one or two sentences: against labels, else as its own probabilities expect."""
    if (accuracy := receipt.get("accuracy")) is not None:
        scene = f" on {TRAINING_SCENE[receipt['training_scene']]}" if "training_scene" in receipt else ""
        right = format_points(accuracy.get("overall_accuracy"))
        score = f"mIoU {format_points(accuracy['miou'])} of 100 against the labels{scene} ({right} % of pixels correct)"
        if control := receipt.get("control"):
            score += f"; the best uniform scan of the same seconds gives {format_points(control['miou'])}"
        return f"{score}. {format_worst_class(accuracy)}".rstrip()
    expected = receipt.get("expected") or {}
    predicted = format_prediction(expected.get("miou"), expected.get("error"))
    if predicted and not warnings_of(receipt):
        return f"Expected mIoU {predicted} of 100, estimated from the map's own probabilities."
    left = "the accuracy was left out; the same survey with --accuracy adds it in a new run"
    known = [expected.get("not_predicted"), left if receipt["settings"].get("accuracy") is False else None]
    why = "; ".join(filter(None, known)) or "the score is not known: there are no labels"
    return f"{why[0].upper()}{why[1:]}."


def format_second_pass(receipt: Mapping[str, Any]) -> str:
    """Return a sentence on what was captured again, where and why; empty without a second pass."""
    plan = receipt.get("plan", {})
    if not plan.get("lines"):
        return ""
    what, _, why = plan["reason"].partition("; ")
    place = f", mostly {plan['place']}" if plan.get("place") else ""
    return f"{what[0].upper()}{what[1:]}{place}{f'; {why}' if why else ''}."


def headline(receipt: Receipt) -> list[str]:
    """Return two paragraphs: the classes of the field; the score and the capture time."""
    sentences = [format_score(receipt), *filter(None, [format_second_pass(receipt)])]
    if "capture_s" in receipt["savings"]:
        row = next(row for row in saving_rows(receipt) if row["label"] == COST_LABELS["capture_s"][0])
        sentences.append(
            f"Capture time: {row['done']} ({format_percent(row['ratio'])} of the reference, {row['full']})."
        )
    return [class_sentence(receipt), " ".join(sentences)]


def print_summary(receipt: Receipt, console: Console, *, verbose: bool = False) -> None:
    """Print warnings, classes, score, leading savings, their reference, saturation, lost lines, and a prior map.

    With ``verbose`` print all savings, the stages that ran or were read from the archive, and the effects.
    """
    show_warnings(warnings_of(receipt), console)
    for sentence in filter(None, (class_sentence(receipt), format_score(receipt), format_second_pass(receipt))):
        console.print(escape(sentence))
    rows = [row for row in saving_rows(receipt) if verbose or row["label"] in LEADING]
    shown_in = {"this survey": "done", "uniform scan": "control", "reference": "full", "fraction": "ratio"}
    if "control" not in receipt:
        del shown_in["uniform scan"]
    rows = [{**row, "ratio": format_percent(row["ratio"])} for row in rows]
    cells = [[row["label"], *(row[name] for name in shown_in.values())] for row in rows]
    costs = table(("", *shown_in), cells, whole=tuple(shown_in))
    costs.show_edge = False  # a blank line below
    console.print()
    console.print(costs)
    console.print(escape(format_reference(receipt)))
    shown = {part: receipt[part] for part in ("signal", "lines", "prior_map") if receipt.get(part)}
    for name, words in finding_rows(shown):
        console.print(escape(f"{name}: {words}"), soft_wrap=True)  # numbers have spaces
    if not verbose:
        return
    stages = [
        [escape(one["name"]), _state(one), format_seconds(one["wall_s"]), format_bytes(one["bytes_out"])]
        for one in receipt["stages"]
    ]
    console.print(table(("stage", "state", "wall time", "written"), stages, left=2))
    if "effects_total" in receipt:
        print_effects(receipt["effects"], receipt["effects_total"], console)


def _state(stage: Mapping[str, Any]) -> str:
    return escape(f"left out: {stage['why']}") if stage["state"] == "left out" else str(stage["state"])


def print_effects(effects: Iterable[Mapping[str, Any]], total: Mapping[str, Any], console: Console) -> None:
    """Print a row for every effect that the rig has, with the reason for its state and its error bound; the totals."""
    cells = [
        [
            *(escape(word) for word in (row["name"], row["variant"] or "off", row["reason"])),
            escape(str(row["magnitude"]).removeprefix(f"{row['name']}: ")),
            "none" if row["bound"] is None else f"{row['bound']:.2g}",
        ]
        for row in effects
        if row["reason"] != "absent"
    ]
    columns = ("effect", "computed", "reason", "magnitude", "error")
    console.print(table(columns, cells, left=4, whole=(*columns[:3], "error")))
    unit = UNIT_NAMES[total["unit"]]
    tolerance = "any number of" if total["tolerance"] is None else f"{total['tolerance']:g}"
    bound = "without a bound" if total["bound"] is None else f"at most {total['bound']:.2g} {unit}"
    saved = f" Saved processor time: about {format_seconds(total['saved_s'])}." if total["saved_s"] > 0 else ""
    console.print(
        f"Effects computed: {total['on']} of {total['on'] + total['off']} (asked: {escape(str(total['asked']))}, "
        f"tolerance {tolerance} {unit}). Change of a stored number by the others: {bound}.{saved}"
    )


def finding_rows(found: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the findings of a receipt as rows of a table: label, and figures with their names.

    Zeros, what is empty, and costs, which the savings have, are left out.
    """
    words: dict[str, list[str]] = {}
    for label, part, name, show in _SHOWN:
        if value := (found.get(part) or {}).get(name):
            words.setdefault(label, []).append(show(value))
    rows = [(label, "; ".join(figures)) for label, figures in words.items()]
    for name, one in found.get("pointing", {}).items():
        if isinstance(one, Mapping):
            figures = [show(one[figure]) for figure, show in _OF_POINTING.items() if one.get(figure)]
            rows.append((f"pointing, {name}", "; ".join(figures)))
    for name, facts in found.get("lines", {}).items():
        counts = ", ".join(f"{count} {what}" for what, count in facts.items() if count)
        rows.append((f"sweep {name}", f"lines left out: {counts}"))
    return [(label, words) for label, words in rows if words]


def _scan(scan: Mapping[str, Any]) -> str:
    words = f"{format_scan(scan['step'], scan['exposure_ms'])}, {scan['seconds']:.1f} s"
    predicted = format_prediction(scan["expected_miou"], scan.get("expected_spread"))
    return f"{words}, expected mIoU {predicted}" if predicted else words


def _counts(words: str) -> Callable[[int], str]:
    return lambda count: f"{format_count(count)} {words}"


def _fractions(words: str) -> Callable[[float], str]:
    return lambda fraction: f"{format_percent(fraction)} {words}"


def _areas(hectares: Mapping[str, float]) -> str:
    return ", ".join(f"{spaced(name)} {format_area(area)}" for name, area in hectares.items() if area)


def _changes(pairs: Sequence[Sequence[Any]], show: Callable[[Any], str]) -> str:
    return ", ".join(f"{spaced(old)} to {spaced(new)} {show(size)}" for size, *_, old, new in pairs[:MOST_NAMED])


# figures of the receipt: row, part, name, and text
_SHOWN: Sequence[tuple[str, str, str, Callable[[Any], str]]] = (
    ("field", "field", "view_deg", lambda view: f"view {' x '.join(f'{one:.3g}' for one in view)} degrees"),
    ("field", "field", "range_m", lambda range_m: f"range {format_metres(range_m['median'])}"),
    ("field", "field", "hectares", format_area),
    ("field", "field", "ground_pixel_m", lambda side: f"ground pixel {format_metres(side)}"),
    ("field", "field", "hectares_per_hour", lambda pace: f"hectares per hour {three_digits(pace)}"),
    ("plan", "plan", "reason", str),
    ("signal", "signal", "saturated", _fractions(SATURATED)),
    ("pixels", "pixels", "px_no_reading", _counts("px no reading")),
    ("pixels", "pixels", "map_without_a_class", _counts("px without a class")),
    ("captured", "extent", "patches_touched", _fractions("of the patches")),
    ("captured", "extent", "expected_wrong", _fractions("of the pixels expected wrong")),
    ("captured", "extent", "due_left", _counts("patches beyond --max-age left")),
    ("prior map", "prior_map", "run", str),
    ("prior map", "prior_map", "days", format_days),
    ("prior map", "prior_map", "changed_px", _counts("px changed")),
    ("prior map", "prior_map", "changes", lambda changes: _changes(changes, _counts("px"))),
    ("uniform scans", "scans", "taken", lambda scan: f"this one: {_scan(scan)}"),
    ("uniform scans", "scans", "best_in_time", lambda scan: f"best in the same time: {_scan(scan)}"),
    ("uniform scans", "scans", "reference", lambda scan: f"cheapest near the best: {_scan(scan)}"),
    ("classes", "areas", "ha", _areas),
    ("changed", "ground", "changes_ha", lambda changes: _changes(changes, format_area)),
)
_OF_POINTING: Mapping[str, Callable[[Any], str]] = {
    "sweeps": lambda sweeps: f"corrected by up to {max(math.hypot(*one) for one in sweeps.values()):.1f} px",
    "residual_rms_px": lambda rms: f"residual rms {rms:.2f} px",
    "not_found": lambda names: f"not found {', '.join(names)}",
    "too_narrow": lambda overlaps: f"{counted(len(overlaps), 'overlap')} too narrow to compare",
    "partly_seen": lambda count: f"partly seen {count}",
}
