"""Estimates of a survey before it runs: seconds, bytes, multiply-adds, score, and the source of each figure."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from rich.table import Table

from flows.settings.survey_settings import BUILT_IN_SCENES
from flows.settings.values import KEEP_SIGNAL
from flows.tasks.run import SurveyRun
from flows.tasks.scores import MOST_ERROR, format_prediction
from flows.terminal.figures import DASH, counted, format_bytes, format_count, format_seconds, known_number
from flows.terminal.progress import table
from pipeline.planning.fine_pass import FinePlan
from pipeline.planning.prices import BYTES_PER_SAMPLE, raw_bytes
from pipeline.signal.subspace import SMALL_FIELD

TITLE = "Estimates: nothing of this has run"
LABELS: Mapping[str, tuple[str, Callable[[float | None], str]]] = {
    "capture_s": ("capture time", format_seconds),
    "bytes_captured": ("bytes captured", format_bytes),
    "bytes_kept": ("bytes kept", format_bytes),
    "multiply_adds": ("model's multiply-adds", format_count),
    "miou": ("mIoU", lambda score: format_prediction(score, None) or DASH),
}
# Bytes kept, fitted to seven surveys (docs/background/signal.md): receipt and report; pictures, by the side of the
# field; the map, by its pixels; and the scores of a spectrum, by the bands of a file.
PAGE, PICTURE_SIDE, MAP_PIXEL = 300_000, 1600.0, 5.0
FARM_SCORES, LARGE_FARM_SCORES, FILE_SCORES, BANDS_POWER = 17.0, 4.5, 2.4, 0.57
KEPT_FROM = "pixels, spectra and bands, by surveys of seven fields, which kept 0.5 to 2 times as much"


@dataclass(frozen=True)
class Estimate:
    """A figure of a survey that has not run; None where it cannot be estimated."""

    value: float | None
    known_from: str
    at_most: bool = False
    spread: float | None = None  # a standard deviation


def estimate_survey(run: SurveyRun, fine: FinePlan | None) -> dict[str, Estimate]:
    """Return what a survey would take and score, by the names of `LABELS`; a raster has no seconds of a camera.

    ``fine`` is the fine pass, where it is planned already.
    """
    camera = {} if run.raster is not None else _of_camera(run, fine)
    patch_index = run.likely_patches if run.plan.plain or fine is None else fine.patch_index
    done = run.work_done(patch_index).total
    return {
        **camera,
        "bytes_kept": _kept(run, (camera["bytes_captured"].value or 0.0) if camera else 0.0),
        "multiply_adds": Estimate(done, "the size of network and field", at_most=fine is None and run.chooses),
        "miou": _score(run),
    }


def _of_camera(run: SurveyRun, fine: FinePlan | None) -> dict[str, Estimate]:
    """Return seconds and bytes of the passes; a fine pass that is not planned yet counts with all of its budget."""
    plan, camera, bands = run.plan, run.camera, len(run.scene.wavelength_nm)
    open_end = fine is None and not plan.plain
    captured = raw_bytes([*plan.coarse, *(fine.sweeps if fine else ())], camera, bands)
    if open_end:
        captured += int(plan.fine_s / (camera.frame_ms * 1e-3)) * camera.samples * bands * BYTES_PER_SAMPLE
    seconds = plan.coarse_s + (plan.fine_s if fine is None else fine.seconds)
    return {
        "capture_s": Estimate(seconds, "the cost model of mirror and camera", open_end),
        "bytes_captured": Estimate(captured, "lines, samples and bands of the passes", open_end),
    }


def _score(run: SurveyRun) -> Estimate:
    """Return the score by the weights' table of scans, else by the scenes that were kept for validation."""
    record = run.described.record
    if (scan := run.scans.chosen) is not None:
        scenes = counted(int(record["scans"]["scenes"]), "scene")
        source = f"the weights' record of such scans, {scenes}"
        if scan.spread is not None and scan.spread > MOST_ERROR:
            return Estimate(None, f"{source}; the scenes differ too much")
        return Estimate(scan.expected["mIoU"], source, at_most=run.budget is not None, spread=scan.spread)
    validation = record.get("validation") or {}
    whole = known_number((validation.get("all") or {}).get("miou"))
    if whole is None:
        return Estimate(None, "no scene was kept for validation when the weights were trained")
    source = f"these weights on {counted(int(validation['scenes']), 'scene')} kept for validation, read whole"
    return Estimate(whole, source, at_most=run.chooses or not run.plan.plain)


def _kept(run: SurveyRun, captured: float) -> Estimate:
    pixels, bands, is_farm = (
        math.prod(run.scene.shape),
        len(run.scene.wavelength_nm),
        run.settings.scene in BUILT_IN_SCENES,
    )
    kept = estimated_bytes(pixels, bands, captured, is_farm=is_farm, most=run.settings.kept_bytes)
    if run.settings.keep == KEEP_SIGNAL:
        return Estimate(kept, KEPT_FROM)
    return Estimate(kept + captured, f"{KEPT_FROM}, and raw lines as they are captured", at_most=True)


def estimated_bytes(pixels: int, bands: int, captured: float, *, is_farm: bool, most: float | None = None) -> float:
    """Return the bytes that a run keeps of a field without its raw lines, by a fit to surveys.

    ``captured`` is the size of the raw lines, 0 for a raster; ``most`` limits the size of the scores.
    """
    spectra = pixels + captured / (BYTES_PER_SAMPLE * bands)  # of the mosaic and of the lines
    of_farm = FARM_SCORES if pixels < SMALL_FIELD else LARGE_FARM_SCORES
    scores = spectra * (of_farm if is_farm else FILE_SCORES * bands**BANDS_POWER)
    scores = scores if most is None else min(scores, most)
    return PAGE + PICTURE_SIDE * math.sqrt(pixels) + MAP_PIXEL * pixels + scores


def estimate_table(estimates: Mapping[str, Mapping[str, Any]]) -> Table:
    """Return the estimates as a table for the terminal: name, value and source."""
    rows = []
    for name, one in estimates.items():
        label, show = LABELS[name]
        words = show(one["value"])
        if one["spread"] is not None and one["value"] is not None:
            words = format_prediction(one["value"], one["spread"])
        known = one["value"] is not None
        rows.append([label, f"at most {words}" if one["at_most"] and known else words, one["known_from"]])
    return table(("", "about", "from"), rows, left=3, title=TITLE, whole=("", "about"))
