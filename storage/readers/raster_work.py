"""A raster's own pixels stored as a survey's images: coarse means and patches, a block of rows in memory at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.grid import SceneGrid, block_means
from storage.arrays.layout import SHARD_ROWS
from storage.arrays.mosaics import PATCHES_A_SHARD, MosaicWriter, PatchWriter
from storage.arrays.quicklooks import Thumbnail
from storage.parallel.pool import RESERVED_BYTES, memory_refusal

COPIES = 6  # of a block while it is read: the file's numbers, their float32, and what is made of them
FRACTION = 4  # of the memory beside what the process takes anyway: more at once is read no faster
Report = Callable[[float], None]


@dataclass(frozen=True)
class RasterPixels:
    """The pixels of a raster: ``read`` gives (y, x, band) float32 of some rows, NaN without a value."""

    read: Callable[[int, int], NDArray[np.float32]]
    missing: NDArray[np.bool_]  # (y, x) of which nothing is known
    bands: int
    grid: SceneGrid

    def rows(self, start: int, stop: int) -> NDArray[np.float32]:
        """Read rows of the raster, NaN in every band of the missing pixels."""
        values = self.read(start, stop)
        values[self.missing[start:stop]] = np.nan
        return values

    def rows_at_once(self, memory: int) -> int:
        """Return how many rows are read at a time: whole rows of patches, at least one (SettingsError: too many)."""
        grid = self.grid
        deep, row = grid.patch * grid.factor, COPIES * grid.width * self.bands * 4
        means = SHARD_ROWS * grid.coarse_shape[1] * self.bands * 4
        patches = PATCHES_A_SHARD * grid.patch**2 * self.bands * 4
        least = RESERVED_BYTES + max(means, patches) + deep * row
        if least > memory:
            why = f"{deep} rows of a raster of {grid.width} px and {self.bands} bands are read at a time"
            raise memory_refusal(least, memory, why)
        return deep * max(1, (memory - RESERVED_BYTES) // FRACTION // (deep * row))


def write_means(
    raster: RasterPixels, writer: MosaicWriter, *, memory: int, seen: Thumbnail, report: Report = lambda done: None
) -> None:
    """Store the mean of every factor x factor pixels that have a value, with coverage 1 where one has.

    Raises SettingsError: not even one row of patches fits the memory.
    """
    grid, factor = raster.grid, raster.grid.factor
    at_once, (height, width) = raster.rows_at_once(memory) // factor, grid.coarse_shape
    every = slice(0, width)
    for top in range(0, height, SHARD_ROWS):
        below = min(top + SHARD_ROWS, height)
        values = np.empty((below - top, width, raster.bands), np.float32)
        coverage = np.empty((below - top, width), np.intp)
        for first in range(top, below, at_once):
            last = min(first + at_once, below)
            part = slice(first - top, last - top)
            pixels = raster.rows(first * factor, min(last * factor, grid.height))
            known = np.asarray(np.isfinite(pixels).any(axis=-1), np.intp)
            values[part], coverage[part] = block_means(pixels, known, factor)
        writer.write_tile(top, 0, values, coverage)
        rows = slice(top, below)
        seen.put(rows, every, seen.cut(rows, every, values).copy())
        report(below / height)


def write_patches(
    raster: RasterPixels,
    writer: PatchWriter,
    patch_index: NDArray[np.integer],
    *,
    memory: int,
    report: Report = lambda done: None,
) -> None:
    """Store the patches of ascending ``patch_index`` at the raster's own pixels; beyond its edge that is repeated.

    Raises SettingsError: not even one row of patches fits the memory.
    """
    done = 0
    for values, valid in patches_of(raster, patch_index, memory=memory):
        writer.write(values, valid)
        done += len(values)
        report(done / len(patch_index))


def patches_of(
    raster: RasterPixels, patch_index: NDArray[np.integer], *, memory: int
) -> Iterator[tuple[NDArray[np.float32], NDArray[np.bool_]]]:
    """Read the patches of ascending ``patch_index``: (patch, y, x, band) values and (patch, y, x) validity, rows at a time.

    Raises SettingsError: not even one row of patches fits the memory.
    """
    grid = raster.grid
    p, (_, across) = grid.patch, grid.patch_shape
    deep = raster.rows_at_once(memory) // p
    row, column = np.divmod(patch_index, across)
    for first in sorted({int(one) // deep * deep for one in np.unique(row)}):
        here = (row >= first) & (row < first + deep)
        top, below = first * p, min((int(row[here].max()) + 1) * p, grid.height)
        pixels = raster.rows(top, below)
        beyond = [(0, -len(pixels) % p), (0, across * p - grid.width)]
        valid = np.pad(~raster.missing[top:below], beyond)
        pixels = np.pad(pixels, [*beyond, (0, 0)], mode="edge")
        cut = pixels.reshape(-1, p, across, p, raster.bands).swapaxes(1, 2)
        place = row[here] - first, column[here]
        yield cut[place], valid.reshape(-1, p, across, p).swapaxes(1, 2)[place]
