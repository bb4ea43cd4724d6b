"""Products for a sprayer, a QGIS project or a spreadsheet, read by programs that did not write them."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import geopandas
import numpy as np
import pyproj
import pytest
import rasterio
import shapely
from affine import Affine

from spectralzoom.flows.archive.export_command import run_export
from spectralzoom.flows.archive.export_layers import ProductFlags, parse_doses
from spectralzoom.flows.settings.settings import load_settings
from spectralzoom.flows.survey_command import run_survey
from spectralzoom.pipeline.errors import SettingsError, WavelengthError
from spectralzoom.pipeline.ground.map_grid import ground_grid, image_at
from spectralzoom.pipeline.ground.view import GroundView, RigPose
from spectralzoom.pipeline.products.indices import find_index
from spectralzoom.storage.arrays.mosaics import open_mosaic
from tests.conftest import QUIET
from tests.exported_run import Exported
from tests.prior_work import without_effects
from tests.storage.export.stac_rules import is_cog
from tests.users.test_georeference import SHAPE, TURNED, corners_px, survey, write_geotiff

POSE = RigPose(lon_deg=9.5, lat_deg=52.1, heading_deg=25.0, tilt_deg=50.0, height_m=1400.0)
BANDS = ",".join(map(str, range(5, 270, 11)))
FLAGS = {"reflectance": True, "indices": "NDVI,SAVI", "polygons": True, "dose": "track=2.5,wheat_a=1"}


def exported(archive: Path, out: Path, receipt: Any, **flags: Any) -> Exported:
    """Export the newest run of an archive with the given flags."""
    return Exported(archive, receipt, out, run_export(archive, None, out, QUIET, ProductFlags(**flags)))


@pytest.fixture(scope="module")
def posed(tmp_path_factory: pytest.TempPathFactory) -> Exported:
    """Return a small farm with a pose, at a height that gives pixels of about a metre, with all of its products."""
    archive, out = tmp_path_factory.mktemp("products") / "field", tmp_path_factory.mktemp("maps").resolve()
    given = {"size": "192x128", "bands": BANDS, "budget": "0.9", "engine": "plain", "seed": "1"}
    settings = load_settings(None, {**given, "out": str(archive)})
    with without_effects():
        published = run_survey(settings.but(pose=POSE), QUIET)
    return exported(archive, out, published.receipt, **FLAGS)


def test_the_reflectance_file_has_the_grid_of_the_map_and_wavelengths(posed: Exported) -> None:
    """It is a COG of the mosaic on the ground map's grid; bands are described as in GDAL, and NaN is nodata."""
    ground, mosaic = posed.store("ground_map"), posed.store("mosaic")
    assert is_cog(posed.file("reflectance"))
    scene = posed.store("class_map")
    grid = ground_grid(GroundView(POSE, scene.attrs["angular_grid"]["ifov_rad"]), scene["classes"].shape)
    rows, columns = (slice(0, size) for size in grid.shape)
    values = open_mosaic(posed.archive / posed.receipt["products"]["mosaic"]).values()
    wanted = image_at(values, grid.scene_pixels(rows, columns))
    with rasterio.open(posed.file("reflectance")) as file:
        np.testing.assert_allclose(np.moveaxis(file.read(), 0, -1), wanted, atol=1e-6)
        assert file.crs.to_epsg() == 32632
        resolution, _, left, _, _, top = ground.attrs["spatial:transform"]
        assert (file.transform.a, file.transform.c, file.transform.f) == (resolution, left, top)
        assert np.isnan(file.nodata)
        imagery = [file.tags(band, ns="IMAGERY") for band in file.indexes]
        assert file.descriptions[0] == f"{mosaic['wavelength'].values[0]:.1f} nm"
    centres = [1000 * float(tags["CENTRAL_WAVELENGTH_UM"]) for tags in imagery]
    np.testing.assert_allclose(centres, mosaic["wavelength"].values, rtol=1e-6)
    np.testing.assert_allclose([1000 * float(tags["FWHM_UM"]) for tags in imagery], mosaic["fwhm"].values, rtol=1e-6)


