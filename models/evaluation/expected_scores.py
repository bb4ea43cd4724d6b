"""Expected scores of a map without labels: counts by its own probabilities, corrected by validation scenes.

The class probabilities of a map give the expected confusion counts, and from these the IoU of each class. Maps are
overconfident at borders and for rare classes, most of all for short exposures and wide line spacings. A bias of each
class, step and exposure corrects the logit of its IoU; it is fitted to validation scenes.

A class may be absent if few pixels of it are expected, or if the map is not sure of them. Its weight in the mean is the
probability that it is present.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from spectralzoom.models.evaluation.metrics import Floats, iou_per_class, labelled_classes, mean_iou

# Logit of the probability that a class is present: a constant, and factors of the logarithm of its expected pixels, the
# logit of its expected IoU, the logarithm of the exposure (more for wider line spacings), and octaves of line spacing.
PRESENT = (-4.33, 2.0, 2.38, 0.94, 2.45)  # least errors of the mIoU of scans of 32 validation scenes
FULL_MS = 100.0  # exposure of logarithm 0
FEW_PX = 10.0  # pixels of other classes that the expected IoU of a class adds
SURE_PX = 2000  # of a class: a scene with so many counts in full; fewer in all scenes shrink the bias
ENOUGH_PX = SURE_PX  # pixels with a class that an expected score needs
SMALL_PX, SMALL_ERROR = 300.0, 0.3  # the IoU of a class of so few pixels has half of this error
LEAST_IOU = 0.005  # IoU is kept as far from 0 and 1
ROUNDING_MS = 0.05  # of exposures, to a tenth of a millisecond
LEAST_ERROR = 0.005  # of mIoU: lower bound of the estimate from a few scenes
LARGEST_ERROR = 0.5  # largest standard deviation of a value between 0 and 1


def expected_counts(swaths: Iterable[NDArray[np.floating]], classes: int) -> Floats:
    """Count pixels by likely class (row) and mapped class (column), (class, class), as `confusion` would with labels.

    ``swaths`` are parts (..., class) of the log-probabilities of a map; a pixel of which nothing is known is left out.
    """
    found = np.zeros((classes, classes))
    for swath in swaths:
        known = swath.reshape(-1, classes)
        chance = np.exp(known[~np.isnan(known).any(axis=1)].astype(np.float64))
        mapped = chance.argmax(axis=1)
        for one in np.flatnonzero(np.bincount(mapped, minlength=classes)):
            found[:, one] += chance[mapped == one].sum(axis=0)
    return found


@dataclass(frozen=True)
class ExpectedScore:
    """Expected score of a map, 0..1: mIoU with a standard deviation, and the IoU of classes likely there."""

    miou: float
    error: float
    per_class_iou: Floats  # (class,) NaN where it is more likely not there


def expected_score(counts: Floats, bias: Floats, error: float, step: int, exposure_ms: float) -> ExpectedScore:
    """Correct `expected_counts` by a ``bias`` of each class (class,), in logits; ``error`` is that of such scans.

    NaN where no class has a pixel.
    """
    area = counts.sum(axis=1)
    own = counts.diagonal()
    octaves = math.log2(step)
    iou = scipy.special.expit(_logit(iou_per_class(counts)) + bias)
    sure = _logit(own / (area + counts.sum(axis=0) - own + FEW_PX))
    factors = np.log1p(area), sure, (1 + octaves) * math.log(exposure_ms / FULL_MS), octaves
    chance = scipy.special.expit(PRESENT[0] + sum(slope * x for slope, x in zip(PRESENT[1:], factors, strict=True)))
    there = np.where(area > 0, chance, 0.0)
    number = float(there.sum())
    if not number > 0:
        return ExpectedScore(math.nan, math.nan, np.full(len(area), np.nan))
    miou = float(there @ iou / number)
    unsure = there * (1 - there) * (iou - miou) ** 2 + there * (SMALL_ERROR * SMALL_PX / (SMALL_PX + area)) ** 2
    off = math.hypot(error, math.sqrt(float(unsure.sum())) / number)
    return ExpectedScore(miou, min(off, LARGEST_ERROR), np.where(there > 0.5, iou, np.nan))


@dataclass(frozen=True)
class ScoredMap:
    """Counts of a map by the labels, and by its own probabilities."""

    counts: NDArray[np.integer]  # (class, class) by label and mapped class
    expected: Floats  # the same by `expected_counts`


def fitted_bias(maps: Sequence[ScoredMap]) -> Floats:
    """Return the mean difference of true and expected logits of the IoU of each class, (class,).

    Scenes are weighted by their expected pixels of the class; a class that is rare in all of them has a smaller bias.
    """
    expected, counts = np.stack([one.expected for one in maps]), np.stack([one.counts for one in maps])
    weight = np.minimum(expected.sum(axis=-1), SURE_PX) * labelled_classes(counts)
    true, predicted = (_logit(iou_per_class(one)) for one in (counts, expected))
    return np.asarray(((true - predicted) * weight).sum(axis=0) / (weight.sum(axis=0) + SURE_PX))


def error_of_passes(maps: Sequence[ScoredMap], step: int, exposure_ms: float) -> float:
    """Return the error of expected mIoU that small classes do not explain, by leaving out one scene at a time."""
    beyond = []
    for i, one in enumerate(maps):
        others = [*maps[:i], *maps[i + 1 :]] or maps
        expected = expected_score(one.expected, fitted_bias(others), 0.0, step, exposure_ms)
        beyond.append((expected.miou - mean_iou(one.counts)) ** 2 - expected.error**2)
    return max(LEAST_ERROR, math.sqrt(max(float(np.nanmean(beyond)), 0.0)))


@dataclass(frozen=True)
class MapScores:
    """Corrections of expected scores, by line spacing and exposure of uniform scans."""

    steps: tuple[int, ...]
    exposures_ms: tuple[float, ...]  # ascending
    bias: Floats  # (step, exposure, class)
    error: Floats  # (step, exposure)
    scenes: int

    @staticmethod
    def fitted(maps: Mapping[tuple[int, float], Sequence[ScoredMap]]) -> MapScores:
        """Fit corrections to maps by step and exposure; each pair has maps of the same scenes."""
        steps, exposures = sorted({step for step, _ in maps}), sorted({exposure for _, exposure in maps})
        return MapScores(
            steps=tuple(steps),
            exposures_ms=tuple(exposures),
            bias=np.array([[fitted_bias(maps[step, ms]) for ms in exposures] for step in steps]),
            error=np.array([[error_of_passes(maps[step, ms], step, ms) for ms in exposures] for step in steps]),
            scenes=len(maps[steps[0], exposures[0]]),
        )

    @staticmethod
    def read(content: Mapping[str, Any]) -> MapScores:
        """Read the corrections from a record. Raises KeyError, TypeError or ValueError where it is malformed."""
        steps, exposures = tuple(map(int, content["steps"])), tuple(map(float, content["exposures_ms"]))
        bias, error = np.asarray(content["bias"], np.float64), np.asarray(content["error"], np.float64)
        if not (bias.ndim == 3 and bias.shape[:2] == error.shape == (len(steps), len(exposures))):
            raise ValueError(f"biases {bias.shape} and errors {error.shape} of {len(steps)} x {len(exposures)} scans")
        return MapScores(steps, exposures, bias, error, int(content["scenes"]))

    def as_dict(self) -> dict[str, Any]:
        """Return the corrections for a record."""
        return {
            "scenes": self.scenes,
            "steps": list(self.steps),
            "exposures_ms": list(self.exposures_ms),
            "bias": self.bias.round(4).tolist(),
            "error": self.error.round(5).tolist(),
        }

    def expected(self, counts: Floats, step: int, exposure_ms: float) -> ExpectedScore | None:
        """Return the expected score of a map by `expected_counts`; None beyond the record, or below `ENOUGH_PX`."""
        within = self.exposures_ms[0] - ROUNDING_MS <= exposure_ms <= self.exposures_ms[-1] + ROUNDING_MS
        enough = len(counts) == self.bias.shape[-1] and round(counts.sum()) >= ENOUGH_PX
        if step not in self.steps or not within or not enough:
            return None
        row = self.steps.index(step)
        at = math.log(exposure_ms)
        known = np.log(self.exposures_ms)
        bias = np.array([np.interp(at, known, one) for one in self.bias[row].T])
        return expected_score(counts, bias, float(np.interp(at, known, self.error[row])), step, exposure_ms)


def _logit(fraction: Floats) -> Floats:
    """Return logits of fractions 0..1, clipped away from both ends; NaN counts as 0."""
    return np.asarray(scipy.special.logit(np.clip(np.nan_to_num(fraction), LEAST_IOU, 1 - LEAST_IOU)))
