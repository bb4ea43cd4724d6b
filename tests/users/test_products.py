"""Products for a sprayer, a QGIS project or a spreadsheet, read by programs that did not write them."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import geopandas
import numpy as np
import pyproj
import pytest
import rasterio
import shapely
from affine import Affine
from isoxml.converter.np_grid import to_numpy_array
from isoxml.util.isoxml_io import isoxml_from_path
from odc.geo.geobox import GeoBox
from scipy import ndimage

from flows.archive.export_command import run_export
from flows.archive.export_layers import ProductFlags, choose_products, open_exported
from flows.archive.export_zones import ClassRaster, check_zones, dose_cells
from flows.settings.load import load_settings
from flows.survey_command import run_survey
from pipeline.errors import SettingsError, WavelengthError
from pipeline.ground.map_grid import ground_grid, image_at
from pipeline.ground.view import GroundView, RigPose
from pipeline.products.indices import find_index
from storage.archive.archive import Archive
from storage.arrays.class_maps import ClassNames
from storage.arrays.mosaics import open_mosaic
from tests.conftest import QUIET
from tests.exported_run import Exported
from tests.prior_work import without_effects
from tests.storage.export.stac_rules import core_problems, extension_problems, is_cog
from tests.users.test_georeference import SHAPE, TURNED, corners_px, survey, write_geotiff

POSE = RigPose(lon_deg=9.5, lat_deg=52.1, heading_deg=25.0, tilt_deg=50.0, height_m=1400.0)
BANDS = ",".join(map(str, range(5, 270, 11)))
FLAGS = {"reflectance": True, "indices": "NDVI,SAVI", "polygons": True, "prescription": "track=2.5,wheat_a=1"}


def exported(archive: Path, out: Path, receipt: Any, **flags: Any) -> Exported:
    """Export the newest run of an archive with the given flags."""
    choice = choose_products(ProductFlags(**flags))
    return Exported(archive, receipt, out, run_export(archive, None, out, False, QUIET, choice))


@pytest.fixture(scope="module")
def posed(tmp_path_factory: pytest.TempPathFactory) -> Exported:
    """Return a small farm with a pose, at a height that gives pixels of about a metre, with all of its products."""
    archive, out = tmp_path_factory.mktemp("products") / "field", tmp_path_factory.mktemp("maps").resolve()
    given = {"size": "192x128", "bands": BANDS, "budget": "0.9", "engine": "plain", "seed": "1"}
    settings = load_settings(None, {**given, "out": str(archive)})
    with without_effects():
        published = run_survey(replace(settings, pose=POSE), QUIET)
    return exported(archive, out, published.receipt, **FLAGS, cell=3.0)


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
    """Rasterized, they equal the class map; GeoPackage in its CRS, GeoJSON in longitude and latitude (RFC 7946)."""
    found = geopandas.read_file(posed.file("polygons"))
    assert found.crs.to_epsg() == 32632
    ground = posed.store("ground_map")
    classes = ground["classes"].values
    transform = Affine(*ground.attrs["spatial:transform"])
    shapes = zip(found.geometry, found["class"], strict=True)
    again = rasterio.features.rasterize(shapes, classes.shape, 255, transform=transform, dtype="uint8")
    np.testing.assert_array_equal(again, classes)
    assert found.area.sum() == pytest.approx((classes != 255).sum() * transform.a**2)
    assert list(found.name) == [ground.attrs["class_names"][number] for number in found["class"]]
    content = json.loads(posed.file("polygons_geojson").read_text())
    assert "crs" not in content
    rings = [shapely.LinearRing(one["geometry"]["coordinates"][0]) for one in content["features"]]
    assert all(shapely.is_ccw(rings))
    degrees = geopandas.read_file(posed.file("polygons_geojson"))
    assert list(degrees.name) == list(found.name)
    np.testing.assert_allclose(degrees.to_crs(32632).area, found.area, rtol=1e-3)


def _classes_of_polygons(posed: Exported) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[str]]:
    """Return the centres of the map's pixels, their classes and the class names."""
    ground = posed.store("ground_map")
    a, _, c, _, e, f = ground.attrs["spatial:transform"]
    rows, columns = ground["classes"].shape
    x, y = np.meshgrid(c + a * (np.arange(columns) + 0.5), f + e * (np.arange(rows) + 0.5))
    return x, y, ground["classes"].values, ground.attrs["class_names"]


