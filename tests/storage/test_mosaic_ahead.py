"""Mosaics made ahead: the bytes that would be made afterwards, or none at all."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Event, Timer
from typing import Any

import numpy as np
import pytest

from pipeline.checked_lines import with_check
from pipeline.errors import SettingsError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import Sweep, line_positions
from pipeline.rectify.placed import PixelGrid, place
from pipeline.source import Line, References
from storage import mosaic_ahead
from storage.arrays.lookups import path_digest
from storage.arrays.mosaic_work import MosaicWork
from storage.arrays.mosaics import MosaicWriter
from storage.arrays.spool import Spool
from storage.arrays.tile_work import Thumbnail, write_mosaic
from storage.mosaic_ahead import AheadOf, MosaicAhead, PlannedLines, place_as_planned, take_over
from tests.storage.small_archive import flip

CAMERA = LineCamera(samples=96)
BANDS = np.array([500.0, 600.0, 700.0])
GRID = PixelGrid((-95.5, -79.5), 1, (192, 160))
PLENTY = 4 * 2**30
SWEEPS = [Sweep(f"coarse-{n}", "fine", "x", strip, -110.0, 220) for n, strip in enumerate((-40.0, 40.0))]
WANTED = AheadOf(CAMERA, GRID, "catmull-rom", 0)


@dataclass(frozen=True)
class Captured:
    """Two sweeps of noise in a spool, and where the plan has them."""

    folder: Path
    lines: list[PlannedLines]

    @property
    def work(self) -> MosaicWork:
        """The mosaic that is to be made of them."""
        return MosaicWork([place_as_planned(one, CAMERA, GRID) for one in self.lines], CAMERA, GRID)

    @property
    def paths(self) -> Mapping[str, str]:
        """Digest of each sweep's path, as its lines came."""
        return {one.sweep.name: path_digest(one.position) for one in self.lines}


@pytest.fixture(scope="module")
def captured(tmp_path_factory: pytest.TempPathFactory) -> Captured:
    """Lines of noise on disk."""
    folder, rng, frame = tmp_path_factory.mktemp("spool"), np.random.default_rng(8), (96, len(BANDS))
    references = References(np.zeros(frame, np.float32), np.full(frame, 2000, np.float32), np.ones(3, np.float32))
    lines = []
    for sweep in SWEEPS:
        position = line_positions(sweep, CAMERA)
        with Spool.open(folder, *frame, header={}, name=sweep.name) as spool:
            for n in range(sweep.lines):
                data = rng.integers(0, 3000, frame).astype(np.uint16)
                spool.append(Line(n, data, *position[n], n * 0.1, 100.0))
        lines.append(PlannedLines(folder, sweep, references, position))
    return Captured(folder, lines)


def begin(path: Path) -> MosaicWriter:
    """The file of the mosaic."""
    return MosaicWriter(path, GRID.shape, BANDS)


def picture() -> Thumbnail:
    """A thumbnail of it."""
    return Thumbnail(GRID.shape, (2, 1, 0), 64)


