"""Headwall folders: parts form one cube in order; gaps, truncated files and references are found."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from spectralzoom.pipeline.errors import SceneError
from spectralzoom.pipeline.frame_indices import times_of_lines
from spectralzoom.storage.readers.envi_files import load_frame_index
from spectralzoom.storage.readers.open_cubes import open_cube_source
from tests.storage.readers.test_envi_cubes import write_envi

DROPPED = "1 frames between the first and the last were dropped by the camera"
NM = {"wavelength_units": "nm", "wavelength": "{\n400.0\n,500.0\n,600.0\n}"}
NO_NM = dict.fromkeys(NM)


def write_part(folder: Path, name: str, values: NDArray[Any], **fields: object) -> None:
    """Write (line, sample, band) values as the camera does: BIL without a file ending, the header beside it."""
    folder.mkdir(exist_ok=True)
    write_envi(folder / name, values, **{";Exposure (ms)": 4.5, "file type": "ENVI Standard", **NM, **fields})


@pytest.fixture
def lines() -> NDArray[np.uint16]:
    """Return the numbers of 30 lines, (30, 4, 3) uint16."""
    return np.arange(360, dtype=np.uint16).reshape(30, 4, 3)


def test_parts_are_joined_in_order_of_their_frames(tmp_path: Path, lines: NDArray[np.uint16]) -> None:
    """Parts are ordered by number, not by alphabet; times come from each part's frame index, in both layouts."""
    for first, last, between in ((0, 8, "\t"), (8, 20, " "), (20, 30, "\t")):
        write_part(tmp_path, f"raw_{first}", lines[first:last])
        rows = [f"{frame}{between}{1000 + 10 * frame}" for frame in range(first, last)]
        (tmp_path / f"frameIndex_{first}.txt").write_text("\r\n".join([f"Frame#{between}Timestamp", *rows]))
    source = open_cube_source(tmp_path)
    assert (source.shape, source.dtype, source.valid.all(), source.notes) == ((30, 4, 3), np.uint16, True, ())
    np.testing.assert_array_equal(source.read(0, 30), lines)
    np.testing.assert_array_equal(source.read(6, 22), lines[6:22])
    np.testing.assert_allclose(source.lines.time_s, np.arange(30) * 1e-5)
    np.testing.assert_array_equal(source.lines.exposure_ms, np.full(30, 4.5))
    np.testing.assert_array_equal(source.bands.wavelength_nm, [400, 500, 600])
    assert len(source.files) == 9


def test_constant_timestamps_are_ignored(tmp_path: Path, lines: NDArray[np.uint16]) -> None:
    """A camera without a clock repeats one timestamp."""
    write_part(tmp_path, "raw_0", lines)
    (tmp_path / "frameIndex_0.txt").write_text("\n".join(["Frame#\tTimestamp", *(f"{n}\t7" for n in range(30))]))
    assert open_cube_source(tmp_path).lines.time_s is None


def test_missing_lines_are_flagged(tmp_path: Path, lines: NDArray[np.uint16]) -> None:
    """A truncated or missing part leaves a gap; the last part's lost lines are at the end."""
    write_part(tmp_path, "raw_0", lines[:6], lines=10)
    write_part(tmp_path, "raw_10", lines[10:20], lines=12)
    source = open_cube_source(tmp_path)
    missing = [6, 7, 8, 9, 20, 21]
    assert source.shape[0] == 22
    assert np.flatnonzero(~source.lines.valid).tolist() == missing
    np.testing.assert_array_equal(source.read(0, 22)[source.lines.valid], lines[[*range(6), *range(10, 20)]])
    assert not source.read(0, 22)[missing].any()
    assert any("4 lines before raw_10 are in no file" in note for note in source.notes)


def test_an_empty_part_is_left_out(tmp_path: Path, lines: NDArray[np.uint16]) -> None:
    """A part that was begun when the capture died is empty; the others are read."""
    write_part(tmp_path, "raw_0", lines[:6])
    write_part(tmp_path, "raw_6", lines[:0], lines=10)
    for name in ("raw_6", "raw_6.bin"):  # with either name of the data file
        source = open_cube_source(tmp_path)
        assert (source.shape[0], source.notes) == (6, (f"{name} is empty and left out",))
        (tmp_path / "raw_6").rename(tmp_path / "raw_6.bin") if name == "raw_6" else None


def test_references_are_found_by_name(tmp_path: Path, lines: NDArray[np.uint16]) -> None:
    """Dark and white frames are averaged over their lines, in any letter case."""
    write_part(tmp_path, "raw_0", lines)
    write_part(tmp_path, "darkReference", np.stack([lines[0], lines[2]]), **NO_NM)
    write_part(tmp_path, "WhiteReference_01", lines[5:6], **NO_NM)
    source = open_cube_source(tmp_path)
    np.testing.assert_array_equal(source.dark, lines[1])
    np.testing.assert_array_equal(source.white, lines[5])
    assert source.notes == ("dark frame from darkReference.hdr", "white frame from WhiteReference_01.hdr")


