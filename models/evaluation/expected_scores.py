"""Expected scores of a map without labels: counts by its own probabilities, corrected by earlier maps.

The probabilities of a map say how many pixels of each class it is likely to have right, wrong and missed, and so the
IoU of each class without a label. Maps are surer along borders and of rare classes than they may be, the more so the
darker and the wider apart the lines, so that this IoU is put right by what scenes with labels showed: one number for
each class and look, added to its logit.

A class of a few expected pixels may be there or not: it counts in the mean by the odds that it is, and the error that
is told grows with them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from models.evaluation.metrics import iou_per_class, labelled_classes, mean_iou

Floats = NDArray[np.float64]
THERE_PX = 100.0  # expected pixels of a class that is as likely to be there as not
SURE_PX = 2000.0  # of a class: from so many on a scene counts in full, and fewer of all scenes put less right
SMALL_PX, SMALL_ERROR = 300.0, 0.3  # the IoU of a class of so few pixels is off by half of so much
LEAST_IOU = 0.005  # IoU is kept as far from 0 and 1
LEAST_ERROR = 0.005  # of mIoU: nobody knows better, whatever a few scenes say


def expected_counts(swaths: Iterable[NDArray[np.floating]], classes: int) -> Floats:
    """Count pixels by likely class (row) and mapped class (column), (class, class), as `confusion` would with labels.

    ``swaths`` are parts (..., class) of the log-probabilities of a map; a pixel of which nothing is known is left out.
    """
    found = np.zeros((classes, classes))
    for swath in swaths:
        known = swath.reshape(-1, classes)
        chance = np.exp(known[np.isfinite(known).all(axis=1)].astype(np.float64))
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


def expected_score(counts: Floats, bias: Floats, error: float = LEAST_ERROR) -> ExpectedScore:
    """Put `expected_counts` right by a ``bias`` of each class (class,), in logits; ``error`` is that of such looks.

    NaN where nothing is known of any class.
    """
    area = counts.sum(axis=1)
    iou = scipy.special.expit(_logit(iou_per_class(counts)) + bias)
    there = area**2 / (area**2 + THERE_PX**2)
    number = float(there.sum())
    if not number > 0:
        return ExpectedScore(math.nan, math.nan, np.full(len(area), np.nan))
    miou = float(there @ iou / number)
    unsure = there * (1 - there) * (iou - miou) ** 2 + there * (SMALL_ERROR * SMALL_PX / (SMALL_PX + area)) ** 2
    off = math.hypot(error, math.sqrt(float(unsure.sum())) / number)
    return ExpectedScore(miou, off, np.where(there > 0.5, iou, np.nan))


@dataclass(frozen=True)
class ScoredMap:
    """A map of a scene with labels: its counts, and what it said of them itself."""

    counts: NDArray[np.integer]  # (class, class) by label and mapped class
    expected: Floats  # the same by `expected_counts`


def fitted_bias(maps: Sequence[ScoredMap]) -> Floats:
    """Return the mean excess of the logits of the classes' IoU over what maps expected of themselves, (class,).

    Scenes count by the pixels that they were expected to have; a class that is rare in all of them is put right less.
    """
    expected = np.stack([one.expected for one in maps])
    counts = np.stack([one.counts for one in maps])
    weight = np.minimum(expected.sum(axis=-1), SURE_PX) * labelled_classes(counts)
    came, said = (_logit(iou_per_class(one)) for one in (counts, expected))
    bias: Floats = ((came - said) * weight).sum(axis=0) / (weight.sum(axis=0) + SURE_PX)
    return bias


def error_of_passes(maps: Sequence[ScoredMap]) -> float:
    """Return the error of expected mIoU beyond what small classes explain; each scene is judged by the others."""
    beyond = []
    for i, one in enumerate(maps):
        others = [*maps[:i], *maps[i + 1 :]]
        expected = expected_score(one.expected, fitted_bias(others or maps), 0.0)
        beyond.append((expected.miou - mean_iou(one.counts)) ** 2 - expected.error**2)
    return max(LEAST_ERROR, math.sqrt(max(float(np.nanmean(beyond)), 0.0)))


@dataclass(frozen=True)
class MapScores:
    """Corrections of expected scores, by step and exposure of uniform scans."""

    steps: tuple[int, ...]
    exposures_ms: tuple[float, ...]  # ascending
    bias: Floats  # (step, exposure, class)
    error: Floats  # (step, exposure)
    scenes: int

    @staticmethod
    def fitted(maps: Mapping[tuple[int, float], Sequence[ScoredMap]]) -> MapScores:
        """Fit corrections to maps by step and exposure, of the same scenes for every pair of both."""
        steps, exposures = sorted({step for step, _ in maps}), sorted({exposure for _, exposure in maps})
        scan_passes = [[maps[step, exposure] for exposure in exposures] for step in steps]
        return MapScores(
            tuple(steps),
            tuple(exposures),
            np.array([[fitted_bias(coarse_pass) for coarse_pass in row] for row in scan_passes]),
            np.array([[error_of_passes(coarse_pass) for coarse_pass in row] for row in scan_passes]),
            len(scan_passes[0][0]),
        )

    @staticmethod
    def read(content: Mapping[str, Any]) -> MapScores:
        """Take them from a record; KeyError, TypeError or ValueError where it is none."""
        steps, exposures = tuple(map(int, content["steps"])), tuple(map(float, content["exposures_ms"]))
        bias, error = np.asarray(content["bias"], np.float64), np.asarray(content["error"], np.float64)
        if not (bias.ndim == 3 and bias.shape[:2] == error.shape == (len(steps), len(exposures))):
            raise ValueError(f"biases {bias.shape} and errors {error.shape} of {len(steps)} x {len(exposures)} looks")
        return MapScores(steps, exposures, bias, error, int(content["scenes"]))

    def as_dict(self) -> dict[str, Any]:
        """Return the corrections as a record keeps them."""
        return {
            "scenes": self.scenes,
            "steps": list(self.steps),
            "exposures_ms": list(self.exposures_ms),
            "bias": self.bias.round(4).tolist(),
            "error": self.error.round(5).tolist(),
        }

    def expected(self, counts: Floats, step: int, exposure_ms: float) -> ExpectedScore | None:
        """Return the expected score of a map by its `expected_counts`; None for a scan beyond the record."""
        if step not in self.steps or not self.exposures_ms[0] <= exposure_ms <= self.exposures_ms[-1]:
            return None
        if len(counts) != self.bias.shape[-1]:
            return None
        row = self.steps.index(step)
        at, known = math.log(exposure_ms), np.log(self.exposures_ms)
        bias = np.array([np.interp(at, known, one) for one in self.bias[row].T])
        return expected_score(counts, bias, float(np.interp(at, known, self.error[row])))


def _logit(fraction: Floats) -> Floats:
    """Logits of shares 0..1, kept from both ends; a fraction that is NaN counts as 0."""
    found: Floats = scipy.special.logit(np.clip(np.nan_to_num(fraction), LEAST_IOU, 1 - LEAST_IOU))
    return found
