"""Area of interest and plots limit a survey from its lines to its areas, and the receipt lists them."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import geopandas
import numpy as np
import pandas
import pytest
import rasterio
import shapely
from affine import Affine

from spectralzoom.flows.opening.open_field import open_field
from spectralzoom.flows.plan import SurveyPlan
from spectralzoom.flows.planning.plan_survey import plan_survey
from spectralzoom.flows.publish.run_folder import Published
from spectralzoom.flows.settings.settings import load_settings, parse_settings
from spectralzoom.pipeline.errors import SettingsError, ZoneError
from spectralzoom.pipeline.geometry.grid import UNLABELLED
from spectralzoom.storage.arrays.class_maps import ClassMap, ProbabilityStore, load_class_map
from spectralzoom.storage.arrays.layout import open_group, read_array
from spectralzoom.storage.arrays.mosaics import chosen_patches
from tests.conftest import Survey
from tests.prior_work import without_effects
from tests.users.zone_sketches import sketch

pytestmark = pytest.mark.usefixtures("no_effects")
NO_GO = shapely.box(50, 24, 58, 33)  # a hole of the area
AREA = shapely.Polygon([(20, 8), (118, 10), (110, 62), (24, 60)]).difference(NO_GO)  # in pixels
PLACE = Affine(1, 0, 400_000, 0, -1, 5_700_000)  # a pixel is a square metre
SHAPES = {"north": (24, 12, 100, 36), "south": (24, 36, 100, 60), "away": (400, 0, 410, 9)}
PLOTS = {name: shapely.box(*corners) for name, corners in SHAPES.items()}
POSE = {"lon_deg": 7.6, "lat_deg": 51.96, "height_m": 30, "heading_deg": 20, "tilt_deg": 35}
NARROW = {"camera.samples": 64, "budget": "1"}


def drawn(out: Path, published: Published) -> ClassMap:
    """Return the class map of a run."""
    return load_class_map(out / published.receipt["products"]["class_map"])


Opened = Callable[..., SurveyPlan]


def on_map(shape: shapely.Geometry) -> shapely.Geometry:
    """Return a polygon of the scene's pixels in metres of UTM zone 32."""
    return shapely.affinity.affine_transform(shape, PLACE.to_shapely())


@pytest.fixture(scope="module")
def scene(scene_files: Path) -> str:
    """Return the small picture as a GeoTIFF with a place on the earth."""
    path = scene_files / "placed.tif"
    with rasterio.open(scene_files / "scene.png") as picture:
        about = picture.profile | {"driver": "GTiff", "crs": "EPSG:32632", "transform": PLACE, "photometric": "RGB"}
        with rasterio.open(path, "w", **about) as file:
            file.write(picture.read())
    return str(path)


@pytest.fixture
def opened(scene: str, weights: Path, tmp_path: Path) -> Opened:
    """Return a function that opens a survey of the small picture with given settings, without running it."""

    def open_with(**given: Any) -> SurveyPlan:
        basic = {"scene": scene, "source": "sim", "weights": str(weights), "out": str(tmp_path / "archive")}
        settings = parse_settings(basic | {name: value for name, value in given.items() if value is not None})
        return plan_survey(open_field(settings, planning=True))

    return open_with


