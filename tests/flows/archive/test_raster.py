"""Surveys of rasters: their own pixels in every product, without a camera; checked with other readers."""

from __future__ import annotations

import csv
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import xarray
from affine import Affine
from numpy.typing import NDArray

import spectralzoom
from spectralzoom.flows.archive.export_command import run_export
from spectralzoom.flows.archive.export_layers import ProductFlags
from spectralzoom.flows.planning.patch_budget import ReadingCosts
from spectralzoom.flows.settings.settings import load_settings
from spectralzoom.flows.survey_command import run_survey
from spectralzoom.models.weights.files import describe_weights
from spectralzoom.pipeline.errors import SceneError, SettingsError
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.storage.arrays.mosaics import open_mosaic
from spectralzoom.storage.runs import verify_everything
from spectralzoom.storage.store import Archive
from tests.blocks import block_means
from tests.conftest import QUIET, RGB_NM, WeightsMaker, patchy_scene
from tests.storage.readers.test_raster_tags import write

CORNER = Affine(0.5, 0, 500_000, 0, -0.5, 5_400_000)
UTM = "EPSG:32632"
Raster = Callable[..., Any]


@pytest.fixture
def surveyed(tmp_path: Path, weights: Path) -> Raster:
    """Return a function that surveys a file as a raster on the plain engine; keywords change flags."""

    def survey(scene: object, **flags: Any) -> Any:
        given = {"scene": str(scene), "weights": str(weights), "engine": "plain", "out": str(tmp_path / "archive")}
        return run_survey(load_settings(None, given | flags), QUIET)

    return survey


def write_tif(path: Path, values: NDArray[Any], place: Affine | None = CORNER, **about: Any) -> Path:
    """Write (y, x, band) values as GeoTIFF in UTM, or without a place; return its path."""
    placed = {} if place is None else {"transform": place, "crs": UTM}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
        write(path, np.moveaxis(values, -1, 0), **placed, **about).close()
    return path


