"""Expected errors of a prior map, patch by patch, and the expected gain of capturing each patch again."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.geometry.grid import SceneGrid

LEAST_EXPECTED_ERROR = 1e-4  # of a histogram of expected errors, even in their logarithm
STEPS = 24  # of this histogram
Floats = NDArray[np.float64]


def expected_error_of(log_probability: NDArray[np.floating]) -> Floats:
    """Return the probability (y, x) that the likeliest class of a pixel is wrong.

    ``log_probability`` is (y, x, class); in a pixel of NaN all classes are equally likely.
    """
    right = np.exp(np.minimum(log_probability.max(axis=-1).astype(np.float64), 0.0))
    nothing = 1 - 1 / log_probability.shape[-1]
    return np.asarray(np.where(np.isfinite(right), np.minimum(1 - right, nothing), nothing))


@dataclass(frozen=True)
class PatchExpectedErrors:
    """Pixels of each patch by their likeliest class and expected error, and the age of the oldest ones.

    One class more than the map has is for pixels without probabilities.
    """

    pixels: NDArray[np.float32]  # (patch, class + 1, step) counts
    wrong: Floats  # (class + 1, step) sum of their expected errors
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
        errors of known pixels. Pixels of ``left_out`` (y, x) do not count.
        """
        edges = np.geomspace(LEAST_EXPECTED_ERROR, 1.0, STEPS)
        kinds = classes + 1
        pixels = np.zeros((*grid.patch_shape, kinds, STEPS), np.float32)
        ages = np.full(grid.patch_shape, -np.inf)
        sums = np.zeros(kinds * STEPS)
        top = 0
        for probabilities, age in strips:
            first = top // grid.patch
            down, across = (np.arange(size) // grid.patch for size in (len(probabilities), grid.width))
            patch_number = down[:, None] * grid.patch_shape[1] + across  # of each pixel, from the first of the strip
            here = slice(first, first + math.ceil(len(probabilities) / grid.patch))
            known = ~np.isnan(probabilities).all(axis=-1)
            wrong = np.where(known, come_true, 1.0) * expected_error_of(probabilities)
            step = np.minimum(np.searchsorted(edges, wrong), STEPS - 1)
            place = np.where(known, np.nan_to_num(probabilities, nan=-np.inf).argmax(axis=-1), classes) * STEPS + step
            asked = np.True_ if left_out is None else ~left_out[top : top + len(probabilities)]
            counts = np.broadcast_to(asked, place.shape)
            sums += np.bincount(place[counts], wrong[counts], minlength=sums.size)
            place = place + patch_number * sums.size
            pixels[here] = np.bincount(place[counts], minlength=pixels[here].size).reshape(pixels[here].shape)
            np.maximum.at(
                ages[here].reshape(-1), patch_number.ravel(), np.where(asked & np.isfinite(age), age, -np.inf).ravel()
            )
            top += len(probabilities)
        age_days = np.where(ages < 0, np.inf, ages).ravel()
        return PatchExpectedErrors(pixels.reshape(-1, kinds, STEPS), sums.reshape(kinds, STEPS), age_days)

    @property
    def expected_error(self) -> Floats:
        """Return the mean expected error of the pixels of each class and step, (class + 1, step); 0 without pixels."""
        counts = self.pixels.sum(axis=0, dtype=np.float64)
        return np.asarray(np.divide(self.wrong, counts, out=np.zeros_like(counts), where=counts > 0))

    def expected_wrong(self) -> float:
        """Return the expected fraction of wrong pixels of the field; 0 without pixels."""
        return float(self.wrong.sum() / max(self.pixels.sum(dtype=np.float64), 1.0))

    def expected_gain(self, wrong_after: Floats) -> Floats:
        """Return the expected increase of the mean accuracy over classes by capturing each patch, (patch,) 0..1.

        ``wrong_after`` (class,) is the fraction of wrong pixels of each class in a map of the new capture. A pixel
        with a smaller expected error gains nothing. All classes have the same weight. Pixels of which nothing is known
        are expected to have the classes of the others, in the same proportions.
        """
        count = self.pixels.sum(axis=(0, 2), dtype=np.float64)
        every = max(count.sum(), 1.0)
        there = count[:-1] > 0
        known = count[:-1].sum() / every
        weight = np.divide(known, count, out=np.full_like(count, 1 / every), where=[*there, False])
        weight[:-1] /= max(int(there.sum()), 1)
        after = np.append(wrong_after, np.mean(wrong_after, where=there if there.any() else True))
        gained = np.maximum(self.expected_error - after[:, None], 0.0) * weight[:, None]
        return np.tensordot(self.pixels, gained, 2)
