"""How sure a difference of two rows is: frames and seeds drawn again and again, both rows judged on the same draw.

The classes of a draw's mean are those that the labels of its frames have: the same in both rows, whatever maps show.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from models.evaluation.metrics import mean_iou_of_each
from pipeline.errors import ShapeError

DRAWS = 2000
LEVEL = 0.95
Counts = NDArray[np.int64]
Numbers = NDArray[np.integer]


@dataclass(frozen=True)
class Interval:
    """A difference of mIoU (first minus second) and the bounds that ``LEVEL`` of the draws lie within."""

    difference: float
    low: float | None  # None with fewer than two frames, or where no draw has a difference
    high: float | None

    def as_dict(self) -> dict[str, float | None]:
        """Give the interval as the evaluation stores it."""
        return {"difference": self.difference, "low": self.low, "high": self.high}


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
    """How often each of ``count`` is drawn in as many goes, (draw, count)."""
    return np.random.default_rng(seed).multinomial(count, np.full(count, 1 / count), size=draws)


def _means(counts: Counts, times: Numbers, often: Numbers | None = None) -> NDArray[np.float64]:
    """Mean over runs of the mIoU of frames taken ``times`` (draw, frame) each; NaN where no run has a frame.

    ``often`` (draw, run) says how often each run counts; once, without it.
    """
    sums = np.einsum("df,rfij->drij", times, counts)
    each = mean_iou_of_each(sums)
    share = (~np.isnan(each)) * (1 if often is None else often)
    number = share.sum(axis=1)
    means: NDArray[np.float64] = np.divide(
        (np.nan_to_num(each) * share).sum(axis=1), number, out=np.full(len(each), np.nan), where=number > 0
    )
    return means
