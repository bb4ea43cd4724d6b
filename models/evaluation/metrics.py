"""Agreement of a class map with labels: confusion counts and what follows from them; how sure a difference is.

A mean over classes is over those that the labels have among the pixels judged (the mean IU of Long et al., arXiv
1411.4038, with the classes of the truth for its n_cl), so that all maps judged by the same labels share one set of
classes, whatever they show. A class that a map shows and the labels lack is a false class: it has no IoU of its own,
`false_pixels` counts it, and each of its pixels is one that the class below it has missed.

How sure a difference of two rows is, draws of frames and seeds say, again and again: both rows are judged on the same
draw, and the classes of its mean are those that the labels of its frames have.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import ShapeError
from pipeline.geometry.grid import UNLABELLED

DRAWS = 2000
LEVEL = 0.95
Counts = NDArray[np.int64]
Numbers = NDArray[np.integer]


def confusion(labels: NDArray[np.integer], predicted: NDArray[np.integer], classes: int) -> NDArray[np.int64]:
    """Count pixels by label (row) and prediction (column), (classes, classes) int64; counts of parts add up.

    Labels of 255 are left out before counting. Raises ShapeError for different shapes, or a label or prediction outside
    0..classes-1 (255 allowed in labels).
    """
    if labels.shape != predicted.shape:
        raise ShapeError(f"labels are {labels.shape}, the class map is {predicted.shape}; they must be equal")
    counted = labels != UNLABELLED
    truth, guess = labels[counted].astype(np.int64), predicted[counted].astype(np.int64)
    for name, values in (("label", truth), ("prediction", guess)):
        if values.size and (values.min() < 0 or values.max() >= classes):
            wrong = values[(values < 0) | (values >= classes)][0]
            raise ShapeError(f"{name} {wrong} is none of the {classes} classes 0..{classes - 1}")
    return np.bincount(truth * classes + guess, minlength=classes**2).reshape(classes, classes)


def labelled_classes(counts: NDArray[np.number]) -> NDArray[np.bool_]:
    """Return which classes the labels have among the pixels judged, (..., class, class) -> (..., class)."""
    held: NDArray[np.bool_] = counts.sum(axis=-1) > 0
    return held


def false_pixels(counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Pixels of each class that the map shows although the labels have none of it; 0 for a class that they have."""
    return np.where(labelled_classes(counts), 0, counts.sum(axis=0))


def iou_per_class(counts: NDArray[np.number]) -> NDArray[np.float64]:
    """Intersection over union of each class, (..., class, class) -> (..., class); NaN for one that the labels lack."""
    hit = np.diagonal(counts, axis1=-2, axis2=-1).astype(np.float64)
    union = counts.sum(axis=-2) + counts.sum(axis=-1) - hit
    iou: NDArray[np.float64] = np.divide(hit, union, out=np.full(hit.shape, np.nan), where=labelled_classes(counts))
    return iou


def mean_iou(counts: NDArray[np.integer]) -> float:
    """Mean IoU over the classes that the labels have, whatever the map shows; NaN when nothing is labelled."""
    return float(mean_iou_of_each(counts))


def mean_iou_of_each(counts: NDArray[np.integer]) -> NDArray[np.float64]:
    """`mean_iou` of many confusion counts at once, (..., class, class) -> (...)."""
    held = labelled_classes(counts)
    total, number = np.where(held, iou_per_class(counts), 0).sum(axis=-1), held.sum(axis=-1)
    mean: NDArray[np.float64] = np.divide(total, number, out=np.full(number.shape, np.nan), where=number > 0)
    return mean


def agreement(counts: NDArray[np.int64]) -> dict[str, float]:
    """Give the figures that stand side by side wherever a map is scored: mIoU and the fraction of right pixels."""
    return {"miou": mean_iou(counts), "overall_accuracy": overall_accuracy(counts)}


def overall_accuracy(counts: NDArray[np.int64]) -> float:
    """Fraction of labelled pixels with the right class; NaN when nothing is labelled."""
    total = counts.sum()
    return float(np.trace(counts) / total) if total else float("nan")


def average_accuracy(counts: NDArray[np.int64]) -> float:
    """Mean over the labelled classes of the fraction of their pixels found; NaN when nothing is labelled."""
    held = labelled_classes(counts)
    return float((np.diag(counts)[held] / counts.sum(axis=1)[held]).mean()) if held.any() else float("nan")


def kappa(counts: NDArray[np.int64]) -> float:
    """Cohen's kappa: agreement beyond what the class shares alone would give."""
    total = counts.sum()
    if not total:
        return float("nan")
    agreed = np.trace(counts) / total
    chance = float((counts.sum(axis=0) / total) @ (counts.sum(axis=1) / total))
    return float((agreed - chance) / (1 - chance)) if chance < 1 else float("nan")


