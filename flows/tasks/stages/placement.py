"""Define the stages registration, geolocation grid and mosaic.

A mosaic is computed several tiles at a time, within a limit of memory. A tile is a shard:
`pipeline.rectify.region` computes it, `storage.arrays.mosaics` stores it.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spectralzoom.flows.tasks.stage import FieldFrame, Product, Report, Wanted, stage
from spectralzoom.models.network.spectral import LineSpec
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.scan import exposing
from spectralzoom.pipeline.rectify.kernels import Kernel
from spectralzoom.pipeline.rectify.placed import PixelGrid, PlacedSweep, TieTable
from spectralzoom.pipeline.rectify.region import (
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
from spectralzoom.pipeline.rectify.registration.alignment import SweepShift
from spectralzoom.pipeline.rectify.registration.illumination import overlap_light, solve_lights
from spectralzoom.pipeline.rectify.registration.overlaps import BroadSweep
from spectralzoom.pipeline.rectify.registration.seams import Anchor, Registration, anchor_sweep, register_sweeps
from spectralzoom.pipeline.rectify.scan_paths import ScanPath
from spectralzoom.pipeline.rectify.sweep_paths import SweepPath, capture_numbers, interlaced_paths, sweep_paths
from spectralzoom.pipeline.signal.components import BROAD_BANDS, Components
from spectralzoom.storage.arrays.geolocation import Tables, open_geolocation, path_digest, write_geolocation
from spectralzoom.storage.arrays.mosaics import MosaicWriter, open_mosaic
from spectralzoom.storage.arrays.signal_cubes import open_signal_cubes
from spectralzoom.storage.parallel.pool import RESERVED_BYTES, THREADS, WorkerPool, memory_refusal, mib, run_blocks
from spectralzoom.storage.store import Ref, read_table, write_table

REGISTRATION, TIE_POINTS = "registration.json", "geolocation.zarr"
SIGNAL_RECORD = "signal.json"  # of compressed sweeps; a copy lies beside their mosaic
POINTING = Product("register", version=2, files=(REGISTRATION,))
GEOLOCATION = Product("locate", version=4, files=(TIE_POINTS,))
MOSAIC = Product("rectify", version=7, files=("mosaic.zarr",))
MERGED = Product("rectify_fine", version=6, files=("mosaic.zarr",))
MOSAIC_STEP = 0.5  # quantisation step, relative to the sweeps: resampled scores have less noise
KERNEL_GAIN = 2.0  # greatest overshoot of the kernels


def open_sweeps(signal: Ref, registration: Ref | None, camera: LineCamera) -> list[SweepPath]:
    """Open the compressed sweeps, by name, with the corrections of a registration."""
    found = None if registration is None else read_table(registration.path / REGISTRATION)["sweeps"]
    return sweep_paths(open_signal_cubes(signal.path), camera, found)


@dataclass(frozen=True)
class MosaicRecipe:
    """Recipe of a mosaic: stores and parameters, valid in every process that can read the stores."""

    signal: Ref  # compressed sweeps
    camera: LineCamera
    grid: PixelGrid
    kernel: Kernel = "catmull-rom"
    geolocation: Ref | None = None  # tie points of the sweeps; None computes them
    interlaced: bool = False  # sweeps of two passes with lines between each other
    registration: Ref | None = None

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
        tables: Tables = {} if self.geolocation is None else open_geolocation(self.geolocation.path / TIE_POINTS)
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

    def take(place: Place, made: tuple[Values, Counts]) -> None:
        writer.write_tile(place[0].start, place[1].start, *made)

    run_blocks(maker, [(tile.rows, tile.columns) for tile in tiles], pool, take=take, report=report)
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


@stage("register_coarse", "registration of the sweeps", POINTING, inputs=1, named="coarse_pointing")
def register_coarse(
    signal: Ref, *, camera: LineCamera, pointing_px: float, frame: FieldFrame, report: Report
) -> Wanted:
    """Estimate pointing and radiometric gain of the coarse sweeps from the overlaps of neighbours."""

    def build(path: Path) -> None:
        """Register the sweeps by their overlaps, and write shifts and gains."""
        sweeps = open_sweeps(signal, None, camera)
        broad = [BroadSweep.read(one.lines, camera, usable=one.usable) for one in sweeps]
        report(0.4)
        found = register_sweeps(broad, camera, prior_px=pointing_px)
        report(0.8)
        placed = [replace(one, shift=found.of(one.lines.sweep.name)).placed(camera) for one in sweeps]
        gains = light_gains(found, placed, camera, frame.wavelength_nm)
        names = [shift.name for shift in found.shifts]
        record = {
            "method": "seams",
            "reference": found.reference,
            "sweeps": {shift.name: _shift_record(shift) | {"gain": gains.get(shift.name)} for shift in found.shifts},
            "untied": list(found.untied),
            "narrow": [asdict(narrow) for narrow in found.narrow],
            "windows": [
                {
                    "reference": names[seen.window.reference],
                    "moving": names[seen.window.moving],
                    "along_px": seen.window.along_px,
                    "scan_px": seen.window.scan_px,
                    "status": "too narrow" if seen.found is None else seen.found.status,
                    "residual_px": seen.residual_px.tolist() if np.isfinite(seen.residual_px).all() else None,
                }
                for seen in found.windows
            ],
        }
        write_table(path / REGISTRATION, record)

    return Wanted(build, {"prior_px": pointing_px, "pass": "coarse"}, [signal])


def light_gains(
    found: Registration, placed: Sequence[PlacedSweep], camera: LineCamera, wavelength_nm: NDArray[np.float64]
) -> dict[str, list[float]]:
    """Return the gain of each sweep by band that makes neighbours agree."""
    windows = [seen.window for seen in found.windows if seen.measured is not None]
    if not windows:
        return {}
    lights = solve_lights(overlap_light(placed, camera, windows), len(placed), wavelength_nm)
    tied = [number for number in range(len(placed)) if number not in lights.untied]
    return {placed[number].lines.sweep.name: lights.gain(number).tolist() for number in tied}


def _shift_record(shift: SweepShift) -> dict[str, Any]:
    return {"offset_px": shift.offset.tolist(), "drift_px_per_line": shift.drift.tolist()}


@stage("register_fine", "registration to the mosaic", POINTING, inputs=2, named="fine_pointing")
def register_fine(
    signal: Ref, mosaic: Ref, *, camera: LineCamera, pointing_px: float, frame: FieldFrame, report: Report
) -> Wanted:
    """Register each fine sweep on the coarse mosaic, which has pointing errors itself."""

    def build(path: Path) -> None:
        """Register each sweep on the mean of the mosaic's bands, and write its shift."""
        sweeps = open_sweeps(signal, None, camera)
        anchors: list[Anchor] = []
        seen = open_mosaic(mosaic.path / "mosaic.zarr")
        under = seen.brightness(bands=BROAD_BANDS) if sweeps else np.empty((0, 0), np.float32)
        for number, one in enumerate(sweeps):
            broad = BroadSweep.read(one.lines, camera, usable=one.usable)
            anchors.append(anchor_sweep(broad, camera, frame.grid, under, prior_px=2 * pointing_px))
            report((number + 1) / len(sweeps))
        record = {
            "method": "mosaic",
            "reference": "the coarse mosaic",
            "sweeps": {one.shift.name: _shift_record(one.shift) | {"gain": None} for one in anchors},
            "untied": [one.shift.name for one in anchors if one.found.status != "found"],
            "narrow": [],
            "windows": [{"moving": one.shift.name, "status": one.found.status} for one in anchors],
        }
        write_table(path / REGISTRATION, record)

    return Wanted(build, {"prior_px": pointing_px, "pass": "fine", "grid": asdict(frame.grid)}, [signal, mosaic])


