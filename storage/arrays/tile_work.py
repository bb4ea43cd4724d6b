"""Making a mosaic on disk from sweeps on disk: tile by tile, several at a time, within a bound of memory.

Registration says which lines of a sweep may be believed, and where they lie. A tile is a shard of the mosaic and a task
of its own: whoever makes it writes files that nobody else touches.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SettingsError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import exposing
from pipeline.rectify.kernels import Kernel
from pipeline.rectify.mosaic import LineCache
from pipeline.rectify.placed import PixelGrid, Placed, place
from pipeline.rectify.region import Reaches, Tile, plan_tiles
from pipeline.rectify.registration.alignment import SweepShift, no_shifts
from pipeline.rectify.scan_paths import LineNumbers, number_lines
from pipeline.rectify.tiles import MosaicWork
from storage.archive.manifests import read_table
from storage.arrays.cubes import RawCube, open_raw_cube
from storage.arrays.geolocation import Tables, open_geolocation
from storage.arrays.mosaics import MosaicWriter
from storage.parallel.pool import THREADS, WorkerPool, run_blocks


@dataclass(frozen=True)
class Sighted:
    """One captured sweep, which of its lines may be believed, and its corrections."""

    cube: RawCube
    numbers: LineNumbers
    shift: SweepShift
    gain: NDArray[np.float32] | None

    @property
    def usable(self) -> NDArray[np.bool_]:
        """(line,) valid lines with a time stamp and a position of their own."""
        known = np.isfinite(self.cube.position.sum(axis=1))
        usable: NDArray[np.bool_] = self.cube.valid_line & self.numbers.usable & known
        return usable

    @property
    def shift_px(self) -> NDArray[np.float64]:
        """(line, 2) pointing corrections along the line and the scan [px]."""
        return self.shift.of_lines(len(self.cube.time_s))

    def placed(self, camera: LineCamera, grid: PixelGrid | None = None) -> Placed:
        """Find where its lines lie."""
        return place(self.cube, camera, grid=grid, usable=self.usable, shift_px=self.shift_px, gain=self.gain)

    def facts(self) -> dict[str, int]:
        """Lines that were lost, sent twice, out of order or late."""
        found = self.numbers
        counts = {"lost": found.lost, "repeated": found.repeated, "backward": found.backward, "late": found.late}
        return counts | {"invalid": int(np.count_nonzero(~self.cube.valid_line))}


def sight_sweeps(cubes: Sequence[RawCube], registration: Path | None, camera: LineCamera) -> list[Sighted]:
    """Judge the lines of opened sweeps, with their corrections from a registration's record, if there is one."""
    shifts = {shift.name: shift for shift in no_shifts([cube.sweep.name for cube in cubes])}
    gains: dict[str, NDArray[np.float32]] = {}
    if registration is not None:
        for name, one in read_table(registration)["sweeps"].items():
            shifts[name] = SweepShift(name, np.array(one["offset_px"]), np.array(one["drift_px_per_line"]))
            if one["gain"] is not None:
                gains[name] = np.array(one["gain"], np.float32)
    frames_s = [_period_s(cube, exposing(camera, cube.sweep)) for cube in cubes]
    return [
        Sighted(cube, number_lines(cube.time_s, frame_s), shifts[cube.sweep.name], gains.get(cube.sweep.name))
        for cube, frame_s in zip(cubes, frames_s, strict=True)
    ]


def _period_s(cube: RawCube, camera: LineCamera) -> float:
    """The time from line to line; of lines that were picked out of a recording their own, not the camera's."""
    apart = np.diff(cube.time_s[np.isfinite(cube.time_s)]) if cube.source == "recorded" else np.zeros(0)
    rising = apart[apart > 0]
    return float(np.median(rising)) if len(rising) else camera.frame_ms * 1e-3


RESERVED_BYTES = 512 * 2**20  # a process before its first tile: interpreter, torch, zarr


