"""Files of a capture become the lines that were written, with missing lines counted; references are exact means."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from spectralzoom.pipeline.errors import RigError, ShapeError
from spectralzoom.pipeline.exposures import Taken
from spectralzoom.pipeline.rig.camera.camera_cubes import (
    as_references,
    mean_frame,
    parse_cube,
    read_capture,
    read_references,
)

HEADER = (
    "ENVI\n; a comment\ninterleave = bil\ndata type = 12\nlines = {lines}\nsamples = 5\nbands = 3\nbyte order = 0\n"
    "header offset = 0\nwavelength = {{\n400.5,\n500,\n600\n}}\n"
)


def numbers(lines: int, first: int = 0) -> NDArray[np.uint16]:
    """Return lines (line, sample, band) of distinct numbers."""
    return (np.arange(lines * 15) + first * 15).reshape(lines, 5, 3).astype(np.uint16)


def bil(values: NDArray[np.uint16]) -> bytes:
    """Return their bytes, interleaved by line (BIL)."""
    return values.transpose(0, 2, 1).astype("<u2").tobytes()


def folder(**files: bytes) -> tuple[list[str], Callable[[str], bytes]]:
    """Return names and a reader of files; "__" in a name becomes a dot, and a folder is prefixed."""
    content = {f"/c/{name.replace('__', '.')}": data for name, data in files.items()}
    return list(content), content.__getitem__


def header(lines: int) -> bytes:
    """Return a header as the camera writes it, in bytes."""
    return HEADER.format(lines=lines).encode()


def test_header_of_a_cube_is_parsed() -> None:
    """Sizes, byte order and offset are read, and bands are interleaved by line."""
    values = parse_cube(HEADER.format(lines=1).replace("\n", "\r\n"), bytes(range(30)), "raw_0.hdr").values
    assert values.shape == (1, 5, 3)
    assert values[0, 1, 0] == 0x0302
    assert values[0, 0, 1] == 0x0B0A


def test_big_endian_cubes_with_an_offset_are_read() -> None:
    """The reader applies the header's byte order and offset."""
    text = HEADER.format(lines=2).replace("byte order = 0", "byte order = 1").replace("offset = 0", "offset = 7")
    data = b"7 bytes" + numbers(2).transpose(0, 2, 1).astype(">u2").tobytes()
    np.testing.assert_array_equal(parse_cube(text, data, "h").values, numbers(2))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("ENVI", "EVNI", "begins with 'EVNI"),
        ("bil", "bsq", "expected bil and u2"),
        ("type = 12", "type = 4", "expected bil and u2"),
        ("samples = 5\n", "", "does not say samples"),
        ("\n}\n", "\n", "never closed; .* fetch it again"),
    ],
)
def test_headers_of_other_formats_are_refused(old: str, new: str, words: str) -> None:
    """Any format other than 16-bit BIL is refused with the offending text."""
    with pytest.raises(RigError, match=words):
        parse_cube(HEADER.format(lines=1).replace(old, new), b"", "raw_0.hdr")


def test_times_come_from_the_frame_index() -> None:
    """A frame that is listed twice counts once, and a missing one has the time -1."""
    names, read = folder(
        raw_4=bil(numbers(4)),
        raw_4__hdr=header(4),
        frameIndex_4__txt=b"Frame\tTime\r\n4\t100\r\n5\t110\r\n5\t115\r\n7\t130\r\n",
        imu_gps__txt=b"Roll\n",
    )
    found = read_capture(names, read)
    np.testing.assert_array_equal(found.values, numbers(4))
    assert found.first_frame == 4
    assert found.times.frame.tolist() == [4, 5, -1, 7]
    assert found.times.stamp_us.tolist() == [100, 110, -1, 130]
    assert "frameIndex_4.txt: 1 frames are listed twice, the first counts" in found.notes


def test_a_truncated_cube_gives_its_whole_lines() -> None:
    """A cube that ends within a line returns the whole lines, the number of lost ones, and a note."""
    names, read = folder(raw_0=bil(numbers(4))[:-40], raw_0__hdr=header(4))
    found = read_capture(names, read)
    np.testing.assert_array_equal(found.values, numbers(2))
    assert found.times.frame.tolist() == [-1, -1]
    assert found.notes == ("raw_0 is cut off: 2 of 4 lines are whole", "there is no frame index for raw_0")


