"""Polygon labels: on a map, in every format, found by name; one error for each mistake."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import geopandas
import numpy as np
import pytest
import rasterio
import shapely
from affine import Affine

from spectralzoom.flows.training.data import load_data_set
from spectralzoom.flows.training.init_command import draft_scene, run_init
from spectralzoom.pipeline.errors import SceneError
from spectralzoom.storage.readers.scene_files import load_scene_file
from tests.conftest import QUIET
from tests.storage.readers.test_raster_tags import write

pytestmark = pytest.mark.filterwarnings("ignore:'crs' was not provided")
PLACE = Affine(2, 0, 400_000, 0, -2, 5_700_000)
SHAPE = 10, 12  # (y, x)
WEST, EAST = shapely.box(400_000, 5_699_980, 400_008, 5_700_000), shapely.box(400_012, 5_699_990, 400_024, 5_700_000)
ELSEWHERE = shapely.box(0, 0, 4, 10), shapely.box(6, 0, 12, 5)
NONE = 255
TRUTH = np.full(SHAPE, NONE)
TRUTH[:, :4], TRUTH[:5, 6:] = 1, 0


def scene(folder: Path, name: str = "field.tif", place: Affine | None = PLACE) -> Path:
    """Write a scene of two bands, with or without a georeference."""
    path = folder / name
    path.parent.mkdir(exist_ok=True)
    known: dict[str, Any] = {} if place is None else {"crs": "EPSG:32632", "transform": place}
    with write(path, np.arange(240, dtype=np.uint8).reshape(2, *SHAPE), **known) as file:
        file.descriptions = ["500 nm", "600 nm"]
    return path


def written(path: Path, shapes: Any = (WEST, EAST), crs: Any = 32632, layer: str | None = None, **columns: Any) -> Path:
    """Write polygons with attributes."""
    path.parent.mkdir(exist_ok=True)
    columns = columns or {"crop": ["wheat", "maize"]}
    table = geopandas.GeoDataFrame(columns, geometry=list(shapes), crs=crs)
    table.to_file(path, engine="pyogrio", **({} if layer is None else {"layer": layer}))
    return path


@pytest.mark.parametrize(("name", "crs"), [("a.gpkg", 32632), ("a.geojson", 4326), ("a.shp", 3857)])
def test_polygons_on_a_map_become_labels(name: str, crs: int, tmp_path: Path) -> None:
    """In any format and CRS, exactly the pixels whose centres lie in a polygon have its class."""
    table = geopandas.GeoSeries([WEST, EAST], crs=32632).to_crs(crs)
    found = load_scene_file(scene(tmp_path), labels=written(tmp_path / "x" / name, table, crs))
    assert found.class_names == ("maize", "wheat")
    assert found.class_values == (1, 2)
    np.testing.assert_array_equal(found.labels, TRUTH)
    assert "2 polygons by their attribute crop" in found.provenance


def test_polygon_labels_equal_rasterios(tmp_path: Path) -> None:
    """A rotated grid and slanted polygons give the same as rasterio's own features."""
    place = PLACE * Affine.rotation(20)
    shapes = [shapely.Point(400_010, 5_699_995).buffer(6), shapely.Point(400_016, 5_699_990).buffer(5)]
    found = load_scene_file(scene(tmp_path, place=place), labels=written(tmp_path / "a.gpkg", shapes, code=[4, 7]))
    other = rasterio.features.rasterize(zip(shapes, (0, 1), strict=True), SHAPE, NONE, transform=place, dtype="uint8")
    np.testing.assert_array_equal(found.labels, other)
    assert found.class_names == ("class_4", "class_7")
    assert found.class_values == (4, 7)


def test_a_layer_is_selected_by_name(tmp_path: Path) -> None:
    """``FILE.gpkg:LAYER`` selects one of several layers, as an argument and in scene.toml."""
    path = written(tmp_path / "farm.gpkg", layer="crops")
    written(path, layer="soil", soil=["clay", "sand"])
    image = scene(tmp_path)
    np.testing.assert_array_equal(load_scene_file(image, labels=f"{path}:crops").labels, TRUTH)
    (tmp_path / "scene.toml").write_text('labels = "farm.gpkg:soil"\nclass_attribute = "soil"\n')
    assert load_scene_file(image).class_names == ("clay", "sand")


def test_polygons_use_the_classes_of_scene_toml(tmp_path: Path) -> None:
    """Names and numbers of [classes] apply; unlabelled polygons do not count, and unknown values are refused."""
    image = scene(tmp_path)
    (tmp_path / "scene.toml").write_text("unlabelled = 9\n[classes]\nmaize = 3\nwheat = 1\nbarley = 2\n")
    found = load_scene_file(image, labels=written(tmp_path / "names.gpkg"))
    assert found.class_values == (3, 1, 2)
    np.testing.assert_array_equal(found.labels, TRUTH)
    found = load_scene_file(image, labels=written(tmp_path / "numbers.gpkg", code=[1, 9]))
    np.testing.assert_array_equal(found.labels, np.where(TRUTH == 1, 1, NONE))
    found = load_scene_file(image, labels=written(tmp_path / "zeros.gpkg", code=["01", "03"]))
    np.testing.assert_array_equal(found.labels, TRUTH)
    with pytest.raises(SceneError, match="have 1 polygons of crop = 'oats', which is no class"):
        load_scene_file(image, labels=written(tmp_path / "odd.gpkg", crop=["wheat", "oats"]))