def test_an_index_follows_its_formula(posed: Exported) -> None:
    """NDVI equals the formula on the file's own bands; it is NaN if a band has no value or both are dark."""
    with rasterio.open(posed.file("reflectance")) as file:
        cube = np.moveaxis(file.read(), 0, -1)
        wave = [float(file.tags(band)["wavelength"]) for band in file.indexes]
    near, red = (int(np.argmin(np.abs(np.array(wave) - nm))) for nm in (832.8, 664.6))
    wanted = (cube[..., near] - cube[..., red]) / (cube[..., near] + cube[..., red])
    wanted[~(cube[..., [near, red]].mean(axis=-1) >= 0.01)] = np.nan
    with rasterio.open(posed.file("NDVI")) as file:
        np.testing.assert_allclose(file.read(1), wanted, atol=1e-5)
        assert file.tags()["reference"] == find_index("NDVI").reference
    assert np.isfinite(wanted).mean() > 0.2


def test_polygons_cover_the_map_without_gap_or_overlap(posed: Exported) -> None:
    """Rasterized, they equal the class map; GeoPackage and shapefile have its CRS, hectares and doses."""
    found = geopandas.read_file(posed.file("polygons"))
    assert found.crs.to_epsg() == 32632
    ground = posed.store("ground_map")
    classes = ground["classes"].values
    transform = Affine(*ground.attrs["spatial:transform"])
    shapes = zip(found.geometry, found["class"], strict=True)
    again = rasterio.features.rasterize(shapes, classes.shape, 255, transform=transform, dtype="uint8")
    np.testing.assert_array_equal(again, classes)
    assert found.area.sum() == pytest.approx((classes != 255).sum() * transform.a**2)
    np.testing.assert_allclose(found.hectares, found.area / 1e4, rtol=2e-3)  # UTM scales by 0.9996
    assert list(found.name) == [ground.attrs["class_names"][number] for number in found["class"]]
    doses = {"track": 2.5, "wheat_a": 1.0}
    assert list(found.dose) == [doses.get(name, 0.0) for name in found.name]
    other = geopandas.read_file(posed.file("polygons_shapefile"))
    assert other.crs.to_epsg() == 32632
    assert [list(other[name]) for name in ("name", "dose")] == [list(found[name]) for name in ("name", "dose")]
    np.testing.assert_allclose(other.area, found.area)


def test_the_table_of_areas_is_consistent_with_map_and_receipt(posed: Exported) -> None:
    """Pixels are those of the map, hectares those of the receipt, fractions sum to 1, errors are not negative."""
    with posed.file("areas").open() as text:
        table = list(csv.DictReader(text))
    names = [row["class"] for row in table]
    counts = np.bincount(posed.store("ground_map")["classes"].values.ravel(), minlength=256)
    assert [int(row["pixels"]) for row in table] == counts[: len(names)].tolist()
    hectares = posed.receipt["areas"]["ha"]
    np.testing.assert_allclose([float(row["hectares"]) for row in table], [hectares[name] for name in names], rtol=1e-5)
    for column in ("fraction", "estimated_fraction"):
        assert sum(float(row[column]) for row in table) == pytest.approx(1, abs=1e-4)
    assert all(float(row["standard_error"]) >= 0 for row in table)
    by_labels = np.array(posed.receipt["accuracy"]["confusion"])
    assert by_labels.sum() == posed.receipt["accuracy"]["pixels"]


