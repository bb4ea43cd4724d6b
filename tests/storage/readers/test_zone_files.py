"""Files of polygons: formats, layers, names and CRS as written, mended borders, and one message for each mistake."""

from __future__ import annotations

import json
import math
import struct
from pathlib import Path
from typing import Any

import geopandas
import pytest
import shapely

from pipeline.errors import ZoneError
from storage.readers.polygons import read_zones

SQUARE, OTHER = shapely.box(0, 0, 10, 10), shapely.box(20, 0, 25, 10)
BOWTIE = shapely.Polygon([(0, 0), (10, 10), (10, 0), (0, 10)])


def written(path: Path, shapes: list[Any], crs: Any = 32632, layer: str | None = None, **columns: list[Any]) -> str:
    """Write geometries with attributes; gives the path."""
    table = geopandas.GeoDataFrame(columns, geometry=shapes, crs=crs)
    table.to_file(path, engine="pyogrio", **({} if layer is None else {"layer": layer}))
    return str(path)


@pytest.mark.parametrize("name", ["z.geojson", "z.gpkg", "z.shp"])
def test_every_format_gives_its_polygons_by_name(name: str, tmp_path: Path) -> None:
    """With the CRS that the file names."""
    found = read_zones(written(tmp_path / name, [SQUARE, OTHER], name=["west", "east"]))
    assert found.crs.to_epsg() == 32632
    assert {key: shape.area for key, shape in found.shapes.items()} == {"west": 100, "east": 50}
    assert found.notes == ()


def test_a_layer_is_named_after_a_colon(tmp_path: Path) -> None:
    """Where there are several it has to be, and the message names them."""
    path = tmp_path / "farm.gpkg"
    written(path, [SQUARE], layer="area")
    written(path, [OTHER], layer="trial")
    assert read_zones(f"{path}:trial").shapes["1"].area == 50
    with pytest.raises(ZoneError, match=r"several layers; name one of area, trial: .*farm\.gpkg:area"):
        read_zones(str(path))
    with pytest.raises(ZoneError, match="no layer 'plots'; name one of area, trial"):
        read_zones(f"{path}:plots")


def test_borders_that_cross_are_mended_with_a_note(tmp_path: Path) -> None:
    """A bowtie is two triangles."""
    found = read_zones(written(tmp_path / "z.gpkg", [BOWTIE, OTHER]))
    assert found.shapes["1"].is_valid
    assert found.shapes["1"].area == pytest.approx(50)
    assert "the borders of 1 of 2 polygons" in found.notes[0]


def test_plots_are_named_by_the_attribute_asked_for(tmp_path: Path) -> None:
    """By default by the first usual one; polygons of one name are one plot, and one without a name has its number."""
    path = written(
        tmp_path / "z.gpkg", [SQUARE, OTHER, BOWTIE.convex_hull], plot_id=[7.0, 7.0, None], kind=["a", "b", "c"]
    )
    assert {name: shape.area for name, shape in read_zones(path).shapes.items()} == {"7": 150, "3": 100}
    assert list(read_zones(path, named_by="kind").shapes) == ["a", "b", "c"]
    with pytest.raises(ZoneError, match="an attribute 'variety' to name plots by, got plot_id, kind"):
        read_zones(path, named_by="variety")


def test_geojson_without_a_crs_and_a_shapefile_without_prj_name_none(tmp_path: Path) -> None:
    """What is meant is the survey's to say."""
    bare = {"type": "Feature", "properties": {}, "geometry": SQUARE.__geo_interface__}
    (tmp_path / "z.geojson").write_text("\ufeff" + json.dumps(bare), encoding="utf-8")
    assert read_zones(str(tmp_path / "z.geojson")).crs is None
    path = written(tmp_path / "z.shp", [SQUARE])
    (tmp_path / "z.prj").unlink()
    assert read_zones(path).crs is None


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("z.kml", "<kml/>", r"expected polygons as \.geojson"),
        ("z.geojson", None, "there is no file"),
        ("z.geojson", "", "cannot read"),
        ("z.geojson", "no map at all", "cannot read"),
        ("z.geojson", '{"type": "FeatureCollection", "features": []}', "expected polygons, got none"),
        ("z.gpkg", "SQLite? no", "cannot read"),
        ("z.shp", "\x00\x00", "cannot read"),
    ],
)
def test_what_holds_no_polygons_is_one_message(name: str, content: str | None, words: str, tmp_path: Path) -> None:
    """Endings, missing, empty and foreign files."""
    if content is not None:
        (tmp_path / name).write_text(content)
    with pytest.raises(ZoneError, match=words):
        read_zones(str(tmp_path / name))


def test_a_ring_that_does_not_close_is_one_message(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As one with a corner of NaN, which is not equal to itself."""
    ring = struct.pack("<BIII8d", 1, 3, 1, 4, *(math.nan, 1), *(5, 5), *(9, 1), *(math.nan, 1))
    path = written(tmp_path / "z.geojson", [SQUARE])
    monkeypatch.setattr("pyogrio.raw.read", lambda path, layer: ({"crs": None, "fields": []}, None, [ring], []))
    with pytest.raises(ZoneError, match=r"cannot read .*z.geojson as polygons: .* closed .*; save it anew"):
        read_zones(path)
