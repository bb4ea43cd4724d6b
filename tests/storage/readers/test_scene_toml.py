"""What stands in scene.toml is used, the flags win over it, and mistakes in it are named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.errors import SceneError, WavelengthError
from storage.readers.scene_files import load_scene_file


def _scene(folder: Path, cube: NDArray[np.uint16], toml: str) -> Path:
    np.save(folder / "a.npy", cube)
    (folder / "scene.toml").write_text(toml)
    return folder / "a.npy"


def test_bands_and_wavelengths_of_the_file(tmp_path: Path, cube: NDArray[np.uint16]) -> None:
    """Bands are counted from 0 and the wavelengths belong to them."""
    scene = load_scene_file(_scene(tmp_path, cube, "bands = [4, 1]\nwavelengths_nm = [800.0, 500.0]"))
    np.testing.assert_array_equal(scene.values, cube[..., [4, 1]])
    assert scene.wavelength_nm.tolist() == [800, 500]


def test_a_flag_for_bands_keeps_their_wavelengths(tmp_path: Path, cube: NDArray[np.uint16]) -> None:
    """--bands picks from the wavelengths stated; a band without one is refused."""
    path = _scene(tmp_path, cube, "bands = [4, 1]\nwavelengths_nm = [800.0, 500.0]")
    assert load_scene_file(path, bands=[1]).wavelength_nm.tolist() == [500]
    with pytest.raises(WavelengthError, match="nothing for band 2"):
        load_scene_file(path, bands=[1, 2])
    assert load_scene_file(path, bands=[2], wavelengths=[700]).wavelength_nm.tolist() == [700]


def test_wavelengths_file_less_dropped_rows(tmp_path: Path, cube: NDArray[np.uint16]) -> None:
    """Rows are counted from 1, headings passed over, widths kept, order kept."""
    (tmp_path / "w.txt").write_text("instrument\n----\n900 10\n500, 9, x\n1 1\n400 8\n600 7\n700 6\n")
    scene = load_scene_file(_scene(tmp_path, cube, 'wavelengths_file = "w.txt"\ndropped_bands = [3]'))
    assert scene.wavelength_nm.tolist() == [900, 500, 400, 600, 700]
    assert scene.fwhm_nm is not None
    assert scene.fwhm_nm.tolist() == [10, 9, 8, 7, 6]


@pytest.mark.parametrize(
    ("toml", "words"),
    [
        ("colour = 1", "unknown key colour; known are bands"),
        ("bands = [", "cannot be read as TOML"),
        ("bands = [1.5]", "list of whole numbers"),
        ("wavelengths_nm = 5", "list of numbers"),
        ("labels = 3", "file name in quotes"),
        ('nodata = "none"', "nodata must be a number such as -9999 or 1e30, got 'none'"),
        ("nodata = true", "nodata must be a number"),
        ("[classes]\na = 1\nb = [1, 2, 3]", "one kind"),
        ("[classes]\na = 1\nb = 1", "same number or colour"),
        ("[classes]\na = [1, 2, 300]", r"colour \[r, g, b\]"),
        ('wavelengths_nm = [500]\nwavelengths_file = "w.txt"', "keep one"),
        ('wavelengths_file = "none.txt"', r"none\.txt cannot be read"),
    ],
)
def test_mistakes_are_named(tmp_path: Path, cube: NDArray[np.uint16], toml: str, words: str) -> None:
    """Unknown keys and wrong values are refused with the key's name."""
    with pytest.raises(SceneError, match=words):
        load_scene_file(_scene(tmp_path, cube, toml))


def test_dropped_rows_must_leave_one_a_band(tmp_path: Path, cube: NDArray[np.uint16]) -> None:
    """Too many or impossible dropped rows are counted out."""
    (tmp_path / "w.txt").write_text("500 9\n600 9\n")
    for dropped, words in (
        ("[1]", r"2 rows, 1 of them dropped, which leaves 1 wavelengths for 5"),
        ("[3]", r"rows 1\.\.2"),
    ):
        with pytest.raises(WavelengthError, match=words):
            load_scene_file(_scene(tmp_path, cube, f'wavelengths_file = "w.txt"\ndropped_bands = {dropped}'))


def test_no_data_as_stated(tmp_path: Path, cube: NDArray[np.uint16]) -> None:
    """The number of scene.toml becomes NaN; one that whole numbers cannot hold is in no pixel."""
    cube[1, 2, 3] = 7
    nm = "wavelengths_nm = [400, 500, 600, 700, 800]\n"
    scene = load_scene_file(_scene(tmp_path, cube, nm + "nodata = 7"))
    np.testing.assert_array_equal(np.isnan(scene.values), cube == 7)
    assert not np.isnan(load_scene_file(_scene(tmp_path, cube, nm + "nodata = -9999")).values).any()