def test_the_catalogue_lists_every_product(posed: Exported) -> None:
    """The files of its assets exist."""
    item = posed.item()
    wanted = {"reflectance", "NDVI", "SAVI", "polygons", "polygons_shapefile", "areas"}
    assert wanted <= set(item["assets"])
    assert all(posed.file(key).is_file() for key in posed.answer["files"])
    assert len(item["assets"]["reflectance"]["bands"]) == len(posed.store("mosaic")["wavelength"])


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        ({"dose": "weed"}, "expects each class once with a number, weed=2.5, got 'weed'"),
        ({"dose": "weed=1e9"}, "got 'weed=1e9'; numbers are 0 or more, without an exponent"),
        *((({name: ","}), f"--{name} ',' names nothing") for name in ("dose", "indices")),
        ({"dose": "weed=1,weed=2"}, "expects each class once with a number, weed=2.5, got 'weed=2'"),
        ({"dose": "thistle=1"}, "no class 'thistle'; its classes are soil, maize"),
        ({"indices": "NDVI,NDMI"}, "NDMI wants Short-wave Infrared"),
    ],
)
def test_impossible_flags_are_refused_first(posed: Exported, tmp_path: Path, flags: dict[str, Any], words: str) -> None:
    """One message names the expected value before any file is written, and no output folder is made."""
    with pytest.raises((SettingsError, WavelengthError), match=words):
        exported(posed.archive, tmp_path / "out", {}, **flags)
    assert not (tmp_path / "out").exists()


def test_a_class_name_may_contain_an_equals_sign() -> None:
    """The dose follows the last equals sign."""
    assert parse_doses("a=1=2.5,b=1") == {"a=1": 2.5, "b": 1.0}


def test_a_survey_without_a_place_exports_polygons_and_ratio_indices(surveyed_png: Any, tmp_path: Path) -> None:
    """Polygons are in camera angles, without hectares; reflectance indices are refused with the reason."""
    archive, out = tmp_path / "archive", tmp_path / "out"
    one_picture = exported(archive, out, surveyed_png(archive).receipt, indices="VARI", polygons=True, reflectance=True)
    found = geopandas.read_file(one_picture.file("polygons"))
    assert found.crs is None
    assert "hectares" not in found
    assert geopandas.read_file(one_picture.file("polygons_shapefile")).crs is None
    store = one_picture.store("class_map")
    assert found.area.sum() == pytest.approx(store["classes"].size * store.attrs["spatial:transform"][0] ** 2, rel=0.01)
    words = r"ExG wants reflectance \(0 to 1\), and the values .* choose an index of ratios"
    with pytest.raises(SettingsError, match=words):
        exported(archive, out / "no", {}, indices="ExG")
    assert not (out / "no").exists()


@pytest.mark.parametrize(
    ("crs", "transform"),
    [
        ("EPSG:32632", TURNED),
        ("EPSG:4326", Affine(7e-7, 0, 9.5, 0, -4.5e-7, 52.1)),
        ("EPSG:3857", Affine(0.08, 0, 1_057_535, 0, -0.08, 6_819_000)),
    ],
    ids=["turned", "in degrees", "web mercator"],
)
def test_products_have_the_position_of_their_scene(tmp_path: Path, weights: Path, crs: str, transform: Affine) -> None:
    """Corners are right to 0.1 px in the scene's CRS, and hectares are true in each; a gap gets no polygon."""
    scene = write_geotiff(tmp_path / "a.tif", transform, gap=True, crs=crs)
    run = survey(scene, weights, tmp_path / "archive", source="raster", budget=None)
    done = exported(tmp_path / "archive", tmp_path / "out", run.receipt, polygons=True, indices="VARI")
    with rasterio.open(done.file("VARI")) as file:
        assert str(file.crs) == crs
        assert corners_px(file.transform, transform, file.shape) < 0.1
        assert np.isnan(file.read(1)[:5, :6]).all()
    found = geopandas.read_file(done.file("polygons"))
    assert str(found.crs) == crs
    column, row = ~transform * shapely.get_coordinates(found.geometry).T
    rows, columns = SHAPE
    assert (column.min(), column.max(), row.min(), row.max()) == pytest.approx((0, columns, 0, rows), abs=0.1)
    assert ((column >= 24 - 0.1) | (row >= 20 - 0.1)).all()  # nothing in the gap
    geod = pyproj.Geod(ellps="WGS84")
    areas = [abs(geod.geometry_area_perimeter(one)[0]) / 1e4 for one in found.to_crs(4326).geometry]
    assert found.hectares.sum() == pytest.approx(sum(areas), rel=1e-3)
    assert done.item()["bbox"][0] == pytest.approx(9.5, abs=0.1)