def test_unsuitable_references_are_refused(tmp_path: Path, lines: NDArray[np.uint16]) -> None:
    """A frame that does not fit the cube is refused, and so are two of a kind."""
    write_part(tmp_path, "raw_0", lines)
    write_part(tmp_path, "darkReference", lines[:1, :2], **NO_NM)
    with pytest.raises(SceneError, match=r"dark frame .* is \(2, 3\) \(sample, band\), the cube \(4, 3\)"):
        open_cube_source(tmp_path)
    write_part(tmp_path, "darkReference_2", lines[:1], **NO_NM)
    with pytest.raises(SceneError, match=r"several dark frames .* name one with --dark"):
        open_cube_source(tmp_path)


def test_parts_that_do_not_fit_are_refused(tmp_path: Path, lines: NDArray[np.uint16]) -> None:
    """A part of another frame size is refused, and so is one with a frame number far beyond the others."""
    write_part(tmp_path / "size", "raw_0", lines)
    write_part(tmp_path / "size", "raw_30", lines[:, :3])
    write_part(tmp_path / "far", "raw_0", lines)
    write_part(tmp_path / "far", "raw_99999999999", lines)
    for name, words in (("size", "have frames of"), ("far", "are in no file, more than")):
        with pytest.raises(SceneError, match=words):
            open_cube_source(tmp_path / name)


def test_folders_without_lines_are_refused(tmp_path: Path, lines: NDArray[np.uint16]) -> None:
    """A folder without parts and one with only empty parts have different messages."""
    expected = "is a folder, expected a file, a Zarr store, or a folder with raw_<frame> files"
    with pytest.raises(SceneError, match=expected):
        open_cube_source(tmp_path)
    write_part(tmp_path, "raw_0", lines[:0])
    with pytest.raises(SceneError, match=r"every part of .* is empty"):
        open_cube_source(tmp_path)


def test_folders_and_pipes_are_ignored_as_parts(tmp_path: Path, lines: NDArray[np.uint16]) -> None:
    """A folder named like a part and other pipes are ignored; a pipe as index, which is read, or header is refused."""
    write_part(tmp_path, "raw_0", lines[:5])
    (tmp_path / "raw_5").mkdir()
    os.mkfifo(tmp_path / "frameIndex.txt")
    assert open_cube_source(tmp_path).shape[0] == 5
    os.mkfifo(tmp_path / "frameIndex_0.txt")
    with pytest.raises(SceneError, match=r"frameIndex_0\.txt is no file"):
        open_cube_source(tmp_path)
    os.mkfifo(tmp_path / "pipe.hdr")
    (tmp_path / "pipe").touch()
    with pytest.raises(SceneError, match="is no file; move it elsewhere"):
        open_cube_source(tmp_path / "pipe.hdr")


def _index(folder: Path, text: str) -> Path:
    path = folder / "frameIndex_0.txt"
    path.write_bytes(text.encode())
    return path


@pytest.mark.parametrize("text", ["", "Frame#\tTimestamp\n", "\0\0\0"])
def test_an_empty_frame_index_is_refused(tmp_path: Path, text: str) -> None:
    """A missing index is refused as well."""
    with pytest.raises(SceneError, match=r"lists no frame, expected lines of number and microseconds"):
        load_frame_index(_index(tmp_path, text))
    with pytest.raises(SceneError, match="cannot be read"):
        load_frame_index(tmp_path / "none.txt")


@pytest.mark.parametrize(
    ("frames", "first", "lost", "found", "notes"),
    [
        (
            # by number: lines count from the part's first frame; a gap of the index has no time
            {2000: 10, 2001: 20, 2003: 40, 2009: 99},
            (2000, 5),
            0,
            [2000, 2001, -1, 2003, -1],
            ("the frame index has the time of 3 of 5 lines", "the frame index lists 1 frames beyond the lines"),
        ),
        # as many frames as lines: they are the lines, whatever their numbers
        ({0: 10, 1: 20, 3: 40}, (0, 3), 0, [0, 1, 3], (DROPPED,)),
        # the index of a later part may count from the part's own start
        ({0: 10, 1: 20}, (2000, 3), 0, [2000, 2001, -1], ("the frame index has the time of 2 of 3 lines",)),
        ({0: 10, 1: 20, 2: 30}, (2000, 3), 0, [2000, 2001, 2002], ()),
        # a file that lost its last line still has its lines in order, also with dropped frames
        ({0: 10, 1: 20, 3: 40, 4: 50}, (0, 3), 1, [0, 1, 3], (DROPPED,)),
    ],
)
def test_lines_have_the_times_of_their_frames(
    tmp_path: Path, frames: dict[int, int], first: tuple[int, int], lost: int, found: list[int], notes: tuple[str, ...]
) -> None:
    """With dropped frames and lost lines, each line has the time of its own frame, or none."""
    index = load_frame_index(_index(tmp_path, "f t\n" + "".join(f"{frame} {at}\n" for frame, at in frames.items())))
    times = times_of_lines(index, *first, lost=lost)
    own = first[0] if 0 in frames else 0
    assert times.stamp_us.tolist() == [frames.get(frame - own, -1) for frame in found]
    assert (times.frame.tolist(), times.notes) == (found, notes)
