"""Tiles of a mosaic from placed sweeps: what is in one, as a function of arrays, and the memory that tiles take.

A maker of tiles opens its sweeps once in every process, and keeps their raw lines from tile to tile.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import block_means
from pipeline.rectify.kernels import Kernel
from pipeline.rectify.placed import PixelGrid, Placed
from pipeline.rectify.region import Reaches, Tile, cache_bytes, column_reach, mosaic_tile, plan_tiles, tile_bytes
from pipeline.signal.lines import LineCache

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


OpenWork = Callable[[], MosaicWork]  # hashable, and where several processes make tiles pickled: it holds paths


@dataclass(frozen=True)
class TileMaker:
    """Makes tiles in any process, with ``cache`` bytes of raw lines kept from tile to tile."""

    open: OpenWork
    cache: int

    def __call__(self, rows: slice, columns: slice) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
        """Return values and coverage as `MosaicWork.make_tile` does."""
        opened = opened_tiles(self)
        return opened.work.make_tile(rows, columns, opened.reach(columns.start, columns.stop), opened.lines)


@dataclass(frozen=True)
class OpenedTiles:
    """What makes tiles in one process."""

    work: MosaicWork
    lines: LineCache
    reach: Callable[[int, int], Reaches]  # of some columns: tiles go down them


@lru_cache(maxsize=1)
def opened_work(open_work: OpenWork) -> MosaicWork:
    """Open work once in this process."""
    return open_work()


@lru_cache(maxsize=1)
def opened_tiles(maker: TileMaker) -> OpenedTiles:
    """Open what a maker needs once in this process; the one before it is let go."""
    work = opened_work(maker.open)
    return OpenedTiles(
        work, LineCache(maker.cache), lru_cache(maxsize=2)(lambda start, stop: work.reach(slice(start, stop)))
    )


def let_tiles_go() -> None:
    """Give back the memory of the last mosaic's raw lines in this process, whose work goes on with something else."""
    opened_tiles.cache_clear()
    opened_work.cache_clear()
