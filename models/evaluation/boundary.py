"""Boundary IoU: agreement of a class map with labels near the borders of either (Cheng et al., arXiv 2103.16562).

Of each class only the pixels within ``d`` px (chessboard) of the border of its own region are kept, in the labels and
in the map, and the IoU is that of what is kept. The edge of the image is a border, and so is that of what has no label.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import ShapeError
from pipeline.geometry.grid import UNLABELLED

DIAGONAL_SHARE = 0.02  # the paper's own default


def boundary_px(shape: tuple[int, int], share: float = DIAGONAL_SHARE) -> int:
    """Width of the boundary [px]: a share of the diagonal, rounded, at least 1."""
    return max(1, round(share * float(np.hypot(*shape))))


def boundary_counts(
    labels: NDArray[np.integer], predicted: NDArray[np.integer], classes: int, width: int | None = None
) -> NDArray[np.int64]:
    """Count boundary pixels of each class, (class, 2) int64: in both, in either. Counts of images add up.

    Parameters
    ----------
    labels, predicted
        (y, x) class indices; where the label is 255 neither counts.
    width
        Of the boundary [px]; by default 2 % of the image's diagonal.

    Raises
    ------
    ShapeError : the two are not of one (y, x) size.
    """
    if labels.shape != predicted.shape or labels.ndim != 2:
        raise ShapeError(f"labels are {labels.shape}, the class map is {predicted.shape}; they must be equal, (y, x)")
    d = boundary_px(labels.shape) if width is None else width
    seen = labels != UNLABELLED
    counts = np.zeros((classes, 2), np.int64)
    for number in range(classes):
        truth = near_border(labels == number, d)
        drawn = near_border((predicted == number) & seen, d)
        counts[number] = np.count_nonzero(truth & drawn), np.count_nonzero(truth | drawn)
    return counts


def near_border(region: NDArray[np.bool_], width: int) -> NDArray[np.bool_]:
    """Pixels of a (y, x) region within ``width`` px of what is not the region; the image ends where the array does."""
    from scipy.ndimage import minimum_filter1d

    if not region.any():
        return region
    inner = region.astype(np.uint8)
    for axis in (0, 1):
        inner = minimum_filter1d(inner, 2 * width + 1, axis=axis, mode="constant", cval=0)
    border: NDArray[np.bool_] = region & (inner == 0)
    return border


def boundary_iou(counts: NDArray[np.int64], labelled: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Boundary IoU of each class from `boundary_counts`; NaN for a class that the labels lack (`labelled_classes`)."""
    both, either = counts[:, 0].astype(np.float64), counts[:, 1]
    iou: NDArray[np.float64] = np.divide(both, either, out=np.full(len(both), np.nan), where=labelled)
    return iou


def mean_boundary_iou(counts: NDArray[np.int64], labelled: NDArray[np.bool_]) -> float:
    """Mean over the classes that the labels have; NaN where there is none."""
    iou = boundary_iou(counts, labelled)
    return float(iou[labelled].mean()) if labelled.any() else float("nan")
