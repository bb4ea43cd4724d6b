"""Between two rounds of detail: how much the first changed the map where it looked, and what the rest is worth by that.

Where the fine patches said more than was expected, seats near them are likely to say more too, and the other way round.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from models.network.sizes import MOST_GAIN
from models.reading.inference import CoarseLook, captured, check_seats, origin_of, readings_of
from models.weights.files import Weights
from pipeline.errors import ShapeError

if TYPE_CHECKING:
    from torch import Tensor

Floats = NDArray[np.float64]

REACH_SEATS = 1.0  # over which what was found at a seat speaks for its neighbours: sigma of a Gaussian
NEAR_SEATS = 2.0  # looks at the seat itself that weigh as much as what holds for the whole field
FIELD_SEATS = 8.0  # looks anywhere that weigh as much as the expectation before them
MOST_SCORE = 1e100  # larger ones are compared in a larger unit
MOST_TIMES = 8.0  # that a score is raised or lowered


def rescore(
    score: NDArray[np.floating],
    seats: NDArray[np.integer],
    surprise: NDArray[np.floating],
    shape: tuple[int, int],
    *,
    seen: NDArray[np.floating] | None = None,
    relative: bool = False,
) -> Floats:
    """Score the seats that are left by what looks at others showed against what was expected of them.

    The score e of a captured seat is what was expected of it, its surprise r what was found. A seat is multiplied by

        (n m g + sum_i w_i r_i) / (n m + sum_i w_i e_i),   g = (f m + sum_i r_i) / (f m + sum_i e_i),

    with Gaussian weights w_i of the distance between seats, m the mean of e, n = ``NEAR_SEATS`` and f =
    ``FIELD_SEATS``: by g, which holds for the whole field, where nothing near was captured, and by 1 where all was as
    expected. The order of the captured seats has no part in it.

    Parameters
    ----------
    score
        (seat,) of the whole padded grid, row by row, as the first round was planned by; below 0 expects nothing.
    seats, surprise
        (captured,) their numbers, each once, and what was found there, in the unit of the score and not below 0.
        Where either is not finite the seat says nothing of others.
    shape
        Seats of the grid, (y, x).
    seen
        (captured,) share of each that was seen, 0..1: the rest is still worth a look. None is all.
    relative
        The score is of another unit than the surprise: it is expected in proportion, and g is 1.

    Returns
    -------
    (seat,) scores in the unit of ``score``, 0 where all was seen.

    Raises
    ------
    ShapeError : arrays that do not fit each other or the grid, or a seat that is none of it or comes twice.
    """
    numbers = np.asarray(seats, np.intp)
    given = np.asarray(score, np.float64)
    found = np.asarray(surprise, np.float64)
    share = np.ones(len(numbers)) if seen is None else np.asarray(seen, np.float64)
    _check(given, numbers, (found, share), shape)
    expected = np.maximum(given[numbers], 0.0)
    known = np.isfinite(expected) & np.isfinite(found)
    ratio = _ratio(numbers[known], expected[known], found[known], shape, relative=relative)
    again = given * ratio
    partly = share < 1
    again[numbers[~partly]] = 0.0
    again[numbers[partly]] *= 1 - share[partly]
    return again


def _ratio(
    seats: NDArray[np.intp], expected: Floats, found: Floats, shape: tuple[int, int], *, relative: bool
) -> Floats:
    """By what to multiply the score of every seat, (seat,)."""
    found = np.maximum(found, 0.0)
    if (most := float(expected.max(initial=0.0))) > MOST_SCORE:  # in a larger unit: sums would end the range of numbers
        expected, found = expected / most, found / most
    if not expected.sum() > 0 or (relative and not found.sum() > 0):
        return np.ones(shape[0] * shape[1])  # nothing was expected, or nothing found: nothing to compare
    if relative:
        expected, found = expected / expected.max(), found / found.max()
        expected = expected * (found.sum() / expected.sum())
    mean = float(expected.mean())  # above 0: nothing below divides by 0
    many, few = FIELD_SEATS * mean, NEAR_SEATS * mean
    field = 1.0 if relative else float((many + found.sum()) / (many + expected.sum()))
    found_near, expected_near = (_blurred(seats, values, shape) for values in (found, expected))
    ratio: Floats = (few * field + found_near) / (few + expected_near)
    return np.clip(ratio, 1 / MOST_TIMES, MOST_TIMES).ravel()


def _blurred(seats: NDArray[np.intp], values: Floats, shape: tuple[int, int]) -> Floats:
    """Sum of the captured seats' values by their distance, for every seat: (y, x), weight 1 at the seat itself."""
    from scipy.ndimage import correlate1d

    image = np.zeros(shape[0] * shape[1])
    image[seats] = values
    away = np.arange(-round(4 * REACH_SEATS), round(4 * REACH_SEATS) + 1)
    weight = np.exp(-0.5 * (away / REACH_SEATS) ** 2)
    blurred: Floats = image.reshape(shape)
    for axis in (0, 1):
        blurred = correlate1d(blurred, weight, axis=axis, mode="constant")
    return blurred


