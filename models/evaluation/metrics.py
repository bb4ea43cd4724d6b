"""Compute the agreement of a class map with labels, from confusion counts, and its calibration.

A mean over classes is over the classes of the labels (Long et al., arXiv 1411.4038). All maps judged by the same labels
therefore share one set of classes. A class that only the map has is a false class. It has no IoU of its own; its
pixels count as missed pixels of the true class.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from spectralzoom.pipeline.errors import ShapeError
from spectralzoom.pipeline.geometry.grid import UNLABELLED, cuts

CONFIDENCE_BINS = 20
BAD_ERROR = 0.02  # expected calibration error above which a temperature is fitted
COOLEST, HOTTEST = 0.2, 5.0
FITTED_PIXELS = 20_000  # random pixels of a scene to fit a temperature to
PIXELS_AT_ONCE = 2**20  # that are counted: their numbers take more memory than the maps
Counts = NDArray[np.int64]
Numbers = NDArray[np.integer]
Floats = NDArray[np.float64]


def confusion(labels: Numbers, predicted: Numbers, classes: int) -> Counts:
    """Count pixels by label (row) and prediction (column), (classes, classes) int64; counts of parts add up.

    Pixels with the label 255 are left out. Raises ShapeError for different shapes, or a label or prediction outside
    0..classes-1 (labels may be 255).
    """
    if labels.shape != predicted.shape:
        raise ShapeError(f"labels are {labels.shape}, the class map is {predicted.shape}; they must be equal")
    counts = np.zeros(classes**2, np.int64)
    for part in cuts(labels.size, PIXELS_AT_ONCE):
        some, drawn = (one.reshape(-1)[part] for one in (labels, predicted))
        truth, guess = (one[some != UNLABELLED].astype(np.int32) for one in (some, drawn))
        for name, values in (("label", truth), ("prediction", guess)):
            if (outside := values[(values < 0) | (values >= classes)]).size:
                raise ShapeError(f"{name} {outside[0]} is none of the {classes} classes 0..{classes - 1}")
        counts += np.bincount(truth * classes + guess, minlength=classes**2)
    return counts.reshape(classes, classes)


def labelled_classes(counts: NDArray[np.number]) -> NDArray[np.bool_]:
    """Return which classes the labels have, (..., class, class) -> (..., class)."""
    return np.asarray(counts.sum(axis=-1) > 0)


def false_pixels(counts: Counts) -> Counts:
    """Return the pixels of each class that the map shows without a label of it; 0 for a class of the labels."""
    return np.where(labelled_classes(counts), 0, counts.sum(axis=0))


def iou_per_class(counts: NDArray[np.number]) -> Floats:
    """Return the IoU of each class, (..., class, class) -> (..., class); NaN for one that the labels lack."""
    hit = np.diagonal(counts, axis1=-2, axis2=-1).astype(np.float64)
    union = counts.sum(axis=-2) + counts.sum(axis=-1) - hit
    return np.asarray(np.divide(hit, union, out=np.full(hit.shape, np.nan), where=labelled_classes(counts)))


def mean_iou(counts: Numbers) -> float:
    """Return the mean IoU over the classes of the labels; NaN when nothing is labelled."""
    held = labelled_classes(counts)
    return float(iou_per_class(counts)[held].mean()) if held.any() else float("nan")


def agreement(counts: Counts) -> dict[str, float]:
    """Return mIoU and overall accuracy."""
    return {"miou": mean_iou(counts), "overall_accuracy": overall_accuracy(counts)}


def overall_accuracy(counts: Counts) -> float:
    """Return the fraction of labelled pixels with the right class; NaN when nothing is labelled."""
    total = counts.sum()
    return float(np.trace(counts) / total) if total else float("nan")


def average_accuracy(counts: Counts) -> float:
    """Return the mean over the labelled classes of their fraction of right pixels; NaN when nothing is labelled."""
    held = labelled_classes(counts)
    return float((np.diag(counts)[held] / counts.sum(axis=1)[held]).mean()) if held.any() else float("nan")


def kappa(counts: Counts) -> float:
    """Return Cohen's kappa: the agreement beyond that of independent maps of the same class fractions."""
    total = counts.sum()
    if not total:
        return float("nan")
    agreed, chance = np.trace(counts) / total, float((counts.sum(axis=0) / total) @ (counts.sum(axis=1) / total))
    return float((agreed - chance) / (1 - chance)) if chance < 1 else float("nan")


# calibration: confidence against the fraction of right pixels