@dataclass(frozen=True)
class MosaicRecipe:
    """What a mosaic is made of, by absolute paths: small, hashable, and good in every process that sees them."""

    raw: Path  # folder of raw cubes
    camera: LineCamera
    grid: PixelGrid
    kernel: Kernel = "catmull-rom"
    geolocation: Path | None = None  # tables of the sweeps; None looks lines up directly
    registration: Path | None = None  # record of the corrections
    finer: PixelGrid | None = None

    @property
    def folders(self) -> list[Path]:
        """What has to be seen by whoever makes tiles."""
        given = (self.raw, self.geolocation, None if self.registration is None else self.registration.parent)
        return [path for path in given if path is not None]

    def sweeps(self) -> list[Sighted]:
        """Open the sweeps, in the order of their names (IncompleteStoreError: one is missing or damaged)."""
        cubes = [open_raw_cube(path) for path in sorted(self.raw.glob("*.zarr"))]
        return sight_sweeps(cubes, self.registration, self.camera)

    def open(self) -> MosaicWork:
        """Open the sweeps and find where their lines lie, from stored tables where there are some.

        Raises IncompleteStoreError: a sweep or the tables are missing or damaged.
        """
        tables: Tables = {} if self.geolocation is None else open_geolocation(self.geolocation)
        placed = []
        for one in self.sweeps():  # without tables where its lines lie too unevenly for one
            stored = tables.get(one.cube.sweep.name)
            placed.append(Placed(one.cube, tuple(stored), one.gain) if stored else one.placed(self.camera))
        return MosaicWork(placed, self.camera, self.grid, self.kernel, self.finer)


