"""Mosaics from disk to disk: bounded memory, errors of workers, and lines that they free."""

from __future__ import annotations

import weakref
from pathlib import Path

import numpy as np
import pytest

from spectralzoom.flows.stages.rectify import MosaicRecipe, tile_budget, write_mosaic
from spectralzoom.pipeline.errors import SettingsError, ShapeError
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.scan import Sweep
from spectralzoom.pipeline.kept import free_kept
from spectralzoom.pipeline.rectify.placed import PixelGrid, place
from spectralzoom.pipeline.rectify.region import MosaicWork, TileMaker, opened_tiles, plan_tiles
from spectralzoom.pipeline.source import References
from spectralzoom.storage.arrays.cubes import SweepHeader
from spectralzoom.storage.arrays.signal_cubes import SignalCube, open_signal_cubes
from spectralzoom.storage.parallel.pool import WorkerPool
from spectralzoom.storage.store import Ref
from tests.storage.plain_mosaic import plain_writer, write_plain_sweep

CAMERA = LineCamera()
BANDS = np.array([500.0, 600.0, 700.0])
GRID = PixelGrid((-70.0, -420.0), 1, (140, 900))
PLENTY = 4 * 2**30
ONE, TWO, THREE = (WorkerPool(workers=count) for count in (1, 2, 3))


@pytest.fixture(scope="module")
def cubes(tmp_path_factory: pytest.TempPathFactory) -> list[SignalCube]:
    """Return two stored sweeps of noise, side by side."""
    folder = tmp_path_factory.mktemp("raw")
    rng = np.random.default_rng(8)
    frame = (CAMERA.samples, len(BANDS))
    references = References(np.zeros(frame, np.float32), np.full(frame, 2000, np.float32), np.ones(3, np.float32))
    for strip in (-250.0, 250.0):
        sweep = Sweep(f"at {strip}", "fine", "x", strip, -120.0, 240)
        values = rng.integers(0, 3000, (240, *frame)) / 2048
        write_plain_sweep(folder / f"{strip}.zarr", SweepHeader(sweep, references, BANDS), values, 2.0**-11)
    return open_signal_cubes(folder)


def recipe_of(cubes: list[SignalCube]) -> MosaicRecipe:
    """Return the recipe of a mosaic of both sweeps, by their folder."""
    folder = Path(str(cubes[0].group.store_path.store.root)).parent
    return MosaicRecipe(Ref("condense", "key", folder), CAMERA, GRID)


def test_memory_limits_the_tiles_at_a_time(tmp_path: Path, cubes: list[SignalCube]) -> None:
    """Memory for one tile allows one worker of three; one byte less is refused."""
    work = recipe_of(cubes)
    first, second, third = (plain_writer(tmp_path / f"{name}.zarr", GRID.shape, BANDS) for name in "abc")
    least = write_mosaic(work, first, memory=PLENTY, pool=ONE).projected
    assert write_mosaic(work, second, memory=least, pool=THREE).workers == 1
    with pytest.raises(SettingsError, match=r"projected memory \d+ MiB exceeds --memory \d+ MiB: one tile of 64 x 640"):
        write_mosaic(work, third, memory=least - 1)


def test_an_error_in_a_tile_ends_the_work(tmp_path: Path, cubes: list[SignalCube]) -> None:
    """An error in a worker is raised at the caller."""
    other = plain_writer(tmp_path / "m.zarr", GRID.shape, BANDS[:2])
    with pytest.raises(ShapeError, match="a tile of the mosaic has the shape"):
        write_mosaic(recipe_of(cubes), other, memory=PLENTY, pool=TWO)


def test_a_worker_frees_its_raw_lines(cubes: list[SignalCube]) -> None:
    """They stay in memory from tile to tile of a mosaic, until free_kept."""
    maker = TileMaker(recipe_of(cubes).open, 2**24)
    maker((slice(0, 64), slice(0, 640)))
    lines = weakref.ref(opened_tiles(maker)[1])
    assert lines() is not None
    free_kept()
    assert lines() is None


def test_memory_of_workers_on_other_machines_is_not_counted(tmp_path: Path, cubes: list[SignalCube]) -> None:
    """On a cluster the smallest memory setting refuses nothing."""
    work = MosaicWork([place(cube, CAMERA, grid=GRID) for cube in cubes], CAMERA, GRID)
    tiles = plan_tiles(work.placed, CAMERA, GRID, (64, 640))
    assert tile_budget(work, tiles, (64, 640), memory=1, pool=WorkerPool("tcp://127.0.0.1:9")).workers == 1
    with pytest.raises(SettingsError, match="exceeds --memory 1 MiB"):
        tile_budget(work, tiles, (64, 640), memory=1, pool=ONE)
