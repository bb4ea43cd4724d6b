"""The paper's scene from disk to disk, bands cut to fit: python tests/benchmarks/paper_scale.py [options] FOLDER

Writes raw sweeps of a whole field (all strips that cover it, some 30 degrees from the axis at the corners) into FOLDER,
rectifies and blends them in a process of its own, and prints the highest memory and the processor time a pixel and
band, the same for a smaller field in the same run. What it wrote is removed. 10240 px with 32 bands take some 14 GB of
disk.
"""

from __future__ import annotations

import argparse
import multiprocessing
import shutil
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from models.network.process import keep_freed_memory, use_one_thread
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import Sweep, line_positions
from pipeline.planning.coverage import full_sweeps
from pipeline.rectify.placed import PixelGrid, place
from pipeline.source import Line, References
from storage.arrays.cubes import RawCubeWriter, SweepHeader, open_raw_cube
from storage.arrays.mosaics import MosaicWriter
from storage.arrays.tile_work import MosaicWork, write_mosaic
from storage.parallel.crew import Crew

CAMERA = LineCamera()
PATTERN_LINES = 512
SMALL_PX = 2560
MEMORY = 4 * 2**30
MOST_MEMORY_GIB = 4.0
MOST_GROWTH = 1.2


@dataclass(frozen=True)
class Spent:
    """What one run took."""

    cpu_s: float
    wall_s: float
    peak_bytes: int
    values: int

    @property
    def cpu_ns(self) -> float:
        """Processor time a pixel and band [ns]."""
        return self.cpu_s / self.values * 1e9


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


def rectify(paths: list[Path], out: Path, grid: PixelGrid, memory: int, workers: int | None) -> None:
    """The stage: cubes opened, placed, made into one mosaic on disk."""
    placed = [place(open_raw_cube(path), CAMERA, grid=grid) for path in paths]
    wavelength_nm = open_raw_cube(paths[0]).wavelength_nm
    writer = MosaicWriter(out, grid.shape, wavelength_nm)
    write_mosaic(MosaicWork(placed, CAMERA, grid), writer, memory=memory, crew=Crew(workers=workers))


def measured(paths: list[Path], out: Path, grid: PixelGrid, memory: int, workers: int | None) -> Spent:
    """Run the stage and tell what this process has spent on it, start-up left out of the time."""
    keep_freed_memory()
    use_one_thread()
    cpu, wall = time.process_time(), time.perf_counter()
    rectify(paths, out, grid, memory, workers)
    bands = len(open_raw_cube(paths[0]).wavelength_nm)
    spent = time.process_time() - cpu, time.perf_counter() - wall
    return Spent(*spent, peak_bytes(), grid.shape[0] * grid.shape[1] * bands)


def peak_bytes() -> int:
    """Highest resident memory of this process; ``getrusage`` would count what it was started from as well."""
    lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) * 1024


def run_field(folder: Path, side: int, bands: int, workers: int | None) -> Spent:
    """Write one field's sweeps, measure the stage in a fresh process, remove both."""
    scene = SceneGrid(side, side, 32, 4)
    sweeps = full_sweeps(scene, CAMERA, "x")
    grid = PixelGrid.of_scene(scene, 1)
    place_of = folder / f"paper-scale-{side}"
    try:
        wall = time.perf_counter()
        paths = write_raw(place_of, sweeps, bands)
        lines = sum(sweep.lines for sweep in sweeps)
        print(
            f"{side} px, {bands} bands: {len(sweeps)} strips, {lines} lines; raw written in "
            f"{time.perf_counter() - wall:.0f} s",
            flush=True,
        )
        with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
            spent = pool.submit(measured, paths, place_of / "mosaic.zarr", grid, MEMORY, workers).result()
    finally:
        shutil.rmtree(place_of, ignore_errors=True)
    print(
        f"{side} px: processor {spent.cpu_s:.1f} s, wall {spent.wall_s:.1f} s, {spent.cpu_ns:.1f} ns a pixel and "
        f"band, peak memory {spent.peak_bytes / 2**30:.2f} GiB",
        flush=True,
    )
    return spent


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("folder", type=Path, help="on a disk with enough room")
    parser.add_argument("--side", type=int, default=10240, help="of the field [px]")
    parser.add_argument("--bands", type=int, default=32)
    parser.add_argument("--workers", type=int, default=1, help="tiles made at a time; 0: one a core")
    given = parser.parse_args()
    small, large = (
        run_field(given.folder, side, given.bands, given.workers or None)
        for side in (min(SMALL_PX, given.side // 2), given.side)
    )
    growth = large.cpu_ns / small.cpu_ns
    met = growth <= MOST_GROWTH and large.peak_bytes <= MOST_MEMORY_GIB * 2**30
    print(
        f"processor time a pixel and band against the smaller field: {growth:.2f} (goal <= {MOST_GROWTH}); peak "
        f"{large.peak_bytes / 2**30:.2f} GiB (goal <= {MOST_MEMORY_GIB:g}); {'met' if met else 'missed'}"
    )


if __name__ == "__main__":
    main()
