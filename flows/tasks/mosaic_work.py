"""Compute mosaics from stored sweeps, several tiles at a time, within a limit of memory.

A tile is a shard of the mosaic: `pipeline.rectify.region` computes it, `storage.arrays.mosaics` stores it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from pipeline.geometry.camera import LineCamera
from pipeline.rectify.kernels import Kernel
from pipeline.rectify.placed import PixelGrid, PlacedSweep
from pipeline.rectify.region import (
    COPIES,
    Counts,
    MosaicWork,
    Place,
    Tile,
    TileMaker,
    Values,
    cache_bytes,
    free_tiles,
    opened_tiles,
    opened_work,
    plan_tiles,
)
from pipeline.rectify.sweep_paths import SweepPath, interlaced_paths, sweep_paths
from storage.archive.keys import StageRef
from storage.archive.manifests import read_table
from storage.arrays.geolocation import Tables, open_geolocation
from storage.arrays.mosaics import MosaicWriter
from storage.arrays.signal_cubes import open_signal_cubes
from storage.parallel.pool import RESERVED_BYTES, THREADS, WorkerPool, memory_refusal, mib, run_blocks

REGISTRATION, TIE_POINTS = "registration.json", "geolocation.zarr"


def open_sweeps(signal: StageRef, registration: StageRef | None, camera: LineCamera) -> list[SweepPath]:
    """Open the compressed sweeps, by name, with the corrections of a registration."""
    found = None if registration is None else read_table(registration.path / REGISTRATION)["sweeps"]
    return sweep_paths(open_signal_cubes(signal.path), camera, found)


@dataclass(frozen=True)
class MosaicRecipe:
    """Recipe of a mosaic: stores and parameters, valid in every process that can read the stores."""

    signal: StageRef  # compressed sweeps
    camera: LineCamera
    grid: PixelGrid
    kernel: Kernel = "catmull-rom"
    geolocation: StageRef | None = None  # tie points of the sweeps; None computes them
    interlaced: bool = False  # sweeps of two passes with lines between each other
    registration: StageRef | None = None

    @property
    def inputs(self) -> list[StageRef]:
        """Return the stores that workers read."""
        return [one for one in (self.signal, self.geolocation, self.registration) if one is not None]

    def sweeps(self) -> list[SweepPath]:
        """Open the sweeps, in the order of their names. Raises IncompleteStoreError: one is missing or damaged."""
        return open_sweeps(self.signal, self.registration, self.camera)

    def open(self) -> MosaicWork:
        """Open the sweeps and locate their lines, with stored tie points if there are any.

        Raises IncompleteStoreError: a sweep or the tie points are missing or damaged.
        """
        if self.interlaced:
            return MosaicWork(
                interlaced_paths(self.sweeps(), self.camera, self.grid), self.camera, self.grid, self.kernel
            )
        tables: Tables = {}
        if self.geolocation is not None:
            tables = open_geolocation(self.geolocation.path / TIE_POINTS)
        placed = []
        for one in self.sweeps():  # no stored tie points if lines are too uneven
            stored = tables.get(one.lines.sweep.name)
            placed.append(PlacedSweep(one.lines, tuple(stored), one.gain) if stored else one.placed(self.camera))
        return MosaicWork(placed, self.camera, self.grid, self.kernel)


@dataclass(frozen=True)
class TileBudget:
    """Number of tiles at a time, and their memory [bytes]."""

    workers: int
    cache: int  # cached lines, per process
    tile: int  # one tile
    processes: bool = False

    @property
    def projected(self) -> int:
        """Return the peak memory of all processes together [bytes]."""
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
    """Rectify and blend sweeps into a stored mosaic; return the budget of tiles. All worker pools give the same bytes.

    ``memory`` [bytes] limits this process and its workers, not workers on other machines. Raises SettingsError: one
    tile does not fit the memory, or the worker pool cannot run; WorkerError: a worker process died.
    """
    work = opened_work(recipe.open)
    tiles = plan_tiles(work.placed, work.camera, work.grid, writer.tile_shape)
    budget = tile_budget(work, tiles, writer.tile_shape, memory=memory, pool=pool)
    maker = TileMaker(recipe.open, budget.cache)
    if pool.shares_memory:
        opened_tiles(maker)  # before threads use it
    if not pool.elsewhere and budget.workers < min(pool.count, len(tiles)):
        pool = WorkerPool(pool.scheduler, budget.workers)
    places = [(tile.rows, tile.columns) for tile in tiles]

    def take(place: Place, made: tuple[Values, Counts]) -> None:
        writer.write_tile(place[0].start, place[1].start, *made)

    run_blocks(maker, places, pool, take=take, report=report, inputs=recipe.inputs)
    free_tiles()
    return budget


def tile_budget(
    work: MosaicWork, tiles: Sequence[Tile], tile_shape: tuple[int, int], *, memory: int, pool: WorkerPool = THREADS
) -> TileBudget:
    """Choose the number of tiles at a time: the greatest that workers and memory allow.

    Raises SettingsError: one tile does not fit the memory.
    """
    processes = not pool.shares_memory
    bands = work.placed[0].signal.bands if work.placed else 1
    one = COPIES * tile_shape[0] * tile_shape[1] * bands * 4
    for count in range(max(1, min(1 if pool.elsewhere else pool.count, len(tiles))), 0, -1):
        lines = cache_bytes(work.placed, tiles, 1 if processes else count)
        budget = TileBudget(count, lines, one, processes)
        if pool.elsewhere or budget.projected <= memory:
            return budget
    raise memory_refusal(
        budget.projected,
        memory,
        f"one tile of {tile_shape[0]} x {tile_shape[1]} px and {bands} bands takes {mib(one)}, the lines behind it "
        f"{mib(lines)}, {'each of two processes' if processes else 'the process itself'} {mib(RESERVED_BYTES)}",
    )
