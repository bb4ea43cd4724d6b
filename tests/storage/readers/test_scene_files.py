"""Scene files of every kind give the same arrays, and unusable files are refused with the reason."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import scipy.io
import tifffile
from numpy.typing import NDArray
from PIL import Image

from spectralzoom.pipeline.errors import SceneError, WavelengthError
from spectralzoom.storage.readers.image_files import ALPHA_NOTE
from spectralzoom.storage.readers.scene_files import load_scene_file

NM = [450.0, 550.0, 650.0, 800.0, 900.0]


def _save(path: Path, values: NDArray[Any]) -> Path:
    """Write a cube in the format of the file's ending."""
    if path.suffix == ".npy":
        np.save(path, values)
    elif path.suffix == ".mat":
        scipy.io.savemat(path, {"cube": values, "count": 3})
    else:
        tifffile.imwrite(path, values, photometric="minisblack", planarconfig="contig")
    return path


def test_matlab_doubles_stored_as_bytes_are_read(tmp_path: Path) -> None:
    """MATLAB stores whole doubles in fewer bytes; complex numbers are refused."""
    values = np.arange(60, dtype=np.uint8).reshape(4, 5, 3)
    path = _save(tmp_path / "a.mat", values)
    content = bytearray(path.read_bytes())
    content[144] = 6  # the class of the array: double in place of uint8
    path.write_bytes(content)
    np.testing.assert_array_equal(load_scene_file(path, wavelengths=NM[:3]).values, values)
    with pytest.raises(SceneError, match="holds complex numbers"):
        load_scene_file(_save(tmp_path / "b.mat", values * 1j), wavelengths=NM[:3])


def test_bands_and_wavelengths_follow_the_arguments(tmp_path: Path, cube: NDArray[np.uint16]) -> None:
    """Wavelengths are given for the chosen bands or for all; the order is kept."""
    path = _save(tmp_path / "a.npy", cube)
    for stated in ([800.0, 450.0], NM):
        scene = load_scene_file(path, bands=[3, 0], wavelengths=stated)
        np.testing.assert_array_equal(scene.values, cube[..., [3, 0]])
        assert scene.wavelength_nm.tolist() == [800.0, 450.0]


@pytest.mark.parametrize(
    ("mode", "bands", "nm"),
    [("L", 1, [550]), ("LA", 1, [550]), ("RGB", 3, [640, 550, 460]), ("RGBA", 3, [640, 550, 460])],
)
def test_images_have_assumed_wavelengths(tmp_path: Path, mode: str, bands: int, nm: list[float]) -> None:
    """Grey and colour images get usual wavelengths, and alpha is dropped; notes say both."""
    Image.new(mode, (6, 4), 77).save(tmp_path / "a.png")
    scene = load_scene_file(tmp_path / "a.png")
    assert scene.values.shape == (4, 6, bands)
    assert scene.wavelength_nm.tolist() == nm
    assert any("assumed" in note for note in scene.provenance)
    assert (ALPHA_NOTE in scene.provenance) == mode.endswith("A")


def test_a_fourth_geotiff_band_is_near_infrared(tmp_path: Path) -> None:
    """A band that the file calls alpha is a mask."""
    values = np.random.default_rng(0).integers(0, 255, (4, 5, 4), dtype=np.uint8)
    tifffile.imwrite(tmp_path / "n.tif", values, photometric="rgb", extrasamples=["unspecified"])
    assert load_scene_file(tmp_path / "n.tif").wavelength_nm.tolist() == [640, 550, 460, 800]
    values[..., 3] = np.where(values[..., 3] > 99, 255, 0)
    tifffile.imwrite(tmp_path / "m.tif", values, photometric="rgb", extrasamples=["unassalpha"])
    assert load_scene_file(tmp_path / "m.tif").wavelength_nm.tolist() == [640, 550, 460]
    tifffile.imwrite(tmp_path / "p.tif", np.moveaxis(values, -1, 0), photometric="minisblack", planarconfig="separate")
    np.testing.assert_array_equal(load_scene_file(tmp_path / "p.tif", wavelengths=NM[:4]).values, values)


