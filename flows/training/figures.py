"""Judge new weights on validation scenes: placements, cascade and uniform scans."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spectralzoom.flows.training.data import Report
from spectralzoom.models.evaluation import metrics
from spectralzoom.models.evaluation.expected_scores import MapScores, ScoredMap, expected_counts
from spectralzoom.models.network.spectral import LineSpec
from spectralzoom.models.policies.placement import ReadTwice
from spectralzoom.models.reading.inference import coarse_prediction_of_columns, map_of_columns
from spectralzoom.models.training.capture_augmentation import REFERENCE_MS, STEPS, CaptureAugmentation
from spectralzoom.models.training.examples import Example
from spectralzoom.models.weights.files import Weights
from spectralzoom.pipeline.geometry.grid import UNLABELLED, SceneGrid
from spectralzoom.pipeline.planning.coverage import frame_patches

VALIDATED_FRACTION = 0.35  # of the patches: that of surveys with K = 35 %


def read_twice(weights: Weights, examples: Iterable[Example]) -> list[ReadTwice]:
    """Segment each scene by the overview alone, and in full."""
    found = []
    for example in examples:
        grid, labels = _parts(weights, example)
        seen = coarse_prediction_of_columns(weights, example.columns.astype(np.float32), grid)
        found.append(ReadTwice.of(weights, seen, labels))
    return found


def validate(scenes: Sequence[ReadTwice], classes: int) -> dict[str, Any] | None:
    """Return `agreement` over all scenes with no patch, some by gain, and all; None without a scene."""
    if not scenes:
        return None
    rows: dict[str, list[metrics.Counts]] = {"none": [], "gain": [], "all": []}
    for scene in scenes:
        part = np.zeros(scene.gain.shape, np.bool_)
        part[frame_patches(scene.gain, VALIDATED_FRACTION)] = True
        for name, chosen in zip(rows, (np.zeros_like(part), part, np.ones_like(part)), strict=True):
            rows[name].append(scene.counts(chosen, classes))
    figures = {name: metrics.agreement(np.sum(counts, axis=0)) for name, counts in rows.items()}
    return {"scenes": len(scenes), "fraction": VALIDATED_FRACTION, **figures}


def judge_calibration(weights: Weights, examples: Iterable[Example], seed: int) -> dict[str, Any] | None:
    """Return the calibration of maps of full scans; None without a scene."""
    maps = []
    for example in examples:
        grid, labels = _parts(weights, example)
        _, every_class = map_of_columns(weights, example.columns.astype(np.float32), grid)
        valid = (labels != UNLABELLED) & ~np.isnan(every_class[..., 0])
        maps.append(metrics.JudgedMap(every_class[valid], labels[valid]))
    return metrics.judge_confidence(maps, seed) if maps else None


SCAN_EXPOSURES = (1.0, 0.5, 0.25, 0.12, 0.06, 0.03)  # of the reference; the darkest of the training is judged, too


def judge_scans(
    weights: Weights,
    examples: Sequence[Example],
    augmentation: CaptureAugmentation | None,
    seed: int,
    report: Report = lambda what, done, figure: None,
) -> tuple[dict[str, Any], MapScores] | None:
    """Return the scores of uniform scans, read in full, for a record, and corrections of expected scores.

    None without a scene, or without an ``augmentation``: the training then had the reference exposure alone. In the
    record ``miou`` and the IoU of each class are tables (step, exposure) of means over the scenes. ``spread`` is the
    standard deviation of their mIoU, ``calibration_error`` that of all pixels together. Scans are simulated by the
    augmentation of the training.
    """
    known = [example for example in examples if example.noise is not None]
    if not known or augmentation is None:
        return None
    steps = [step for step in STEPS if all(len(one.labels) % step == 0 for one in known)]
    usual = [fraction * REFERENCE_MS for fraction in SCAN_EXPOSURES]
    exposures = [*(ms for ms in usual if ms > augmentation.min_exposure_ms), augmentation.min_exposure_ms]
    miou, spread, calibration = np.zeros((3, len(steps), len(exposures)))
    of_classes = np.zeros((len(weights.class_names), len(steps), len(exposures)))
    maps: dict[tuple[int, float], list[ScoredMap]] = {}
    for i, step in enumerate(steps):
        for j, exposure_ms in enumerate(exposures):
            rng = np.random.default_rng([seed, 0x5CA, i, j])
            judged = [_scanned(weights, one, augmentation, step, exposure_ms / REFERENCE_MS, rng) for one in known]
            counts = [one.counts for one, _ in judged]
            calibration[i, j] = metrics.calibration_error(np.sum([sure for _, sure in judged], axis=0))
            own = [metrics.mean_iou(one) for one in counts]
            miou[i, j] = np.nanmean(own)
            spread[i, j] = np.nanstd(own, ddof=1) if len(own) > 1 else np.nan
            with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # of an absent class
                of_classes[:, i, j] = np.nanmean([metrics.iou_per_class(one) for one in counts], axis=0)
            maps[step, exposure_ms] = [one for one, _ in judged]
            figure = f"lines {step} px apart, {exposure_ms:g} ms: {100 * miou[i, j]:.1f}"
            report("judging scans", len(maps) / miou.size, figure)
    record = {
        "scenes": len(known),
        "steps": steps,
        "exposures_ms": exposures,
        "miou": miou.tolist(),
        "spread": spread.tolist() if len(known) > 1 else None,
        "calibration_error": calibration.tolist(),
        "per_class_iou": {
            name: iou.tolist()
            for name, iou in zip(weights.class_names, of_classes, strict=True)
            if np.isfinite(iou).all()
        },
    }
    return record, MapScores.fitted(maps)


def _scanned(
    weights: Weights,
    example: Example,
    augmentation: CaptureAugmentation,
    step: int,
    light: float,
    rng: np.random.Generator,
) -> tuple[ScoredMap, metrics.Floats]:
    """Simulate a uniform scan of a scene and segment it in full; return counts of the map and its confidence."""
    assert example.noise is not None
    grid, labels = _parts(weights, example)
    scan = augmentation.scanned(
        example.columns, example.noise, light=light, step=step, rng=rng, device=weights.segmenter.device
    )
    drawn, every_class = map_of_columns(weights, scan, grid, LineSpec(light, step))
    valid = (labels != UNLABELLED) & np.isfinite(drawn.confidence)
    sure = metrics.confidence_counts(drawn.confidence[valid], drawn.classes[valid] == labels[valid])
    counts = metrics.confusion(labels, drawn.classes, weights.config.classes)
    return ScoredMap(counts, expected_counts([every_class[valid]], weights.config.classes)), sure


def _parts(weights: Weights, example: Example) -> tuple[SceneGrid, NDArray[np.uint8]]:
    grid = SceneGrid(*example.shape, weights.config.patch)
    return grid, example.labels[: grid.height, : grid.width]


def miou_of(weights: Weights, examples: Sequence[Example]) -> float:
    """Return the mIoU of all scenes together, by every line at the reference exposure."""
    counts = np.zeros((weights.config.classes,) * 2, np.int64)
    for example in examples:
        grid, labels = _parts(weights, example)
        drawn, _ = map_of_columns(weights, example.columns.astype(np.float32), grid)
        counts += metrics.confusion(labels, drawn.classes, weights.config.classes)
    return metrics.mean_iou(counts)
