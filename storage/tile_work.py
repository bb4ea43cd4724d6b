"""Making a mosaic on disk from sweeps on disk: tile by tile, several at a time, within a bound of memory."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import dask.threaded
import numpy as np
from dask.callbacks import Callback
from numpy.typing import NDArray

from pipeline.camera import LineCamera
from pipeline.errors import SettingsError
from pipeline.rectify.line_cache import LineCache
from pipeline.rectify.placed import PixelGrid, Placed
from pipeline.rectify.region import mosaic_tile
from pipeline.rectify.resample import Kernel
from pipeline.rectify.tiles import Tile, cache_bytes, plan_tiles, tile_bytes
from storage.mosaics import MosaicWriter

RESERVED_BYTES = 512 * 2**20  # the process before its first tile: interpreter, torch, zarr

Seen = Callable[[Tile, NDArray[np.float32]], None]


@dataclass(frozen=True)
class MosaicWork:
    """What a mosaic is made of, and with what."""

    placed: Sequence[Placed]
    camera: LineCamera
    grid: PixelGrid
    kernel: Kernel = "catmull-rom"


class Thumbnail:
    """Every n-th pixel of a mosaic in a few bands, filled as tiles are made: ``write_mosaic(..., seen=thumbnail)``."""

    def __init__(self, shape: tuple[int, int], bands: Sequence[int], most_px: int) -> None:
        self._steps = tuple(-(-size // most_px) for size in shape)
        self._bands = list(bands)
        size = [-(-size // step) for size, step in zip(shape, self._steps, strict=True)]
        self.image: NDArray[np.float32] = np.full((*size, len(bands)), np.nan, np.float32)  # (y, x, band)

    def __call__(self, tile: Tile, values: NDArray[np.float32]) -> None:
        """Take what falls on the thumbnail's pixels."""
        (top, left), (down, across) = (tile.rows.start, tile.columns.start), self._steps
        part = values[-top % down :: down, -left % across :: across][..., self._bands]
        y, x = -(-top // down), -(-left // across)
        self.image[y : y + part.shape[0], x : x + part.shape[1]] = part


@dataclass(frozen=True)
class TileBudget:
    """How many tiles are made at a time, and the memory that this takes [bytes]."""

    workers: int
    cache: int  # raw lines kept
    tile: int  # one tile in the making

    @property
    def projected(self) -> int:
        """Highest memory of the process [bytes]."""
        return RESERVED_BYTES + self.cache + self.workers * self.tile


def write_mosaic(
    work: MosaicWork,
    writer: MosaicWriter,
    *,
    memory: int,
    workers: int | None = None,
    seen: Seen | None = None,
    report: Callable[[float], None] = lambda done: None,
) -> TileBudget:
    """Rectify and blend sweeps into a stored mosaic. However many workers there are, the same bytes come out.

    Parameters
    ----------
    memory
        What the process may take. [bytes]
    workers
        Most tiles at a time, one thread each; None allows one a core. Fewer are made where memory holds fewer.
    seen
        Called with each tile and its (y, x, band) values before they are written, from the thread that made it.
    report
        Called with the share done after each tile, from the calling thread.

    Returns
    -------
    How it was done.

    Raises
    ------
    SettingsError : not even one tile at a time fits the memory.
    """
    tiles = plan_tiles(work.placed, work.camera, work.grid, writer.tile_shape)
    budget = tile_budget(work, tiles, writer.tile_shape, memory=memory, workers=workers)
    cache = LineCache(budget.cache)

    def make(number: int) -> None:
        tile = tiles[number]
        values, coverage = mosaic_tile(
            work.placed, work.camera, work.grid, tile.rows, tile.columns,
            kernel=work.kernel, cache=cache, reach=tile.reach,
        )  # fmt: skip
        if seen is not None:
            seen(tile, values)
        writer.write_tile(tile.rows.start, tile.columns.start, values, coverage)

    _run_in_order(make, len(tiles), budget.workers, report)
    return budget


def tile_budget(
    work: MosaicWork, tiles: Sequence[Tile], tile_shape: tuple[int, int], *, memory: int, workers: int | None
) -> TileBudget:
    """Choose how many tiles to make at a time: as many as are allowed and memory holds.

    Raises
    ------
    SettingsError : not even one tile at a time fits the memory.
    """
    most = max(1, min(_cores() if workers is None else workers, len(tiles)))
    bands = len(work.placed[0].lines.references.panel) if work.placed else 1
    one = tile_bytes(tile_shape, bands)
    budgets = [TileBudget(count, cache_bytes(work.placed, tiles, count), one) for count in range(most, 0, -1)]
    for budget in budgets:
        if budget.projected <= memory:
            return budget
    least = budgets[-1]
    raise SettingsError(
        f"projected memory {_mib(least.projected)} exceeds --memory {_mib(memory)}: one tile of {tile_shape[0]} x "
        f"{tile_shape[1]} px and {bands} bands takes {_mib(one)}, the raw lines behind it {_mib(least.cache)}, the "
        f"process itself {_mib(RESERVED_BYTES)}; give at least --memory {_mib(least.projected)}"
    )


def _cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _mib(size: int) -> str:
    return f"{-(-size // 2**20)} MiB"


def _run_in_order(make: Callable[[int], None], count: int, workers: int, report: Callable[[float], None]) -> None:
    """Call ``make`` for 0..count, each once all that lie ``workers`` before it are done: tiles stay near each other."""
    if workers == 1:
        for number in range(count):
            make(number)
            report((number + 1) / count)
        return
    finished = iter(range(1, count + 1))
    graph = {
        f"tile {number}": (
            lambda number, *before: make(number), number, *(f"tile {at}" for at in _awaited(number, workers)),
        )
        for number in range(count)
    }  # fmt: skip
    told = Callback(posttask=lambda *about: report(next(finished) / count))  # type: ignore[no-untyped-call]
    with told:
        dask.threaded.get(graph, list(graph), num_workers=workers)


def _awaited(number: int, workers: int) -> list[int]:
    """Tiles to wait for; two in a row are enough, for they waited for all before."""
    return [at for at in (number - workers, number - workers - 1) if at >= 0]
