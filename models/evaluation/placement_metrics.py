"""How well seats were placed, against the seats whose fine look lowers the loss most. Uses labels: evaluation only."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from models.network.sizes import MOST_GAIN
from models.reading.inference import CoarseLook, Glance, captured, origin_of, readings_of
from models.weights.files import Weights
from pipeline.geometry.grid import UNLABELLED

if TYPE_CHECKING:
    from torch import Tensor

Values = NDArray[np.floating]


def oracle_gain(
    weights: Weights, seen: Glance, fine: NDArray[np.floating], labels: NDArray[np.uint8]
) -> NDArray[np.float64]:
    """Loss with no fine seat minus loss with all of them, (seat,) [nat], mean over a seat's pixels.

    The loss is the cross-entropy of the labelled pixels; others, and those beside the scene, add 0 to the mean.
    Clipped to -5..5; negative where the fine look makes the map worse.

    Parameters
    ----------
    fine
        (seat, p, p, column) normalised columns of every seat of the padded grid.
    labels
        (y, x) class indices of the scene's own size, 255 unlabelled.
    """
    import torch

    grid, p = seen.grid, seen.grid.patch
    full = np.full(grid.padded_shape, UNLABELLED, np.uint8)
    full[: grid.height, : grid.width] = labels
    rows, columns = grid.seat_shape
    truth = full.reshape(rows, p, columns, p).swapaxes(1, 2).reshape(-1, p, p)
    gain, valid = np.zeros(len(truth)), grid.valid_seats()
    with torch.inference_mode():
        for seats, before, after in _both_looks(weights, seen, fine[valid], valid):
            lower = _losses(before.numpy(), truth[seats]) - _losses(after.numpy(), truth[seats])
            gain[seats] = lower.sum(axis=(1, 2)) / p**2
    return np.clip(gain, -MOST_GAIN, MOST_GAIN)


def _both_looks(
    weights: Weights, seen: CoarseLook, patches: NDArray[np.floating], seats: NDArray[np.int64]
) -> Iterator[tuple[NDArray[np.int64], Tensor, Tensor]]:
    """Seats, some at a time, and class logits (seat, class, p, p) by the glance alone and by the patches too.

    A patch that shows too little to be read is left out, as in the map.
    """
    import torch

    from models.network.batches import FineScene, read_fine_packed

    patches, seats = captured(patches, seats)
    if not len(seats):
        return
    model, (reading,), first = weights.segmenter.eval(), readings_of(weights, [seen]), 0
    for after in read_fine_packed(model, [FineScene(reading, patches, torch.from_numpy(seats), origin_of(seen))]):
        some = seats[first : first + len(after)]
        yield some, model.seat_windows(reading.logits, torch.from_numpy(some)[None]), after
        first += len(after)


def _losses(logits: NDArray[np.float32], truth: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Cross-entropy of each pixel, (seat, class, y, x) and (seat, y, x) -> (seat, y, x); 0 where unlabelled."""
    from scipy.special import logsumexp

    labelled = truth != UNLABELLED
    index = np.where(labelled, truth, 0).astype(np.intp)[:, None]
    exact = logits.astype(np.float64)
    loss = logsumexp(exact, axis=1) - np.take_along_axis(exact, index, axis=1)[:, 0]
    return np.where(labelled, loss, 0.0)


def gain_sums(gain: Values, chosen: NDArray[np.integer], valid: NDArray[np.integer]) -> tuple[float, float]:
    """Gain of the chosen seats, and of as many of the best valid ones; add frames up before dividing."""
    best = np.sort(gain[valid])[::-1][: len(chosen)]
    return float(gain[chosen].sum()), float(best.sum())


def captured_gain(bought: float, best: float) -> float | None:
    """Share of the best seats' gain that the chosen ones have; None where there is none to be had."""
    return bought / best if best > 0 else None


def average_precision(score: Values, positive: NDArray[np.bool_]) -> float:
    """Mean precision at each positive, from the best score down; equal scores by number, NaN last.

    NaN where nothing is positive.
    """
    if not positive.any():
        return float("nan")
    worth = np.where(np.isnan(score), -np.inf, score)
    hits = positive[np.argsort(-worth, kind="stable")]
    precision = np.cumsum(hits) / np.arange(1, len(hits) + 1)
    return float(precision[hits].mean())


def top_seats(gain: Values, count: int) -> NDArray[np.bool_]:
    """Which of the seats are the ``count`` with the most gain, equal ones by number, (seat,)."""
    best = np.zeros(len(gain), bool)
    best[np.argsort(-gain, kind="stable")[:count]] = True
    return best


def rank_correlation(score: Values, gain: Values) -> float:
    """Spearman's correlation, equal values sharing their mean rank; NaN where either is flat."""
    from scipy.stats import rankdata

    if len(score) < 2:
        return float("nan")
    first, second = (rankdata(values) - (len(values) + 1) / 2 for values in (score, gain))
    spread = float(np.sqrt((first**2).sum() * (second**2).sum()))
    return float((first * second).sum() / spread) if spread > 0 else float("nan")
