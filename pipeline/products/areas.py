"""Estimate the fractions of classes on a map and their errors, from a confusion matrix or class probabilities."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.errors import ShapeError

Floats = NDArray[np.float64]

BLOCK_PX = 16  # a side: errors are taken as equal within a block, and as independent between blocks


@dataclass(frozen=True)
class FractionEstimate:
    """Fractions of the classes in the mapped area, and their standard errors."""

    fractions: Floats  # (class,)
    errors: Floats  # (class,)


def judged_enough(confusion: ArrayLike) -> NDArray[np.bool_]:
    """Return which mapped classes (class,) have the two judged pixels that an estimate needs."""
    return np.asarray(np.asarray(confusion).sum(axis=0) >= 2, np.bool_)


def stratified_fractions(
    mapped: ArrayLike, confusion: ArrayLike, others: FractionEstimate | None = None
) -> FractionEstimate:
    """Estimate fractions from those of a map and the confusion matrix of judged pixels.

    ``mapped`` is (class,) fractions of the map, ``confusion`` (label, mapped class) counts, as
    `models.evaluation.metrics.confusion` returns them. The judged pixels count as a random sample of each mapped class.
    ``others`` are the fractions within all pixels mapped as classes that are not `judged_enough`, by other means.
    Without them the result is NaN if there are such pixels. Raises ShapeError: the sizes differ.

    References
    ----------
    .. [1] Olofsson et al., "Good practices for estimating area and assessing accuracy of land change", Remote Sensing
       of Environment 148, 2014. doi:10.1016/j.rse.2014.02.015
    """
    weight, counts = np.asarray(mapped, np.float64), np.asarray(confusion, np.float64)
    if counts.shape != (len(weight), len(weight)):
        raise ShapeError(f"{len(weight)} classes and a confusion matrix of {counts.shape} do not fit")
    judged = judged_enough(counts)
    strata, number = weight[judged], counts[:, judged].sum(axis=0)
    of_map = counts[:, judged] / number
    fractions = (strata * of_map).sum(axis=1)  # [1] Eq. 9
    variance = (strata**2 * of_map * (1 - of_map) / (number - 1)).sum(axis=1)  # [1] Eq. 10, squared
    rest = float(weight[~judged].sum())
    if rest > 0:
        unknown = np.full(len(weight), np.nan)
        others = FractionEstimate(unknown, unknown) if others is None else others
        fractions, variance = fractions + rest * others.fractions, variance + (rest * others.errors) ** 2
    return FractionEstimate(fractions, np.sqrt(variance))


def probable_fractions(swaths: Iterable[NDArray[np.floating]], classes: int) -> FractionEstimate:
    """Estimate fractions from probabilities (y, x, class), given as swaths of a map from the top down.

    NaN where a pixel has no class. Swaths are a multiple of ``BLOCK_PX`` high, but for the last. Each pixel is one draw
    by its probabilities. Within a block of 16 x 16 px all draws are equal, and blocks are independent. Otherwise a map
    in large patches would get too small an error. NaN without any pixel.
    """
    total, expected, variance = 0, np.zeros(classes), np.zeros(classes)
    for swath in swaths:
        known = np.isfinite(swath).all(axis=-1)
        fraction = np.where(known[..., None], swath, 0.0).astype(np.float64)
        total += int(known.sum())
        expected += fraction.sum(axis=(0, 1))
        spread = np.sqrt(fraction * (1 - fraction))
        for axis in (0, 1):
            spread = np.add.reduceat(spread, np.arange(0, spread.shape[axis], BLOCK_PX), axis=axis)
        variance += (spread**2).sum(axis=(0, 1))
    if not total:
        return FractionEstimate(np.full(classes, np.nan), np.full(classes, np.nan))
    return FractionEstimate(expected / total, np.sqrt(variance) / total)
