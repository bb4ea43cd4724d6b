"""Estimate what a planned survey takes: seconds of the camera, bytes, multiply-adds and score, each with its source."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from spectralzoom.flows.plan import SurveyPlan
from spectralzoom.flows.publish.scores import MOST_ERROR, format_prediction
from spectralzoom.flows.terminal.figures import DASH, counted, format_bytes, format_count, format_seconds, known_number
from spectralzoom.flows.terminal.progress import table
from spectralzoom.pipeline.planning.coverage import BYTES_PER_SAMPLE, patches_shown, raw_bytes
from spectralzoom.pipeline.planning.fine_pass import FinePlan
from spectralzoom.pipeline.planning.uniform_scans import MIOU, format_scan
from spectralzoom.storage.runs import Run, read_run
from spectralzoom.storage.store import Archive, is_archive, run_stem

MOST_SCANS = 8  # in the table


def scan_table(scans: Mapping[str, Any]) -> Table:
    """Return two passes and the best uniform scans of other time budgets: seconds, bytes, multiply-adds and score."""
    named = {
        "this survey": scans["taken"],
        "best uniform scan in this time": scans["best_in_time"],
        "cheapest near the best": scans["reference"],
    }
    bound = "at most " if scans["at_most"] else ""
    every = scans["candidates"][:: math.ceil(len(scans["candidates"]) / MOST_SCANS)]
    rows = {
        one["seconds"]: [
            format_scan(one["step"], one["exposure_ms"]),
            ", ".join(name for name, marked in named.items() if marked == one),
            format_seconds(one["seconds"]),
            format_bytes(one["bytes_raw"]),
            format_count(one["multiply_adds"]),
            f"{bound}{score}" if (score := format_prediction(one["expected_miou"], one["expected_spread"])) else DASH,
        ]
        for one in (*every, *named.values())
        if one is not None
    }
    cells = [*rows.items()]
    if (zoomed := scans["two_passes"]) is not None:
        first = format_scan(zoomed["step"], zoomed["exposure_ms"])
        mark = "this survey, two passes" if zoomed["taken"] else "two passes"
        words = [format_estimate(name, zoomed[name]) for name in LABELS if name != "miou"]
        score = DASH if zoomed["miou"]["at_most"] else format_estimate("miou", zoomed["miou"])  # no score by the record
        cells.append((zoomed["capture_s"]["value"], [first, mark, *words, score]))
    columns = ("scan or first pass", "", "capture time", "bytes captured", "multiply-adds", "mIoU, about")
    return table(columns, [row for _, row in sorted(cells)], left=2, whole=columns[2:])


LABELS: Mapping[str, tuple[str, Callable[[float | None], str]]] = {
    "capture_s": ("capture time", format_seconds),
    "bytes_captured": ("bytes captured", format_bytes),
    "multiply_adds": ("model's multiply-adds", format_count),
    "miou": ("mIoU", lambda score: format_prediction(score, None) or DASH),
}


@dataclass(frozen=True)
class Estimate:
    """A figure of a survey that has not run; None where it cannot be estimated."""

    value: float | None
    known_from: str
    at_most: bool = False
    at_least: bool = False
    spread: float | None = None  # a standard deviation
    range: tuple[float, float] | None = None  # of other scenes


def estimate_survey(plan: SurveyPlan, fine: FinePlan | None, unscored: str) -> dict[str, dict[str, Any]]:
    """Return what a survey would take and score, `Estimate`s by the names of `LABELS`; a raster has no seconds.

    ``fine`` is the fine pass, where it is planned already; ``unscored`` is why no score is expected, or empty.
    """
    camera = {} if plan.field.raster is not None else _of_camera(plan, fine)
    score = Estimate(None, unscored) if unscored else _score(plan)
    found = {**camera, "multiply_adds": _work(plan, fine), "miou": score}
    return {name: asdict(one) for name, one in found.items()}


def _work(plan: SurveyPlan, fine: FinePlan | None) -> Estimate:
    """Return the multiply-adds with the patches that an earlier run of the field read, or that other scenes needed."""
    likely = plan.reading.likely()
    if plan.reading.least_gain is None:  # patches are chosen before the map is drawn
        patch_index = likely[0] if fine is None or not fine.sweeps else fine.patch_index
        work = plan.reading.work_done(patch_index, None if fine is None else fine.changed).total
        return Estimate(work, "network and field", fine is None and plan.reading.chooses)
    changed, source = likely_changed(plan) if fine is None else fine.changed, "the patches that other scenes needed"
    if (run := _earlier_run(plan)) is not None:
        likely = (plan.field.kept_patches[: run.receipt["kept"]["patches"]],)
        source = f"the patches that {run.folder.name} read"
    every = format_count(plan.reading.work_done(plan.field.kept_patches, changed).total)
    work, *ends = (plan.reading.work_done(some, changed).total for some in likely)
    return Estimate(work, f"{source}; {every} with every patch", range=None if len({*ends}) < 2 else (ends[0], ends[1]))


def likely_changed(plan: SurveyPlan) -> NDArray[np.intp] | None:
    """Return the patches of which a second pass shows a part if all of them gain alike; None for a uniform scan."""
    planner, record, patches = plan.request.planner, plan.request.scan_record, plan.field.grid.every_patch()
    if planner is None:
        return None
    alike = np.isin(patches, plan.field.kept_patches) / len(patches)
    fine = planner.by_score(alike)
    if record is not None:
        fine = planner.best(record, lambda *scan: alike * record.expected(*scan)[MIOU])
    return np.flatnonzero(patches_shown(fine.sweeps, plan.field.grid, planner.camera))


def _earlier_run(plan: SurveyPlan) -> Run | None:
    """Return the newest run of the same field that chose patches by the same gain."""
    field, settings = plan.field, plan.settings
    alike = plan.reading.figures(field.kept_patches)
    folders = Archive(Path(settings.out).absolute()).runs() if is_archive(settings.out) else []
    for run in (read_run(one) for one in reversed(folders) if run_stem(field.name) in one.name):
        if (run.receipt.get("survey"), run.settings.get("seed")) == (field.name, settings.seed):
            kept = run.receipt.get("kept")
            if not isinstance(kept, dict) or not isinstance(kept.get("patches"), int):
                continue
            if all(kept.get(name) == alike[name] for name in ("asked", "of_patches")):
                return run
    return None


def _of_camera(plan: SurveyPlan, fine: FinePlan | None) -> dict[str, Estimate]:
    """Return seconds and bytes of the passes.

    A fine pass that is not planned yet counts with all of its budget, and with as many lines as can fit into it.
    """
    camera = plan.field.camera
    bands = len(plan.field.scene.wavelength_nm)
    captured = raw_bytes([*plan.passes.coarse, *(fine.sweeps if fine else ())], camera, bands)
    open_end = fine is None and not plan.passes.plain
    if fine is None and (second := plan.request.planner) is not None:
        record = None if plan.field.recorded else plan.request.scan_record
        left = raw_bytes(second.swaths, camera, bands) - second.interlaces * captured
        offered_ms = second.recorded_ms or ((camera.exposure_ms,) if record is None else record.offered_ms(camera))
        lines = int(plan.passes.fine_s / (replace(camera, exposure_ms=offered_ms[0]).frame_ms * 1e-3))
        captured += min(lines * camera.samples * bands * BYTES_PER_SAMPLE, left)
    seconds = plan.passes.coarse_s + (plan.passes.fine_s if fine is None else fine.seconds)
    return {
        "capture_s": Estimate(seconds, "the cost model of mirror and camera", open_end),
        "bytes_captured": Estimate(captured, "lines, samples and bands of the passes", open_end),
    }


def _score(plan: SurveyPlan) -> Estimate:
    """Return the score by the weights' table of scans, else by the scenes that were kept for validation."""
    if plan.part:
        return Estimate(None, "a part of the field is captured, the prior map shows the rest")
    if (scan := plan.scans.chosen) is not None:
        scenes = int((plan.field.described.scans(plan.settings.law) or {})["scenes"])
        source = f"the weights' record of such scans, {counted(scenes, 'scene')}"
        if scan.spread is not None and scan.spread > MOST_ERROR:
            return Estimate(None, f"{source}; the scenes differ too much")
        return Estimate(scan.expected["mIoU"], source, at_most=plan.reading.budget is not None, spread=scan.spread)
    if (zoomed := plan.scans.two_passes) is not None and plan.request.scan_record is not None:
        return Estimate(zoomed.expected, "the weights' record of uniform scans and both passes", at_least=True)
    validation = plan.field.described.record.get("validation") or {}
    whole = known_number((validation.get("all") or {}).get("miou"))
    if whole is None:
        return Estimate(None, "no scene was kept for validation when the weights were trained")
    source = f"these weights on {counted(int(validation['scenes']), 'scene')} kept for validation, read whole"
    return Estimate(whole, source, at_most=plan.reading.chooses or not plan.passes.plain)


def format_estimate(name: str, one: Mapping[str, Any]) -> str:
    """Return an estimate of a name in `LABELS` as text, with its bound or spread."""
    words = LABELS[name][1](one["value"]) if one["spread"] is None else format_prediction(one["value"], one["spread"])
    if one["range"] is not None:
        words += f" ({' to '.join(map(LABELS[name][1], one['range']))})"
    bound = "at most {}" if one["at_most"] else "{} or more" if one["at_least"] else "{}"
    return words if one["value"] is None else bound.format(words)
