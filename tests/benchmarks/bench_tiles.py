"""Rectification and mosaic from disk to disk: against the codec alone, with the field's size, and its memory."""

from __future__ import annotations

import shutil
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from measure import Row, alone, peak_bytes, ratio, time_in_turn
from numpy.typing import NDArray

from flows.tasks.mosaic_work import MosaicRecipe, write_mosaic
from models.network.machine import keep_freed_memory, use_one_thread
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import Sweep, line_positions
from pipeline.planning.coverage import full_sweeps
from pipeline.rectify.placed import PixelGrid
from pipeline.signal.lines import BLOCK_LINES
from pipeline.source import Line, References
from storage.arrays.cubes import RawCubeWriter, SweepHeader, open_raw_cube
from storage.arrays.layout import ArraySpec, create_array, create_group, image_spec
from storage.arrays.mosaics import MosaicWriter, load_mosaic
from storage.parallel.pool import WorkerPool

CAMERA = LineCamera()
PATTERN_LINES = 512
BANDS, SHAPE = 270, (128, 1200)
FEW_BANDS, SIDES = 16, (1280, 2560)
MEMORY = 4 * 2**30
MOST_MEMORY_GIB = 4.0
MOST_GROWTH = 1.2
ROUNDS = 3


@dataclass(frozen=True)
class Spent:
    """What one run took."""

    cpu_s: float
    peak_bytes: int
    values: int

    @property
    def cpu_ns(self) -> float:
        """Processor time a pixel and band [ns]."""
        return self.cpu_s / self.values * 1e9


def rows() -> list[Row]:
    """The stage against the codec, and a larger field against a smaller one."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        return [alone(_against_codec, folder), *_with_size(folder)]


def _against_codec(folder: Path) -> Row:
    """Two sweeps of all bands into one mosaic, beside reading these sweeps and writing this mosaic, nothing between."""
    keep_freed_memory()
    use_one_thread()
    scene = SceneGrid(*SHAPE, 32, 4)
    grid, out = PixelGrid.of_scene(scene, 1), folder / "mosaic.zarr"
    paths = write_raw(folder, full_sweeps(scene, CAMERA, "x"), BANDS)
    rectify(paths, out, grid)
    stored = load_mosaic(out)

    def stage() -> None:
        shutil.rmtree(out, ignore_errors=True)
        rectify(paths, out, grid)

    def read() -> None:
        for path in paths:
            cube = open_raw_cube(path)
            for first in range(0, cube.sweep.lines, BLOCK_LINES):
                cube.read(first, min(first + BLOCK_LINES, cube.sweep.lines))

    def write() -> None:
        shutil.rmtree(folder / "copy.zarr", ignore_errors=True)
        group = create_group(folder / "copy.zarr", "copy", {})
        for name, array, dims in (
            ("values", stored.values, ("y", "x", "band")),
            ("coverage", stored.coverage, ("y", "x")),
        ):
            spec: ArraySpec = image_spec(dims, array.shape, "<f4")
            copy = create_array(group, name, spec, {})
            rows, columns = (spec.shard or spec.chunk)[:2]
            for x in range(0, array.shape[1], columns):
                for y in range(0, array.shape[0], rows):
                    copy[y : y + rows, x : x + columns] = array[y : y + rows, x : x + columns]

    def codec() -> None:
        read()
        write()

    clocks = time_in_turn({"stage": stage, "codec": codec, "read": read}, rounds=ROUNDS)
    fraction, per = ratio(clocks, "stage", "codec"), 1e9 / stored.values.size
    cost = {name: clock.cpu_min_s * per for name, clock in clocks.items()}
    return Row(
        f"rectify and mosaic disk to disk, {SHAPE[0]} x {SHAPE[1]} px, {BANDS} bands, {len(paths)} sweeps",
        f"{fraction:.2f} x codec, {cost['stage']:.1f} ns a px and band",
        "<= 2 x codec",
        fraction <= 2,
        f"read the sweeps {cost['read']:.1f} ns, with writing the mosaic {cost['codec']:.1f} ns",
    )


def _with_size(folder: Path) -> list[Row]:
    small, large = (_field(folder, side, FEW_BANDS) for side in SIDES)
    growth = large.cpu_ns / small.cpu_ns
    peak = large.peak_bytes / 2**30
    return [
        Row(
            f"processor time a px and band, {SIDES[1]} px field against {SIDES[0]} px, {FEW_BANDS} bands",
            f"{growth:.2f}, {large.cpu_ns:.0f} ns",
            f"<= {MOST_GROWTH:.2f}",
            growth <= MOST_GROWTH,
            f"{SIDES[0]} px: {small.cpu_ns:.0f} ns",
        ),
        Row(
            f"peak memory of the {SIDES[1]} px field",
            f"{peak:.2f} GiB",
            f"<= {MOST_MEMORY_GIB:g} GiB",
            peak <= MOST_MEMORY_GIB,
            f"the mosaic itself: {large.values * 4 / 2**30:.2f} GiB",
        ),
    ]


def _field(folder: Path, side: int, bands: int) -> Spent:
    """Write one field's sweeps, measure the stage in a fresh process, remove both."""
    scene = SceneGrid(side, side, 32, 4)
    place_of = folder / f"field-{side}"
    try:
        paths = write_raw(place_of, full_sweeps(scene, CAMERA, "x"), bands)
        return alone(measured, paths, place_of / "mosaic.zarr", PixelGrid.of_scene(scene, 1))
    finally:
        shutil.rmtree(place_of, ignore_errors=True)