@pytest.mark.parametrize(
    ("stated", "words"),
    [
        ([0.45, 0.55, 0.65, 0.8, 0.9], "look like micrometres; write them in nm: 450"),
        ([450.0, 550.0], "expected 5 wavelengths, one a band, got 2"),
        ([450.0, 550, 650, 800, 9000], "9000 lie outside 200-3000 nm"),
        ([450.0, 550, 650, 800, float("nan")], "must be numbers"),
        (None, "5 bands and nothing says their wavelengths; write wavelengths_nm"),
    ],
)
def test_wrong_wavelengths(tmp_path: Path, cube: NDArray[np.uint16], stated: list[float] | None, words: str) -> None:
    """Micrometres, a wrong count, a wrong range and no wavelengths each have their own message."""
    with pytest.raises(WavelengthError, match=words):
        load_scene_file(_save(tmp_path / "a.npy", cube), wavelengths=stated)


def test_a_nodata_value_beyond_the_number_type_is_ignored(tmp_path: Path) -> None:
    """-9999 stated for 16-bit numbers is not 55537, to which it would wrap; 7 marks the sevens."""
    values = np.array([[1, 55537], [7, 7]], np.uint16)
    for stated, missing in (("-9999", 0), ("7", 2)):
        tifffile.imwrite(tmp_path / "a.tif", values, extratags=[(42113, "s", 0, stated, True)])
        assert np.isnan(load_scene_file(tmp_path / "a.tif", wavelengths=[500.0]).values).sum() == missing


def test_a_pixel_without_most_of_its_bands_is_missing(tmp_path: Path) -> None:
    """With half of its bands a pixel still counts."""
    values = np.ones((1, 3, 4), np.float32)
    values[0, 1, :2], values[0, 2, :3] = np.nan, np.nan
    np.save(tmp_path / "a.npy", values)
    scene = load_scene_file(tmp_path / "a.npy", wavelengths=[450.0, 550, 650, 800])
    assert scene.missing.tolist() == [[False, False, True]]
    assert scene.filled_px == 2


def test_scene_hash_depends_on_content_and_bands(tmp_path: Path, cube: NDArray[np.uint16]) -> None:
    """The hash does not depend on the file's location and labels."""
    one, two = _save(tmp_path / "a.npy", cube), _save(tmp_path / "b.npy", cube)
    np.save(tmp_path / "labels.npy", np.ones((7, 9), int))
    plain = load_scene_file(one, wavelengths=NM)
    labelled = load_scene_file(one, wavelengths=NM, labels=tmp_path / "labels.npy")
    assert plain.light_hash == labelled.light_hash == load_scene_file(two, wavelengths=NM).light_hash
    assert plain.light_hash != load_scene_file(one, wavelengths=NM, bands=[0, 1]).light_hash


ENVI = "ENVI\nsamples = 9\nlines = 7\nbands = 5\ndata type = 12\ninterleave = bip\nbyte order = 0\n"
ENVI_NM = "wavelength units = um\nwavelength = {0.45, 0.55, 0.65, 0.8, 0.9}\nfwhm = {0.01, 0.01, 0.01, 0.02, 0.02}\n"


@pytest.mark.parametrize("name", ["a.hdr", "a.img"])
def test_envi_scenes_are_read(tmp_path: Path, cube: NDArray[np.uint16], name: str) -> None:
    """The header or the data file may be given; wavelengths in micrometres become nm."""
    (tmp_path / "a.hdr").write_text(ENVI + ENVI_NM)
    (tmp_path / "a.img").write_bytes(cube.tobytes())
    scene = load_scene_file(tmp_path / name)
    np.testing.assert_array_equal(scene.values, cube)
    np.testing.assert_allclose(scene.wavelength_nm, NM)
    np.testing.assert_allclose(scene.fwhm_nm, [10, 10, 10, 20, 20])
    assert load_scene_file(tmp_path / name, bands=[1], wavelengths=[560]).wavelength_nm.tolist() == [560]


def test_truncated_envi_scenes_have_nan_lines(tmp_path: Path, cube: NDArray[np.uint16]) -> None:
    """The lines that the file lacks are NaN, and a note counts the whole lines."""
    (tmp_path / "a.hdr").write_text(ENVI)
    (tmp_path / "a.img").write_bytes(cube.tobytes()[:-100])
    scene = load_scene_file(tmp_path / "a.hdr", wavelengths=NM)
    np.testing.assert_array_equal(scene.values[:5], cube[:5])
    assert np.isnan(scene.values[5:]).all()
    assert "a.img is cut off: 5 of 7 lines are whole" in scene.provenance


