"""Judge new weights on validation scenes: placements, cascade, uniform scans and baselines."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.ensemble import RandomForestClassifier
from sklearn.linear_model import LogisticRegression

from spectralzoom.flows.training.data import Report
from spectralzoom.models.evaluation import metrics
from spectralzoom.models.evaluation.expected_scores import MapScores, ScoredMap, expected_counts
from spectralzoom.models.network.spectral import LineSpec
from spectralzoom.models.policies.placement import ReadTwice
from spectralzoom.models.reading.inference import coarse_prediction_of_columns, map_of_columns
from spectralzoom.models.training.capture_augmentation import REFERENCE_MS, STEPS, CaptureAugmentation
from spectralzoom.models.training.examples import Example
from spectralzoom.models.training.train import LabelledPixels, halfway, with_linear
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


FEW_PIXELS = 50_000  # labelled pixels of a training, below which no reading is reliably the best
WITH_START = "mean with --start"
READINGS = MappingProxyType({"network": 1.0, "mean of both": 0.5, "linear classifier": 0.0})  # network's fraction


def better_reading(
    weights: Weights, start: Mapping[str, Any], validation: Sequence[Example], *, few: bool, begun: Weights | None
) -> tuple[Weights, dict[str, Any]]:
    """Choose between the trained network, its initial linear classifier and the mean of their logits.

    A training from weights, ``begun``, also has the mean of both networks. With ``few`` labelled pixels the mean of the
    logits is kept, as few validation pixels cannot tell. Else it is the best by mIoU of the validation scenes; without
    one it is the mean of both networks, or the network. Returns the weights, and all scores.
    """
    readings = {
        name: replace(weights, segmenter=with_linear(weights.segmenter, start, fraction))
        for name, fraction in READINGS.items()
    }
    if begun is not None:
        readings[WITH_START] = replace(weights, segmenter=halfway(begun.segmenter, weights.segmenter))
    scores = {name: _miou(one, validation) for name, one in readings.items()} if validation else {}
    best = max(scores, key=lambda name: scores[name], default="network" if begun is None else WITH_START)
    kept = "mean of both" if few else best
    return readings[kept], {"miou": scores, "kept": kept}


def _miou(weights: Weights, examples: Sequence[Example]) -> float:
    """Return the mIoU of all scenes together, by every line at the reference exposure."""
    counts = np.zeros((weights.config.classes,) * 2, np.int64)
    for example in examples:
        grid, labels = _parts(weights, example)
        drawn, _ = map_of_columns(weights, example.columns.astype(np.float32), grid)
        counts += metrics.confusion(labels, drawn.classes, weights.config.classes)
    return metrics.mean_iou(counts)


def judge_baselines(
    train: Sequence[Example], validation: Sequence[Example], classes: int, seed: int, report: Report
) -> dict[str, float] | None:
    """Return the mIoU of LDA, logistic regression and a random forest on the same pixels of validation scenes.

    Without such scenes they learn from a random half of the training pixels, and the other half judges them. Features
    are those of `linear_classifier`. None with a single class, or if each has one pixel to learn from.
    """
    rng = np.random.default_rng([seed, 0xBA5])
    learnt = LabelledPixels.drawn(train, rng)
    if validation:
        judged = LabelledPixels.drawn(validation, rng)
    else:
        half = rng.permutation(len(learnt.labels)) % 2 == 0
        learnt, judged = (LabelledPixels(learnt.features[part], learnt.labels[part]) for part in (half, ~half))
    if not 1 < len(np.unique(learnt.labels)) < len(learnt.labels):
        return None
    found: dict[str, float] = {}
    for name, classifier in {
        "LDA": LinearDiscriminantAnalysis(solver="lsqr", shrinkage="auto"),
        "logistic regression": LogisticRegression(max_iter=200),
        "random forest": RandomForestClassifier(100, min_samples_leaf=2, random_state=seed),
    }.items():
        report("fitting baseline classifiers", len(found) / 3, name)
        with warnings.catch_warnings(action="ignore", category=UserWarning):  # not converged; a single pixel
            classifier.fit(learnt.features, learnt.labels)
        drawn = classifier.predict(judged.features).astype(np.uint8)
        found[name] = metrics.mean_iou(metrics.confusion(judged.labels, drawn, classes))
    return found
