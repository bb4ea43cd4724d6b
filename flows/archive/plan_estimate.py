"""Estimates of a survey before it runs: seconds, bytes, multiply-adds, score, and the source of each figure."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from flows.settings.survey_settings import BUILT_IN_SCENES
from flows.settings.values import KEEP_SIGNAL
from flows.tasks.run import SurveyRun
from flows.tasks.scores import JUDGING, MOST_ERROR, format_prediction
from flows.terminal.figures import DASH, counted, format_bytes, format_count, format_seconds, known_number
from flows.terminal.progress import table
from pipeline.planning.fine_pass import FinePlan
from pipeline.planning.prices import BYTES_PER_SAMPLE, prices_of, raw_bytes
from pipeline.signal.subspace import SMALL_FIELD
from storage.archive.lineage import Catalogue
from storage.archive.records import Run

TITLE = "Estimates: nothing of this has run"
LABELS: Mapping[str, tuple[str, Callable[[float | None], str]]] = {
    "capture_s": ("time at the camera", format_seconds),
    "bytes_captured": ("bytes captured", format_bytes),
    "bytes_kept": ("bytes kept", format_bytes),
    "multiply_adds": ("model's multiply-adds", format_count),
    "miou": ("mIoU", lambda score: format_prediction(score, None) or DASH),
    "cpu_s": ("processor time", format_seconds),
}
# Bytes kept, fitted to seven surveys (docs/background/signal.md): receipt and report, their pictures for a pixel of a
# side, the map for a pixel, and the scores of a spectrum, which follow the bands of a file.
PAGE, PICTURE_SIDE, MAP_PIXEL = 300_000, 1600.0, 5.0
FARM_SCORES, LARGE_FARM_SCORES, FILE_SCORES, BANDS_POWER = 17.0, 4.5, 2.4, 0.57
KEPT_FROM = "pixels, spectra and bands, by surveys of seven fields, which kept 0.5 to 2 times as much"


@dataclass(frozen=True)
class Estimate:
    """A figure of a survey that has not run; None where nothing tells it."""

    value: float | None
    known_from: str
    at_most: bool = False
    spread: float | None = None  # a standard deviation


def estimate_survey(run: SurveyRun, fine: FinePlan | None, catalogue: Catalogue) -> dict[str, Estimate]:
    """Return what a survey would take and score, by the names of `LABELS`; of a raster nothing of a camera.

    ``fine`` is the fine pass where it is planned already. What an archive's last survey of such a source with the same
    weights took stands for what only measuring tells.
    """
    found = {} if run.raster is not None else _of_camera(run, fine)
    like = _last_alike(run, catalogue)
    return {
        **found,
        "bytes_kept": _kept(run, like, 0.0 if run.raster is not None else found["bytes_captured"].value or 0.0),
        "multiply_adds": _multiply_adds(run, fine),
        "miou": _score(run),
        "cpu_s": _processor_time(run, like),
    }


def _of_camera(run: SurveyRun, fine: FinePlan | None) -> dict[str, Estimate]:
    """Return seconds and bytes of the passes; of a fine pass that is not planned yet, the most there is for it."""
    plan, camera, bands = run.plan, run.camera, len(run.scene.wavelength_nm)
    open_end = fine is None and not plan.plain
    captured = raw_bytes([*plan.coarse, *(fine.sweeps if fine else ())], camera, bands)
    if open_end:
        lines = max(prices_of(camera, run.settings.cost).most_lines(plan.fine_s, 1), 0)
        captured += lines * camera.samples * bands * BYTES_PER_SAMPLE
    seconds = plan.coarse_s + (plan.fine_s if fine is None else fine.seconds)
    return {
        "capture_s": Estimate(seconds, "the cost model of mirror and camera", open_end),
        "bytes_captured": Estimate(captured, "lines, samples and bands of the passes", open_end),
    }


def _multiply_adds(run: SurveyRun, fine: FinePlan | None) -> Estimate:
    """Count the model over the patches that are read in detail, as far as it is known which these are."""
    patch_index: NDArray[np.integer] = run.likely_patches
    if not run.plan.plain and fine is not None:
        patch_index = fine.patch_index
    done = run.work_done(patch_index).total
    return Estimate(done, "the size of network and field", at_most=fine is None and run.chooses)


def _score(run: SurveyRun) -> Estimate:
    """Take the weights' record of the scan, else what they scored on whole scenes kept for validation."""
    record = run.described.record
    if (scan := run.scans.chosen) is not None:
        scenes = counted(int(record["scans"]["scenes"]), "scene")
        source = f"the weights' record of such scans, {scenes}"
        if scan.spread is not None and scan.spread > MOST_ERROR:
            return Estimate(None, f"{source}, which differ too much")
        return Estimate(scan.expected["mIoU"], source, at_most=run.budget is not None, spread=scan.spread)
    validation = record.get("validation") or {}
    whole = known_number((validation.get("all") or {}).get("miou"))
    if whole is None:
        return Estimate(None, "no scene was kept for validation when the weights were trained")
    source = f"these weights on {counted(int(validation['scenes']), 'scene')} kept for validation, read whole"
    return Estimate(whole, source, at_most=run.chooses or not run.plan.plain)


