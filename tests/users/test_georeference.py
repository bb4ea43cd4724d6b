"""Surveys of a georeferenced scene: the positions of all products, as independent readers find them."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import odc.geo.xr  # noqa: F401 - registers the accessor
import pytest
import rasterio
import rioxarray  # noqa: F401 - registers the accessor
import xarray as xr
from affine import Affine
from odc.geo.geobox import GeoBox
from pyproj import CRS
from rasterio.enums import ColorInterp

import spectralzoom.models.reading.prior_map as prior_map
from spectralzoom.flows.archive.export_command import run_export
from spectralzoom.flows.publish.run_folder import Published
from spectralzoom.flows.settings.settings import load_settings
from spectralzoom.flows.survey_command import run_survey
from spectralzoom.pipeline.ground.georeference import pixel_rows_m2
from spectralzoom.storage.arrays.mosaics import open_mosaic
from spectralzoom.storage.runs import verify_everything
from spectralzoom.storage.store import Archive, read_manifest
from tests.conftest import QUIET, RGB_NM, patchy_scene
from tests.prior_work import without_effects
from tests.storage.readers.test_envi_cubes import write_envi

SHAPE = (52, 70)
NORTH_UP = Affine(0.05, 0, 534_257.65, 0, -0.05, 5_772_301.4)
TURNED = Affine(0.0433, 0.025, 534_257.65, 0.025, -0.0433, 5_772_301.4)  # by 30 degrees
EVERY_STORE = (
    *("class_map", "class_probabilities", "mosaic", "attention"),
    *("raw_coarse", "raw_fine", "signal_coarse", "signal_fine"),
)
ONE_SCAN: dict[str, Any] = {"budget": None, "scan_step": 2}
FILE_ALONE: dict[str, Any] = {"budget": None, "source": "raster"}  # without a camera
UNCOUNTED = ("rgb", "rare")  # rare spectra are found by their line and sample
GAP = np.s_[:20, :24]
PIXELS = patchy_scene(SHAPE, 3, seed=4)[0].astype(np.uint8)  # (y, x, band) of a field of three classes


def write_geotiff(path: Path, transform: Affine, *, gap: bool = False, crs: str = "EPSG:32632") -> Path:
    """Write a GeoTIFF of the field with wavelengths in its tags and, if `gap` is set, a transparent corner."""
    values = np.moveaxis(PIXELS, -1, 0)
    count = len(values) + gap
    profile = {"driver": "GTiff", "height": SHAPE[0], "width": SHAPE[1], "count": count, "dtype": "uint8"}
    with rasterio.open(path, "w", **profile, crs=crs, transform=transform, photometric="MINISBLACK") as file:
        file.write(values, list(range(1, len(values) + 1)))
        for band, centre in enumerate(RGB_NM):
            file.update_tags(band + 1, wavelength=str(centre), wavelength_units="Nanometers")
        if gap:
            alpha = np.full(SHAPE, 255, np.uint8)
            alpha[GAP] = 0
            file.write(alpha, count)
            file.colorinterp = [ColorInterp.gray, ColorInterp.undefined, ColorInterp.undefined, ColorInterp.alpha]
    return path


def envi(folder: Path) -> tuple[Path, Affine]:
    place = "{UTM, 1, 1, 534257.65, 5772301.4, 0.05, 0.05, 32, North, WGS-84, units=Meters, rotation=25}"
    nm = {"wavelength_units": "nm", "wavelength": "{640, 550, 460}"}
    write_envi(folder / "a.img", PIXELS, "bip", map_info=place, **nm)
    with rasterio.open(folder / "a.img") as file:
        return folder / "a.hdr", file.transform


def in_km(folder: Path) -> tuple[Path, Affine]:
    """Write NetCDF with coordinates in km and a CRS in metres."""
    rows, columns = np.arange(SHAPE[0]) + 0.5, np.arange(SHAPE[1]) + 0.5
    axes = {"y": (NORTH_UP.f + NORTH_UP.e * rows) / 1e3, "x": (NORTH_UP.c + NORTH_UP.a * columns) / 1e3}
    about = {"crs": ((), 0, CRS.from_epsg(32632).to_cf()), "wavelength": ("band", np.array(RGB_NM), {"units": "nm"})}
    image = {"v": (("y", "x", "band"), PIXELS, {"grid_mapping": "crs"}), **about}
    content = xr.Dataset(image, {name: (name, one, {"units": "km"}) for name, one in axes.items()})
    content.to_netcdf(folder / "a.nc", engine="h5netcdf")
    return folder / "a.nc", NORTH_UP


KINDS: dict[str, Callable[[Path], tuple[Path, Affine]]] = {
    "GeoTIFF": lambda folder: (write_geotiff(folder / "a.tif", NORTH_UP), NORTH_UP),
    "turned GeoTIFF": lambda folder: (write_geotiff(folder / "a.tif", TURNED), TURNED),
    "turned ENVI": envi,
    "NetCDF in km": in_km,
}


def survey(scene: Path, weights: Path, out: Path, **flags: Any) -> Published:
    """Survey the scene without effects, accuracy or controls."""
    files = {"scene": str(scene), "weights": str(weights), "out": str(out)}
    given = {"source": "sim", "engine": "plain", "budget": 0.8, "accuracy": False}
    with without_effects():
        return run_survey(load_settings(None, {**files, **given, **flags}), QUIET)


def opened(run: Published, product: str) -> xr.Dataset:
    """Open a store of the run by plain xarray; a warning is an error."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return xr.open_zarr(run.folder.parent.parent / run.receipt["products"][product])


