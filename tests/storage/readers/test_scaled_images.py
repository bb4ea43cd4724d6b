"""JPEG 2000 images, and scale factors of TIFF, ENVI and scene.toml."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import xarray as xr
from affine import Affine

from spectralzoom.pipeline.errors import SceneError
from spectralzoom.storage.readers.open_cubes import open_cube_source
from spectralzoom.storage.readers.scene_files import load_scene_file, open_scene_file
from tests.storage.readers.test_raster_tags import write

REVERSIBLE = {"QUALITY": "100", "REVERSIBLE": "YES"}


def test_jpeg_2000_is_read(tmp_path: Path) -> None:
    """Numbers are read as written, whole and by lines; wavelengths have to be stated."""
    values = np.random.default_rng(9).integers(1, 60_000, (3, 70, 50)).astype(np.uint16)
    path = tmp_path / "a.jp2"
    place = {"crs": "EPSG:32632", "transform": Affine(10, 0, 600_000, 0, -10, 5_700_000)}
    with rasterio.open(path, "w", "JP2OpenJPEG", 50, 70, 3, dtype="uint16", **place, **REVERSIBLE) as file:
        file.write(values)
    source = open_cube_source(path)
    assert source.geobox is not None
    expected = np.moveaxis(values, 0, -1)
    np.testing.assert_array_equal(np.concatenate([source.read(0, 64), source.read(64, 70)]), expected)
    np.testing.assert_array_equal(load_scene_file(path, wavelengths=[500, 600, 700]).values, expected)
    path.write_bytes(path.read_bytes()[:80])
    with pytest.raises(SceneError, match="cannot be read as JPEG 2000"):
        load_scene_file(path, wavelengths=[500, 600, 700])


def write_tiff(path: Path, scales: tuple[float, ...] | None = None, offsets: tuple[float, ...] = (0, 0)) -> Path:
    values = np.arange(24, dtype=np.int16).reshape(2, 3, 4) * 100
    with write(path, values, nodata=0) as file:
        if scales is not None:
            file.scales, file.offsets = scales, offsets
    return path


def test_scale_and_offset_of_tiff_are_applied(tmp_path: Path) -> None:
    """Both apply by band, to a scene and to lines; no-data is found before scaling. Another scale changes the hash."""
    scaled = write_tiff(tmp_path / "scaled.tif", (0.001, 0.002), (0.5, 0.0))
    scene = load_scene_file(scaled, wavelengths=[500, 600])
    raw = np.moveaxis(np.arange(24).reshape(2, 3, 4) * 100, 0, -1)
    expected = np.where(raw == 0, np.nan, raw * [0.001, 0.002] + [0.5, 0.0])
    np.testing.assert_allclose(scene.values, expected, rtol=1e-6)
    np.testing.assert_allclose(open_cube_source(scaled).read(1, 3), expected[1:3], rtol=1e-6)
    said = "values are the file's numbers times 0.001 plus 0.5 (others"
    assert any(note.startswith(said) for note in scene.provenance)
    sidecar = write_tiff(tmp_path / "sidecar.tif")
    before = load_scene_file(sidecar, wavelengths=[500, 600])
    bands = "".join(f'<PAMRasterBand band="{band}"><Scale>0.1</Scale></PAMRasterBand>' for band in (1, 2))
    (tmp_path / "sidecar.tif.aux.xml").write_text(f"<PAMDataset>{bands}</PAMDataset>")
    after = load_scene_file(sidecar, wavelengths=[500, 600])
    np.testing.assert_allclose(after.values, before.values * 0.1, rtol=1e-6)
    assert before.light_hash != after.light_hash


def test_unscaled_files_keep_their_hash(tmp_path: Path) -> None:
    """Files without a scale have the hash of their bytes, bands and wavelengths alone."""
    path = write_tiff(tmp_path / "plain.tif")
    scene = load_scene_file(path, wavelengths=[500, 600])
    parts = [hashlib.sha256(path.read_bytes()).hexdigest(), None, [0, 1], [500.0, 600.0], None]
    assert scene.light_hash == hashlib.sha256(json.dumps(parts).encode()).hexdigest()


def test_scale_of_scene_toml_is_applied(tmp_path: Path) -> None:
    """Values are numbers times scale plus offset, loaded or read by rows; no-data is found before scaling."""
    path = write_tiff(tmp_path / "plain.tif")
    before = load_scene_file(path, wavelengths=[500, 600])
    (tmp_path / "scene.toml").write_text("scale = 0.0001\noffset = -0.1\nnodata = 300\n")
    after, opened = (read(path, wavelengths=[500, 600]) for read in (load_scene_file, open_scene_file))
    raw = np.moveaxis(np.arange(24).reshape(2, 3, 4) * 100, 0, -1)
    np.testing.assert_allclose(after.values, np.where(raw == 300, np.nan, raw * 0.0001 - 0.1), rtol=1e-6)
    np.testing.assert_array_equal(opened.read(1, 3), after.values[1:3])
    assert before.light_hash != after.light_hash == opened.light_hash
    assert any(note.startswith("values are the file's times 0.0001 plus -0.1, as ") for note in after.provenance)


@pytest.mark.parametrize(
    "toml", ["scale = 0", "scale = -1.0", "scale = inf", 'scale = "0.0001"', "offset = nan", "offset = true"]
)
def test_invalid_scales_are_refused(tmp_path: Path, toml: str) -> None:
    """A scale is a number above 0, an offset any number; the error says so."""
    path = write_tiff(tmp_path / "plain.tif")
    (tmp_path / "scene.toml").write_text(toml)
    with pytest.raises(SceneError, match=r"(scale|offset): Input should be (a|greater)"):
        load_scene_file(path, wavelengths=[500, 600])


def test_envi_reflectance_scale_factor_is_applied(tmp_path: Path) -> None:
    """Numbers are divided by it, except for labels."""
    numbers = np.arange(24, dtype=np.uint16).reshape(3, 4, 2) * 400
    head = "ENVI\nsamples = 4\nlines = 3\nbands = 2\ndata type = 12\ninterleave = bip\nbyte order = 0\n"
    (tmp_path / "a.hdr").write_text(f"{head}reflectance scale factor = 10000\ndata ignore value = 0\n")
    (tmp_path / "a.bip").write_bytes(numbers.tobytes())
    scene = load_scene_file(tmp_path / "a.hdr", wavelengths=[500, 600])
    np.testing.assert_allclose(scene.values, np.where(numbers == 0, np.nan, numbers / 10_000), rtol=1e-6)
    np.testing.assert_array_equal(open_cube_source(tmp_path / "a.hdr", labels=True).read(0, 3), numbers)


def write_envi(folder: Path, numbers: np.ndarray, **fields: str) -> Path:
    """Write a cube (3, 4, 2) with more fields, and return its header."""
    code = {"uint16": 12, "int16": 2, "float32": 4}[numbers.dtype.name]
    head = f"ENVI\nsamples = 4\nlines = 3\nbands = 2\ndata type = {code}\ninterleave = bip\nbyte order = 0\n"
    rows = "".join(f"{key.replace('_', ' ')} = {value}\n" for key, value in fields.items())
    (folder / "a.hdr").write_text(head + rows)
    (folder / "a.bip").write_bytes(numbers.tobytes())
    return folder / "a.hdr"


NUMBERS = np.arange(24, dtype=np.uint16).reshape(3, 4, 2)


@pytest.mark.parametrize(
    ("fields", "gain", "offset", "left"),
    [
        ({"data_gain_values": "{2, 3}", "data_offset_values": "{1, 0}"}, (2, 3), (1, 0), ""),
        ({"data_reflectance_gain_values": "{0.5, 0.25}"}, (0.5, 0.25), (0, 0), ""),
        ({"data_reflectance_offset_values": "{4, 5}"}, (1, 1), (4, 5), ""),
        (
            {"data_reflectance_gain_values": "{0.5, 0.25}", "data_gain_values": "{2, 3}"},
            (0.5, 0.25),
            (0, 0),
            "data gain values of the header is not applied: data reflectance gain values is",
        ),
        (
            {"reflectance_scale_factor": "10", "data_reflectance_gain_values": "{2, 3}"},
            (0.1, 0.1),
            (0, 0),
            "data reflectance gain values of the header is not applied: reflectance scale factor is",
        ),
    ],
)
def test_gains_of_envi_are_applied_by_band(tmp_path: Path, fields: Any, gain: Any, offset: Any, left: str) -> None:
    """The first of three scales counts, and a note names the others."""
    scene = load_scene_file(write_envi(tmp_path, NUMBERS, **fields), wavelengths=[500, 600])
    np.testing.assert_allclose(scene.values, NUMBERS * np.array(gain) + offset, rtol=1e-6)
    assert (left in scene.provenance) == bool(left)
    assert sum("is not applied" in note for note in scene.provenance) == bool(left)


@pytest.mark.parametrize("name", ["data_reflectance_gain_values", "data_reflectance_offset_values"])
def test_gains_that_are_not_one_a_band_are_refused(tmp_path: Path, name: str) -> None:
    """The message names the field and its value."""
    with pytest.raises(SceneError, match=rf"{name.replace('_', ' ')} = '1, 2, 3', expected 2 as numbers; correct it"):
        load_scene_file(write_envi(tmp_path, NUMBERS, **{name: "{1, 2, 3}"}), wavelengths=[500, 600])


def by_band_tiff(folder: Path, fills: Any) -> Path:
    path = write_tiff(folder / "a.tif")
    with rasterio.open(path, "r+") as file:
        file.nodata = None
    texts = ("" if fill is None else f"<NoDataValue>{fill}</NoDataValue>" for fill in fills)
    bands = "".join(f'<PAMRasterBand band="{at + 1}">{text}</PAMRasterBand>' for at, text in enumerate(texts))
    (folder / "a.tif.aux.xml").write_text(f"<PAMDataset>{bands}</PAMDataset>")
    return path


@pytest.mark.parametrize("fills", [(100, 1500), (100, None), (None, 2000), (300, -9999)])
@pytest.mark.parametrize("kind", ["TIFF", "ENVI"])
def test_each_band_has_its_own_nodata_value(tmp_path: Path, kind: str, fills: Any) -> None:
    """That of one band is a value in the others, and another one changes the hash."""
    raw: Any = NUMBERS * 100
    if kind == "TIFF":
        path = by_band_tiff(tmp_path, fills)
        raw = np.moveaxis(np.arange(24).reshape(2, 3, 4) * 100, 0, -1)
    else:
        listed = ", ".join("nan" if fill is None else f"{fill}" for fill in fills)
        path = write_envi(tmp_path, raw.astype(np.int16), data_ignore_value=f"{{{listed}}}")
    scene = load_scene_file(path, wavelengths=[500, 600])
    expected = np.where(raw == np.array(fills, float), np.nan, raw)
    np.testing.assert_array_equal(scene.values, expected)
    assert any(note.startswith("the no-data values of the bands are") for note in scene.provenance)


def test_an_ignore_value_that_is_no_number_is_noted(tmp_path: Path) -> None:
    """NaN is none, and needs no note."""
    for text, noted in (("zero", True), ("nan", False)):
        path = write_envi(tmp_path, NUMBERS.astype(np.float32), data_ignore_value=text)
        notes = load_scene_file(path, wavelengths=[500, 600]).provenance
        assert ("data ignore value = 'zero' is no number, and is not read" in notes) == noted


def packed_netcdf(path: Path, numbers: np.ndarray, fill: float) -> Path:
    about = {"scale_factor": 0.01, "missing_value": fill}
    xr.Dataset({"r": (("y", "x", "band"), numbers, about)}).to_netcdf(path, engine="h5netcdf")
    return path


@pytest.mark.parametrize(
    ("fill", "held", "words"),
    [
        (-700, True, None),  # as the numbers are stored
        (-0.5, False, "have the file's no-data value -0.5"),  # no whole number
        (
            -7,
            True,
            "no sample has the file's no-data value -7 before scaling, and 2 have it after; if these are no data",
        ),
    ],
)
@pytest.mark.parametrize("kind", ["ENVI", "NetCDF"])
def test_a_nodata_value_of_scaled_values_is_found(
    tmp_path: Path, kind: str, fill: float, held: bool, words: str | None
) -> None:
    """One that the numbers cannot hold is compared after scaling; one that only fits after it is noted."""
    raw = np.arange(24, dtype=np.int16).reshape(3, 4, 2) + 1
    raw[0, 0] = -700 if held else -50
    if kind == "ENVI":
        path = write_envi(tmp_path, raw, reflectance_scale_factor="100", data_ignore_value=f"{fill}")
    else:
        path = packed_netcdf(tmp_path / "a.nc", raw, fill)
    scene = load_scene_file(path, wavelengths=[500, 600])
    assert np.isnan(scene.values[0, 0]).all() == (fill != -7)
    assert not np.isnan(scene.values[1:]).any()
    assert words is None or any(words in note for note in scene.provenance)
    assert any("before scaling" in note for note in scene.provenance) == (fill == -7)