def load_registration(registration: Ref) -> dict[str, Any]:
    """Read a registration: offset, drift and gain by sweep; reference, sweeps without overlap, and windows."""
    return read_table(registration.path / REGISTRATION)


@stage("locate", "geolocation grid", GEOLOCATION)
def locate(
    signal: Ref, registration: Ref | None = None, *, camera: LineCamera, frame: FieldFrame, report: Report
) -> Wanted:
    """Compute the geolocation grid, which all surveys along the same path share."""
    grid = PixelGrid.of_scene(frame.grid)
    sweeps = open_sweeps(signal, registration, camera)
    params = {
        "camera": {name: getattr(camera, name) for name in ("samples", "pitch_um", "focal_length_mm")},
        "grid": asdict(grid),
        "paths": {
            one.lines.sweep.name: {
                "path": path_digest(one.lines.position, one.usable, one.shift_px),
                **{name: getattr(one.lines.sweep, name) for name in ("along", "step", "binning")},
            }
            for one in sweeps
        },
    }

    def build(path: Path) -> None:
        """Write the tie points of each sweep; none where they are not accurate enough."""
        tables: dict[str, list[tuple[ScanPath, TieTable]]] = {}
        for number, one in enumerate(sweeps):
            made = one.placed(camera, grid).scan_paths
            whole = [(scan_path, table) for scan_path, table in made if table is not None]
            # a sweep whose lines are too uneven for tie points is located directly
            tables[one.lines.sweep.name] = whole if len(whole) == len(made) else []
            report((number + 1) / len(sweeps))
        write_geolocation(path / TIE_POINTS, tables, params)

    return Wanted(build, params)  # the key depends on the paths, not on the values