@pytest.fixture(scope="module")
def zones(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Return files of an area with a hole, and of plots."""
    folder = tmp_path_factory.mktemp("zones")
    return {
        "area": sketch(folder / "area.geojson", {"field": on_map(AREA)}, 32632),
        "plots": sketch(folder / "plots.gpkg", {name: on_map(shape) for name, shape in PLOTS.items()}, 32632),
    }


@pytest.fixture(scope="module")
def kept_to(
    survey_png: Survey, scene: str, zones: dict[str, str], tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, Published]:
    """Return the archive and the run of a survey with the area and the plots."""
    out = tmp_path_factory.mktemp("kept") / "archive"
    with without_effects():
        return out, survey_png(out, scene=scene, **NARROW, **zones)


@pytest.fixture(scope="module")
def whole(survey_png: Survey, scene: str, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Published]:
    """Return the archive and the run of a survey of the whole field."""
    out = tmp_path_factory.mktemp("whole") / "archive"
    with without_effects():
        return out, survey_png(out, scene=scene)


def inside(shape: shapely.Geometry) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """Return a mask of the pixels whose centres lie in a polygon, by shapely alone."""
    x, y = np.meshgrid(np.arange(128) + 0.5, np.arange(96) + 0.5)
    return np.asarray(shapely.contains_xy(shape, x, y))


def test_the_class_map_covers_the_area_without_its_hole(kept_to: tuple[Path, Published]) -> None:
    """Pixels there have a class, a confidence, an accuracy, and probabilities for the next visit; others have none."""
    found = drawn(*kept_to)
    classed = found.classes != UNLABELLED
    assert (classed != inside(AREA)).sum() <= 2 * AREA.length / 100  # on the border only, if at all
    assert not classed[inside(NO_GO)].any()
    out, published = kept_to
    values, age, _ = ProbabilityStore(out / published.receipt["products"]["class_probabilities"]).read()
    for known in (found.confidence, values[..., 0], age):
        assert np.array_equal(np.isfinite(known), classed)
    assert published.receipt["accuracy"]["pixels"] == classed.sum()


def test_patches_outside_or_in_a_hole_are_never_chosen(kept_to: tuple[Path, Published]) -> None:
    """Their score is 0 and they have no rank."""
    out, published = kept_to
    products = published.receipt["products"]
    score, rank = (read_array(open_group(out / products["attention"]), name) for name in ("score", "rank"))
    rows, columns = rank.shape
    patch_index = [shapely.box(8 * x, 8 * y, 8 * x + 8, 8 * y + 8) for y in range(rows) for x in range(columns)]
    barred = np.array([not patch_number.intersects(AREA) for patch_number in patch_index])
    cut = chosen_patches(out / products["attention"])
    assert len(cut) > 10
    assert not barred[cut].any()
    assert (rank.ravel()[barred] == -1).all()
    assert (score.ravel()[barred] == 0).all()


def test_lines_outside_are_left_out(kept_to: tuple[Path, Published], opened: Opened, zones: dict[str, str]) -> None:
    """Coarse pass, full scan and the reference of the reading cover the area only, and cost less than the field's."""
    rest = {"camera": {"samples": 64}, "budget": 1.0}
    plan = opened(**zones, **rest)
    kept, field = plan.passes, plan.field
    assert kept_to[1].receipt["savings"]["patches"]["full"] == len(field.kept_patches) < field.grid.every_patch().size
    whole = opened(**rest).passes
    assert sum(one.lines for one in kept.coarse) < sum(one.lines for one in whole.coarse)
    assert kept.full_s < whole.full_s
    assert kept_to[1].receipt["savings"]["capture_s"]["full"] == pytest.approx(kept.full_s)


def test_plots_are_listed_in_receipt_and_csv(kept_to: tuple[Path, Published]) -> None:
    """Fractions, pixels and confidence are those of the map; a plot outside of the field has 0 pixels."""
    _, published = kept_to
    found = drawn(*kept_to)
    table = pandas.read_csv(published.folder / "plots.csv").set_index("plot")
    rows = {row["plot"]: row for row in published.receipt["plots"]}
    assert list(rows) == ["north", "south", "away"] == list(table.index)
    for name in ("north", "south"):
        mapped = inside(PLOTS[name]) & (found.classes != UNLABELLED)
        counts = np.bincount(found.classes[mapped], minlength=3)
        assert rows[name]["mapped_pixels"] == mapped.sum() == table.loc[name, "mapped_pixels"]
        assert list(rows[name]["fractions"].values()) == pytest.approx(counts / counts.sum())
        assert table.loc[name, "fraction_class_1"] == pytest.approx(rows[name]["fractions"]["class_1"])
        assert rows[name]["confidence"] == pytest.approx(found.confidence[mapped].mean(), rel=1e-5)
    assert (rows["away"]["pixels"], rows["away"]["confidence"]) == (0, None)
    assert "plots.csv" in published.receipt["products"]
    assert "north" in (published.folder / "report.html").read_text(encoding="utf-8")


def test_a_visit_with_zones_keeps_the_prior_map_outside_of_them(
    survey_png: Survey, scene: str, whole: tuple[Path, Published], zones: dict[str, str], tmp_path: Path
) -> None:
    """Outside of the area the classes stay those of the prior map, and no pass is counted."""
    first = whole[1]
    shutil.copytree(whole[0], tmp_path, dirs_exist_ok=True)
    second = survey_png(tmp_path, scene=scene, visit="second", prior="latest", accuracy=False, **zones)
    before, after = (
        ProbabilityStore(tmp_path / one.receipt["products"]["class_probabilities"]).read() for one in (first, second)
    )
    away = drawn(tmp_path, second).classes == UNLABELLED
    assert away.any()
    assert np.array_equal(before[0][away].argmax(axis=-1), after[0][away].argmax(axis=-1))
    assert np.isfinite(after[0]).all()
    assert (after[2][away] <= before[2][away] + 1e-6).all()


def test_an_area_of_the_whole_field_changes_no_key(
    survey_png: Survey, scene: str, whole: tuple[Path, Published], tmp_path: Path
) -> None:
    """Every store has its key without zones, so the survey makes no new store."""
    shutil.copytree(whole[0], tmp_path / "archive")
    area = sketch(tmp_path / "all.geojson", {"all": on_map(shapely.box(-5, -5, 200, 200))}, 32632)
    published = survey_png(tmp_path / "archive", scene=scene, **{"area": area})
    assert {stage["state"] for stage in published.receipt["stages"]} == {"cached"}
    assert "zones" not in published.receipt


def test_polygons_in_any_crs_give_the_same_mask(opened: Opened, tmp_path: Path) -> None:
    """The far half of the field is given in metres, in degrees, in web Mercator and in LAEA (axes north, east)."""
    place = opened(pose=POSE).field.place
    west, south, east, north = place.outline.bounds
    half = shapely.intersection(place.outline, shapely.box(west, (south + north) / 2, east, north))
    fine = geopandas.GeoSeries([half], crs=place.crs).segmentize((east - west) / 500)
    masks = []
    for name, crs in (("utm.gpkg", 32632), ("globe.geojson", 4326), ("web.shp", 3857), ("laea.gpkg", 3035)):
        path = sketch(tmp_path / name, {"half": fine.to_crs(crs).iloc[0]}, crs)
        masks.append(opened(pose=POSE, area=path).field.zones.kept)
    assert 0.2 < masks[0].mean() < 0.8
    differ = [(mask != masks[0]).sum() for mask in masks]
    assert max(differ) <= 16  # of 12 288: datums differ by half a millimetre after a round trip, a pixel has 7


@pytest.mark.parametrize(
    ("kind", "shape", "crs", "pose", "words"),
    [
        ("area", on_map(shapely.box(300, 0, 400, 50)), 32632, None, "expected some in x 7.5.*got x 7.5"),
        ("plots", on_map(shapely.box(-3.5, 0, -0.5, 50)), 32632, None, "do not lie on the field"),
        ("area", on_map(shapely.box(10.1, 10.1, 10.3, 10.3)), 32632, None, "smaller than a pixel"),
        ("area", shapely.box(8.5, 51.9, 8.7, 52), 4326, POSE, "x 7.6.*got x 8.5 to 8.7"),
    ],
    ids=["beside", "at the border", "tiny", "another farm"],
)
def test_a_zone_off_the_field_is_refused(
    opened: Opened, tmp_path: Path, kind: str, shape: Any, crs: int, pose: Any, words: str
) -> None:
    """The message gives both extents."""
    path = sketch(tmp_path / "zone.gpkg", {"a": shape}, crs)
    with pytest.raises(ZoneError, match=words):
        opened(**{kind: path}, pose=pose)


def test_zones_of_a_field_without_a_place_are_refused(opened: Opened, scene_files: Path, tmp_path: Path) -> None:
    """The message names both ways to give the field a place."""
    path = sketch(tmp_path / "zone.geojson", {"a": shapely.box(0, 0, 50, 50)}, 4326)
    with pytest.raises(ZoneError, match=r"no georeference: give the rig's \[pose\], or a scene with a CRS"):
        opened(scene=str(scene_files / "scene.png"), area=path)


def test_plots_name_without_plots_is_refused() -> None:
    """The message names the missing flag."""
    with pytest.raises(SettingsError, match="give --plots FILE too"):
        load_settings(None, {"plots_name": "variety"})


def test_paths_of_zones_are_relative_to_the_settings_file(tmp_path: Path) -> None:
    """The layer of a GeoPackage is kept, and an unset zone stays None."""
    (tmp_path / "s.toml").write_text('area = "area.geojson"\nplots = "plots.gpkg:trial"\n')
    found = load_settings(tmp_path / "s.toml")
    assert (found.area, found.plots) == (str(tmp_path / "area.geojson"), str(tmp_path / "plots.gpkg:trial"))