def test_prescription_cells_hold_the_dose_of_their_classes(posed: Exported) -> None:
    """A cell's dose is at least the highest dose of the pixel centres inside, and at most that within 1.5 m around."""
    cells = geopandas.read_file(posed.file("prescription"))
    assert cells.crs.to_epsg() == 32632
    assert set(cells.dose) == {0.0, 1.0, 2.5}
    assert set(cells.unit) == {"l/ha"}
    np.testing.assert_allclose(cells.area, 9.0)
    x, y, classes, names = _classes_of_polygons(posed)
    doses = np.zeros(256)
    doses[[names.index("track"), names.index("wheat_a")]] = 2.5, 1.0
    tree = shapely.STRtree(shapely.points(x.ravel(), y.ravel()))
    for cell, dose in zip(cells.geometry, cells.dose, strict=True):
        inside, around = (classes.ravel()[tree.query(one, predicate="contains")] for one in (cell, cell.buffer(1.5)))
        assert doses[inside].max(initial=0) <= dose <= doses[around].max(initial=0)
    covered = shapely.union_all(cells.geometry)
    assert shapely.contains_xy(covered, x[classes != 255], y[classes != 255]).all()


def test_task_data_match_the_class_map(posed: Exported) -> None:
    """Another library reads the grid: cells that are mostly wheat hold its dose, cells without pixels hold 0."""
    task_data, numbers = isoxml_from_path(posed.file("task_data"))
    (grid,) = task_data.tasks[0].grids
    doses = to_numpy_array(numbers[grid.filename], grid) / 10_000
    assert set(np.unique(doses)) == {0.0, 1.0, 2.5}
    x, y, classes, names = _classes_of_polygons(posed)
    to_degrees = pyproj.Transformer.from_crs(32632, 4326, always_xy=True)
    lon, lat = to_degrees.transform(x, y)
    row = np.floor((lat - float(grid.minimum_north_position)) / grid.cell_north_size).astype(int)
    column = np.floor((lon - float(grid.minimum_east_position)) / grid.cell_east_size).astype(int)
    known = classes != 255
    assert row[known].min() >= 0
    assert row[known].max() < grid.maximum_row
    assert column[known].max() < grid.maximum_column
    wheat, total = np.zeros(doses.shape), np.zeros(doses.shape)
    np.add.at(total, (row[known], column[known]), 1)
    np.add.at(wheat, (row[known], column[known]), classes[known] == names.index("wheat_a"))
    mostly = (total > 4) & (wheat > 0.5 * total)
    assert mostly.sum() > 10
    assert (doses[mostly] >= 1.0).all()
    assert (doses[ndimage.maximum_filter(total, 3) == 0] == 0).all()  # a cell may have a part of a pixel


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
    """The STAC item is valid, and the files of its assets exist."""
    item = posed.item()
    assert core_problems(Path(posed.answer["item"])) == []
    assert extension_problems(item) == []
    wanted = {"reflectance", "NDVI", "SAVI", "polygons", "polygons_geojson", "prescription", "task_data", "areas"}
    assert wanted <= set(item["assets"])
    assert all(posed.file(key).is_file() for key in posed.answer["files"])
    assert len(item["assets"]["reflectance"]["bands"]) == len(posed.store("mosaic")["wavelength"])


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        ({"prescription": "weed"}, "expects classes with numbers, weed=2.5, got 'weed'"),
        ({"prescription": "weed=1", "dose_unit": "gal/ac"}, "--dose-unit expects l/ha or kg/ha, got 'gal/ac'"),
        ({"prescription": "weed=1e9"}, "got 'weed=1e9'; numbers are 0 or more, without an exponent"),
        *((({name: ","}), f"--{name} ',' names nothing") for name in ("prescription", "indices")),
        ({"prescription": "weed=1,weed=2"}, "names weed twice; give it one number"),
        *(
            ({"prescription": "weed=1", "cell": m}, "--cell expects metres above 0 and at most 1000")
            for m in (0.0, 1e9)
        ),
        *((one, "--cell and --dose-unit need --prescription") for one in ({"cell": 2.0}, {"dose_unit": "kg/ha"})),
        ({"prescription": "thistle=1"}, "no class 'thistle'; its classes are soil, maize"),
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
    assert choose_products(ProductFlags(prescription="a=1=2.5,b=1")).doses == {"a=1": 2.5, "b": 1.0}