def test_overlapping_polygons_take_the_later_class(tmp_path: Path) -> None:
    """A note counts their pixels; a polygon without a value is left out."""
    shapes = [WEST, WEST.buffer(-2, join_style="mitre"), EAST]
    path = written(tmp_path / "a.gpkg", shapes, crop=["wheat", "maize", None])
    found = load_scene_file(scene(tmp_path), labels=path)
    expected = np.where(TRUTH == 1, 1, NONE)
    expected[1:9, 1:3] = 0
    np.testing.assert_array_equal(found.labels, expected)
    assert "16 px lie in polygons of several classes: the later polygon counts" in found.provenance
    assert "1 polygons without a value of crop are left out" in found.provenance


@pytest.mark.parametrize("name", ["field.gpkg", "field_labels.geojson", "labels/field.shp"])
def test_labels_are_found_by_their_names(name: str, tmp_path: Path) -> None:
    """The files have the scene's name, alone or with a word, or are in a folder `labels`; an image has priority."""
    image = scene(tmp_path)
    written(tmp_path / name)
    found = load_scene_file(image)
    np.testing.assert_array_equal(found.labels, TRUTH)
    write(tmp_path / "field_mask.tif", np.ones((1, *SHAPE), np.uint8)).close()
    assert load_scene_file(image).class_names == ("class_1",)


def test_scenes_of_a_folder_share_their_classes(tmp_path: Path) -> None:
    """Each scene has its own polygons; classes are those of all files by name, and `init` finds their fractions."""
    for name, crops in (("a", ["wheat", "maize"]), ("b", ["maize", "oats"])):
        scene(tmp_path, f"{name}.tif")
        written(tmp_path / f"{name}.gpkg", crop=crops)
    data = load_data_set(tmp_path)
    assert data.classes == {"maize": 1, "oats": 2, "wheat": 3}
    assert [data.load(name).class_names for name in ("a", "b")] == [("maize", "oats", "wheat")] * 2
    assert (data.load("b").labels == 0).sum() == (TRUTH == 1).sum()
    assert {one.name: (one.value, round(one.fraction * 140)) for one in draft_scene(tmp_path).classes} == {
        "maize": (1, 70),
        "oats": (2, 30),
        "wheat": (3, 40),
    }
    write(tmp_path / "c_mask.tif", np.ones((1, *SHAPE), np.uint8)).close()
    scene(tmp_path, "c.tif")
    with pytest.raises(SceneError, match=r"some labels are polygons .* and some are pictures"):
        _ = load_data_set(tmp_path).classes


def test_init_uses_the_class_attribute_of_scene_toml(tmp_path: Path) -> None:
    """`init` asks for an unusual attribute; with that in scene.toml it finds the classes and suggests training."""
    written(scene(tmp_path).with_suffix(".gpkg"), culture=["wheat", "maize"])
    asked = run_init(str(tmp_path), QUIET)
    assert "class_attribute" in asked["unseen"][0]
    assert "--force" in asked["next"]
    (tmp_path / "scene.toml").write_text('class_attribute = "culture"\n')
    told = run_init(str(tmp_path), QUIET, force=True)
    assert [one["name"] for one in told["classes"]] == ["maize", "wheat"]
    assert "train" in told["next"]
    assert load_data_set(tmp_path).load("field").class_names == ("maize", "wheat")


@pytest.mark.parametrize(
    ("shapes", "crs", "columns", "place", "words"),
    [
        ([shapely.Point(1, 1)] * 2, 32632, {}, PLACE, "expected polygons, got 2 Point"),
        ((WEST, EAST), 32632, {"owner": ["a", "b"]}, PLACE, r"lack an attribute that says the class; they have owner;"),
        ((WEST, EAST), 32632, {"crop": [None, None]}, PLACE, "have no class for any polygon"),
        ((WEST, EAST), 32632, {}, None, r"has polygons, and this field has no georeference"),
        ((WEST, EAST), None, {}, PLACE, "has no CRS"),
        (
            ELSEWHERE,
            32632,
            {},
            PLACE,
            "do not lie on the scene: all polygons are within x 0 to 12, y 0 to 10 in WGS 84",
        ),
        ([WEST.centroid.buffer(0.1)] * 2, 32632, {}, PLACE, "no pixel's centre lies in a polygon that has a class"),
    ],
)
def test_bad_polygons_are_refused(shapes: Any, crs: Any, columns: Any, place: Any, words: str, tmp_path: Path) -> None:
    """The error says what is wrong with which file, and what to do."""
    path = written(tmp_path / "labels.shp", shapes, crs, **columns)
    with pytest.raises(SceneError, match=words):
        load_scene_file(scene(tmp_path, place=place), labels=path)