def whole(published: Any, archive: Path, factor: int = 4) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the stored pixels of a run, (y, x, band), and their coarse means."""
    mosaic = open_mosaic(archive / published.receipt["products"]["mosaic"])
    return mosaic.values(), block_means(mosaic.values(), factor)


def rounding(values: NDArray[Any]) -> float:
    """Return the largest error of stored values: none for integers, else a small part of their spread."""
    return 1e-3 if (values == np.rint(values)).all() else 0.05 * float(np.nanstd(values))


@pytest.mark.parametrize(("shape", "kind"), [((33, 47), np.float32), ((1, 40), np.uint8), ((5, 3), np.uint16)])
def test_stores_equal_files(surveyed: Raster, tmp_path: Path, kind: type[np.generic], shape: tuple[int, int]) -> None:
    """Stored pixels are equal up to rounding, integers exactly, and coarse values are their means."""
    values = patchy_scene(shape, 3, seed=4)[0].astype(kind)
    write_tif(tmp_path / "field.tif", values)
    published = surveyed(tmp_path / "field.tif", wavelengths="640,550,460")
    image, mosaic = whole(published, tmp_path / "archive")
    np.testing.assert_allclose(image, values, atol=rounding(values))
    assert mosaic.shape[:2] == (-(-shape[0] // 4), -(-shape[1] // 4))
    for y, row in enumerate(mosaic):
        for x, mean in enumerate(row):
            block = values[4 * y : 4 * y + 4, 4 * x : 4 * x + 4].astype(float)
            np.testing.assert_allclose(mean, block.mean(axis=(0, 1)), atol=rounding(values) + 1e-4)


def test_nodata_stays_nodata(surveyed: Raster, tmp_path: Path) -> None:
    """A pixel without any band has no class and no value; a single missing band is filled from the others."""
    values = patchy_scene((40, 56), 3, seed=3)[0]
    values[8:20, 8:30] = -9999  # no band has a value
    values[30, 40, 1] = -9999  # one band has no value
    write_tif(tmp_path / "gaps.tif", values, nodata=-9999)
    published = surveyed(tmp_path / "gaps.tif", wavelengths="640,550,460")
    image, mosaic = whole(published, tmp_path / "archive")
    expected = np.where((values == -9999).all(axis=2, keepdims=True), np.nan, values)
    np.testing.assert_allclose(image[30, 40, [0, 2]], values[30, 40, [0, 2]], atol=rounding(values))
    assert 0 < image[30, 40, 1] < 255
    image[30, 40] = expected[30, 40] = 0
    np.testing.assert_allclose(image, expected, atol=rounding(values))
    assert np.isnan(mosaic[3, 4]).all()
    assert np.isfinite(mosaic[7, 10]).all()
    classes = xarray.open_zarr(tmp_path / "archive" / published.receipt["products"]["class_map"], consolidated=False)
    assert (np.asarray(classes["classes"])[8:20, 8:30] == 255).all()
    assert np.asarray(classes["classes"])[30, 40] != 255


def test_a_receipt_of_a_raster_has_no_camera_figures(surveyed: Raster, scene_files: Path, tmp_path: Path) -> None:
    """Without seconds and lines, its savings are bytes kept and multiply-adds relative to all pixels."""
    published = surveyed(scene_files / "scene.png", labels=str(scene_files / "labels.png"), macs="80%")
    receipt = published.receipt
    assert receipt["source"] == receipt["settings"]["source"] == "raster"
    assert set(receipt["savings"]) == {"patches", "multiply_adds"}
    assert receipt["savings"]["multiply_adds"]["ratio"] <= 0.8
    assert receipt["data_bytes"]["captured"] == 0
    assert receipt["data_bytes"]["kept"] > 0
    assert receipt["field"]["camera_s"] is receipt["field"]["lines"] is receipt["field"]["view_deg"] is None
    names = ("condense_raster", "read_overview", "score", "segment", "evaluate")
    assert [row["name"] for row in receipt["stages"]] == [*names]
    assert [found.problem for found in verify_everything(Archive.open(tmp_path / "archive"))] == [None] * 6


def test_multiply_adds_count_all_components(surveyed: Raster, tmp_path: Path, make_weights: WeightsMaker) -> None:
    """A raster of 40 bands of noise has more components than a plan assumes; a limit of multiply-adds holds."""
    own = make_weights(tuple(map(float, range(400, 1000, 15))))
    np.save(tmp_path / "noise.npy", np.random.default_rng(0).normal(100, 9, (64, 64, 40)))
    flags = {"wavelengths": ",".join(map(str, range(400, 1000, 15))), "weights": str(own), "macs": "90%"}
    receipt = surveyed(tmp_path / "noise.npy", **flags).receipt
    components = len(open_mosaic(tmp_path / "archive" / receipt["products"]["mosaic"]).components)
    assert components > 24
    costs = ReadingCosts(describe_weights(own).config, SceneGrid(64, 64, 8), components)
    found = receipt["savings"]["multiply_adds"]
    assert found["overview"] == costs.of_map(np.zeros(0, np.intp)).overview  # the choice of patches has read it
    assert found["full"] == costs.of_map(costs.grid.every_patch()).total
    assert 0.8 < found["ratio"] <= 0.9


@pytest.mark.parametrize("pixel_m", [None, 10.0])
def test_areas_need_no_geographic_place(surveyed: Raster, tmp_path: Path, pixel_m: float | None) -> None:
    """Classes have pixels and percent; hectares need the size of a pixel in scene.toml."""
    write_tif(tmp_path / "field.tif", patchy_scene((32, 40), 3, 0)[0], None)
    (tmp_path / "scene.toml").write_text("" if pixel_m is None else f"pixel_m = {pixel_m}\n")
    published = surveyed(tmp_path / "field.tif", wavelengths=",".join(map(str, RGB_NM)))
    pixels = published.receipt["areas"]["px"]
    assert sum(pixels.values()) == 32 * 40
    files = run_export(tmp_path / "archive", None, tmp_path / "out", console=QUIET)["files"]
    with (tmp_path / "out" / files["areas"]).open() as text:
        rows = {row["class"]: row for row in csv.DictReader(text)}
    assert {name: int(row["pixels"]) for name, row in rows.items()} == pixels
    if pixel_m is None:
        assert "ha" not in published.receipt["areas"]
        assert {row["hectares"] for row in rows.values()} == {""}
        return
    most = max(pixels, key=pixels.__getitem__)
    hectares = {name: count * 0.01 for name, count in pixels.items()}
    assert published.receipt["areas"]["ha"] == pytest.approx(hectares)
    assert float(rows[most]["hectares"]) == pytest.approx(hectares[most], rel=1e-5)


def test_an_export_has_the_rasters_own_pixels(surveyed: Raster, make_weights: WeightsMaker, tmp_path: Path) -> None:
    """Reflectance, by rising wavelength, and NDVI are the file's as rasterio reads it, on its grid and CRS."""
    values = (patchy_scene((50, 70), 3, seed=7)[0] / 255).astype(np.float32)
    source = write_tif(tmp_path / "field.tif", values)
    published = surveyed(source, wavelengths="670,550,800", weights=str(make_weights((550.0, 670.0, 800.0))))
    products = ProductFlags(reflectance=True, indices="NDVI")
    run_export(tmp_path / "archive", None, tmp_path / "out", QUIET, products)
    folder = tmp_path / "out" / published.folder.name
    with rasterio.open(folder / "reflectance.tif") as exported, rasterio.open(source) as own:
        assert (exported.crs, exported.transform, exported.shape) == (own.crs, own.transform, own.shape)
        np.testing.assert_allclose(exported.read(), own.read([2, 1, 3]), atol=rounding(values))
    ndvi = (values[..., 2] - values[..., 0]) / (values[..., 2] + values[..., 0])
    with rasterio.open(folder / "NDVI.tif") as exported:
        assert np.sqrt(np.mean((exported.read(1) - ndvi) ** 2)) < 0.01