def test_headwall_scenes_are_divided_by_the_white_reference(tmp_path: Path) -> None:
    """With dark and white frames beside its parts a folder gives reflectance, without them raw numbers."""
    shown = np.random.default_rng(5).uniform(0.1, 0.9, (6, 40, 5))
    raw = np.rint(100 + shown * 1000).astype(np.uint16)
    head = ENVI.replace("9", "40").replace("bip", "bil")
    frames = {"raw_0": raw[:4], "raw_4": raw[4:], "darkReference": np.full((2, 40, 5), 100, np.uint16)}
    frames["whiteReference"] = np.full((1, 40, 5), 1100, np.uint16)
    for name, values in frames.items():
        (tmp_path / name).write_bytes(values.transpose(0, 2, 1).tobytes())
        (tmp_path / f"{name}.hdr").write_text(head.replace("lines = 7", f"lines = {len(values)}") + ENVI_NM)
    scene = load_scene_file(tmp_path)
    np.testing.assert_allclose(scene.values, shown, atol=1e-3)
    assert "values are over the white reference" in scene.provenance
    before = scene.light_hash
    (tmp_path / "whiteReference.hdr").unlink()
    plain = load_scene_file(tmp_path)
    np.testing.assert_array_equal(plain.values, raw)
    assert plain.light_hash != before


def test_links_in_a_mat_file_are_not_followed(tmp_path: Path, cube: NDArray[np.uint16]) -> None:
    """A MATLAB 7.3 file cannot include other files by link, external storage or virtual data set."""
    secret = tmp_path / "secret73.mat"
    with h5py.File(secret, "w", userblock_size=512) as file:
        file["cube"] = cube
    (tmp_path / "raw.bin").write_bytes(cube.tobytes())
    layout = h5py.VirtualLayout(cube.shape, cube.dtype)
    layout[:] = h5py.VirtualSource(secret, "cube", shape=cube.shape)
    with h5py.File(tmp_path / "a73.mat", "w", userblock_size=512) as file:
        file["link"] = h5py.ExternalLink("secret73.mat", "/cube")
        file["soft"] = h5py.SoftLink("/link")
        file.create_dataset("outside", cube.shape, cube.dtype, external=[("raw.bin", 0, cube.nbytes)])
        file.create_virtual_dataset("virtual", layout)
    with pytest.raises(SceneError, match=r"link is a link to secret73\.mat:/cube, which is not followed; copy what"):
        load_scene_file(tmp_path / "a73.mat", wavelengths=NM)
    with h5py.File(tmp_path / "b73.mat", "w", userblock_size=512) as file:
        file.create_virtual_dataset("virtual", layout)
    with pytest.raises(SceneError, match=r"virtual takes its numbers from .*secret73\.mat, which is not followed"):
        load_scene_file(tmp_path / "b73.mat", wavelengths=NM)


@pytest.mark.parametrize("value", ["1e+30", "-3.4028235e+38", "2e+09"])
def test_an_unstated_fill_value_is_refused_with_its_position(tmp_path: Path, value: str) -> None:
    """The error names the band of the file; the setting that it suggests makes exactly these values missing."""
    values = np.random.default_rng(0).uniform(0.1, 0.5, (6, 7, 4)).astype(np.float32)
    holes = values.copy()
    values[2, 3:5, 1], values[4, 0, 3] = np.float32(value), np.float32(value)
    holes[2, 3:5, 1], holes[4, 0, 3] = np.nan, np.nan
    path = _save(tmp_path / "a.npy", values)
    with pytest.raises(SceneError) as refused:
        load_scene_file(path, bands=[1, 3], wavelengths=[500, 600])
    told = str(refused.value)
    assert f"a.npy has {np.float32(value)!s} at y 2, x 3, band 1, above the limit" in told
    (tmp_path / "scene.toml").write_text(told[told.index("nodata =") : told.index(" into a scene.toml")] + "\n")
    found = load_scene_file(path, wavelengths=NM[:4])
    np.testing.assert_array_equal(found.values, holes)
    assert any(note.startswith("3 samples have the file's no-data value") for note in found.provenance)
    (tmp_path / "scene.toml").unlink()
    load_scene_file(path, bands=[0, 2], wavelengths=[500, 600])