@stage("rectify", "mosaic", MOSAIC)
def rectify(
    signal: Ref,
    geolocation: Ref,
    registration: Ref | None = None,
    *,
    camera: LineCamera,
    frame: FieldFrame,
    resampling: Kernel,
    memory: int,
    pool: WorkerPool,
    report: Report,
) -> Wanted:
    """Resample the sweeps of the first pass to the scene grid, and blend them into one mosaic, tile by tile."""

    def build(path: Path) -> None:
        """Write mosaic and the record of each sweep's lines."""
        grid = PixelGrid.of_scene(frame.grid)
        recipe = MosaicRecipe(signal, camera, grid, resampling, geolocation=geolocation, registration=registration)
        writer = mosaic_of_sweeps(path, signal, frame)
        write_mosaic(recipe, writer, memory=memory, pool=pool, report=report)
        writer.blank(frame.missing)
        write_table(path / "lines.json", {one.lines.sweep.name: one.facts() for one in recipe.sweeps()})

    params = {"grid": asdict(frame.grid), "resampling": resampling, **frame.key}
    return Wanted(build, params, [signal, geolocation, *([] if registration is None else [registration])])


@stage("rectify_fine", "mosaic of all passes", MERGED)
def rectify_fine(
    signal: Ref,
    registration: Ref | None = None,
    *,
    camera: LineCamera,
    frame: FieldFrame,
    light: LineSpec,
    resampling: Kernel,
    memory: int,
    pool: WorkerPool,
    report: Report,
) -> Wanted:
    """Resample the lines of both passes to the scene grid, merged by position; each pixel is from the closest lines."""

    def build(path: Path) -> None:
        """Write mosaic, the capture of each pixel, and the record of each sweep's lines."""
        grid = PixelGrid.of_scene(frame.grid)
        recipe = MosaicRecipe(signal, camera, grid, resampling, registration=registration, interlaced=True)
        writer = mosaic_of_sweeps(path, signal, frame)
        write_mosaic(recipe, writer, memory=memory, pool=pool, report=report)
        placed = recipe.open().placed
        exposed = [(exposing(camera, one.lines.sweep).exposure_ms, one.lines.sweep.step) for one in placed]
        captures = [LineSpec(light.light * exposure_ms / camera.exposure_ms, step) for exposure_ms, step in exposed]
        writer.write_captures(captures, np.maximum(capture_numbers(placed, camera, grid), 0))
        writer.blank(frame.missing)
        write_table(path / "lines.json", {one.lines.sweep.name: one.facts() for one in recipe.sweeps()})

    params = {"grid": asdict(frame.grid), "resampling": resampling, "light": light.light, **frame.key}
    return Wanted(build, params, [signal, *([] if registration is None else [registration])])


def mosaic_of_sweeps(path: Path, signal: Ref, frame: FieldFrame) -> MosaicWriter:
    """Create the mosaic of compressed sweeps, in the pixels of the scene, and copy the record of their signal."""
    sweeps = open_signal_cubes(signal.path)
    shutil.copyfile(signal.path / SIGNAL_RECORD, path / SIGNAL_RECORD)
    return MosaicWriter(
        path / "mosaic.zarr",
        (frame.grid.height, frame.grid.width),
        sweeps[0].components if sweeps else Components.empty(len(frame.wavelength_nm)),
        frame.wavelength_nm,
        step=MOSAIC_STEP * sweeps[0].step if sweeps else 1.0,
        largest=max((sweep.largest for sweep in sweeps), default=0.0) * KERNEL_GAIN,
        fwhm_nm=frame.fwhm_nm,
        grid=frame.angular_grid(),
        simulation=sweeps[0].simulation if sweeps else None,
    )