def _kept(run: SurveyRun, like: Run | None, captured: float) -> Estimate:
    pixels, bands = math.prod(run.scene.shape), len(run.scene.wavelength_nm)
    if like is not None and _pixels(like) == pixels:
        told = like.receipt.get("data_bytes")
        if (kept := known_number(told.get("kept")) if isinstance(told, Mapping) else None) is not None:
            return Estimate(kept, f"{like.folder.name}, of as many pixels")
    is_farm = run.settings.scene in BUILT_IN_SCENES
    kept = estimated_bytes(pixels, bands, captured, is_farm=is_farm, most=run.settings.kept_bytes)
    if run.settings.keep == KEEP_SIGNAL:
        return Estimate(kept, KEPT_FROM)
    return Estimate(kept + captured, f"{KEPT_FROM}, and raw lines as they are captured", at_most=True)


def estimated_bytes(pixels: int, bands: int, captured: float, *, is_farm: bool, most: float | None = None) -> float:
    """Return the bytes that a run keeps of a field, without raw lines, by what surveys kept.

    ``captured`` are bytes of raw lines, 0 of a raster; ``most`` limits those of the scores.
    """
    spectra = pixels + captured / (BYTES_PER_SAMPLE * bands)  # of the mosaic and of the lines
    of_farm = FARM_SCORES if pixels < SMALL_FIELD else LARGE_FARM_SCORES
    scores = spectra * (of_farm if is_farm else FILE_SCORES * bands**BANDS_POWER)
    scores = scores if most is None else min(scores, most)
    return PAGE + PICTURE_SIDE * math.sqrt(pixels) + MAP_PIXEL * pixels + scores


def _processor_time(run: SurveyRun, like: Run | None) -> Estimate:
    """Scale what the last survey took by its pixels; what is judged by labels does not count."""
    rows = [] if like is None else [row for row in like.stages if row.get("name") != JUDGING]
    seconds = [known_number(row.get("cpu_s")) for row in rows if row.get("state") == "ran"]
    if like is None or len(seconds) < len(rows) or not seconds:
        return Estimate(None, "known once a survey of this kind has run into this archive")
    spent = sum(one for one in seconds if one is not None)
    return Estimate(spent * math.prod(run.scene.shape) / _pixels(like), f"{like.folder.name}, by its pixels")


def _last_alike(run: SurveyRun, catalogue: Catalogue) -> Run | None:
    """Return the newest run from such a source that was read with the same weights, if its receipt has a size."""
    for one in reversed(catalogue.runs):
        segmented = next((row for row in one.stages if row.get("name") == "segment"), {})
        alike = one.receipt.get("source") == run.source.name and segmented.get("state") == "ran"
        if alike and one.problem is None and _pixels(one) and _weights_of(one, catalogue) == run.weights_key:
            return one
    return None


def _weights_of(run: Run, catalogue: Catalogue) -> Any:
    address = "/".join(run.products.get("class_map", "").split("/")[:3])
    store = catalogue.stores.get(address)
    return None if store is None else store.params.get("weights")


def _pixels(run: Run) -> int:
    field = run.receipt.get("field")
    size = field.get("size_px") if isinstance(field, Mapping) else None
    return (
        math.prod(size)
        if isinstance(size, Sequence) and len(size) == 2 and all(isinstance(n, int) for n in size)
        else 0
    )


def estimate_table(estimates: Mapping[str, Mapping[str, Any]]) -> Table:
    """Return the estimates as a table for the terminal: what, how much, from what."""
    rows = []
    for name, one in estimates.items():
        label, show = LABELS[name]
        words = show(one["value"])
        if one["spread"] is not None and one["value"] is not None:
            words = format_prediction(one["value"], one["spread"])
        known = one["value"] is not None
        rows.append([label, f"at most {words}" if one["at_most"] and known else words, one["known_from"]])
    return table(("", "about", "from"), rows, left=3, title=TITLE, whole=("", "about"))