def corners_px(found: Any, wanted: Affine, shape: tuple[int, int]) -> float:
    """Return the largest distance of an image's corners from their expected positions, in its pixels."""
    rows, columns = shape
    corners = np.array([(0, 0), (columns, 0), (0, rows), (columns, rows)]).T
    return float(np.hypot(*(~wanted * (found * corners) - corners)).max())


@pytest.mark.parametrize("kind", KINDS)
def test_products_have_the_position_of_their_scene(tmp_path: Path, weights: Path, kind: str) -> None:
    """All corners lie within 0.1 px of the source's, in stores (odc-geo, rioxarray) and exports (GDAL)."""
    scene, transform = KINDS[kind](tmp_path)
    run = survey(scene, weights, tmp_path / "archive", **{} if "GeoTIFF" in kind else FILE_ALONE)
    assert sum(run.receipt["areas"]["ha"].values()) == pytest.approx(np.prod(SHAPE) * 0.05**2 / 1e4, rel=2e-3)
    for product, name in (("class_map", "classes"), ("mosaic", "scores")):
        found = opened(run, product)[name]
        shape = (found.sizes["y"], found.sizes["x"])
        assert (found.odc.crs.epsg, found.rio.crs.to_epsg()) == (32632, 32632)
        assert corners_px(found.odc.geobox.affine, transform, shape) < 0.1
        assert corners_px(found.rio.transform(), transform, shape) < 0.1
    files = run_export(tmp_path / "archive", None, tmp_path / "out", console=QUIET)
    assert files["placed"]
    for name, size in (("class_map", 1), ("confidence", 1), ("attention", 8), ("rgb", 1)):
        with rasterio.open(tmp_path / "out" / files["files"][name]) as file:
            assert file.crs.to_epsg() == 32632
            assert corners_px(file.transform, transform * Affine.scale(size), file.shape) < 0.1
    item = json.loads(Path(files["item"]).read_text())
    assert item["properties"]["proj:epsg"] == 32632
    assert item["properties"]["proj:transform"][:6] == pytest.approx(list(transform[:6]))
    assert not [one for one in verify_everything(Archive.open(tmp_path / "archive")) if one.problem]


