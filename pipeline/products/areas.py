"""Estimate the fractions of classes on a map and their errors from a confusion matrix."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]


def stratified_fractions(mapped: ArrayLike, confusion: ArrayLike) -> tuple[Floats, Floats]:
    """Estimate fractions (class,) and their standard errors from a map and the confusion matrix of judged pixels.

    ``mapped`` is (class,) fractions of the map, ``confusion`` (label, mapped class) counts, as
    `models.evaluation.metrics.confusion` returns them. The judged pixels count as a random sample of each mapped class.
    The result is NaN if a mapped class has fewer than the two judged pixels that an error needs.

    References
    ----------
    .. [1] Olofsson et al., "Good practices for estimating area and assessing accuracy of land change", Remote Sensing
       of Environment 148, 2014. doi:10.1016/j.rse.2014.02.015
    """
    weight, counts = np.asarray(mapped, np.float64), np.asarray(confusion, np.float64)
    there = weight > 0
    strata, number = weight[there], counts[:, there].sum(axis=0)
    if (number < 2).any():
        return np.full(len(weight), np.nan), np.full(len(weight), np.nan)
    of_map = counts[:, there] / number
    fractions = (strata * of_map).sum(axis=1)  # [1] Eq. 9
    variance = (strata**2 * of_map * (1 - of_map) / (number - 1)).sum(axis=1)  # [1] Eq. 10, squared
    return fractions, np.sqrt(variance)
