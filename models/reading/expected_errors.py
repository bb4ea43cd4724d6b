"""Expected errors of a prior map, patch by patch, and the expected gain of capturing each patch again."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.grid import SceneGrid

LEAST_EXPECTED_ERROR, STEPS = 1e-4, 24  # of a histogram of expected errors, even in their logarithm
Floats = NDArray[np.float64]


def expected_error_of(log_probability: NDArray[np.floating]) -> Floats:
    """Return the probability (y, x) that the likeliest class of a pixel is wrong.

    ``log_probability`` is (y, x, class); in a pixel of NaN all classes are equally likely.
    """
    right = np.exp(np.minimum(log_probability.max(axis=-1).astype(np.float64), 0.0))
    nothing = 1 - 1 / log_probability.shape[-1]
    found: Floats = np.where(np.isfinite(right), np.minimum(1 - right, nothing), nothing)
    return found


@dataclass(frozen=True)
class PatchExpectedErrors:
    """Pixels of each patch by their likeliest class and expected error, and the age of the oldest ones."""

    pixels: NDArray[np.float32]  # (patch, class, step) counts
    expected_error: Floats  # (step,) upper bound of each step
    age_days: Floats  # (patch,) of its oldest pixel with data; inf without one

    @staticmethod
    def of(
        strips: Iterable[tuple[NDArray[np.floating], NDArray[np.floating]]],
        grid: SceneGrid,
        classes: int,
        *,
        come_true: float = 1.0,
        left_out: NDArray[np.bool_] | None = None,
    ) -> PatchExpectedErrors:
        """Sort the pixels of a field given in strips from the top: log-probabilities (y, x, class), ages (y, x) [days].

        Every strip but the last is a number of whole patches high. ``come_true`` is the ratio of true to expected
        errors. Pixels of ``left_out`` (y, x) do not count.
        """
        expected_error = np.geomspace(LEAST_EXPECTED_ERROR, 1.0, STEPS)
        rows, columns = grid.patch_shape
        pixels, ages = np.zeros((rows, columns, classes, STEPS), np.float32), np.full((rows, columns), -np.inf)
        top = 0
        for probabilities, age in strips:
            first = top // grid.patch
            down, across = (np.arange(size) // grid.patch for size in (len(probabilities), grid.width))
            patch_number = down[:, None] * columns + across  # of each pixel, from the first of the strip
            here = slice(first, first + math.ceil(len(probabilities) / grid.patch))
            wrong = come_true * expected_error_of(probabilities)
            step = np.minimum(np.searchsorted(expected_error, wrong), STEPS - 1)
            likeliest = np.where(
                np.isfinite(probabilities[..., 0]), np.nan_to_num(probabilities, nan=-np.inf).argmax(axis=-1), 0
            )
            place = (patch_number * classes + likeliest) * STEPS + step
            asked = np.True_ if left_out is None else ~left_out[top : top + len(probabilities)]
            counted = np.bincount(place[np.broadcast_to(asked, place.shape)], minlength=pixels[here].size)
            pixels[here] = counted.reshape(pixels[here].shape)
            known_age = np.where(asked & np.isfinite(age), age, -np.inf)
            np.maximum.at(ages[here].reshape(-1), patch_number.ravel(), known_age.ravel())
            top += len(probabilities)
        known = np.where(ages < 0, np.inf, ages).ravel()
        return PatchExpectedErrors(pixels.reshape(-1, classes, STEPS), expected_error, known)

    def expected_wrong(self) -> float:
        """Return the expected fraction of wrong pixels of the field."""
        return float(
            self.pixels.sum(axis=(0, 1), dtype=np.float64) @ self.expected_error / self.pixels.sum(dtype=np.float64)
        )

    def expected_gain(self, wrong_after: Floats) -> Floats:
        """Return the expected increase of the mean accuracy over classes by capturing each patch, (patch,) 0..1.

        ``wrong_after`` (class,) is the fraction of wrong pixels of each class in a map of the new capture. A pixel
        with a smaller expected error gains nothing. All classes have the same weight.
        """
        count = self.pixels.sum(axis=(0, 2), dtype=np.float64)
        there = count > 0
        weight = np.divide(1.0, count, out=np.zeros_like(count), where=there) / max(int(there.sum()), 1)
        gained = np.maximum(self.expected_error - wrong_after[:, None], 0.0) * weight[:, None]
        found: Floats = self.pixels.reshape(len(self.pixels), -1) @ gained.ravel()
        return found
