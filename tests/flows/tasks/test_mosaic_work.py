"""Mosaics from disk to disk: the same bytes however many workers, bounded memory, progress."""

from __future__ import annotations

import hashlib
import os
import signal
import weakref
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from flows.tasks.mosaic_work import MosaicRecipe, tile_budget, write_mosaic
from pipeline.errors import SettingsError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import block_means
from pipeline.geometry.scan import Sweep, line_positions
from pipeline.rectify.placed import PixelGrid, place
from pipeline.rectify.region import cache_bytes, plan_tiles
from pipeline.rectify.tiles import MosaicWork, TileMaker, let_tiles_go, opened_tiles
from pipeline.signal.lines import LineCache, line_blocks
from pipeline.source import Line, References
from storage.arrays.cubes import RawCube, RawCubeWriter, SweepHeader, open_raw_cube
from storage.arrays.mosaics import MosaicWriter, load_mosaic
from storage.arrays.quicklooks import Thumbnail, ThumbnailCut
from storage.parallel.pool import WorkerPool

CAMERA = LineCamera()
BANDS = np.array([500.0, 600.0, 700.0])
GRID = PixelGrid((-70.0, -420.0), 1, (140, 900))
PLENTY = 4 * 2**30
ONE, TWO, THREE = (WorkerPool(workers=count) for count in (1, 2, 3))


@pytest.fixture(scope="module")
def cubes(tmp_path_factory: pytest.TempPathFactory) -> list[RawCube]:
    """Two stored sweeps of noise, side by side."""
    folder, rng = tmp_path_factory.mktemp("raw"), np.random.default_rng(8)
    frame = (CAMERA.samples, len(BANDS))
    references = References(np.zeros(frame, np.float32), np.full(frame, 2000, np.float32), np.ones(3, np.float32))
    for strip in (-250.0, 250.0):
        sweep = Sweep(f"at {strip}", "fine", "x", strip, -120.0, 240)
        raw, position = rng.integers(0, 3000, (240, *frame)).astype(np.uint16), line_positions(sweep, CAMERA)
        with RawCubeWriter(folder / f"{strip}.zarr", SweepHeader(sweep, references, BANDS)) as cube:
            cube.write([Line(n, raw[n], *position[n], n * 0.1, 100.0) for n in range(240)])
    return [open_raw_cube(path) for path in sorted(folder.iterdir())]


@dataclass(frozen=True)
class KillOnce(ThumbnailCut):
    """A cut that ends its process the first time, and leaves what an interrupted write leaves."""

    folder: str = ""

    def __call__(self, rows: slice, columns: slice, values: np.ndarray) -> np.ndarray:
        """As a thumbnail's, once somebody was killed."""
        if not (Path(self.folder) / "killed").exists():
            (Path(self.folder) / "m.zarr" / "values" / "c.1234.partial").write_bytes(b"half")
            (Path(self.folder) / "killed").touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return super().__call__(rows, columns, values)


@pytest.fixture(scope="module")
def processes() -> Iterator[WorkerPool]:
    """Two worker processes for all tests here."""
    with WorkerPool("processes", 2).open() as pool:
        yield pool


def recipe_of(cubes: list[RawCube]) -> MosaicRecipe:
    """Both sweeps by the folder that they lie in."""
    return MosaicRecipe(Path(str(cubes[0].group.store_path.store.root)).parent, CAMERA, GRID)


def work_of(cubes: list[RawCube]) -> MosaicWork:
    """Both sweeps on the grid."""
    return MosaicWork([place(cube, CAMERA, grid=GRID) for cube in cubes], CAMERA, GRID)


def mosaic_at(path: Path) -> MosaicWriter:
    """An empty mosaic on the grid."""
    return MosaicWriter(path, GRID.shape, BANDS)