@pytest.mark.parametrize(
    ("crs", "box", "words"),
    [
        ("EPSG:4326", (10, 89.9, 11, 89.99), "beyond 84 degrees north or 80 south"),
        ("EPSG:32660", (820_000, 1_100_000, 840_000, 1_110_000), "across 180 degrees of longitude"),
        ("EPSG:4326", (179.9997, 10, 180.0003, 10.0005), "across 180 degrees of longitude"),
    ],
)
def test_a_prescription_over_a_border_is_refused(posed: Exported, crs: str, box: tuple[float, ...], words: str) -> None:
    """The borders are the limits of UTM in latitude and the longitude of 180 degrees."""
    run = Mock(wraps=open_exported(Archive.open(posed.archive), None), map_product="class_map")
    run.geobox = GeoBox.from_bbox(box, crs=crs, shape=(4, 4))
    with pytest.raises(SettingsError, match=words):
        check_zones(run, choose_products(ProductFlags(prescription="weed=1")))


def test_a_survey_without_a_place_exports_polygons_and_ratio_indices(surveyed_png: Any, tmp_path: Path) -> None:
    """Polygons are in camera angles, without GeoJSON; doses and reflectance indices are refused with the reason."""
    archive, out = tmp_path / "archive", tmp_path / "out"
    one_picture = exported(archive, out, surveyed_png(archive).receipt, indices="VARI", polygons=True, reflectance=True)
    found = geopandas.read_file(one_picture.file("polygons"))
    assert found.crs is None
    assert "polygons_geojson" not in one_picture.answer["files"]
    store = one_picture.store("class_map")
    assert found.area.sum() == pytest.approx(store["classes"].size * store.attrs["spatial:transform"][0] ** 2, rel=0.01)
    with pytest.raises(SettingsError, match=r"metres, and the run has no place .* \[pose\]"):
        exported(archive, out / "no", {}, prescription="class_1=1")
    words = r"ExG wants reflectance \(0 to 1\), and the values .* choose an index of ratios"
    with pytest.raises(SettingsError, match=words):
        exported(archive, out / "no", {}, indices="ExG")
    assert not (out / "no").exists()


@pytest.mark.parametrize(
    ("crs", "transform"),
    [
        ("EPSG:32632", TURNED),
        *(("EPSG:4326", Affine(7e-7, 0, lon, 0, -4.5e-7, 52.1)) for lon in (9.5, 369.5)),
        ("EPSG:3857", Affine(0.08, 0, 1_057_535, 0, -0.08, 6_819_000)),
    ],
    ids=["turned", "in degrees", "beyond 180 degrees", "web mercator"],
)
def test_products_have_the_position_of_their_scene(tmp_path: Path, weights: Path, crs: str, transform: Affine) -> None:
    """Corners are right to 0.1 px in the scene's CRS; cells are square in metres; a gap gets no dose."""
    scene = write_geotiff(tmp_path / "a.tif", transform, gap=True, crs=crs)
    run = survey(scene, weights, tmp_path / "archive", source="raster", budget=None)
    flags = {"polygons": True, "indices": "VARI", "prescription": "class_1=2", "cell": 0.5}
    done = exported(tmp_path / "archive", tmp_path / "out", run.receipt, **flags)
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
    cells = geopandas.read_file(done.file("prescription"))
    assert cells.crs.to_epsg() == 32632
    np.testing.assert_allclose(cells.area, 0.25, rtol=1e-6)
    assert (cells.dose == 2).any()
    assert {0.0, 2.0} >= set(cells.dose)
    task_data, numbers = isoxml_from_path(done.file("task_data"))
    (grid,) = task_data.tasks[0].grids
    lowest = float(grid.minimum_east_position), float(grid.minimum_north_position)
    assert lowest == pytest.approx(done.item()["bbox"][:2], abs=1e-5)
    assert 9 < lowest[0] < 10
    assert (to_numpy_array(numbers[grid.filename], grid) > 0).any()


