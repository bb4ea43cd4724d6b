"""Metadata of GeoTIFF, PNG and Zarr files, as scenes keep it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import odc.geo.xr  # noqa: F401 - registers the accessor
import pytest
import rasterio
import xarray as xr
from affine import Affine
from PIL import Image
from rasterio.control import GroundControlPoint

from spectralzoom.storage.readers.scene_files import load_scene_file

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


def test_a_geotiff_keeps_its_georeference(tmp_path: Path) -> None:
    """CRS and transform are as written; one alone, or ground control points, give no georeference but a note."""
    write(tmp_path / "a.tif", crs="EPSG:25832", transform=PLACE).close()
    scene = load_scene_file(tmp_path / "a.tif", wavelengths=NM)
    assert (scene.geobox.affine, scene.geobox.crs.epsg, tuple(scene.geobox.shape)) == (PLACE, 25832, (6, 7))
    write(tmp_path / "b.tif", transform=PLACE).close()
    points = [GroundControlPoint(0, 0, 7, 52), GroundControlPoint(6, 0, 7, 51.9), GroundControlPoint(0, 7, 7.1, 52)]
    write(tmp_path / "c.tif", gcps=points, crs="EPSG:4326").close()
    write(tmp_path / "d.tif", crs="EPSG:25832").close()
    notes = {"b": "a transform and no CRS", "c": "control points, which are not read", "d": "a CRS and no transform"}
    for name, words in notes.items():
        scene = load_scene_file(tmp_path / f"{name}.tif", wavelengths=NM)
        assert scene.geobox is None
        assert any(words in note for note in scene.provenance)


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


def test_a_zarr_store_is_georeferenced_in_three_ways(tmp_path: Path) -> None:
    """A grid mapping, coordinates with a CRS, and GeoZarr's attributes are read; coordinates alone do not suffice."""
    values = ("y", "x", "band"), np.moveaxis(VALUES, 0, -1)
    centres = {"y": 5_700_000 - 0.25 - 0.5 * np.arange(6), "x": 400_000.25 + 0.5 * np.arange(7)}
    waves = {"wavelength": ("band", np.array(NM), {"units": "nm"})}
    crs = xr.DataArray(0, attrs={"crs_wkt": rasterio.crs.CRS.from_epsg(25832).to_wkt()})
    told = {"GeoTransform": "400000 0.5 0 5700000 0 -0.5", **crs.attrs}
    geozarr = {"proj:code": "EPSG:25832", "spatial:transform": list(PLACE[:6])}
    stores = {
        "mapping": xr.Dataset({"v": (*values, {"grid_mapping": "crs"})}, {**waves, "crs": ((), 0, told)}),
        "centres": xr.Dataset({"v": values}, {**waves, **centres, "spatial_ref": crs}),
        "geozarr": xr.Dataset({"v": (*values, geozarr)}, waves),
        "halves": xr.Dataset({"v": values}, {**waves, **centres}),
    }
    for name, store in stores.items():
        store.to_zarr(tmp_path / f"{name}.zarr", zarr_format=3, consolidated=False)
        geobox = load_scene_file(tmp_path / f"{name}.zarr:v").geobox
        if name == "halves":
            assert geobox is None
        else:
            assert geobox.crs.epsg == 25832
            np.testing.assert_allclose(geobox.affine[:6], PLACE[:6])