def test_transparent_pixels_are_nodata_in_every_product(tmp_path: Path, weights: Path) -> None:
    """They are 255 in the map, NaN in the mosaic, not counted in areas, and patches without other pixels score 0."""
    run = survey(write_geotiff(tmp_path / "a.tif", NORTH_UP, gap=True), weights, tmp_path / "archive", budget=1)
    mosaic = open_mosaic(tmp_path / "archive" / run.receipt["products"]["mosaic"])
    with opened(run, "class_map") as drawn:
        classes = drawn["classes"].values
        assert classes.dtype == np.uint8
        assert (classes[GAP] == 255).all()
        gap = np.zeros(SHAPE, np.bool_)
        gap[GAP] = True
        assert (classes[~gap] != 255).all()
        assert np.isnan(drawn["confidence"].values[GAP]).all()
    np.testing.assert_array_equal(np.isfinite(mosaic.values()).all(axis=2), ~gap)
    assert np.isnan(mosaic.values()[gap]).all()
    np.testing.assert_array_equal(mosaic.coverage() > 0, ~gap)
    assert run.receipt["pixels"]["map_without_a_class"] == gap.sum()
    hectares = sum(run.receipt["areas"]["ha"].values())
    assert hectares == pytest.approx((~gap).sum() * 0.05**2 / 1e4, rel=2e-3)  # UTM's scale
    whole = np.sum(list(pixel_rows_m2(GeoBox(SHAPE, NORTH_UP, "EPSG:32632"))))
    assert hectares * 1e4 == pytest.approx(whole * (~gap).mean(), rel=1e-6)
    with opened(run, "attention") as attention:
        assert (attention["score"].values[:2, :3] == 0).all()  # patches of 8 px without a pixel of the scene


