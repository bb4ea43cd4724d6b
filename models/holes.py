"""Pixels without a value: filled from the rest of their patch, and what of a patch is too little to be read."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Kind = TypeVar("Kind", bound=np.generic)

MOST_DEAD = 0.5  # a token with more dead pixels than this share is not read


def dead_pixels(columns: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Pixels with a column that is not finite, (..., column) -> (...)."""
    return np.asarray(~np.isfinite(columns).all(axis=-1), np.bool_)


def fill_dead(patches: NDArray[np.floating], dead: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Patches (P, y, x, column) with the mean of each one's living pixels in the dead ones; 0 where none lives."""
    known = np.where(dead[..., None], np.float32(0), np.asarray(patches, np.float32))
    living = np.count_nonzero(~dead, axis=(1, 2))
    mean = known.sum(axis=(1, 2), dtype=np.float64) / np.maximum(living, 1)[:, None]
    return np.asarray(np.where(dead[..., None], mean[:, None, None], known), np.float32)


def readable(dead: NDArray[np.bool_], side: int = 1) -> NDArray[np.bool_]:
    """Which of ``side`` x ``side`` tokens a patch can be read, (P, y, x) dead pixels -> (P, side^2), row by row."""
    count, height, width = dead.shape
    cells = dead.reshape(count, side, height // side, side, width // side)
    return np.asarray(cells.mean(axis=(2, 4)) <= MOST_DEAD, np.bool_).reshape(count, side * side)


def patches_of(image: NDArray[Kind], patch: int) -> NDArray[Kind]:
    """Cut an image whose sides ``patch`` divides, (y, x, ...), into patches (P, patch, patch, ...), row by row."""
    y, x = image.shape[0] // patch, image.shape[1] // patch
    cells = image.reshape(y, patch, x, patch, *image.shape[2:]).swapaxes(1, 2)
    return cells.reshape(y * x, patch, patch, *image.shape[2:])


def image_of(patches: NDArray[Kind], columns: int) -> NDArray[Kind]:
    """Put the patches of `patches_of` together again, ``columns`` of them side by side."""
    patch = patches.shape[1]
    cells = patches.reshape(-1, columns, *patches.shape[1:]).swapaxes(1, 2)
    return cells.reshape(cells.shape[0] * patch, columns * patch, *patches.shape[3:])
