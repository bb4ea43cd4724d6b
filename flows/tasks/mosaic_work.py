"""Mosaics from sweeps on disk to tiles on disk: several at a time, within a bound of memory.

A tile is a shard of the mosaic. `pipeline.rectify.region` makes it as arrays, `storage.arrays.mosaics` stores it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.geometry.camera import LineCamera
from pipeline.rectify.kernels import Kernel
from pipeline.rectify.placed import PixelGrid, PlacedSweep
from pipeline.rectify.region import MosaicWork, Tile, TileMaker, free_tiles, opened_tiles, opened_work, plan_tiles
from pipeline.rectify.sweep_paths import SweepPath, interlaced_paths, sweep_paths
from storage.archive.manifests import read_table
from storage.arrays.geolocation import Tables, open_geolocation
from storage.arrays.mosaics import MosaicWriter, write_tiles
from storage.arrays.signal_cubes import open_signal_cubes
from storage.parallel.pool import RESERVED_BYTES, THREADS, WorkerPool, memory_refusal, mib


def open_sweeps(signal: Path, registration: Path | None, camera: LineCamera) -> list[SweepPath]:
    """Open the condensed sweeps of a folder, by name, with the corrections that registration recorded."""
    found = None if registration is None else read_table(registration)["sweeps"]
    return sweep_paths(open_signal_cubes(signal), camera, found)


@dataclass(frozen=True)
class MosaicRecipe:
    """Recipe of a mosaic, by absolute paths: small, hashable, and good in every process that sees them."""

    signal: Path  # folder of condensed sweeps
    camera: LineCamera
    grid: PixelGrid
    kernel: Kernel = "catmull-rom"
    geolocation: Path | None = None  # tables of the sweeps; None makes them anew
    interlaced: bool = False  # sweeps of several passes, of which some lie between the lines of others
    registration: Path | None = None  # record of the corrections

    @property
    def folders(self) -> list[Path]:
        """Return the paths that workers must see."""
        given = (self.signal, self.geolocation, None if self.registration is None else self.registration.parent)
        return [path for path in given if path is not None]

    def sweeps(self) -> list[SweepPath]:
        """Open the sweeps, in the order of their names (IncompleteStoreError: one is missing or damaged)."""
        return open_sweeps(self.signal, self.registration, self.camera)

    def open(self) -> MosaicWork:
        """Open the sweeps and find where their lines lie, from stored tables where there are some.

        Raises IncompleteStoreError: a sweep or the tables are missing or damaged.
        """
        if self.interlaced:
            return MosaicWork(
                interlaced_paths(self.sweeps(), self.camera, self.grid), self.camera, self.grid, self.kernel
            )
        tables: Tables = {} if self.geolocation is None else open_geolocation(self.geolocation)
        placed = []
        for one in self.sweeps():  # without tables where its lines lie too unevenly for one
            stored = tables.get(one.lines.sweep.name)
            placed.append(PlacedSweep(one.lines, tuple(stored), one.gain) if stored else one.placed(self.camera))
        return MosaicWork(placed, self.camera, self.grid, self.kernel)


@dataclass(frozen=True)
class TileBudget:
    """Number of tiles made at a time, and the memory that this takes [bytes]."""

    workers: int
    cache: int  # lines kept; by each process where there are several
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
    report: Callable[[float], None] = lambda done: None,
) -> TileBudget:
    """Rectify and blend sweeps into a stored mosaic; return how. Any worker's tiles give the same bytes.

    Fewer tiles are made at a time where ``memory``
    [bytes] of this process and those that it starts, not of workers elsewhere, holds fewer. Raises SettingsError: not
    even one tile fits the memory, or the worker pool cannot work here. WorkerError: processes that made tiles were
    lost.
    """
    work = opened_work(recipe.open)
    tiles = plan_tiles(work.placed, work.camera, work.grid, writer.tile_shape)
    budget = tile_budget(work, tiles, writer.tile_shape, memory=memory, pool=pool)
    maker = TileMaker(recipe.open, budget.cache)
    if pool.shares_memory:
        opened_tiles(maker)  # before several threads ask for it
    if not pool.elsewhere and budget.workers < min(pool.count, len(tiles)):
        pool = WorkerPool(pool.scheduler, budget.workers)
    places = [(tile.rows, tile.columns) for tile in tiles]
    write_tiles(writer, maker, places, pool, paths=recipe.folders, report=report)
    free_tiles()
    return budget


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
    bands = work.placed[0].signal.bands if work.placed else 1
    raise memory_refusal(
        budget.projected,
        memory,
        f"one tile of {tile_shape[0]} x {tile_shape[1]} px and {bands} bands takes {mib(one)}, the lines behind it "
        f"{mib(lines)}, {'each of two processes' if processes else 'the process itself'} {mib(RESERVED_BYTES)}",
    )