def digest_of(folder: Path) -> str:
    """Hash of all files of a store, names included."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return hashlib.sha256(
        b"".join(f"{path.relative_to(folder)}".encode() + path.read_bytes() for path in files)
    ).hexdigest()


def test_workers_do_not_change_a_byte(tmp_path: Path, cubes: list[RawCube]) -> None:
    """One tile at a time in a plain loop, or three at once, the files are the same."""
    digests = set()
    for pool in (ONE, THREE):
        path = tmp_path / f"{pool.workers}.zarr"
        budget = write_mosaic(recipe_of(cubes), mosaic_at(path), memory=PLENTY, pool=pool)
        assert budget.workers == pool.workers
        digests.add(digest_of(path))
    assert len(digests) == 1


def test_progress_and_tiles_are_told(tmp_path: Path, cubes: list[RawCube]) -> None:
    """Every tile is shown once with its values, and the fraction done rises to 1."""
    seen: list[tuple[int, int]] = []
    fractions: list[float] = []

    class Watched(Thumbnail):
        def put(self, rows: slice, columns: slice, part: np.ndarray) -> None:
            assert part.shape == (rows.stop - rows.start, columns.stop - columns.start, 3)
            seen.append((rows.start, columns.start))

    write_mosaic(
        recipe_of(cubes),
        mosaic_at(tmp_path / "m.zarr"),
        memory=PLENTY,
        pool=TWO,
        seen=Watched(GRID.shape, [0, 1, 2], 900),
        report=fractions.append,
    )
    assert sorted(seen) == [(y, x) for y in (0, 64, 128) for x in (0, 640)]
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1


@pytest.mark.parametrize("most_px", [37, 140, 2000])
def test_thumbnail_is_every_nth_pixel(tmp_path: Path, cubes: list[RawCube], most_px: int) -> None:
    """Whatever tiles it is made of, a thumbnail holds the mosaic's own pixels, at most so many a side."""
    thumbnail = Thumbnail(GRID.shape, [2, 0], most_px)
    path = tmp_path / "m.zarr"
    write_mosaic(recipe_of(cubes), mosaic_at(path), memory=PLENTY, pool=ONE, seen=thumbnail)
    down, across = (-(-size // most_px) for size in GRID.shape)
    whole = load_mosaic(path).values[::down, ::across, ::-2]
    np.testing.assert_allclose(thumbnail.image, whole, rtol=3e-4)
    assert max(thumbnail.image.shape[:2]) <= most_px


def test_memory_says_how_many_tiles_at_a_time(tmp_path: Path, cubes: list[RawCube]) -> None:
    """With memory for one tile only one is made at a time, whatever is allowed; a byte less and none is."""
    work = recipe_of(cubes)
    least = write_mosaic(work, mosaic_at(tmp_path / "a.zarr"), memory=PLENTY, pool=ONE).projected
    tight = write_mosaic(work, mosaic_at(tmp_path / "b.zarr"), memory=least, pool=THREE)
    assert tight.workers == 1
    with pytest.raises(SettingsError, match=r"projected memory \d+ MiB exceeds --memory \d+ MiB: one tile of 64 x 640"):
        write_mosaic(work, mosaic_at(tmp_path / "c.zarr"), memory=least - 1)


def test_an_error_in_a_tile_ends_the_work(tmp_path: Path, cubes: list[RawCube]) -> None:
    """What goes wrong in a worker is raised where the work was asked for."""

    thumbnail = Thumbnail(GRID.shape, [3], 100)  # a band too far
    with pytest.raises(IndexError, match="index 3 is out of bounds"):
        write_mosaic(recipe_of(cubes), mosaic_at(tmp_path / "m.zarr"), memory=PLENTY, pool=TWO, seen=thumbnail)


def test_processes_write_the_same_bytes(tmp_path: Path, cubes: list[RawCube], processes: WorkerPool) -> None:
    """From one recipe threads and processes make the same files and the same thumbnail, nothing beside them."""
    made = {}
    for pool in (ONE, TWO, processes):
        path, thumbnail = tmp_path / f"{pool.scheduler}{pool.workers}.part" / "m.zarr", Thumbnail(GRID.shape, [2], 50)
        budget = write_mosaic(recipe_of(cubes), mosaic_at(path), memory=PLENTY, pool=pool, seen=thumbnail)
        assert (budget.workers, budget.processes) == (pool.workers, pool is processes)
        made[pool] = digest_of(path), thumbnail.image.tobytes()
    assert len({*made.values()}) == 1


def test_a_worker_killed_between_tiles_changes_nothing(
    tmp_path: Path, cubes: list[RawCube], processes: WorkerPool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """kill -9 of a process that makes tiles, with a shard half written: the mosaic is as an undisturbed one."""
    folder = tmp_path / "key.part"
    write_mosaic(recipe_of(cubes), mosaic_at(tmp_path / "a.zarr"), memory=PLENTY, pool=ONE)
    kill = KillOnce((1, 1), (0,), str(folder))
    monkeypatch.setattr("storage.arrays.quicklooks.ThumbnailCut", lambda *about: kill)
    writer = mosaic_at(folder / "m.zarr")
    write_mosaic(recipe_of(cubes), writer, memory=PLENTY, pool=processes, seen=Thumbnail(GRID.shape, [0], 900))
    assert (folder / "killed").exists()
    assert digest_of(folder / "m.zarr") == digest_of(tmp_path / "a.zarr")


def test_each_process_keeps_the_lines_of_one_tile(cubes: list[RawCube]) -> None:
    """Two processes keep each what one thread keeps; two threads share what both need."""
    work = work_of(cubes)
    tiles = plan_tiles(work.placed, CAMERA, GRID, (64, 640))
    kept = [
        tile_budget(work, tiles, (64, 640), memory=PLENTY, pool=pool).cache
        for pool in (ONE, TWO, WorkerPool("processes", 2))
    ]
    assert kept[2] == kept[0] < kept[1]


def test_means_keep_the_lines_of_two_parts_of_a_tile(cubes: list[RawCube], tmp_path: Path) -> None:
    """They are fewer than those of a tile, and enough for each block of lines to be read once."""
    work = replace(work_of(cubes), grid=PixelGrid((-68.5, -418.5), 4, (35, 225)), finer=GRID)
    writer = MosaicWriter(tmp_path / "m.zarr", work.grid.shape, BANDS)
    tiles = plan_tiles(work.placed, CAMERA, work.grid, writer.tile_shape)
    budget = tile_budget(work, tiles, writer.tile_shape, memory=PLENTY, pool=ONE)
    assert budget.cache < cache_bytes(work.placed, tiles, 1)
    kept = LineCache(budget.cache)
    for tile in tiles:
        work.make_tile(tile.rows, tile.columns, work.reach(tile.columns), kept)
    assert kept.reads == sum(len(line_blocks(slice(0, len(cube.valid_line)))) for cube in cubes)


def test_a_worker_lets_tiles_go(cubes: list[RawCube]) -> None:
    """Raw lines are kept from tile to tile of a mosaic, and no longer than the process is at tiles."""
    maker = TileMaker(recipe_of(cubes).open, 2**24)
    maker(slice(0, 64), slice(0, 640))
    lines = weakref.ref(opened_tiles(maker).lines)
    assert lines() is not None
    let_tiles_go()
    assert lines() is None


def test_memory_of_workers_elsewhere_is_not_counted(tmp_path: Path, cubes: list[RawCube]) -> None:
    """They lie on other machines; here the least memory refuses nothing."""
    work, elsewhere = work_of(cubes), WorkerPool("tcp://127.0.0.1:9")
    tiles = plan_tiles(work.placed, CAMERA, GRID, (64, 640))
    assert tile_budget(work, tiles, (64, 640), memory=1, pool=elsewhere).workers == 1
    with pytest.raises(SettingsError, match="exceeds --memory 1 MiB"):
        tile_budget(work, tiles, (64, 640), memory=1, pool=ONE)


def test_every_process_counts_against_the_memory(tmp_path: Path, cubes: list[RawCube], processes: WorkerPool) -> None:
    """Two processes and this one do not fit where one does; the message says what each takes."""
    writer = mosaic_at(tmp_path / "m.zarr")
    with pytest.raises(SettingsError, match=r"each of two processes 512 MiB; give at least --memory 1\d\d\d MiB"):
        write_mosaic(recipe_of(cubes), writer, memory=2**30, pool=processes)


@pytest.mark.parametrize("apart", [False, True], ids=["here", "processes"])
def test_a_mosaic_of_means_is_the_mean_of_the_finer_one(
    cubes: list[RawCube], tmp_path: Path, processes: WorkerPool, apart: bool
) -> None:
    """Whoever makes its tiles: 4 x 4 finer pixels a pixel, those that no line reached left out."""
    fine, coarse = recipe_of(cubes), PixelGrid((-68.5, -418.5), 4, (35, 225))
    made = []
    for name, recipe in {"fine": fine, "means": replace(fine, grid=coarse, finer=GRID)}.items():
        writer = MosaicWriter(tmp_path / f"{name}.zarr", recipe.grid.shape, BANDS)
        write_mosaic(recipe, writer, memory=PLENTY, pool=processes if apart else ONE)
        made.append(load_mosaic(tmp_path / f"{name}.zarr"))
    means, covered = block_means(made[0].values, made[0].coverage.astype(np.intp), 4)
    np.testing.assert_allclose(made[1].values, means, rtol=5e-4, atol=1e-6)  # both are stored rounded
    np.testing.assert_array_equal(made[1].coverage, covered)
