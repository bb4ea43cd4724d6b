"""Tiles of a mosaic from placed sweeps: what is in one, as a function of arrays, and the memory that tiles take."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.camera import LineCamera
from pipeline.rectify.kernels import Kernel
from pipeline.rectify.mosaic import LineCache
from pipeline.rectify.placed import PixelGrid, Placed
from pipeline.rectify.region import Reaches, Tile, cache_bytes, column_reach, mosaic_tile, plan_tiles, tile_bytes

ROWS_OF_MEANS = 8  # of a mosaic whose pixels are means, rectified at once


@dataclass(frozen=True)
class MosaicWork:
    """What a mosaic is made of, and with what."""

    placed: Sequence[Placed]
    camera: LineCamera
    grid: PixelGrid
    kernel: Kernel = "catmull-rom"
    finer: PixelGrid | None = None  # whose pixels are rectified, and their means are the grid's

    @property
    def read(self) -> PixelGrid:
        """The pixels that lines are rectified onto."""
        return self.finer or self.grid

    def reach(self, columns: slice) -> Reaches:
        """What sweeps show of some columns of the grid, the same for all rows."""
        times = 1 if self.finer is None else self.grid.spacing_px // self.finer.spacing_px
        wide = slice(columns.start * times, min(columns.stop * times, self.read.shape[1]))
        return column_reach(self.placed, self.camera, self.read, wide)

    def make_tile(
        self, rows: slice, columns: slice, reach: Reaches, cache: LineCache
    ) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
        """Return the (y, x, band) values and (y, x) coverage of some rows and columns, NaN and 0 where nothing is seen.

        Of a finer grid they are means over its pixels that lines reached, a few rows at a time.
        """

        def tile(rows: slice, columns: slice) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
            return mosaic_tile(
                self.placed, self.camera, self.read, rows, columns, kernel=self.kernel, cache=cache, reach=reach
            )

        if self.finer is None:
            return tile(rows, columns)
        times, bands = (
            self.grid.spacing_px // self.finer.spacing_px,
            len(self.placed[0].lines.references.white_reference),
        )
        wide = slice(columns.start * times, min(columns.stop * times, self.finer.shape[1]))
        shape = rows.stop - rows.start, columns.stop - columns.start
        values, coverage = np.empty((*shape, bands), np.float32), np.empty(shape, np.intp)
        for first in range(rows.start, rows.stop, ROWS_OF_MEANS):
            last = min(first + ROWS_OF_MEANS, rows.stop)
            deep = slice(first * times, min(last * times, self.finer.shape[0]))
            part = slice(first - rows.start, last - rows.start)
            values[part], coverage[part] = block_means(*tile(deep, wide), times)
        return values, coverage

    def tile_memory(self, tiles: Sequence[Tile], tile_shape: tuple[int, int], at_once: int) -> tuple[int, int]:
        """Return the bytes of one tile of (y, x) ``tile_shape`` in the making, and of raw lines that tiles share."""
        bands = len(self.placed[0].lines.references.white_reference) if self.placed else 1
        one = tile_bytes(tile_shape, bands)
        if self.finer is None:
            return one, cache_bytes(self.placed, tiles, at_once)
        times = self.grid.spacing_px // self.finer.spacing_px
        part_shape = ROWS_OF_MEANS * times, tile_shape[1] * times
        parts = cache_bytes(self.placed, plan_tiles(self.placed, self.camera, self.finer, part_shape), 2)
        return one + tile_bytes(part_shape, bands), at_once * parts


def block_means(
    values: NDArray[np.float32], coverage: NDArray[np.intp], times: int
) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
    """Mean of every ``times`` x ``times`` pixels that are no NaN, (y, x, band), and the most sweeps that saw one.

    Sides that ``times`` does not divide end in a smaller block. NaN where nothing of a block was seen.
    """
    beyond = [(0, -size % times) for size in coverage.shape]
    if any(more for _, more in beyond):
        values = np.pad(values, (*beyond, (0, 0)), constant_values=np.nan)
        coverage = np.pad(coverage, beyond)
    blocks = values.reshape(values.shape[0] // times, times, values.shape[1] // times, times, -1)
    covered = coverage.reshape(*blocks.shape[:4]).max(axis=(1, 3))
    with np.errstate(over="ignore", invalid="ignore"):
        total = blocks.sum(axis=(1, 3), dtype=np.float32)
    if np.isfinite(total).all():  # the rule: all was seen
        return total / np.float32(times**2), covered
    seen = np.isfinite(blocks)
    count = seen.sum(axis=(1, 3), dtype=np.float32)
    total = np.where(seen, blocks, np.float32(0)).sum(axis=(1, 3), dtype=np.float32)
    return np.divide(total, count, out=np.full_like(total, np.nan), where=count > 0), covered
