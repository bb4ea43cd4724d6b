"""Rectification and mosaic from disk to disk: against the codec alone, with the field's size, and its memory."""

from __future__ import annotations

import multiprocessing
import shutil
import tempfile
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import TypeVar

from measure import Row, ratio, time_in_turn
from paper_scale import CAMERA, Spent, measured, rectify, write_raw

from models.network.process import keep_freed_memory, use_one_thread
from pipeline.geometry.grid import SceneGrid
from pipeline.planning.coverage import full_sweeps
from pipeline.rectify.line_cache import BLOCK_LINES
from pipeline.rectify.placed import PixelGrid
from storage.arrays.cubes import open_raw_cube
from storage.arrays.layout import ArraySpec, create_array, create_group, image_spec
from storage.arrays.mosaics import load_mosaic

BANDS, SHAPE = 270, (128, 1200)
FEW_BANDS, SIDES = 16, (1280, 2560)
MEMORY = 4 * 2**30
ROUNDS = 3

T = TypeVar("T")


def rows() -> list[Row]:
    """The stage against the codec, and a larger field against a smaller one."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        return [alone(_against_codec, folder), *_with_size(folder)]


def alone(call: Callable[..., T], *given: object) -> T:
    """Call in a process of its own, whose memory and settings are not those of other benchmarks."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(call, *given).result()


def _against_codec(folder: Path) -> Row:
    """Two sweeps of all bands into one mosaic, beside reading these sweeps and writing this mosaic, nothing between."""
    keep_freed_memory()
    use_one_thread()
    scene = SceneGrid(*SHAPE, 32, 4)
    grid, out = PixelGrid.of_scene(scene, 1), folder / "mosaic.zarr"
    paths = write_raw(folder, full_sweeps(scene, CAMERA, "x"), BANDS)
    rectify(paths, out, grid, MEMORY, 1)
    stored = load_mosaic(out)

    def stage() -> None:
        shutil.rmtree(out, ignore_errors=True)
        rectify(paths, out, grid, MEMORY, 1)

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
    share, per = ratio(clocks, "stage", "codec"), 1e9 / stored.values.size
    cost = {name: clock.cpu_min_s * per for name, clock in clocks.items()}
    return Row(
        f"rectify and mosaic disk to disk, {SHAPE[0]} x {SHAPE[1]} px, {BANDS} bands, {len(paths)} sweeps",
        f"{share:.2f} x codec, {cost['stage']:.1f} ns a px and band",
        "<= 2 x codec",
        share <= 2,
        f"read the sweeps {cost['read']:.1f} ns, with writing the mosaic {cost['codec']:.1f} ns",
    )


def _with_size(folder: Path) -> list[Row]:
    spent = [_field(folder / str(side), side) for side in SIDES]
    small, large = spent
    growth = large.cpu_ns / small.cpu_ns
    peak = large.peak_bytes / 2**30
    return [
        Row(
            f"processor time a px and band, {SIDES[1]} px field against {SIDES[0]} px, {FEW_BANDS} bands",
            f"{growth:.2f}, {large.cpu_ns:.0f} ns",
            "<= 1.20",
            growth <= 1.2,
            f"{SIDES[0]} px: {small.cpu_ns:.0f} ns; 10240 px by paper_scale.py",
        ),
        Row(
            f"peak memory of the {SIDES[1]} px field",
            f"{peak:.2f} GiB",
            "<= 4 GiB",
            peak <= 4,
            f"the mosaic itself: {large.values * 4 / 2**30:.2f} GiB",
        ),
    ]


def _field(folder: Path, side: int) -> Spent:
    scene = SceneGrid(side, side, 32, 4)
    paths = write_raw(folder, full_sweeps(scene, CAMERA, "x"), FEW_BANDS)
    spent = alone(measured, paths, folder / "mosaic.zarr", PixelGrid.of_scene(scene, 1), MEMORY, 1)
    shutil.rmtree(folder)
    return spent
