"""Agreement of a class map with labels: confusion counts and what follows from them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import ShapeError
from pipeline.grid import UNLABELLED


def confusion(labels: NDArray[np.integer], predicted: NDArray[np.integer], classes: int) -> NDArray[np.int64]:
    """Count pixels by label (row) and prediction (column), (classes, classes) int64.

    Labels of 255 are left out before counting; counts of parts add up to the count of the whole.

    Raises
    ------
    ShapeError : different shapes, or a label or prediction outside 0..classes-1 (255 allowed in labels).
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


def iou_per_class(counts: NDArray[np.int64]) -> NDArray[np.float64]:
    """Intersection over union of each class; NaN for a class in neither labels nor predictions."""
    hit = np.diag(counts).astype(np.float64)
    union = counts.sum(axis=0) + counts.sum(axis=1) - np.diag(counts)
    iou: NDArray[np.float64] = np.divide(hit, union, out=np.full(len(hit), np.nan), where=union > 0)
    return iou


def mean_iou(counts: NDArray[np.int64]) -> float:
    """Mean over the classes that labels or map hold; NaN when nothing is labelled.

    A class that is in neither is left out of the mean, not counted as 0 or 1.
    """
    held = counts.sum(axis=0) + counts.sum(axis=1) > 0
    return float(iou_per_class(counts)[held].mean()) if held.any() else float("nan")


def overall_accuracy(counts: NDArray[np.int64]) -> float:
    """Share of labelled pixels with the right class; NaN when nothing is labelled."""
    total = counts.sum()
    return float(np.trace(counts) / total) if total else float("nan")


def average_accuracy(counts: NDArray[np.int64]) -> float:
    """Mean over the labelled classes of the share of their pixels found."""
    support = counts.sum(axis=1)
    present = support > 0
    return float((np.diag(counts)[present] / support[present]).mean()) if present.any() else float("nan")


def kappa(counts: NDArray[np.int64]) -> float:
    """Cohen's kappa: agreement beyond what the class shares alone would give."""
    total = counts.sum()
    if not total:
        return float("nan")
    agreed = np.trace(counts) / total
    chance = float((counts.sum(axis=0) / total) @ (counts.sum(axis=1) / total))
    return float((agreed - chance) / (1 - chance)) if chance < 1 else float("nan")


def gap_closed(reached: float, none: float, all_seats: float) -> float | None:
    """Share of the way from no fine seat to every fine seat; None where that way is not one point up or more."""
    way = all_seats - none
    return (reached - none) / way if way >= 0.01 else None  # NaN is None too


def frequency_weighted_iou(counts: NDArray[np.int64]) -> float:
    """Mean of the classes' IoU by how many pixels carry their label; NaN when nothing is labelled."""
    support = counts.sum(axis=1)
    held = support > 0
    return float(np.average(iou_per_class(counts)[held], weights=support[held])) if held.any() else float("nan")


def miou_over_frames(frames: NDArray[np.int64]) -> float:
    """`miou_i`: each frame's own mean IoU, then the mean over frames that have one, (frame, class, class) counts."""
    return _mean_of_known(np.array([mean_iou(counts) for counts in frames]))


def miou_over_frame_classes(frames: NDArray[np.int64]) -> float:
    """`miou_c`: each class's mean IoU over the frames that hold it, then the mean over classes; (frame, class, class).

    A large object counts as much as a small one, which the counts of the whole data set do not allow for.
    """
    each = np.array([iou_per_class(counts) for counts in frames]).reshape(len(frames), -1)
    return _mean_of_known(np.array([_mean_of_known(column) for column in each.T]))


def _mean_of_known(values: NDArray[np.float64]) -> float:
    known = values[~np.isnan(values)]
    return float(known.mean()) if known.size else float("nan")
