"""Threads and processes on one rectification from disk to disk: wall and processor time, and the same bytes."""

from __future__ import annotations

import hashlib
import os
import resource
import shutil
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from bench_tiles import CAMERA, alone, write_raw
from measure import Row

from models.network.machine import keep_freed_memory, use_one_thread
from pipeline.geometry.grid import SceneGrid
from pipeline.planning.coverage import full_sweeps
from pipeline.rectify.placed import PixelGrid
from pipeline.rectify.region import plan_tiles
from storage.arrays.mosaics import MosaicWriter
from storage.arrays.tile_work import MosaicRecipe, write_mosaic
from storage.parallel.crew import Crew, run_blocks

SCENE, BANDS = SceneGrid(1024, 1280, 32, 4), 128
LARGEST_PX, LARGEST_BANDS, MOST_TASKS = 10240, 270, 20_000
MEMORY = 8 * 2**30
ROUNDS = 2
CREWS = {"one thread": Crew(workers=1), "two threads": Crew(workers=2), "two processes": Crew("processes", 2)}


@dataclass(frozen=True)
class Spent:
    """What one run took, in all processes together."""

    start_s: float  # until workers took their first block
    start_cpu_s: float
    wall_s: float  # of the work itself
    cpu_s: float
    digest: str


def rows() -> list[Row]:
    """The same mosaic by each crew, in turn, each in a process of its own; then the size of the largest graphs."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_raw(folder / "raw", full_sweeps(SCENE, CAMERA, "x"), BANDS)
        runs: dict[str, list[Spent]] = {crew: [] for crew in CREWS}
        for _ in range(ROUNDS):
            for crew, spent in runs.items():
                spent.append(alone(_made_by, folder, CREWS[crew]))
    best = {crew: min(spent, key=lambda one: one.wall_s) for crew, spent in runs.items()}
    one = best["one thread"]
    load = f"{ROUNDS} rounds, best; {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}"
    found = [
        Row(
            f"rectify {SCENE.height} x {SCENE.width} px, {BANDS} bands, disk to disk: {crew}",
            f"{it.wall_s:.1f} s, processor {it.cpu_s:.1f} s",
            peers=f"wall {it.wall_s / one.wall_s:.2f}, processor {it.cpu_s / one.cpu_s:.2f} x one thread; "
            f"before that, starting: {it.start_s:.1f} s, processor {it.start_cpu_s:.1f} s; {load}",
        )
        for crew, it in best.items()
    ]
    digests = {it.digest for spent in runs.values() for it in spent}
    return [*found, Row("different mosaics that these crews made", f"{len(digests)}", "1", len(digests) == 1), _tasks()]


def _made_by(folder: Path, crew: Crew) -> Spent:
    """One mosaic in this process and those that it starts."""
    keep_freed_memory()
    use_one_thread()
    grid, out = PixelGrid.of_scene(SCENE, 1), folder / "mosaic.zarr"
    begun = time.perf_counter()
    with crew.open():
        workers = {} if crew.shares_memory else dict(run_blocks(_cpu_here, range(8), crew))
        ready, before = time.perf_counter(), time.process_time()
        writer = MosaicWriter(out, grid.shape, np.linspace(400, 1000, BANDS))
        write_mosaic(MosaicRecipe(folder / "raw", CAMERA, grid), writer, memory=MEMORY, crew=crew)
        done, after = time.perf_counter(), time.process_time()
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    ended = children.ru_utime + children.ru_stime - sum(workers.values())
    digest = hashlib.sha256()
    for path in sorted(path for path in out.rglob("*") if path.is_file()):
        digest.update(path.relative_to(out).as_posix().encode() + path.read_bytes())
    shutil.rmtree(out)
    return Spent(ready - begun, sum(workers.values()), done - ready, after - before + ended, digest.hexdigest())


def _cpu_here(number: int) -> tuple[int, float]:
    return os.getpid(), time.process_time()


def _tasks() -> Row:
    """Tasks of the paper's field, counted without data: rectified coarse and fine."""
    counts = []
    with tempfile.TemporaryDirectory() as name:
        for side in (LARGEST_PX, LARGEST_PX // 4):
            writer = MosaicWriter(Path(name) / f"{side}.zarr", (side, side), np.linspace(400, 1000, LARGEST_BANDS))
            tiles = plan_tiles([], CAMERA, PixelGrid((0.0, 0.0), 1, (side, side)), writer.tile_shape)
            counts.append(len(tiles))
    return Row(
        f"dask tasks of {LARGEST_PX} x {LARGEST_PX} x {LARGEST_BANDS}",
        f"{sum(counts)}",
        f"< {MOST_TASKS}",
        sum(counts) < MOST_TASKS,
        f"tiles {counts[0]} fine, {counts[1]} coarse",
    )
