"""Means of blocks of pixels."""

from __future__ import annotations

import warnings

import numpy as np
from numpy.typing import NDArray


def block_means(values: NDArray[np.float32], times: int) -> NDArray[np.float32]:
    """Return the mean of ``times`` x ``times`` pixels without NaN, (y, x, band); blocks at the end may be smaller."""
    beyond = [(0, -size % times) for size in values.shape[:2]]
    whole = np.pad(values, (*beyond, (0, 0)), constant_values=np.nan)
    blocks = whole.reshape(whole.shape[0] // times, times, whole.shape[1] // times, times, -1)
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # of a block without a value
        return np.asarray(np.nanmean(blocks, axis=(1, 3)), np.float32)