def _check(score: Floats, seats: NDArray[np.intp], each: tuple[Floats, ...], shape: tuple[int, int]) -> None:
    count = shape[0] * shape[1]
    if score.shape != (count,) or seats.ndim != 1 or any(values.shape != seats.shape for values in each):
        sizes = ", ".join(str(values.shape) for values in each)
        raise ShapeError(
            f"expected {count} scores and one surprise and share for each of {seats.shape} captured seats, "
            f"got {score.shape} and {sizes}"
        )
    if len(strange := seats[(seats < 0) | (seats >= count)]):
        raise ShapeError(f"seat {strange[0]} is none of the {count} seats of the field, 0..{count - 1}")
    distinct, times = np.unique(seats, return_counts=True)
    if len(repeated := distinct[times > 1]):
        raise ShapeError(f"seat {repeated[0]} was captured once and is given {times.max()} times; give each seat once")


def surprise(
    weights: Weights, seen: CoarseLook, patches: NDArray[np.floating], seats: NDArray[np.integer]
) -> NDArray[np.float64]:
    """Tell how much each fine patch changed the map, (seat,) [nat per px], by the share of it that lies on the scene.

    It is the divergence of what is said with the patch from what the glance said: of a model that knows how sure it is,
    what the look gained in loss. At most ``MOST_GAIN``; NaN where a patch shows too little to be read.

    Parameters
    ----------
    patches
        (seat, p, p, column) normalised columns of the fine pass, holes as in ``models.reading.inference.segment``.
    seats
        (seat,) their numbers on the grid of ``seen``, each once.

    Raises
    ------
    ShapeError : a seat given twice or outside the grid, or patches of another shape.
    """
    grid, p, numbers = seen.grid, seen.grid.patch, np.asarray(seats, np.int64)
    check_seats(numbers, grid)
    expected = (len(numbers), p, p, weights.config.columns)
    if patches.shape != expected:
        raise ShapeError(f"expected patches of shape {expected} (seat, y, x, column), got {patches.shape}")
    gained, pixel = np.full(grid.seat_shape, np.nan).ravel(), np.arange(p)
    for some, before, after in both_looks(weights, seen, patches, numbers):
        corner = grid.seat_origin(some)  # (seat, 2)
        down = corner[:, 0, None] + pixel < grid.height
        across = corner[:, 1, None] + pixel < grid.width
        apart = np.where(down[:, :, None] & across[:, None, :], _divergence(after, before), 0.0)
        gained[some] = np.minimum(apart.sum(axis=(1, 2)) / p**2, MOST_GAIN)
    return gained[numbers]


def both_looks(
    weights: Weights, seen: CoarseLook, patches: NDArray[np.floating], seats: NDArray[np.int64]
) -> Iterator[tuple[NDArray[np.int64], Tensor, Tensor]]:
    """Seats, some at a time, and class logits of their pixels by the glance alone and by the patches too.

    Logits are (seat, class, p, p). A patch that shows too little to be read is left out, as in the map.
    """
    import torch

    numbered: Iterator[tuple[NDArray[np.int64], Tensor, Tensor]]
    numbered = torch.inference_mode()(_both_looks)(weights, seen, *captured(patches, seats))  # while it runs, not after
    return numbered


def _both_looks(
    weights: Weights, seen: CoarseLook, patches: NDArray[np.floating], seats: NDArray[np.int64]
) -> Iterator[tuple[NDArray[np.int64], Tensor, Tensor]]:
    import torch

    from models.network.batches import FineScene, read_fine_packed

    if not len(seats):
        return
    model, (reading,), first = weights.segmenter.eval(), readings_of(weights, [seen]), 0
    for after in read_fine_packed(model, [FineScene(reading, patches, torch.from_numpy(seats), origin_of(seen))]):
        some = seats[first : first + len(after)]
        yield some, model.seat_windows(reading.logits, torch.from_numpy(some)[None]), after
        first += len(after)


def _divergence(of: Tensor, against: Tensor) -> Floats:
    """KL over the classes of logits (n, class, y, x), (n, y, x) [nat], never below 0."""
    sure, before = of.double().log_softmax(dim=1), against.double().log_softmax(dim=1)
    apart: Floats = (sure.exp() * (sure - before)).sum(dim=1).clamp(min=0).numpy()
    return apart
