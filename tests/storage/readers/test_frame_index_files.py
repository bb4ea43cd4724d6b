"""Frame indices are read in every layout, and lines get the times of their own frames."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from pipeline.errors import SceneError
from pipeline.rig.camera.camera_texts import times_of_lines
from storage.readers.headwall_folders import load_frame_index


def _index(folder: Path, text: str) -> Path:
    path = folder / "frameIndex_0.txt"
    path.write_bytes(text.encode())
    return path


@pytest.mark.parametrize("between", ["\t", " ", "  ", ","])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_layouts(tmp_path: Path, between: str, end: str) -> None:
    """A tab or spaces between number and time, Unix and Windows line ends, with and without a last one."""
    lines = [between.join(words) for words in (("Frame#", "Timestamp"), ("0", "1500000"), ("1", "1510000"))]
    for text in (end.join(lines), end.join(lines) + end, "\ufeff" + end.join(lines)):
        index = load_frame_index(_index(tmp_path, text))
        assert index.frame.tolist() == [0, 1]
        assert index.stamp_us.tolist() == [1500000, 1510000]
        assert index.notes == ()


def test_without_a_heading(tmp_path: Path) -> None:
    """The first line may be a frame already."""
    assert load_frame_index(_index(tmp_path, "5 10\n6 20\n")).frame.tolist() == [5, 6]


def test_what_is_no_frame_is_counted(tmp_path: Path) -> None:
    """Torn lines, words and numbers beyond all measure are passed over; of a frame twice the first counts."""
    text = "Frame\tTime\n0\t10\n1\t\n2\tx\n1\t30\n1\t40\n99999999999999999999\t5\n3\t20\n"
    index = load_frame_index(_index(tmp_path, text))
    assert (index.frame.tolist(), index.stamp_us.tolist()) == ([0, 1, 3], [10, 30, 20])
    assert index.notes == (
        "frameIndex_0.txt: 3 lines are no frames",
        "frameIndex_0.txt: 1 frames are listed twice, the first counts",
        "frameIndex_0.txt: time goes back 1 times",
    )


def test_exposure_column(tmp_path: Path) -> None:
    """A column that the heading calls exposure is read; where it says nothing there is none."""
    index = load_frame_index(_index(tmp_path, "Frame#\tTimestamp\tExposure (ms)\n0\t10\t4.5\n1\t20\n"))
    assert index.exposure_ms is not None
    np.testing.assert_array_equal(index.exposure_ms, [4.5, np.nan])


@pytest.mark.parametrize("text", ["", "Frame#\tTimestamp\n", "\0\0\0"])
def test_no_frame_at_all(tmp_path: Path, text: str) -> None:
    """A file that lists no frame is refused; so is one that is not there."""
    with pytest.raises(SceneError, match=r"lists no frame, expected lines of number and microseconds"):
        load_frame_index(_index(tmp_path, text))
    with pytest.raises(SceneError, match="cannot be read"):
        load_frame_index(tmp_path / "none.txt")


def test_times_by_number(tmp_path: Path) -> None:
    """A line's frame is the part's first and so on; where the index has a gap nothing is known."""
    index = load_frame_index(_index(tmp_path, "f t\n2000 10\n2001 20\n2003 40\n2009 99\n"))
    times = times_of_lines(index, 2000, 5)
    assert times.frame.tolist() == [2000, 2001, -1, 2003, -1]
    assert times.stamp_us.tolist() == [10, 20, -1, 40, -1]
    assert times.notes == (
        "the frame index tells the time of 3 of 5 lines",
        "the frame index lists 1 frames beyond the lines",
    )


def test_frames_dropped_by_the_camera(tmp_path: Path) -> None:
    """As many frames as lines are the lines, whatever their numbers."""
    index = load_frame_index(_index(tmp_path, "f t\n0 10\n1 20\n3 40\n"))
    times = times_of_lines(index, 0, 3)
    assert times.frame.tolist() == [0, 1, 3]
    assert times.notes == ("1 frames between the first and the last were dropped by the camera",)


def test_numbers_that_begin_anew(tmp_path: Path) -> None:
    """An index of a later part that counts from 0 counts from the part's own start."""
    index = load_frame_index(_index(tmp_path, "f t\n0 10\n1 20\n"))
    assert times_of_lines(index, 2000, 3).stamp_us.tolist() == [10, 20, -1]


def test_a_file_that_lost_its_last_lines(tmp_path: Path) -> None:
    """The index of a file that was whole still tells its lines in order, where frames had been dropped before."""
    index = load_frame_index(_index(tmp_path, "f t\n0 10\n1 20\n3 40\n4 50\n"))
    times = times_of_lines(index, 0, 3, lost=1)
    assert times.frame.tolist() == [0, 1, 3]
    assert times.stamp_us.tolist() == [10, 20, 40]


@pytest.mark.parametrize(
    ("heading", "ms"),
    [
        ("Frame Number\tTime Stamp\tExposure (ms)\tGain", 4.5),
        ("Frame#, Time, Exposure (us), Gain", 0.0045),
        ("frame  time  exposure [s]  gain", 4500),
        ("frame time exposure gain", 4.5),
    ],
)
def test_titles_of_several_words(tmp_path: Path, heading: str, ms: float) -> None:
    """Spaces within a title do not shift the columns, and the title's unit counts."""
    between = "\t" if "\t" in heading else "," if "," in heading else " "
    index = load_frame_index(_index(tmp_path, f"{heading}\n" + between.join(("0", "10", "4.5", "7", "8")) + "\n"))
    assert index.exposure_ms is not None
    np.testing.assert_allclose(index.exposure_ms, [ms])


def test_a_long_index_takes_little_memory(tmp_path: Path) -> None:
    """Reading an index takes a few times the bytes of its file, not what lists of its words would."""
    path = _index(tmp_path, "f\tt\n" + "".join(f"{n}\t{1600000000000000 + 40000 * n}\n" for n in range(50_000)))
    tracemalloc.start()
    assert len(load_frame_index(path).frame) == 50_000
    assert tracemalloc.get_traced_memory()[1] < 4 * path.stat().st_size
    tracemalloc.stop()
