"""How sure a difference of two rows is: frames drawn again and again, both rows judged on the same draw."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import ShapeError

DRAWS = 2000
LEVEL = 0.95
Counts = NDArray[np.int64]


@dataclass(frozen=True)
class Interval:
    """A difference of mIoU (first minus second) and the bounds that ``LEVEL`` of the draws lie within."""

    difference: float
    low: float | None  # None with fewer than two frames, or where no draw has a difference
    high: float | None

    def as_dict(self) -> dict[str, float | None]:
        """Give the interval as the evaluation stores it."""
        return {"difference": self.difference, "low": self.low, "high": self.high}


def mean_iou_of_sums(counts: NDArray[np.integer]) -> NDArray[np.float64]:
    """Mean IoU of each of many confusion counts, (..., class, class) -> (...); NaN where nothing is labelled."""
    exact = counts.astype(np.float64)
    hit = np.diagonal(exact, axis1=-2, axis2=-1)
    union = exact.sum(axis=-1) + exact.sum(axis=-2) - hit
    iou = np.divide(hit, union, out=np.zeros_like(hit), where=union > 0)
    present = (union > 0).sum(axis=-1)
    mean: NDArray[np.float64] = np.divide(
        iou.sum(axis=-1), present, out=np.full(present.shape, np.nan), where=present > 0
    )
    return mean


def paired_interval(first: Counts, second: Counts, *, draws: int = DRAWS, seed: int = 0) -> Interval:
    """Bootstrap the difference of two rows over frames.

    Parameters
    ----------
    first, second
        (run, frame, class, class) confusion counts. A run is a seed of the training or of the placement; a row's
        figure is the mean over its runs of the mIoU of the drawn frames together. The rows may differ in runs, not in
        frames. A frame that a run did not judge is all zeros.
    draws
        How many times as many frames as there are are drawn, with replacement.

    Raises
    ------
    ShapeError : the rows differ in frames or classes.
    """
    if first.shape[1:] != second.shape[1:] or first.ndim != 4:
        raise ShapeError(f"expected two rows of the same frames and classes, got {first.shape} and {second.shape}")
    frames = first.shape[1]
    whole = np.ones((1, frames), np.int64)
    difference = float((_means(first, whole) - _means(second, whole))[0])
    if frames < 2:
        return Interval(difference, None, None)
    drawn = np.random.default_rng([seed, 0xB007]).multinomial(frames, np.full(frames, 1 / frames), size=draws)
    moved = _means(first, drawn) - _means(second, drawn)
    moved = moved[~np.isnan(moved)]
    if not moved.size:
        return Interval(difference, None, None)
    low, high = np.quantile(moved, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return Interval(difference, float(low), float(high))


def _means(counts: Counts, times: NDArray[np.integer]) -> NDArray[np.float64]:
    """Mean over runs of the mIoU of frames taken ``times`` (draw, frame) each; NaN where no run has a frame."""
    sums = np.einsum("df,rfij->drij", times, counts)
    each = mean_iou_of_sums(sums)
    known = ~np.isnan(each)
    number = known.sum(axis=1)
    means: NDArray[np.float64] = np.divide(
        np.where(known, each, 0.0).sum(axis=1), number, out=np.full(len(each), np.nan), where=number > 0
    )
    return means
