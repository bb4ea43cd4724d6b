"""Pictures that already lie in the plane of the grid: put together by their places alone, as sweeps are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import ShapeError
from pipeline.rectify.mosaic import Part, edge_distance, mosaic
from pipeline.rectify.registration.shifts import PairShift, pair_shift
from pipeline.rectify.resample import Kernel, resample

Floats = NDArray[np.float64]

BLOCK_ROWS = 64


@dataclass(frozen=True)
class Picture:
    """An image and where its first pixel's centre lies on the grid. Its lookup is a shift and nothing else."""

    values: NDArray[np.float32]  # (row, column, band)
    origin_px: Floats  # (2,) row and column of the grid, whole or not
    valid: NDArray[np.bool_] | None = None  # (row, column); None where every pixel counts

    def __post_init__(self) -> None:
        if self.values.ndim != 3 or (self.valid is not None and self.valid.shape != self.values.shape[:2]):
            mask = None if self.valid is None else self.valid.shape
            raise ShapeError(
                f"expected a picture (row, column, band) with a mask (row, column), got {self.values.shape} and {mask}"
            )

    @property
    def mask(self) -> NDArray[np.bool_]:
        """(row, column) pixels that count."""
        return np.ones(self.values.shape[:2], bool) if self.valid is None else self.valid

    def on_grid(self, rows: slice, columns: slice, kernel: Kernel) -> Part:
        """Resample the picture at a part of the grid's pixels."""
        row, column = np.arange(rows.start, rows.stop), np.arange(columns.start, columns.stop)
        at = np.stack(np.meshgrid(row - self.origin_px[0], column - self.origin_px[1], indexing="ij"), axis=-1)
        height, width = self.values.shape[:2]
        edge = edge_distance(at, height, width)
        at[~(edge >= 0)] = np.nan
        values, weight = resample(self.values, self.mask, at.reshape(-1, 2), kernel)
        return Part(values, weight, edge.ravel())


def join_pictures(
    pictures: Sequence[Picture], shape: tuple[int, int], *, kernel: Kernel = "catmull-rom"
) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
    """Resample and blend pictures on a grid of ``shape`` pixels.

    Returns
    -------
    (row, column, band) float32, NaN where no picture reached, and (row, column) how many did.

    Raises
    ------
    ShapeError : no picture, or pictures of different bands.
    """
    joined, coverage = [], []
    for first in range(0, shape[0], BLOCK_ROWS):
        rows = slice(first, min(first + BLOCK_ROWS, shape[0]))
        values, count = mosaic([picture.on_grid(rows, slice(0, shape[1]), kernel) for picture in pictures])
        joined.append(values.reshape(-1, shape[1], values.shape[1]))
        coverage.append(count.reshape(-1, shape[1]))
    if not joined:
        raise ShapeError(f"expected a grid of at least one row, got {shape}")
    return np.concatenate(joined), np.concatenate(coverage)


def picture_shift(reference: Picture, moving: Picture, *, prior_px: float) -> PairShift:
    """Register two pictures where they overlap, by the mean of their bands.

    Parameters
    ----------
    prior_px
        Largest error of their places relative to each other, in either axis. [px]

    Returns
    -------
    The shift to add to ``moving.origin_px``.
    """
    pictures = (reference, moving)
    first = np.ceil(np.max([picture.origin_px for picture in pictures], axis=0)).astype(int)
    ends = [picture.origin_px + picture.values.shape[:2] for picture in pictures]
    last = np.maximum(np.floor(np.min(ends, axis=0)).astype(int), first + 1)
    rows, columns = (slice(int(low), int(high)) for low, high in zip(first, last, strict=True))
    parts = [picture.on_grid(rows, columns, "catmull-rom") for picture in pictures]
    shape = rows.stop - rows.start, columns.stop - columns.start
    return pair_shift(*(part.values.mean(axis=1).reshape(shape) for part in parts), prior_px=prior_px)