@pytest.mark.parametrize(
    ("files", "words"),
    [
        ({}, "one cube with a whole line, got an empty folder"),
        ({"raw_0": b"", "raw_0__hdr": header(0)}, "one cube with a whole line, got raw_0, raw_0.hdr"),
        ({"raw_0": b"", "raw_5": b""}, "one cube with a whole line, got raw_0, raw_5"),
        ({"raw_0": bil(numbers(1))}, "has no header raw_0.hdr"),
        ({"raw_0": bil(numbers(2)), "raw_0__hdr": header(1)}, "states 30 bytes of data, there are 60"),
    ],
)
def test_incomplete_captures_are_refused(files: dict[str, bytes], words: str) -> None:
    """The message names the missing or contradicting file."""
    with pytest.raises(RigError, match=words):
        read_capture(*folder(**files))


def test_references_are_found_in_a_folder() -> None:
    """Dark and white cubes are recognised by the beginning of their names. Two of a kind are refused."""
    names, read = folder(darkReference=bil(numbers(2)), darkReference__hdr=header(2))
    assert list(read_references(names, read)) == ["dark"]
    np.testing.assert_array_equal(read_references(names, read)["dark"].mean, numbers(2).mean(axis=0))
    names, read = folder(dark=b"", dark__hdr=header(0))
    with pytest.raises(RigError, match="holds 0 whole frames, its header says 0; take both references again"):
        read_references(names, read)
    names, read = folder(dark=bil(numbers(1)), dark__hdr=header(1), darkRef=bil(numbers(1)), darkRef__hdr=header(1))
    with pytest.raises(RigError, match="two dark references"):
        read_references(names, read)


def frames(level: float, count: int = 40, shape: tuple[int, int] = (40, 10)) -> np.ndarray:
    """Return noisy frames (frame, sample, band) around a level."""
    return np.clip(np.rint(np.random.default_rng(3).normal(level, 4, (count, *shape))), 0, 4095).astype(np.uint16)


def test_mean_frame_is_exact() -> None:
    """The mean equals that of float64 over all frames, in any order of frames."""
    taken = frames(200, 200)
    np.testing.assert_array_equal(mean_frame(taken).mean, taken.mean(axis=0).astype(np.float32))
    np.testing.assert_array_equal(mean_frame(taken[::-1]).mean, mean_frame(taken).mean)


def test_stuck_and_dead_pixels_are_found() -> None:
    """An element that never changes and one that hardly responds are marked as bad."""
    dark, white = frames(64), frames(3000)
    dark[:, 3, 4] = 70
    white[:, 20, 5] = 66
    references, _ = as_references(mean_frame(dark), mean_frame(white), white_reference=0.5)
    assert references.bad is not None
    assert np.argwhere(references.bad).tolist() == [[3, 4], [20, 5]]
    assert references.white_reference.tolist() == [0.5] * 10


def test_references_of_another_exposure_are_scaled() -> None:
    """The camera copies frames that its own program took; a dark frame that cannot be scaled is refused."""
    dark, white = (mean_frame(np.full((1, 8, 10), level, np.uint16)) for level in (60, 1560))
    stated = replace(white, taken=Taken("the white frame", {"": 5.0}))
    for one, exposure_ms, found in ((white, 10.0, None), (stated, 5.0, None), (stated, 10.0, 5.0)):
        references, notes = as_references(dark, one, exposure_ms=exposure_ms)
        assert (references.exposure_ms, len(notes)) == (found, int(found is not None))
    with pytest.raises(RigError, match=r"dark frame was taken with 1 ms, .* take both again"):
        as_references(replace(dark, taken=Taken("the dark frame", {"": 1.0})), stated, exposure_ms=5.0)


def test_references_that_do_not_fit_are_refused() -> None:
    """Swapped frames and two sizes are refused. A single frame shows no stuck elements."""
    dark, white = mean_frame(frames(64)), mean_frame(frames(3000))
    with pytest.raises(RigError, match=r"white frame is not brighter than the dark one .*; take both again"):
        as_references(white, dark)
    with pytest.raises(RigError, match="take both anew"):
        as_references(dark, mean_frame(frames(3000, shape=(40, 9))))
    with pytest.raises(ShapeError, match="at least one frame"):
        mean_frame(np.zeros((0, 2, 3), np.uint16))
    assert not mean_frame(frames(64, 1)).stuck.any()


def test_stuck_elements_need_eight_frames() -> None:
    """An element may have the same number in seven frames by chance, but not in eight."""
    dark = frames(64, 8)
    dark[:, 3, 4] = 70
    assert not mean_frame(dark[:7]).stuck.any()
    assert mean_frame(dark).stuck[3, 4]
