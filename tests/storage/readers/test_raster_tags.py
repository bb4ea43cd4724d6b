"""Metadata of GeoTIFF, PNG and Zarr files, as scenes keep it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from PIL import Image

from spectralzoom.storage.readers.labels import load_codes
from spectralzoom.storage.readers.open_cubes import open_cube_source
from spectralzoom.storage.readers.scene_files import load_scene_file

VALUES = np.random.default_rng(3).integers(1, 200, (4, 6, 7)).astype(np.uint8)  # (band, y, x)
NM = [450.0, 550.0, 660.5, 800.0]


def write(path: Path, values: Any = VALUES, **profile: Any) -> rasterio.io.DatasetWriter:
    """Return an open GeoTIFF of (band, y, x) values, to which metadata can be added; None leaves a default of GDAL."""
    count, height, width = values.shape
    size = {"count": count, "height": height, "width": width, "dtype": values.dtype.name}
    about = {"driver": "GTiff", "photometric": "MINISBLACK", **size, **profile}
    file = rasterio.open(path, "w", **{key: value for key, value in about.items() if value is not None})
    file.write(values)
    return file


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


def test_a_mask_of_all_pixels_is_left_out(tmp_path: Path) -> None:
    """All values and labels are kept, and a note says why."""
    picture = np.moveaxis(VALUES[:3], 0, -1)
    Image.fromarray(np.dstack([picture, np.zeros(picture.shape[:2], np.uint8)])).save(tmp_path / "a.png")
    scene = load_scene_file(tmp_path / "a.png")
    np.testing.assert_array_equal(scene.values, picture)
    assert "every pixel is transparent or masked: the mask is left out" in scene.provenance
    assert load_codes(tmp_path / "a.png").values.min() >= 0


@pytest.mark.parametrize(("unit", "scale"), [("um", 1e-3), ("Nanometers", 1.0), ("reflectance", 1.0)])
def test_a_bare_unit_counts_if_it_is_a_length(tmp_path: Path, unit: str, scale: float) -> None:
    """The key is unit, Units or similar; another unit is that of the values."""
    with write(tmp_path / "a.tif") as file:
        for band, nm in enumerate(NM, 1):
            file.update_tags(band, wavelength=nm * scale, **{"Units" if band % 2 else "unit": unit})
    source = open_cube_source(tmp_path / "a.tif")
    np.testing.assert_allclose(source.bands.wavelength_nm, NM)
    assert any("have no unit" in note for note in source.notes) == (unit == "reflectance")