def test_transparent_pixels_did_not_change(tmp_path: Path, weights: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """If pixels become transparent before the second visit, they have no age and no change; other pixels do change."""
    for name in ("CERTAIN", "SURE"):  # untrained weights are sure of nothing: every class counts as sure
        monkeypatch.setattr(prior_map, name, 1e-6)
    for name in ("first", "later"):
        (tmp_path / name).mkdir()
    scenes = [write_geotiff(tmp_path / name / "a.tif", NORTH_UP, gap=name == "later") for name in ("first", "later")]
    flags = {"name": "north", "prior": "latest", "scan_step": 2, "budget": None}
    for day, scene in enumerate(scenes, 1):
        run = survey(scene, weights, tmp_path / "archive", **flags, visit=f"2026-06-0{day}T10:00:00Z", seed=day)
    with opened(run, "class_probabilities") as probabilities:
        old, age = (probabilities[name].values for name in ("changed_from", "age"))
    assert (old != 255).any()
    assert (old[GAP] == 255).all()
    assert np.isnan(age[GAP]).all()
    assert np.isnan(age).sum() == age[GAP].size


def test_keys_of_mosaic_and_map_contain_the_georeference(tmp_path: Path, weights: Path) -> None:
    """Mosaic and map of a scene without a georeference have neither the parameter nor a CRS."""
    bare = tmp_path / "bare.npy"
    np.save(bare, PIXELS)
    run = survey(bare, weights, tmp_path / "archive", wavelengths="640,550,460", **ONE_SCAN)
    here = survey(write_geotiff(tmp_path / "a.tif", NORTH_UP), weights, tmp_path / "archive", **ONE_SCAN)
    archive = Archive.open(tmp_path / "archive")
    for product in ("mosaic", "class_map"):
        frames = []
        for one in (run, here):
            params = read_manifest(archive.ref(*one.receipt["products"][product].split("/")[1:3]).path)["params"]
            frames.append(params.get("gains", params)["frame"])
        assert "georeference" not in frames[0]
        assert frames[1]["georeference"]["crs"] == "EPSG:32632"
        assert "spatial_ref" not in opened(run, product)


def test_lines_keep_the_georeference_of_their_scene(tmp_path: Path, weights: Path) -> None:
    """The CRS and the hectares are kept after the scene file is deleted; another part of the field has no hectares."""
    scene = write_geotiff(tmp_path / "a.tif", TURNED)
    before = survey(scene, weights, tmp_path / "archive", budget=None, scan_step=1, keep="raw")
    scene.unlink()

    def again(**size: str) -> Published:
        given = {"sweeps": str(before.folder), "weights": str(weights), "out": str(tmp_path / "other"), **size}
        return run_survey(load_settings(None, {**given, "engine": "plain"}), QUIET)

    whole = again()
    assert whole.receipt["areas"] == before.receipt["areas"]
    assert corners_px(opened(whole, "class_map")["classes"].odc.geobox.affine, TURNED, SHAPE) < 1e-6
    assert "ha" not in again(size="32x32").receipt["areas"]


def test_a_pose_replaces_the_georeference_of_the_scene(tmp_path: Path, weights: Path) -> None:
    """A note says so, and only the ground map has a CRS."""
    pose = {"lon_deg": 7.6, "lat_deg": 51.96, "height_m": 30, "heading_deg": 20, "tilt_deg": 35}
    run = survey(write_geotiff(tmp_path / "a.tif", NORTH_UP), weights, tmp_path / "archive", **ONE_SCAN, pose=pose)
    assert any("[pose] replaces the georeference" in note for note in run.receipt["settings"]["notes"])
    assert "spatial_ref" not in opened(run, "class_map")
    assert "spatial_ref" in opened(run, "ground_map")


def test_every_store_opens_in_xarray_without_a_warning(tmp_path: Path, weights: Path) -> None:
    """Axes have coordinates with units, and a band is found by its wavelength."""
    run = survey(write_geotiff(tmp_path / "a.tif", NORTH_UP), weights, tmp_path / "archive", keep="raw", budget=1)
    for product in EVERY_STORE:
        address = run.receipt["products"][product]
        stores = sorted((tmp_path / "archive" / address).glob("*.zarr")) or [tmp_path / "archive" / address]
        for store in stores:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                content = xr.open_zarr(store)
            for name, array in content.data_vars.items():
                axes = [axis for axis in array.dims if not str(axis).startswith(UNCOUNTED)]
                assert set(axes) <= set(content.coords), (product, name)
                assert all("units" in content[axis].attrs for axis in axes), (product, name)
    axes = opened(run, "mosaic")["axes"]
    assert float(axes.sel(band=560, method="nearest")["wavelength"]) == 550
    swapped = axes.swap_dims(band="wavelength").sel(wavelength=[455, 700], method="nearest")
    assert swapped["wavelength"].values.tolist() == [460, 640]


def test_a_georeferenced_file_is_surveyed_and_exported(tmp_path: Path, real_data: Path, make_weights: Any) -> None:
    """Class map, areas and exports of rgbn.tif have the position and size of the source."""
    scene = real_data / "rgbn" / "rgbn_suba.tif"
    if not scene.is_file():
        pytest.skip(f"there is no {scene}")
    run = survey(scene, make_weights((640.0, 550.0, 460.0, 800.0)), tmp_path / "archive", **FILE_ALONE)
    files = run_export(tmp_path / "archive", None, tmp_path / "out", console=QUIET)["files"]
    with rasterio.open(scene) as source, rasterio.open(tmp_path / "out" / files["class_map"]) as file:
        assert (file.crs.to_epsg(), file.shape) == (source.crs.to_epsg(), source.shape)
        assert corners_px(file.transform, source.transform, source.shape) < 0.1
        empty = (source.read() == 0).all(axis=0)
        classes = file.read(1)
    assert (classes[empty] == 255).all()
    hectares = sum(run.receipt["areas"]["ha"].values())
    assert hectares == pytest.approx((classes != 255).sum() * 25 / 1e4, rel=5e-3)
