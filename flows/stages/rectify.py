"""Resample sweeps to the pixels of the scene, and blend them into one mosaic, several tiles at a time.

A tile is a shard: `pipeline.rectify.region` computes it, `storage.arrays.mosaics` stores it.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spectralzoom.flows.frame import FieldFrame
from spectralzoom.flows.stage import Output, Report, Unkeyed, stage
from spectralzoom.flows.stages.condense import SIGNAL_RECORD
from spectralzoom.flows.stages.locate import TIE_POINTS
from spectralzoom.flows.stages.register import open_sweeps
from spectralzoom.models.network.spectral import LineSpec
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.scan import exposing
from spectralzoom.pipeline.kept import free_kept
from spectralzoom.pipeline.rectify.kernels import Kernel
from spectralzoom.pipeline.rectify.placed import PixelGrid, PlacedSweep
from spectralzoom.pipeline.rectify.region import (
    COPIES,
    Counts,
    MosaicWork,
    Place,
    Tile,
    TileMaker,
    Values,
    cache_bytes,
    opened_tiles,
    opened_work,
    plan_tiles,
)
from spectralzoom.pipeline.rectify.sweep_paths import SweepPath, capture_numbers, interlaced_paths
from spectralzoom.pipeline.signal.components import Components
from spectralzoom.storage.arrays.geolocation import Tables, open_geolocation
from spectralzoom.storage.arrays.mosaics import MosaicWriter
from spectralzoom.storage.arrays.signal_cubes import open_signal_cubes
from spectralzoom.storage.parallel.pool import RESERVED_BYTES, THREADS, WorkerPool, memory_refusal, mib, run_blocks
from spectralzoom.storage.store import Ref, write_table

MADE_BY = ("pipeline/rectify", "pipeline/geometry", "storage/arrays/mosaics.py")
MOSAIC_STEP = 0.5  # quantisation step, relative to the sweeps: resampled scores have less noise
KERNEL_GAIN = 2.0  # greatest overshoot of the kernels


@stage("mosaic", version=9, made_by=MADE_BY)
def rectify(
    out: Output,
    signal: Ref,
    places: Ref,
    seams: Ref | None = None,
    *,
    frame: FieldFrame,
    camera: LineCamera,
    kernel: Kernel,
    memory: Unkeyed[int],
    pool: Unkeyed[WorkerPool],
) -> None:
    """Resample the sweeps of the first pass to the scene grid, and blend them into one mosaic, tile by tile.

    Writes mosaic and the record of each sweep's lines.
    """
    recipe = MosaicRecipe(signal, camera, PixelGrid.of_scene(frame.grid), kernel, places=places, seams=seams)
    writer = mosaic_of_sweeps(out, signal, frame)
    write_mosaic(recipe, writer, memory=memory, pool=pool, report=out.report)
    writer.blank(frame.missing)
    write_table(out.path / "lines.json", {one.lines.sweep.name: one.facts() for one in recipe.sweeps()})


@stage("mosaic of all passes", version=8, made_by=MADE_BY)
def rectify_fine(
    out: Output,
    signal: Ref,
    seams: Ref | None = None,
    *,
    frame: FieldFrame,
    camera: LineCamera,
    light: LineSpec,
    kernel: Kernel,
    memory: Unkeyed[int],
    pool: Unkeyed[WorkerPool],
) -> None:
    """Resample the lines of both passes to the scene grid, merged by position; each pixel is from the closest lines.

    Writes mosaic, the capture of each pixel, and the record of each sweep's lines.
    """
    grid = PixelGrid.of_scene(frame.grid)
    recipe = MosaicRecipe(signal, camera, grid, kernel, seams=seams, interlaced=True)
    writer = mosaic_of_sweeps(out, signal, frame)
    write_mosaic(recipe, writer, memory=memory, pool=pool, report=out.report)
    placed = recipe.open().placed
    exposed = [(exposing(camera, one.lines.sweep).exposure_ms, one.lines.sweep.step) for one in placed]
    captures = [LineSpec(light.light * exposure_ms / camera.exposure_ms, step) for exposure_ms, step in exposed]
    writer.write_captures(captures, np.maximum(capture_numbers(placed, camera, grid), 0))
    writer.blank(frame.missing)
    write_table(out.path / "lines.json", {one.lines.sweep.name: one.facts() for one in recipe.sweeps()})


def mosaic_of_sweeps(out: Output, signal: Ref, frame: FieldFrame) -> MosaicWriter:
    """Create the mosaic of compressed sweeps, in the pixels of the scene, and copy the record of their signal."""
    sweeps = open_signal_cubes(signal.path)
    shutil.copyfile(signal.path / SIGNAL_RECORD, out.path / SIGNAL_RECORD)
    return MosaicWriter(
        out.path / "mosaic.zarr",
        (frame.grid.height, frame.grid.width),
        sweeps[0].components if sweeps else Components.empty(len(frame.wavelength_nm)),
        frame.wavelength_nm,
        step=MOSAIC_STEP * sweeps[0].step if sweeps else 1.0,
        largest=max((sweep.largest for sweep in sweeps), default=0.0) * KERNEL_GAIN,
        fwhm_nm=frame.fwhm_nm,
        grid=frame.angular_grid(),
        simulation=sweeps[0].simulation if sweeps else None,
    )


@dataclass(frozen=True)
class MosaicRecipe:
    """Recipe of a mosaic: stores and parameters, valid in every process that can read the stores."""

    signal: Ref  # compressed sweeps
    camera: LineCamera
    grid: PixelGrid
    kernel: Kernel = "catmull-rom"
    places: Ref | None = None  # tie points of the sweeps; None computes them
    interlaced: bool = False  # sweeps of two passes with lines between each other
    seams: Ref | None = None  # registration of the sweeps

    def sweeps(self) -> list[SweepPath]:
        """Open the sweeps, in the order of their names. Raises IncompleteStoreError: one is missing or damaged."""
        return open_sweeps(self.signal, self.seams, self.camera)

    def open(self) -> MosaicWork:
        """Open the sweeps and locate their lines, with stored tie points if there are any.

        Raises IncompleteStoreError: a sweep or the tie points are missing or damaged.
        """
        if self.interlaced:
            return MosaicWork(
                interlaced_paths(self.sweeps(), self.camera, self.grid), self.camera, self.grid, self.kernel
            )
        tables: Tables = {} if self.places is None else open_geolocation(self.places.path / TIE_POINTS)
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
    report: Report = lambda done: None,
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

    def take(place: Place, made: tuple[Values, Counts]) -> None:
        writer.write_tile(place[0].start, place[1].start, *made)

    run_blocks(maker, [(tile.rows, tile.columns) for tile in tiles], pool, take=take, report=report)
    free_kept()
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