def pattern(bands: int, seed: int = 0) -> NDArray[np.uint16]:
    """Lines of a smooth scene with shot and read noise, (line, sample, band) DN: they compress as a rig's do."""
    rng = np.random.default_rng(seed)
    line, sample = np.arange(PATTERN_LINES)[:, None, None], np.arange(CAMERA.samples)[None, :, None]
    spectrum = 1 + 0.5 * np.cos(np.arange(bands) / 40)
    light = (900 + 600 * np.sin(sample / 30) + 200 * np.sin(line / 20)) * spectrum
    electrons = (light * CAMERA.electrons_per_dn).astype(np.float32)
    noise = rng.standard_normal(electrons.shape, dtype=np.float32) * np.sqrt(electrons + CAMERA.read_noise_e**2)
    dn = (electrons + noise) / CAMERA.electrons_per_dn + CAMERA.dark_dn
    return np.clip(np.rint(dn), 0, CAMERA.full_scale_dn - 1).astype(np.uint16)


def write_raw(folder: Path, sweeps: list[Sweep], bands: int) -> list[Path]:
    """Store sweeps of the pattern over and over, each from another line on."""
    lines = pattern(bands)
    frame = (CAMERA.samples, bands)
    rng = np.random.default_rng(1)
    dark = (CAMERA.dark_dn + rng.normal(0, 0.5, frame)).astype(np.float32)
    white = (3500 * rng.normal(1, 0.02, frame)).astype(np.float32)
    references = References(dark, white, np.full(bands, 0.95, np.float32))
    paths = []
    for number, sweep in enumerate(sweeps):
        position = line_positions(sweep, CAMERA)
        paths.append(folder / f"{sweep.name}.zarr")
        header = SweepHeader(sweep, references, np.linspace(400, 1000, bands))
        with RawCubeWriter(paths[-1], header) as cube:
            for n in range(sweep.lines):
                data = lines[(n + 97 * number) % PATTERN_LINES]
                cube.write([Line(n, data, *position[n], n * 0.1, CAMERA.exposure_ms)])
    return paths


def rectify(paths: list[Path], out: Path, grid: PixelGrid) -> None:
    """The stage: cubes opened, placed, made into one mosaic on disk."""
    wavelength_nm = open_raw_cube(paths[0]).wavelength_nm
    writer = MosaicWriter(out, grid.shape, wavelength_nm)
    write_mosaic(MosaicRecipe(paths[0].parent, CAMERA, grid), writer, memory=MEMORY, pool=WorkerPool(workers=1))


def measured(paths: list[Path], out: Path, grid: PixelGrid) -> Spent:
    """Run the stage and tell what this process has spent on it, start-up left out of the time."""
    keep_freed_memory()
    use_one_thread()
    cpu = time.process_time()
    rectify(paths, out, grid)
    bands = len(open_raw_cube(paths[0]).wavelength_nm)
    return Spent(time.process_time() - cpu, peak_bytes(), grid.shape[0] * grid.shape[1] * bands)