def test_another_nodata_value_gives_another_hash(tmp_path: Path) -> None:
    """Stores of one scene are therefore never used for the other; 5 and 5.0 are equal."""
    path = _save(tmp_path / "a.npy", np.arange(12.0).reshape(2, 3, 2))
    found = [load_scene_file(path, wavelengths=[500, 600]).light_hash]
    for number in ("0", "5", "5.0"):
        (tmp_path / "scene.toml").write_text(f"nodata = {number}\n")
        found.append(load_scene_file(path, wavelengths=[500, 600]).light_hash)
    assert len(set(found)) == 3
    assert found[2] == found[3]


def _scene(folder: Path, cube: NDArray[np.uint16], toml: str) -> Path:
    np.save(folder / "a.npy", cube)
    (folder / "scene.toml").write_text(toml)
    return folder / "a.npy"


def test_bands_and_wavelengths_of_scene_toml(tmp_path: Path, cube: NDArray[np.uint16]) -> None:
    """Bands are counted from 0; --bands selects from the stated wavelengths, and a band without one is refused."""
    path = _scene(tmp_path, cube, "bands = [4, 1]\nwavelengths_nm = [800.0, 500.0]")
    scene = load_scene_file(path)
    np.testing.assert_array_equal(scene.values, cube[..., [4, 1]])
    assert scene.wavelength_nm.tolist() == [800, 500]
    assert load_scene_file(path, bands=[1]).wavelength_nm.tolist() == [500]
    with pytest.raises(WavelengthError, match="nothing for band 2"):
        load_scene_file(path, bands=[1, 2])
    assert load_scene_file(path, bands=[2], wavelengths=[700]).wavelength_nm.tolist() == [700]


def test_wavelengths_file_skips_dropped_rows(tmp_path: Path, cube: NDArray[np.uint16]) -> None:
    """Rows are counted from 1, headings are skipped, and widths and order are kept."""
    (tmp_path / "w.txt").write_text("instrument\n----\n900 10\n500, 9, x\n1 1\n400 8\n600 7\n700 6\n")
    scene = load_scene_file(_scene(tmp_path, cube, 'wavelengths_file = "w.txt"\ndropped_bands = [3]'))
    assert scene.wavelength_nm.tolist() == [900, 500, 400, 600, 700]
    assert scene.fwhm_nm.tolist() == [10, 9, 8, 7, 6]
    with pytest.raises(WavelengthError, match=r"leaves 6 wavelengths for the 5 bands of .*\.npy; correct"):
        load_scene_file(_scene(tmp_path, cube, 'wavelengths_file = "w.txt"'))


@pytest.mark.parametrize(
    ("toml", "words"),
    [
        ("colour = 1", "unknown key colour; known are bands"),
        ("bands = [", "cannot be read as TOML"),
        ("bands = [1.5]", "bands.0: Input should be a valid integer, got 1.5; correct it"),
        ("wavelengths_nm = 5", "wavelengths_nm: Input should be a valid tuple"),
        ("labels = 3", "labels: Input should be a valid string"),
        ('nodata = "none"', "nodata: Input should be a valid number, got 'none'"),
        ("nodata = true", "nodata: Input should be a valid number"),
        ("[classes]\na = 1\nb = [1, 2, 3]", "one kind"),
        ("[classes]\na = 1\nb = 1", "same number or colour"),
        ("[classes]\na = [1, 2, 300]", r"classes.a: Input should be"),
        ('wavelengths_nm = [500]\nwavelengths_file = "w.txt"', "keep one"),
        ('wavelengths_file = "none.txt"', r"none\.txt cannot be read"),
    ],
)
def test_mistakes_in_scene_toml_are_named(tmp_path: Path, cube: NDArray[np.uint16], toml: str, words: str) -> None:
    """Unknown keys and wrong values are refused with the key's name."""
    with pytest.raises(SceneError, match=words):
        load_scene_file(_scene(tmp_path, cube, toml))