@dataclass(frozen=True)
class ThumbnailCut:
    """Which pixels and bands of a tile a thumbnail shows. Goes to whoever makes tiles."""

    steps: tuple[int, ...]  # (y, x) [px]
    bands: tuple[int, ...]

    def __call__(self, rows: slice, columns: slice, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """What falls on the thumbnail's pixels, (y, x, band), of the (y, x, band) values of a tile."""
        part = values[-rows.start % self.steps[0] :: self.steps[0], -columns.start % self.steps[1] :: self.steps[1]]
        return part[..., list(self.bands)]


class Thumbnail:
    """Every n-th pixel of a mosaic in a few bands, filled as tiles are made: ``write_mosaic(..., seen=thumbnail)``."""

    def __init__(self, shape: tuple[int, int], bands: Sequence[int], most_px: int) -> None:
        self.cut = ThumbnailCut(tuple(-(-size // most_px) for size in shape), tuple(bands))
        size = [-(-side // step) for side, step in zip(shape, self.cut.steps, strict=True)]
        self.image: NDArray[np.float32] = np.full((*size, len(bands)), np.nan, np.float32)  # (y, x, band)

    def put(self, rows: slice, columns: slice, part: NDArray[np.float32]) -> None:
        """Take what ``cut`` gave for a tile."""
        y, x = (-(-one.start // step) for one, step in zip((rows, columns), self.cut.steps, strict=True))
        self.image[y : y + part.shape[0], x : x + part.shape[1]] = part

    def blank(self, where: NDArray[np.bool_]) -> None:
        """Leave (y, x) pixels of the mosaic out of the picture."""
        self.image[where[:: self.cut.steps[0], :: self.cut.steps[1]]] = np.nan


@dataclass(frozen=True)
class TileBudget:
    """How many tiles are made at a time, and the memory that this takes [bytes]."""

    workers: int
    cache: int  # raw lines kept; by each process where there are several
    tile: int  # one tile in the making
    processes: bool = False

    @property
    def projected(self) -> int:
        """Highest memory of the process, of all processes together where there are several [bytes]."""
        if self.processes:
            return RESERVED_BYTES + self.workers * (RESERVED_BYTES + self.cache + self.tile)
        return RESERVED_BYTES + self.cache + self.workers * self.tile


def write_mosaic(
    recipe: MosaicRecipe,
    writer: MosaicWriter,
    *,
    memory: int,
    pool: WorkerPool = THREADS,
    seen: Thumbnail | None = None,
    report: Callable[[float], None] = lambda done: None,
) -> TileBudget:
    """Rectify and blend sweeps into a stored mosaic, and tell how. Whoever makes the tiles, the same bytes come out.

    Fewer tiles are made at a time where ``memory`` [bytes] of this process and those that it starts, not of workers
    elsewhere, holds fewer. ``seen`` is filled with the pixels that it shows, ``report`` called with the fraction done
    after each tile, from the calling thread. Raises SettingsError: not even one tile fits the memory, or the worker pool
    cannot work here. WorkerError: processes that made tiles were lost.
    """
    work = _work_of(recipe)
    tiles = plan_tiles(work.placed, work.camera, work.grid, writer.tile_shape)
    budget = tile_budget(work, tiles, writer.tile_shape, memory=memory, pool=pool)
    maker = TileMaker(recipe, writer.path.absolute(), budget.cache, None if seen is None else seen.cut)
    if pool.shares_memory:
        _opened(maker)  # before several threads ask for it
    fewer = not pool.elsewhere and budget.workers < min(pool.count, len(tiles))
    run_blocks(
        maker,
        [(tile.rows, tile.columns) for tile in tiles],
        WorkerPool(pool.scheduler, budget.workers) if fewer else pool,
        keep=False,
        report=report,
        paths=[*recipe.folders, maker.out],
        each=lambda place, part: None if seen is None or part is None else seen.put(*place, part),
    )
    let_tiles_go()
    return budget


@dataclass(frozen=True)
class TileMaker:
    """Makes tiles in any process: opens recipe and mosaic once there, and keeps raw lines from tile to tile."""

    recipe: MosaicRecipe
    out: Path  # the mosaic, begun
    cache: int  # bytes of raw lines kept
    cut: ThumbnailCut | None = None

    def __call__(self, place: tuple[slice, slice]) -> NDArray[np.float32] | None:
        """Make and write the tile of some rows and columns; gives what a thumbnail shows of it."""
        (rows, columns), opened = place, _opened(self)
        reach = opened.reach(columns.start, columns.stop)
        values, coverage = opened.work.make_tile(rows, columns, reach, opened.lines)
        part = None if self.cut is None else self.cut(rows, columns, values).copy()
        opened.writer.write_tile(rows.start, columns.start, values, coverage)
        return part


@dataclass(frozen=True)
class _Opened:
    """What makes tiles in one process."""

    work: MosaicWork
    writer: MosaicWriter
    lines: LineCache
    reach: Callable[[int, int], Reaches]  # of some columns: tiles go down them


@lru_cache(maxsize=1)
def _work_of(recipe: MosaicRecipe) -> MosaicWork:
    return recipe.open()


@lru_cache(maxsize=1)
def _opened(maker: TileMaker) -> _Opened:
    """What a maker needs, opened once in this process; the one before it is let go."""
    work = _work_of(maker.recipe)
    reach = lru_cache(maxsize=2)(lambda start, stop: work.reach(slice(start, stop)))
    return _Opened(work, MosaicWriter.reopen(maker.out), LineCache(maker.cache), reach)


def let_tiles_go() -> None:
    """Give back the memory of the last mosaic's raw lines in this process, whose work goes on with something else."""
    _opened.cache_clear()
    _work_of.cache_clear()


def tile_budget(
    work: MosaicWork, tiles: Sequence[Tile], tile_shape: tuple[int, int], *, memory: int, pool: WorkerPool = THREADS
) -> TileBudget:
    """Choose how many tiles to make at a time: as many as are allowed and memory holds; elsewhere memory is no matter.

    Raises SettingsError: not even one tile at a time fits the memory.
    """
    processes = not pool.shares_memory
    most = max(1, min(1 if pool.elsewhere else pool.count, len(tiles)))
    for count in range(most, 0, -1):
        one, lines = work.tile_memory(tiles, tile_shape, 1 if processes else count)
        budget = TileBudget(count, lines, one, processes)
        if pool.elsewhere or budget.projected <= memory:
            return budget
    bands = len(work.placed[0].lines.references.white_reference) if work.placed else 1
    raise SettingsError(
        f"projected memory {_mib(budget.projected)} exceeds --memory {_mib(memory)}: one tile of {tile_shape[0]} x "
        f"{tile_shape[1]} px and {bands} bands takes {_mib(one)}, the raw lines behind it {_mib(lines)}, "
        f"{'each of two processes' if processes else 'the process itself'} {_mib(RESERVED_BYTES)}; give at least "
        f"--memory {_mib(budget.projected)}"
    )


def _mib(size: int) -> str:
    return f"{-(-size // 2**20)} MiB"
