"""Judge new weights on validation scenes: placements, cascade and uniform scans."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spectralzoom.flows.training.data import Report
from spectralzoom.models.evaluation import metrics
from spectralzoom.models.evaluation.expected_scores import MapScores, ScoredMap, expected_counts
from spectralzoom.models.network.spectral import LineSpec
from spectralzoom.models.policies.placement import CascadeTable, ReadTwice
from spectralzoom.models.reading.inference import coarse_prediction_of_columns, map_of_columns
from spectralzoom.models.training.capture_augmentation import REFERENCE_MS, STEPS, CaptureAugmentation
from spectralzoom.models.training.examples import Example
from spectralzoom.models.weights.files import BY_LAW, CASCADE, Weights
from spectralzoom.pipeline.geometry.grid import UNLABELLED, SceneGrid
from spectralzoom.pipeline.planning.coverage import frame_patches

VALIDATED_FRACTION = 0.35  # of the patches: that of surveys with K = 35 %


def judge_reading(weights: Weights, examples: Iterable[Example]) -> dict[str, Any]:
    """Return the figures of scenes with no patch, some by gain, and all, and the cascade of a network, for a record."""
    scenes = []
    for example in examples:
        grid, labels = _parts(weights, example)
        seen = coarse_prediction_of_columns(weights, example.columns.astype(np.float32), grid)
        scenes.append(ReadTwice.of(weights, seen, labels))
    validation = validate(scenes, weights.config.classes)
    if not weights.config.corrected:
        return {"validation": validation}
    useless = validation["all"]["miou"] <= validation["none"]["miou"]
    losses = CascadeTable.of_overview() if useless else CascadeTable.judged(scenes, weights.config.classes)
    return {"validation": validation, CASCADE: asdict(losses)}


def validate(scenes: Sequence[ReadTwice], classes: int) -> dict[str, Any]:
    """Return `agreement` over all scenes with no patch, some by gain, and all."""
    rows: dict[str, list[metrics.Counts]] = {"none": [], "gain": [], "all": []}
    for scene in scenes:
        part = np.zeros(scene.gain.shape, np.bool_)
        part[frame_patches(scene.gain, VALIDATED_FRACTION)] = True
        for name, chosen in zip(rows, (np.zeros_like(part), part, np.ones_like(part)), strict=True):
            rows[name].append(scene.counts(chosen, classes))
    figures = {name: metrics.agreement(np.sum(counts, axis=0)) for name, counts in rows.items()}
    return {"scenes": len(scenes), "fraction": VALIDATED_FRACTION, **figures}


def judge_calibration(weights: Weights, examples: Iterable[Example], seed: int) -> dict[str, Any]:
    """Return the calibration of maps of full scans."""
    maps = []
    for example in examples:
        grid, labels = _parts(weights, example)
        _, every_class = map_of_columns(weights, example.columns.astype(np.float32), grid)
        valid = (labels != UNLABELLED) & ~np.isnan(every_class[..., 0])
        maps.append(metrics.JudgedMap(every_class[valid], labels[valid]))
    return metrics.judge_confidence(maps, seed)


SCAN_EXPOSURES = (1.0, 0.5, 0.25, 0.12, 0.06, 0.03)  # of the reference; the darkest of the training is judged, too


def judge_scans(
    weights: Weights,
    examples: Sequence[Example],
    laws: Sequence[str],
    augmentation: CaptureAugmentation | None,
    seed: int,
    report: Report = lambda what, done, figure: None,
) -> tuple[dict[str, Any], MapScores] | None:
    """Return the scores of uniform scans, read in full, for a record, and corrections of expected scores.

    None without a scene, or without an ``augmentation``: the training then had the reference exposure alone. In the
    record ``miou`` and the IoU of each class are tables (step, exposure) of means over the scenes; ``spread`` is the
    standard deviation of their mIoU. Built-in scenes of several ``laws``, one for each example, also have a table of
    each law. Scans are simulated by the augmentation of the training.
    """
    known = [(example, law) for example, law in zip(examples, laws, strict=True) if example.noise is not None]
    if not known or augmentation is None:
        return None
    steps = [step for step in STEPS if all(len(one.labels) % step == 0 for one, _ in known)]
    usual = [fraction * REFERENCE_MS for fraction in SCAN_EXPOSURES]
    exposures = [*(ms for ms in usual if ms > augmentation.min_exposure_ms), augmentation.min_exposure_ms]
    judged: dict[tuple[int, float], list[ScoredMap]] = {}
    for i, step in enumerate(steps):
        for j, exposure_ms in enumerate(exposures):
            rng = np.random.default_rng([seed, 0x5CA, i, j])
            light = exposure_ms / REFERENCE_MS
            judged[step, exposure_ms] = [_scanned(weights, one, augmentation, step, light, rng) for one, _ in known]
            miou = np.nanmean([metrics.mean_iou(one.counts) for one in judged[step, exposure_ms]])
            figure = f"lines {step} px apart, {exposure_ms:g} ms: {100 * miou:.1f}"
            report("judging scans", len(judged) / len(steps) / len(exposures), figure)
    names = weights.class_names
    record = _scan_table(judged, names)
    if len({law for _, law in known}) > 1:
        own = {law: [number for number, (_, of) in enumerate(known) if of == law] for _, law in known}
        record[BY_LAW] = {
            law: _scan_table({scan: [found[one] for one in chosen] for scan, found in judged.items()}, names)
            for law, chosen in own.items()
        }
    return record, MapScores.fitted(judged)


def _scan_table(judged: Mapping[tuple[int, float], Sequence[ScoredMap]], class_names: Sequence[str]) -> dict[str, Any]:
    """Return the tables of scans by step and exposure, each judged on the same scenes."""
    steps, exposures = list(dict.fromkeys(step for step, _ in judged)), list(dict.fromkeys(ms for _, ms in judged))
    scenes = len(judged[steps[0], exposures[0]])
    miou, spread = np.full((2, len(steps), len(exposures)), np.nan)
    of_classes = np.zeros((len(class_names), len(steps), len(exposures)))
    for (step, exposure_ms), found in judged.items():
        at = steps.index(step), exposures.index(exposure_ms)
        counts = [one.counts for one in found]
        own = [metrics.mean_iou(one) for one in counts]
        miou[at] = np.nanmean(own)
        spread[at] = np.nanstd(own, ddof=1) if scenes > 1 else np.nan
        with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # of an absent class
            of_classes[:, *at] = np.nanmean([metrics.iou_per_class(one) for one in counts], axis=0)
    return {
        "scenes": scenes,
        "steps": steps,
        "exposures_ms": exposures,
        "miou": miou.tolist(),
        "spread": spread.tolist() if scenes > 1 else None,
        "per_class_iou": {
            name: iou.tolist() for name, iou in zip(class_names, of_classes, strict=True) if np.isfinite(iou).all()
        },
    }


def _scanned(
    weights: Weights,
    example: Example,
    augmentation: CaptureAugmentation,
    step: int,
    light: float,
    rng: np.random.Generator,
) -> ScoredMap:
    """Simulate a uniform scan of a scene, segment it in full, and count its pixels."""
    assert example.noise is not None
    grid, labels = _parts(weights, example)
    scan = augmentation.scanned(
        example.columns, example.noise, light=light, step=step, rng=rng, device=weights.segmenter.device
    )
    drawn, every_class = map_of_columns(weights, scan, grid, LineSpec(light, step))
    valid = (labels != UNLABELLED) & np.isfinite(drawn.confidence)
    counts = metrics.confusion(labels, drawn.classes, weights.config.classes)
    return ScoredMap(counts, expected_counts([every_class[valid]], weights.config.classes))


def _parts(weights: Weights, example: Example) -> tuple[SceneGrid, NDArray[np.uint8]]:
    grid = SceneGrid(*example.shape, weights.config.patch)
    return grid, example.labels[: grid.height, : grid.width]


CORRECTIONS = (0.0, 0.25, 0.5, 0.75, 1.0)  # fractions of a network's correction, to choose from


def corrected_miou(base: Weights, network: Weights, examples: Sequence[Example]) -> dict[float, float]:
    """Return the mIoU of all scenes together by each of `CORRECTIONS` of a base, of which a network has all."""
    counts = dict.fromkeys(CORRECTIONS, np.zeros((base.config.classes,) * 2, np.int64))
    for example in examples:
        grid, labels = _parts(base, example)
        columns = example.columns.astype(np.float32)
        first, last = (np.maximum(map_of_columns(one, columns, grid)[1], -1e4) for one in (base, network))
        for part in CORRECTIONS:
            drawn = (first + np.float32(part) * (last - first)).argmax(axis=-1).astype(np.uint8)
            counts[part] = counts[part] + metrics.confusion(labels, drawn, base.config.classes)
    return {part: metrics.mean_iou(one) for part, one in counts.items()}


def miou_of(weights: Weights, examples: Sequence[Example]) -> float:
    """Return the mIoU of all scenes together, by every line at the reference exposure."""
    counts = np.zeros((weights.config.classes,) * 2, np.int64)
    for example in examples:
        grid, labels = _parts(weights, example)
        drawn, _ = map_of_columns(weights, example.columns.astype(np.float32), grid)
        counts += metrics.confusion(labels, drawn.classes, weights.config.classes)
    return metrics.mean_iou(counts)