def contents(folder: Path) -> dict[str, str]:
    """Hash of each file."""
    files = (path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def make_ahead(captured: Captured, folder: Path, until: int = 220) -> None:
    """Tell of all lines of the first sweep, and of the second one by one as far as ``until``."""
    with MosaicAhead(folder, captured.work, begin, picture(), memory=PLENTY) as ahead:
        ahead.arrived("coarse-0", 220)
        for count in range(1, until + 1):
            ahead.arrived("coarse-1", count)
        ahead._thread.submit(lambda: None).result()  # what was begun is waited for: the end of the block cancels it


@pytest.mark.parametrize("until", [140, 200, 220])
def test_bytes_are_those_made_afterwards(
    captured: Captured, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, until: int
) -> None:
    """However many lines had arrived: tiles made ahead and the rest after them are one mosaic, and one picture."""
    plain, seen = begin(tmp_path / "plain.zarr"), picture()
    write_mosaic(captured.work, plain, memory=PLENTY, seen=seen)
    make_ahead(captured, tmp_path / "ahead", until)
    other, out = picture(), tmp_path / "out.zarr"
    there = take_over(tmp_path / "ahead", out, WANTED, captured.paths, other)
    assert 0 < len(there) < 3 if until < 220 else len(there) == 3
    written: list[int] = []
    real = MosaicWriter.write_tile
    monkeypatch.setattr(MosaicWriter, "write_tile", lambda *given: (written.append(given[1]), real(*given))[1])
    write_mosaic(captured.work, MosaicWriter.reopen(out), memory=PLENTY, seen=other, there=there)
    assert len(written) == 3 - len(there)  # what is there is not made again
    assert contents(out) == contents(tmp_path / "plain.zarr")
    np.testing.assert_array_equal(other.image, seen.image)


def test_no_tile_is_made_before_its_lines_are_there(captured: Captured, tmp_path: Path) -> None:
    """Lines that have not arrived are never read."""
    first = captured.lines[1]
    reads: list[int] = []

    class Counted(PlannedLines):
        def read(self, start: int, stop: int) -> np.ndarray:
            reads.append(stop)
            return super().read(start, stop)

    lines = [captured.lines[0], Counted(first.spool, first.sweep, first.references, first.position)]
    with MosaicAhead(tmp_path / "a", Captured(captured.folder, lines).work, begin, picture(), memory=PLENTY) as ahead:
        ahead.arrived("coarse-0", 220)
        for count in range(221):
            ahead.arrived("coarse-1", count)
            ahead._thread.submit(lambda: None).result()
            assert max(reads, default=0) <= count
    assert max(reads) == 220


CHANGED = {
    "a line lies elsewhere": lambda place, usable: (place + np.eye(1, 2)[0] * 1e-9, usable),
    "a line is not valid": lambda place, usable: (place, usable & (np.arange(220) != 5)),
}


@pytest.mark.parametrize("change", CHANGED.values(), ids=CHANGED)
def test_lines_that_are_not_as_planned_take_nothing_over(captured: Captured, tmp_path: Path, change) -> None:
    """One line off the plan by a billionth, or one lost: the mosaic is made anew, and what was ahead stays behind."""
    make_ahead(captured, tmp_path / "ahead")
    one = captured.lines[0]
    paths = {**captured.paths, one.sweep.name: path_digest(*change(one.position, one.valid_line))}
    assert take_over(tmp_path / "ahead", tmp_path / "out.zarr", WANTED, paths, picture()) == []
    assert not (tmp_path / "out.zarr").exists()


OTHERS = {
    "kernel": replace(WANTED, kernel="nearest"),
    "version": replace(WANTED, version=1),
    "camera": replace(WANTED, camera=replace(CAMERA, pitch_um=7.5)),
}


@pytest.mark.parametrize("wanted", OTHERS.values(), ids=OTHERS)
def test_what_was_made_of_other_settings_is_not_taken_over(captured: Captured, tmp_path: Path, wanted: AheadOf) -> None:
    """Nor what an earlier version of the stage made."""
    make_ahead(captured, tmp_path / "ahead")
    assert take_over(tmp_path / "ahead", tmp_path / "out.zarr", wanted, captured.paths, picture()) == []


def test_what_a_power_cut_left_is_not_taken_over(
    captured: Captured, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk was waited for by nobody: once the machine has started anew a tile may be a hole."""
    make_ahead(captured, tmp_path / "ahead")
    monkeypatch.setattr(mosaic_ahead, "_boot", lambda: "another")
    assert take_over(tmp_path / "ahead", tmp_path / "out.zarr", WANTED, captured.paths, picture()) == []


@pytest.mark.parametrize("record", ["{}", "[]", '{"tiles": 3}', '{"tiles": [[1]]}', "null"])
def test_a_record_of_something_else_takes_nothing_over(captured: Captured, tmp_path: Path, record: str) -> None:
    """A file that is no record of ours is no reason to fail."""
    make_ahead(captured, tmp_path / "ahead")
    for text in (record.encode(), with_check(record.encode())):
        (tmp_path / "ahead" / "ahead.json").write_bytes(text)
        assert take_over(tmp_path / "ahead", tmp_path / "out.zarr", WANTED, captured.paths, picture()) == []


@pytest.mark.parametrize("name", ["ahead.json", "seen.npy"])
def test_what_has_changed_is_not_taken_over(captured: Captured, tmp_path: Path, name: str) -> None:
    """A bit in the record, which could name a tile that is not ready, or in the picture."""
    make_ahead(captured, tmp_path / "ahead")
    path = tmp_path / "ahead" / name
    at = path.read_bytes().index(b'"tiles": [[0') + 11 if name == "ahead.json" else -5
    flip(path, at, bit=0)
    assert take_over(tmp_path / "ahead", tmp_path / "out.zarr", WANTED, captured.paths, picture()) == []


def test_a_mosaic_is_taken_over_once(captured: Captured, tmp_path: Path) -> None:
    """Whoever fails after that makes all of it: the record is gone with the mosaic."""
    make_ahead(captured, tmp_path / "ahead")
    assert take_over(tmp_path / "ahead", tmp_path / "out.zarr", WANTED, captured.paths, picture())
    assert take_over(tmp_path / "ahead", tmp_path / "again.zarr", WANTED, captured.paths, picture()) == []


def test_a_picture_of_another_size_takes_nothing_over(captured: Captured, tmp_path: Path) -> None:
    """Its pixels would be others."""
    make_ahead(captured, tmp_path / "ahead")
    seen = Thumbnail(GRID.shape, (2, 1, 0), 32)
    assert take_over(tmp_path / "ahead", tmp_path / "out.zarr", WANTED, captured.paths, seen) == []


def test_capture_that_breaks_off_leaves_nothing_ahead(captured: Captured, tmp_path: Path) -> None:
    """Its tiles go: the capture is gone on with, and then makes them again."""
    ahead = MosaicAhead(tmp_path / "ahead", captured.work, begin, picture(), memory=PLENTY)
    ahead.arrived("coarse-0", 220)
    ahead.__exit__(KeyboardInterrupt)
    assert not (tmp_path / "ahead").exists()


def test_the_end_of_a_capture_waits_for_one_tile_at_most(
    captured: Captured, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Tiles that wait for their turn are left to whoever makes the rest, with more hands."""
    free, made = Event(), list[int]()
    real = MosaicWriter.write_tile

    def slow(writer: MosaicWriter, row: int, *rest: Any) -> None:
        assert free.wait(30)
        made.append(row)
        real(writer, row, *rest)

    monkeypatch.setattr(MosaicWriter, "write_tile", slow)
    with MosaicAhead(tmp_path / "ahead", captured.work, begin, picture(), memory=PLENTY) as ahead:
        for name in ("coarse-0", "coarse-1"):
            ahead.arrived(name, 220)
        Timer(0.2, free.set).start()  # the block has ended by then
    assert len(made) == 1


@pytest.mark.parametrize("failing", [1, 2])
def test_tile_that_fails_harms_nobody(
    captured: Captured, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, failing: int
) -> None:
    """A full disk behind the capture's back is told to the log, and the mosaic is made in its turn."""
    real, calls = MosaicWriter.write_tile, list[int]()

    def full(writer: MosaicWriter, row: int, *rest: Any) -> None:
        calls.append(row)
        if len(calls) == failing:
            raise OSError("No space left")
        real(writer, row, *rest)

    monkeypatch.setattr(MosaicWriter, "write_tile", full)
    with caplog.at_level("INFO", mosaic_ahead.__name__):
        make_ahead(captured, tmp_path / "ahead")
    assert "made after its lines: No space left" in caplog.text
    assert take_over(tmp_path / "ahead", tmp_path / "out.zarr", WANTED, captured.paths, picture()) == []


def test_killed_process_leaves_nothing_to_take(captured: Captured, tmp_path: Path) -> None:
    """Without its record, which is written last, no mosaic is taken over."""
    make_ahead(captured, tmp_path / "ahead")
    (tmp_path / "ahead" / "ahead.json").unlink()
    assert take_over(tmp_path / "ahead", tmp_path / "out.zarr", WANTED, captured.paths, picture()) == []


def test_memory_is_bounded(captured: Captured, tmp_path: Path) -> None:
    """Where not even one tile fits, it says so before anything is made."""
    with pytest.raises(SettingsError, match="exceeds --memory"):
        MosaicAhead(tmp_path / "ahead", captured.work, begin, picture(), memory=1)


def test_tables_are_those_of_a_stored_sweep(captured: Captured) -> None:
    """The plan's lines are looked up as the captured ones are."""
    one = captured.lines[0]
    (track, table), (other, wanted) = (
        placed.tracks[0] for placed in (place_as_planned(one, CAMERA, GRID), place(one, CAMERA, grid=GRID))
    )
    np.testing.assert_array_equal(track.scan, other.scan)
    assert (table is None) == (wanted is None)
