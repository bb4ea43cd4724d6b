"""Expected errors of a remembered map, patch by patch, and the gain of capturing each patch again."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.grid import SceneGrid

LEAST_EXPECTED_ERROR, STEPS = 1e-4, 24  # expected errors are kept in so many steps by their logarithm
Floats = NDArray[np.float64]


def expected_error_of(log_probability: NDArray[np.floating]) -> Floats:
    """Give the chance (y, x) that the likeliest class of a pixel is not its class.

    ``log_probability`` (y, x, class) is what is believed; NaN is a pixel of which nothing is known: each class is as
    likely there.
    """
    right = np.exp(np.minimum(log_probability.max(axis=-1).astype(np.float64), 0.0))
    nothing = 1 - 1 / log_probability.shape[-1]
    found: Floats = np.where(np.isfinite(right), np.minimum(1 - right, nothing), nothing)
    return found


@dataclass(frozen=True)
class PatchExpectedErrors:
    """Pixels of each patch by their believed class and doubt, and how old the oldest look at a patch is."""

    pixels: NDArray[np.float32]  # (patch, class, step) counts
    expected_error: Floats  # (step,) of the pixels of a step, at most
    age_days: Floats  # (patch,) of its oldest pixel of which anything is known; inf where of none is

    @staticmethod
    def of(
        strips: Iterable[tuple[NDArray[np.floating], NDArray[np.floating]]],
        grid: SceneGrid,
        classes: int,
        *,
        come_true: float = 1.0,
    ) -> PatchExpectedErrors:
        """Sort the pixels of a field. ``strips`` are (y, x, class) probabilities and (y, x) ages [days] from the top.

        Every strip but the last is of whole patches high; ``come_true`` is the fraction of expected errors that do.
        """
        expected_error = np.geomspace(LEAST_EXPECTED_ERROR, 1.0, STEPS)
        rows, columns = grid.patch_shape
        pixels, ages = np.zeros((rows, columns, classes, STEPS), np.float32), np.full((rows, columns), -np.inf)
        top = 0
        for probabilities, age in strips:
            first = top // grid.patch
            down, across = (np.arange(size) // grid.patch for size in (len(probabilities), grid.width))
            patch_number = down[:, None] * columns + across  # of each pixel, counted from the strip's first
            here = slice(first, first + math.ceil(len(probabilities) / grid.patch))
            wrong = come_true * expected_error_of(probabilities)
            step = np.minimum(np.searchsorted(expected_error, wrong), STEPS - 1)
            believed = np.where(
                np.isfinite(probabilities[..., 0]), np.nan_to_num(probabilities, nan=-np.inf).argmax(axis=-1), 0
            )
            place = (patch_number * classes + believed) * STEPS + step
            counted = np.bincount(place.ravel(), minlength=pixels[here].size)
            pixels[here] = counted.reshape(pixels[here].shape)
            np.maximum.at(
                ages[here].reshape(-1), patch_number.ravel(), np.where(np.isfinite(age), age, -np.inf).ravel()
            )
            top += len(probabilities)
        known = np.where(ages < 0, np.inf, ages).ravel()
        return PatchExpectedErrors(pixels.reshape(-1, classes, STEPS), expected_error, known)

    def expected_wrong(self) -> float:
        """Give the fraction of the field's pixels that are expected to be wrong."""
        return float(
            (self.pixels.sum(axis=(0, 1), dtype=np.float64) @ self.expected_error) / self.pixels.sum(dtype=np.float64)
        )

    def expected_wrong_pixels(self) -> Floats:
        """Return how many pixels of each patch are expected to be wrong, (patch,)."""
        found: Floats = self.pixels.sum(axis=1, dtype=np.float64) @ self.expected_error
        return found

    def expected_gain(self, wrong_after: Floats) -> Floats:
        """Give what a look at each patch (patch,) is expected to add to the mean over classes, 0..1.

        ``wrong_after`` (class,) is the fraction of a class's pixels that such a look calls otherwise. A pixel that is
        surer than that gains nothing, and each class counts as much as any other, whatever its area.
        """
        count = self.pixels.sum(axis=(0, 2), dtype=np.float64)
        there = count > 0
        weight = np.divide(1.0, count, out=np.zeros_like(count), where=there) / max(int(there.sum()), 1)
        gained = np.maximum(self.expected_error - wrong_after[:, None], 0.0) * weight[:, None]
        found: Floats = self.pixels.reshape(len(self.pixels), -1) @ gained.ravel()
        return found