def confidence_counts(confidence: NDArray[np.floating], right: NDArray[np.bool_]) -> Floats:
    """Count pixels in `CONFIDENCE_BINS` equal bins of confidence: (3, bin) pixels, right pixels, sum of confidence.

    ``confidence`` and ``right`` are (pixel,). Counts of several maps add up.
    """
    place = np.clip((confidence * CONFIDENCE_BINS).astype(np.intp), 0, CONFIDENCE_BINS - 1)
    weights = (None, right.astype(np.float64), confidence.astype(np.float64))
    return np.stack([np.bincount(place, one, CONFIDENCE_BINS).astype(np.float64) for one in weights])


def calibration_error(counts: Floats) -> float:
    """Return the expected calibration error of `confidence_counts`, 0..1; NaN without a pixel. (Naeini et al. 2015)"""
    pixels, right, confidence = counts
    total = float(pixels.sum())
    return float(np.abs(right - confidence).sum() / total) if total else float("nan")


@dataclass(frozen=True)
class JudgedMap:
    """Log-probabilities of the labelled pixels of a map."""

    log_probability: NDArray[np.float32]  # (pixel, class), minus infinity for a class that is never drawn
    labels: NDArray[np.uint8]  # (pixel,)


def judge_confidence(maps: list[JudgedMap], seed: int) -> dict[str, Any]:
    """Return the expected calibration error of maps for a record, with a ``temperature`` where it is above 0.02.

    The temperature divides logits, which keeps the likeliest class. ``expected_error_before`` is the error without it.
    """
    error = _error(maps, 1.0)
    if not error > BAD_ERROR:
        return {"scenes": len(maps), "expected_error": error}
    temperature = fitted_temperature(maps, seed)
    after = {"expected_error": _error(maps, temperature), "expected_error_before": error, "temperature": temperature}
    return {"scenes": len(maps), **after}


def fitted_temperature(maps: list[JudgedMap], seed: int) -> float:
    """Return the temperature with the highest likelihood of the labels that maps can have; 1 without one."""
    rng = np.random.default_rng([seed, 0x7E3])
    drawn = [rng.choice(len(one.labels), min(FITTED_PIXELS, len(one.labels)), replace=False) for one in maps]
    values = np.concatenate([one.log_probability[i] for one, i in zip(maps, drawn, strict=True)]).astype(np.float64)
    labels = np.concatenate([one.labels[i] for one, i in zip(maps, drawn, strict=True)])
    possible = values[np.arange(len(labels)), labels] > -np.inf
    if not possible.any():
        return 1.0
    values, labels = values[possible], labels[possible]

    def loss(log_temperature: float) -> float:
        scaled = scipy.special.log_softmax(values / np.exp(log_temperature), axis=1)
        return float(-scaled[np.arange(len(labels)), labels].mean())

    bounds = np.log(COOLEST), np.log(HOTTEST)
    return float(np.exp(scipy.optimize.minimize_scalar(loss, bounds=bounds, method="bounded").x))


def _error(maps: list[JudgedMap], temperature: float) -> float:
    counts = np.zeros((3, CONFIDENCE_BINS))
    for one in maps:
        probability = scipy.special.softmax(one.log_probability / np.float32(temperature), axis=1)
        counts += confidence_counts(probability.max(axis=1), probability.argmax(axis=1) == one.labels)
    return calibration_error(counts)


def stratified_fractions(mapped: ArrayLike, confusion: ArrayLike) -> tuple[Floats, Floats]:
    """Estimate fractions (class,) and their standard errors from a map and the confusion matrix of judged pixels.

    ``mapped`` is (class,) fractions of the map, ``confusion`` (label, mapped class) counts, as `confusion` above
    returns them. The judged pixels count as a random sample of each mapped class. The result is NaN if a mapped
    class has fewer than the two judged pixels that an error needs.

    References
    ----------
    .. [1] Olofsson et al., "Good practices for estimating area and assessing accuracy of land change", Remote Sensing
       of Environment 148, 2014. doi:10.1016/j.rse.2014.02.015
    """
    weight = np.asarray(mapped, np.float64)
    counts = np.asarray(confusion, np.float64)
    there = weight > 0
    strata = weight[there]
    number = counts[:, there].sum(axis=0)
    if (number < 2).any():
        return np.full(len(weight), np.nan), np.full(len(weight), np.nan)
    of_map = counts[:, there] / number
    fractions = (strata * of_map).sum(axis=1)  # [1] Eq. 9
    variance = (strata**2 * of_map * (1 - of_map) / (number - 1)).sum(axis=1)  # [1] Eq. 10, squared
    return fractions, np.sqrt(variance)