@pytest.mark.parametrize(("turned_deg", "pixel_m"), [(0, 2.0), (0, 10.0), (15, 0.5), (30, 2.0), (30, 10.0), (45, 0.5)])
def test_cells_have_the_dose_of_the_pixels_that_they_overlap(turned_deg: float, pixel_m: float) -> None:
    """Single weed pixels of a rotated map treat a cell of which they cover 0.1 %; 5 % of any class give it a dose."""
    classes = (np.random.default_rng(1).random((40, 50)) < 0.02).astype(np.uint8)
    place = Affine.translation(400_000, 5_750_000) * Affine.rotation(turned_deg) * Affine.scale(pixel_m, -pixel_m)
    field = GeoBox((40, 50), place, "EPSG:32632")
    legend = ClassNames(("soil", "weed"), np.zeros((2, 3), np.uint8))
    cells = GeoBox.from_bbox(tuple(field.extent.boundingbox), crs="EPSG:32632", resolution=3)
    dose = dose_cells(ClassRaster(classes, legend, place, field), {"weed": 2.0}, cells)
    row, column = np.indices(cells.shape)
    left, top = cells.affine * (0, 0)
    boxes = shapely.box(left + 3 * column, top - 3 * row - 3, left + 3 * column + 3, top - 3 * row)
    weeds = [shapely.box(x, y, x + 1, y + 1) for y, x in np.argwhere(classes)]
    outlines = [shapely.union_all(weeds), shapely.box(0, 0, 50, 40)]
    there = shapely.transform(outlines, lambda xy: np.stack(place * xy.T, axis=-1))
    weed_m2, mapped_m2 = (shapely.area(shapely.intersection(boxes, one)) for one in there)
    assert (dose[weed_m2 > 1e-3 * 9] == 2).all()
    assert np.isfinite(dose[mapped_m2 > 0.05 * 9]).all()
    assert (dose == 0).any()


def test_cells_of_coarse_pixels_cover_the_field(tmp_path: Path, weights: Path) -> None:
    """With pixels of 30 m on multiples of 30 m, each pixel is one cell by default; the gap in a corner has none."""
    scene = write_geotiff(tmp_path / "a.tif", Affine(30, 0, 534_240, 0, -30, 5_772_330), gap=True)
    survey(scene, weights, tmp_path / "archive", source="raster", budget=None)
    done = exported(tmp_path / "archive", tmp_path / "out", {}, polygons=True, prescription="class_1=2,class_2=1")
    cells, field = geopandas.read_file(done.file("prescription")), geopandas.read_file(done.file("polygons"))
    assert len(cells) == 3160
    assert cells.area.sum() == pytest.approx(field.area.sum())
    assert shapely.union_all(field.geometry).difference(shapely.union_all(cells.geometry)).area < 1
    treated = field[field.name.isin(["class_1", "class_2"])].area.sum()
    assert cells.area[cells.dose > 0].sum() == pytest.approx(treated)
    task_data, numbers = isoxml_from_path(done.file("task_data"))
    (grid,) = task_data.tasks[0].grids
    fraction = (to_numpy_array(numbers[grid.filename], grid) > 0).mean()
    assert fraction == pytest.approx(treated / field.area.sum(), rel=0.35)
