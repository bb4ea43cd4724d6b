"""Pixels without a reading: filled from the rest of their patch, and what of a patch is too little to be read."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Kind = TypeVar("Kind", bound=np.generic)

MOST_DEAD = 0.5  # a token with more dead pixels than this share is not read
MOST_COLUMN = 1e12  # of normalised columns: no reading gives more, and squares of more would end the range of float32


def all_alive(columns: NDArray[np.floating]) -> bool:
    """Whether no pixel is dead, without a copy of the columns."""
    return not columns.size or bool(columns.min() >= -MOST_COLUMN and columns.max() <= MOST_COLUMN)


def dead_pixels(columns: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Pixels with a column that is not finite, or larger than any reading gives, (..., column) -> (...)."""
    if all_alive(columns):
        return np.zeros(columns.shape[:-1], np.bool_)
    alive = columns <= MOST_COLUMN  # no copy of the columns: their size would be one
    alive &= columns >= -MOST_COLUMN
    return np.asarray(~alive.all(axis=-1), np.bool_)


def fill_dead(patches: NDArray[np.floating], dead: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Patches (P, y, x, column) with the mean of each one's living pixels in the dead ones; 0 where none lives."""
    filled = np.array(patches, np.float32)
    for patch, holes in zip(filled, dead, strict=True):  # one by one: together they would take several copies of all
        if holes.any():
            patch[holes] = 0 if holes.all() else patch[~holes].mean(axis=0, dtype=np.float64)
    return filled


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
