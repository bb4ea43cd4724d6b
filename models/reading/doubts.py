"""How doubtful a remembered map is, seat by seat, and what a look at each seat would mend of it."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.grid import SceneGrid

LEAST_DOUBT, STEPS = 1e-4, 24  # doubts are kept in so many steps by their logarithm
Floats = NDArray[np.float64]


def doubt_of(log_probability: NDArray[np.floating]) -> Floats:
    """Give the chance (y, x) that the likeliest class of a pixel is not its class.

    ``log_probability`` (y, x, class) is what is believed; NaN is a pixel of which nothing is known: each class is as
    likely there.
    """
    right = np.exp(np.minimum(log_probability.max(axis=-1).astype(np.float64), 0.0))
    nothing = 1 - 1 / log_probability.shape[-1]
    found: Floats = np.where(np.isfinite(right), np.minimum(1 - right, nothing), nothing)
    return found


@dataclass(frozen=True)
class SeatDoubts:
    """Pixels of each seat by their believed class and doubt, and how old the oldest look at a seat is."""

    pixels: NDArray[np.float32]  # (seat, class, step) counts
    doubt: Floats  # (step,) of the pixels of a step, at most
    age_days: Floats  # (seat,) of its oldest pixel of which anything is known; inf where of none is

    @staticmethod
    def of(
        strips: Iterable[tuple[NDArray[np.floating], NDArray[np.floating]]],
        grid: SceneGrid,
        classes: int,
        *,
        come_true: float = 1.0,
    ) -> SeatDoubts:
        """Sort the pixels of a field. ``strips`` are (y, x, class) beliefs and (y, x) ages from the top down [days].

        Every strip but the last is of whole seats high; ``come_true`` is the share of doubts that do.
        """
        doubt = np.geomspace(LEAST_DOUBT, 1.0, STEPS)
        rows, columns = grid.seat_shape
        pixels, ages = np.zeros((rows, columns, classes, STEPS), np.float32), np.full((rows, columns), -np.inf)
        top = 0
        for belief, age in strips:
            first, seat = top // grid.patch, _seats_of(len(belief), grid)
            here = slice(first, first + math.ceil(len(belief) / grid.patch))
            wrong = come_true * doubt_of(belief)
            step = np.minimum(np.searchsorted(doubt, wrong), STEPS - 1)
            believed = np.where(np.isfinite(belief[..., 0]), np.nan_to_num(belief, nan=-np.inf).argmax(axis=-1), 0)
            place = (seat * classes + believed) * STEPS + step
            counted = np.bincount(place.ravel(), minlength=pixels[here].size)
            pixels[here] = counted.reshape(pixels[here].shape)
            np.maximum.at(ages[here].reshape(-1), seat.ravel(), np.where(np.isfinite(age), age, -np.inf).ravel())
            top += len(belief)
        known = np.where(ages < 0, np.inf, ages).ravel()
        return SeatDoubts(pixels.reshape(-1, classes, STEPS), doubt, known)

    def expected_wrong(self) -> float:
        """Give the share of the field's pixels that are expected to be wrong."""
        return float((self.pixels.sum(axis=(0, 1), dtype=np.float64) @ self.doubt) / self.pixels.sum(dtype=np.float64))

    def worth(self, wrong_after: Floats) -> Floats:
        """Give what a look at each seat (seat,) is expected to add to the mean over classes, 0..1.

        ``wrong_after`` (class,) is the share of a class's pixels that such a look calls otherwise. A pixel that is
        surer than that gains nothing, and each class counts as much as any other, whatever its area.
        """
        count = self.pixels.sum(axis=(0, 2), dtype=np.float64)
        there = count > 0
        weight = np.divide(1.0, count, out=np.zeros_like(count), where=there) / max(int(there.sum()), 1)
        gained = np.maximum(self.doubt - wrong_after[:, None], 0.0) * weight[:, None]
        found: Floats = self.pixels.reshape(len(self.pixels), -1) @ gained.ravel()
        return found


def _seats_of(rows: int, grid: SceneGrid) -> NDArray[np.intp]:
    """(y, x) numbers of the seats of so many rows of pixels, counted from their first."""
    down, across = (np.arange(size) // grid.patch for size in (rows, grid.width))
    return down[:, None] * grid.seat_shape[1] + across
