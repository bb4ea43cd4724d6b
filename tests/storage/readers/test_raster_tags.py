"""Metadata of GeoTIFF, PNG and Zarr files, as scenes keep it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import odc.geo.xr  # noqa: F401 - registers the accessor
import pytest
import rasterio
from affine import Affine
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from spectralzoom.pipeline.setting_fields import numbers_of
from spectralzoom.storage.readers.image_files import bad_bands
from spectralzoom.storage.readers.scene_files import bands_text, load_scene_file

PLACE = Affine(0.5, 0, 400_000, 0, -0.5, 5_700_000)
VALUES = np.random.default_rng(3).integers(1, 200, (4, 6, 7)).astype(np.uint8)  # (band, y, x)
NM = [450.0, 550.0, 660.5, 800.0]


def write(path: Path, values: Any = VALUES, **profile: Any) -> rasterio.io.DatasetWriter:
    """Return an open GeoTIFF of (band, y, x) values, to which metadata can be added."""
    count, height, width = values.shape
    size = {"count": count, "height": height, "width": width, "dtype": values.dtype.name}
    file = rasterio.open(path, "w", **{"driver": "GTiff", "photometric": "MINISBLACK", **size, **profile})
    file.write(values)
    return file


def say_in_bands(file: Any) -> None:
    for band, centre in enumerate(NM):
        file.update_tags(band + 1, WAVELENGTH=f"{centre / 1000}", WAVELENGTH_UNITS="Micrometers")


def say_in_imagery(file: Any) -> None:
    for band, centre in enumerate(NM):
        file.update_tags(band + 1, ns="IMAGERY", CENTRAL_WAVELENGTH_UM=str(centre / 1000), FWHM_UM="0.006")


def say_in_a_list(file: Any) -> None:
    file.update_tags(wavelength="{" + ", ".join(map(str, NM)) + "}", wavelength_units="nm", fwhm="6 6 6 6")


def say_in_names(file: Any) -> None:
    file.descriptions = [f"Band {number} ({centre} Nanometers)" for number, centre in enumerate(NM)]


@pytest.mark.parametrize("say", [say_in_bands, say_in_imagery, say_in_a_list, say_in_names])
def test_wavelengths_are_read_from_several_kinds_of_tags(tmp_path: Path, say: Any) -> None:
    """Tags of bands, GDAL's domain IMAGERY, a list of the file and band names are read; two kinds have widths."""
    with write(tmp_path / "a.tif") as file:
        say(file)
    scene = load_scene_file(tmp_path / "a.tif")
    assert scene.wavelength_nm.tolist() == pytest.approx(NM)
    if say in (say_in_imagery, say_in_a_list):
        assert scene.fwhm_nm.tolist() == pytest.approx([6.0] * 4)


def test_bands_marked_as_bad_are_left_out(tmp_path: Path) -> None:
    """A note names them, and `--bands` can still select them."""
    with write(tmp_path / "a.tif") as file:
        say_in_a_list(file)
        file.update_tags(bbl="{1, 0, 1, 1}")
    scene = load_scene_file(tmp_path / "a.tif")
    assert scene.wavelength_nm.tolist() == [450.0, 660.5, 800.0]
    assert any("bands 1 are left out: the file marks them as bad; --bands 0-3 takes" in one for one in scene.provenance)
    assert load_scene_file(tmp_path / "a.tif", bands=[1]).wavelength_nm.tolist() == [550.0]


@pytest.mark.parametrize("kind", ["mask", "RGBA", "RGB"])
def test_masked_and_transparent_pixels_are_nan(tmp_path: Path, kind: str) -> None:
    """The kinds are a mask, alpha and a PNG colour. A gap changes the hash of the scene."""
    there = np.ones((6, 7), np.bool_)
    there[2:4, :3] = False
    hashes = set()
    for gap in (True, False):
        mask = np.where(there | (not gap), 255, 0).astype(np.uint8)
        if kind == "mask":
            with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), write(tmp_path / "a.tif") as file:
                file.write_mask(mask)
            scene = load_scene_file(tmp_path / "a.tif", wavelengths=NM)
        elif kind == "RGBA":
            Image.fromarray(np.dstack([np.moveaxis(VALUES[:3], 0, -1), mask])).save(tmp_path / "a.png")
            scene = load_scene_file(tmp_path / "a.png")
        else:  # in red both colours are alike
            picture = Image.fromarray((~there).astype(np.uint8), "P")
            picture.putpalette([200, 9, 1, 200, 9, 250])
            picture.convert(kind).save(tmp_path / "a.png", **({"transparency": (200, 9, 250)} if gap else {}))
            scene = load_scene_file(tmp_path / "a.png")
        assert (np.isnan(scene.values) == (~there & gap)[..., None]).all()
        hashes.add(scene.light_hash)
    assert len(hashes) == 2


@given(st.lists(st.booleans(), min_size=1, max_size=40))
def test_bad_bands_round_trip_as_text(good: list[bool]) -> None:
    """The zeros of a list are the bad bands, and their text is read as the same bands."""
    bad = bad_bands("{" + ", ".join(str(int(one)) for one in good) + "}", len(good))
    assert list(bad) == [band for band, one in enumerate(good) if not one]
    assert bad_bands("1, 1", len(good)) == () or len(good) == 2
    if bad:
        assert [int(str(one)) for part in bands_text(bad).split(",") for one in numbers_of(part)] == list(bad)
