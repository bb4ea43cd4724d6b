"""ENVI cubes of every interleave, type and byte order are the same view; damaged ones say what is left."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.errors import SceneError
from storage.readers.envi_cubes import open_envi_cube

CODES = {"u1": 1, "i2": 2, "i4": 3, "f4": 4, "f8": 5, "c8": 6, "c16": 9, "u2": 12, "u4": 13, "i8": 14, "u8": 15}
AXES = {"bil": (0, 2, 1), "bip": (0, 1, 2), "bsq": (2, 0, 1)}


def write_envi(path: Path, values: NDArray[Any], interleave: str = "bil", *, offset: int = 0, order: int = 0) -> Path:
    """Write (line, sample, band) values and their header beside them; give the data file's path."""
    lines, samples, bands = values.shape
    code = CODES[values.dtype.str[1:]]
    path.with_suffix(".hdr").write_text(
        f"ENVI\nsamples = {samples}\nlines = {lines}\nbands = {bands}\nheader offset = {offset}\n"
        f"data type = {code}\ninterleave = {interleave}\nbyte order = {order}\n"
    )
    stored = values.transpose(AXES[interleave]).astype(values.dtype.newbyteorder("<>"[order]))
    path.write_bytes(b"x" * offset + stored.tobytes())
    return path


@pytest.mark.parametrize("kind", sorted(CODES))
@pytest.mark.parametrize("interleave", sorted(AXES))
def test_any_type_and_interleave(tmp_path: Path, kind: str, interleave: str) -> None:
    """The view is (line, sample, band) whatever the file's order, and a big endian file gives the same numbers."""
    values = np.random.default_rng(1).integers(0, 200, (5, 4, 3)).astype(kind)
    for order, offset in ((0, 0), (1, 0), (0, 13)):
        path = write_envi(tmp_path / f"{order}{offset}.dat", values, interleave, order=order, offset=offset)
        cube = open_envi_cube(path)
        np.testing.assert_array_equal(cube.values, values)
        assert (cube.lost_lines, cube.notes) == (0, ())


def test_lazy_and_read_only(tmp_path: Path) -> None:
    """The view is the file itself: a change in the file shows, a change of the view is refused."""
    path = write_envi(tmp_path / "a.raw", np.zeros((4, 3, 2), "u2"))
    values = open_envi_cube(path.with_suffix(".hdr")).values
    with path.open("r+b") as file:
        file.write(b"\x07\x00")
    assert values[0, 0, 0] == 7
    with pytest.raises(ValueError, match="read-only"):
        values[0, 0, 0] = 1


@pytest.mark.parametrize("interleave", sorted(AXES))
def test_truncated_file_keeps_whole_lines(tmp_path: Path, interleave: str) -> None:
    """A file that is cut off gives the lines that are whole in all bands, and says how many are lost."""
    values = np.arange(120, dtype="u2").reshape(10, 4, 3)
    path = write_envi(tmp_path / "a.img", values, interleave, offset=6)
    content = path.read_bytes()
    path.write_bytes(content[:-17])
    cube = open_envi_cube(path)
    kept = {"bil": 9, "bip": 9, "bsq": 7}[interleave]
    assert cube.values.shape == (kept, 4, 3)
    assert cube.lost_lines == 10 - kept
    assert cube.notes == (f"a.img is cut off: {kept} of 10 lines are whole",)
    np.testing.assert_array_equal(cube.values, values[:kept])


@pytest.mark.parametrize("interleave", sorted(AXES))
@pytest.mark.parametrize("size", [0, 5, 20])
def test_no_whole_line_is_refused(tmp_path: Path, interleave: str, size: int) -> None:
    """Where no line is whole there is nothing to give; an empty file too."""
    path = write_envi(tmp_path / "a", np.ones((10, 4, 3), "u2"), interleave)
    path.write_bytes(path.read_bytes()[:size])
    with pytest.raises(SceneError, match=f"holds {size} bytes after an offset of 0, no whole line"):
        open_envi_cube(path)


@pytest.mark.parametrize("interleave", sorted(AXES))
def test_lines_not_said(tmp_path: Path, interleave: str) -> None:
    """Without lines in the header the file's size says how many there are."""
    values = np.arange(60, dtype="f4").reshape(5, 4, 3)
    path = write_envi(tmp_path / "a.bin", values, interleave)
    header = path.with_suffix(".hdr")
    header.write_text(header.read_text().replace("lines = 5\n", ""))
    cube = open_envi_cube(header)
    np.testing.assert_array_equal(cube.values, values)
    assert "the file holds 5" in cube.notes[0]


def test_more_bytes_than_said(tmp_path: Path) -> None:
    """Bytes after the last line are left alone and noted."""
    path = write_envi(tmp_path / "a.dat", np.ones((2, 2, 2), "u1"))
    path.write_bytes(path.read_bytes() + b"tail")
    cube = open_envi_cube(path)
    assert cube.values.shape == (2, 2, 2)
    assert cube.notes == ("a.dat holds 4 bytes more than its header says",)


def test_names_of_the_pair(tmp_path: Path) -> None:
    """Header and data find each other by either name; a missing one is named."""
    path = write_envi(tmp_path / "scene.bip", np.ones((2, 2, 2), "u1"), "bip")
    (tmp_path / "scene.hdr").rename(tmp_path / "scene.bip.hdr")
    assert open_envi_cube(path).path == path
    assert open_envi_cube(tmp_path / "scene.bip.hdr").path == path
    with pytest.raises(SceneError, match=r"no header beside .*lonely\.dat"):
        open_envi_cube(_touched(tmp_path / "lonely.dat"))
    with pytest.raises(SceneError, match=r"no data file beside .*alone\.hdr"):
        open_envi_cube(_touched(tmp_path / "alone.hdr"))
    with pytest.raises(SceneError, match=r"there is no file .*none\.dat"):
        open_envi_cube(tmp_path / "none.dat")


def _touched(path: Path) -> Path:
    path.touch()
    return path


def test_spectral_library_is_no_cube(tmp_path: Path) -> None:
    """A library of spectra has neither lines nor bands."""
    path = write_envi(tmp_path / "a.dat", np.ones((2, 2, 1), "f4"), "bsq")
    header = path.with_suffix(".hdr")
    header.write_text(header.read_text() + "file type = ENVI Spectral Library\n")
    with pytest.raises(SceneError, match="spectral library, expected a cube"):
        open_envi_cube(path)


def test_raw_frames_of_a_spaceborne_imager(real_data: Path) -> None:
    """Three raw lines of 1280 samples and 328 bands open by their data file, which has no ending."""
    cube = open_envi_cube(real_data / "emit_raw" / "emit20220305t002444_subset_raw")
    assert cube.values.shape == (3, 1280, 328)
    assert cube.values.dtype == np.dtype("<i2")
    flat = np.fromfile(cube.path, "<i2").reshape(3, 328, 1280)
    np.testing.assert_array_equal(cube.values[1], flat[1].T)