def test_a_second_visit_uses_the_first_as_prior_map(surveyed: Raster, scene_files: Path) -> None:
    """The first visit was three days before."""
    surveyed(scene_files / "scene.png", visit="2026-06-01T10:00:00Z", prior="latest")
    later = surveyed(scene_files / "scene.png", visit="2026-06-04T10:00:00Z", prior="latest", macs="80%")
    assert later.receipt["prior_map"]["days"] == 3


@pytest.mark.parametrize(
    ("name", "value"),
    {"seconds": 5, "budget": 0.5, "effects": "all", "camera.samples": 64, "extent": "0:0-4", "pointing_px": 1}.items(),
)
def test_a_setting_of_a_camera_is_refused(scene_files: Path, name: str, value: object) -> None:
    """For a raster one message names the setting, and the source with which the rig scans the file."""
    flag = "--" + name.replace("_", "-")
    with pytest.raises(SettingsError, match=rf"{flag} is of a camera, .* leave it out, or give --source sim"):
        load_settings(None, {"scene": str(scene_files / "scene.png"), name: value})


def test_a_raster_beyond_the_memory_is_refused(surveyed: Raster, tmp_path: Path) -> None:
    """Rows are read in blocks; the message says that not even one block fits."""
    values = np.zeros((64, 4096, 3), np.uint8)
    write_tif(tmp_path / "wide.tif", values + np.arange(64, dtype=np.uint8)[:, None, None])
    with pytest.raises(SettingsError, match=r"exceeds --memory 512 MiB: 8 rows of a raster of 4096 px"):
        surveyed(tmp_path / "wide.tif", wavelengths="640,550,460", memory="512MiB")


@pytest.mark.parametrize("address", ["tiles", "tiles/*.tif"])
def test_tiles_are_refused(surveyed: Raster, tmp_path: Path, address: str) -> None:
    """A folder or a pattern is refused; the message has the command that merges the tiles."""
    (tmp_path / "tiles").mkdir()
    write_tif(tmp_path / "tiles" / "a.tif", patchy_scene((16, 16), 3, seed=1)[0])
    with pytest.raises(SceneError, match=r"make one file first: rio merge tiles/\*\.tif field\.tif"):
        surveyed(tmp_path / address, wavelengths="640,550,460")


def test_bands_of_two_detectors_leave_sorted(surveyed: Raster, make_weights: WeightsMaker, tmp_path: Path) -> None:
    """Opened cube, its Zarr copy and the exported image have rising wavelengths and the detector of each band."""
    centres = [500.0, 600.0, 700.0, 650.0, 700.0, 800.0]
    values = (patchy_scene((32, 40), 6, seed=3)[0] / 255).astype(np.float32)
    source = write_tif(tmp_path / "field.tif", values, None)
    surveyed(source, wavelengths=",".join(map(str, centres)), weights=str(make_weights(tuple(centres))))
    cube = spectralzoom.open(tmp_path / "archive").latest.mosaic
    cube.to_dataset(name="values").to_zarr(tmp_path / "copy.zarr", zarr_format=3, consolidated=False)
    copy = xarray.open_zarr(tmp_path / "copy.zarr", consolidated=False)["values"].set_xindex("wavelength")
    for one in (cube, copy):
        near = one.sel(wavelength=660, method="nearest")
        np.testing.assert_allclose(near, values[..., 3], atol=rounding(values))
        assert one.detector.values.tolist() == [0, 0, 1, 0, 1, 1]
    done = run_export(tmp_path / "archive", None, tmp_path / "out", QUIET, ProductFlags(reflectance=True))
    with rasterio.open(tmp_path / "out" / done["files"]["reflectance"]) as file, rasterio.open(source) as own:
        np.testing.assert_allclose(file.read(), own.read([1, 2, 4, 3, 5, 6]), atol=rounding(values))
        assert [file.tags(band)["detector"] for band in file.indexes] == list("001011")
        assert file.descriptions[2:4] == ("650.0 nm, detector 1", "700.0 nm, detector 0")