def gap_closed(reached: float, none: float, all_patches: float) -> float | None:
    """Fraction of the way from no fine patch to every fine patch; None where that way is not one point up or more."""
    way = all_patches - none
    return (reached - none) / way if way >= 0.01 else None  # NaN is None too


CONFIDENCE_BINS = 20


def confidence_counts(confidence: NDArray[np.floating], right: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Pixels by their confidence 0..1 in `CONFIDENCE_BINS` equal steps: (3, bin) how many, how many right, and the sum.

    ``confidence`` and ``right`` are (pixel,). Counts of several maps add up.
    """
    place = np.clip((confidence * CONFIDENCE_BINS).astype(np.intp), 0, CONFIDENCE_BINS - 1)
    weights = (None, right.astype(np.float64), confidence.astype(np.float64))
    return np.stack([np.bincount(place, one, CONFIDENCE_BINS).astype(np.float64) for one in weights])


def calibration_error(counts: NDArray[np.float64]) -> float:
    """Return the expected calibration error of `confidence_counts`, 0..1: confidence less the fraction that is right.

    Mean over the bins by their pixels, of |share right - mean confidence|; NaN without a pixel. (Naeini et al. 2015)
    """
    pixels, right, confidence = counts
    total = float(pixels.sum())
    return float(np.abs(right - confidence).sum() / total) if total else float("nan")


@dataclass(frozen=True)
class Interval:
    """A difference of mIoU (first minus second) and the bounds that ``LEVEL`` of the draws lie within."""

    difference: float
    low: float | None  # None with fewer than two frames, or where no draw has a difference
    high: float | None


def paired_interval(
    first: Counts, second: Counts, *, seeds: tuple[Numbers, Numbers] | None = None, draws: int = DRAWS, seed: int = 0
) -> Interval:
    """Bootstrap the difference of two rows over frames, and over seeds of the training where there are several.

    ``first`` and ``second`` are (run, frame, class, class) confusion counts. A run is a seed of the training or of the
    placement; a row's figure is the mean over its runs of the mIoU of the drawn frames together. The rows may differ in
    runs, not in frames. A frame that a run did not judge is all zeros. ``draws`` times as many frames as there are are
    drawn, with replacement. ``seeds`` say of each row which seed of the training every run is of, (run,) from 0: seeds
    are drawn with replacement too, and rows of equally many share the draw; without them all runs count alike.

    Raises ShapeError where the rows differ in frames or classes, or seeds are not given for every run.
    """
    if first.shape[1:] != second.shape[1:] or first.ndim != 4:
        raise ShapeError(f"expected two rows of the same frames and classes, got {first.shape} and {second.shape}")
    of_runs = (np.zeros(len(first), np.intp), np.zeros(len(second), np.intp)) if seeds is None else seeds
    if (len(of_runs[0]), len(of_runs[1])) != (len(first), len(second)):
        raise ShapeError(f"expected a seed for each of {len(first)} and {len(second)} runs, got {len(of_runs[0])}")
    frames = first.shape[1]
    whole = np.ones((1, frames), np.int64)
    difference = float((_means(first, whole) - _means(second, whole))[0])
    if frames < 2:
        return Interval(difference, None, None)
    drawn = _drawn(frames, draws, [seed, 0xB007])
    often = {count: _drawn(count, draws, [seed, 0x5EED, count]) for count in {int(of.max()) + 1 for of in of_runs}}
    one, other = (
        _means(counts, drawn, often[int(of.max()) + 1][:, of])
        for counts, of in zip((first, second), of_runs, strict=True)
    )
    moved = one - other
    moved = moved[~np.isnan(moved)]
    if not moved.size:
        return Interval(difference, None, None)
    low, high = np.quantile(moved, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return Interval(difference, float(low), float(high))


def _drawn(count: int, draws: int, seed: list[int]) -> NDArray[np.int64]:
    """Return the number of times that each of ``count`` is drawn in as many goes, (draw, count)."""
    return np.random.default_rng(seed).multinomial(count, np.full(count, 1 / count), size=draws)


def _means(counts: Counts, times: Numbers, often: Numbers | None = None) -> NDArray[np.float64]:
    """Mean over runs of the mIoU of frames taken ``times`` (draw, frame) each; NaN where no run has a frame.

    ``often`` (draw, run) says how often each run counts; once, without it.
    """
    sums = np.einsum("df,rfij->drij", times, counts)
    each = mean_iou_of_each(sums)
    fraction = (~np.isnan(each)) * (1 if often is None else often)
    number = fraction.sum(axis=1)
    means: NDArray[np.float64] = np.divide(
        (np.nan_to_num(each) * fraction).sum(axis=1), number, out=np.full(len(each), np.nan), where=number > 0
    )
    return means
