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
from pipeline.rectify.kernels import Kernel
from pipeline.rectify.placed import PixelGrid, Placed
from pipeline.rectify.region import COPIES, Reaches, Tile, cache_bytes, column_reach, mosaic_tile
from pipeline.signal.lines import LineCache


@dataclass(frozen=True)
class MosaicWork:
    """Placed sweeps, camera and grid of a mosaic."""

    placed: Sequence[Placed]
    camera: LineCamera
    grid: PixelGrid
    kernel: Kernel = "catmull-rom"

    def reach(self, columns: slice) -> Reaches:
        """Return what sweeps show of some columns of the grid, the same for all rows."""
        return column_reach(self.placed, self.camera, self.grid, columns)

    def tile_memory(self, tiles: Sequence[Tile], tile_shape: tuple[int, int], at_once: int) -> tuple[int, int]:
        """Return the bytes of one tile of (y, x) ``tile_shape`` in the making, and of stored lines that tiles share."""
        bands = self.placed[0].signal.bands if self.placed else 1
        return COPIES * tile_shape[0] * tile_shape[1] * bands * 4, cache_bytes(self.placed, tiles, at_once)


OpenWork = Callable[[], MosaicWork]  # hashable, and where several processes make tiles pickled: it holds paths


@dataclass(frozen=True)
class TileMaker:
    """Makes tiles in any process, with ``cache`` bytes of raw lines kept from tile to tile."""

    open: OpenWork
    cache: int

    def __call__(self, rows: slice, columns: slice) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
        """Return the (y, x, component) scores and (y, x) coverage of a part, NaN and 0 where nothing is seen."""
        opened = opened_tiles(self)
        work, reach = opened.work, opened.reach(columns.start, columns.stop)
        return mosaic_tile(
            work.placed, work.camera, work.grid, rows, columns, kernel=work.kernel, cache=opened.lines, reach=reach
        )


@dataclass(frozen=True)
class OpenedTiles:
    """Opened work that makes tiles in one process."""

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
    """Give back the memory of the last mosaic's raw lines in this process, before its next work."""
    opened_tiles.cache_clear()
    opened_work.cache_clear()
