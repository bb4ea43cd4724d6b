"""Polygon files: formats, layers, names, CRS and repaired borders; one error for each mistake."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import geopandas
import pytest
import shapely

from spectralzoom.pipeline.errors import ZoneError
from spectralzoom.storage.readers.polygons import read_zones

SQUARE, OTHER = shapely.box(0, 0, 10, 10), shapely.box(20, 0, 25, 10)
BOWTIE = shapely.Polygon([(0, 0), (10, 10), (10, 0), (0, 10)])


def written(path: Path, shapes: list[Any], crs: Any = 32632, layer: str | None = None, **columns: list[Any]) -> str:
    """Write geometries with attributes, and return the path."""
    table = geopandas.GeoDataFrame(columns, geometry=shapes, crs=crs)
    table.to_file(path, engine="pyogrio", **({} if layer is None else {"layer": layer}))
    return str(path)


@pytest.mark.parametrize("name", ["z.geojson", "z.gpkg", "z.shp"])
def test_every_format_gives_its_polygons_by_name(name: str, tmp_path: Path) -> None:
    """The CRS is the one that the file names."""
    found = read_zones(written(tmp_path / name, [SQUARE, OTHER], name=["west", "east"]))
    assert found.crs.to_epsg() == 32632
    assert {key: shape.area for key, shape in found.shapes.items()} == {"west": 100, "east": 50}
    assert found.notes == ()


def test_a_layer_is_selected_after_a_colon(tmp_path: Path) -> None:
    """If a file has several layers, one has to be named; the error lists them."""
    path = tmp_path / "farm.gpkg"
    written(path, [SQUARE], layer="area")
    written(path, [OTHER], layer="trial")
    assert read_zones(f"{path}:trial").shapes["1"].area == 50
    with pytest.raises(ZoneError, match=r"several layers; name one of area, trial: .*farm\.gpkg:area"):
        read_zones(str(path))
    with pytest.raises(ZoneError, match="no layer 'plots'; name one of area, trial"):
        read_zones(f"{path}:plots")


def test_crossing_borders_are_repaired_with_a_note(tmp_path: Path) -> None:
    """A bowtie becomes two triangles."""
    found = read_zones(written(tmp_path / "z.gpkg", [BOWTIE, OTHER]))
    assert found.shapes["1"].is_valid
    assert found.shapes["1"].area == pytest.approx(50)
    assert "the borders of 1 of 2 polygons" in found.notes[0]


def test_plots_are_named_by_an_attribute(tmp_path: Path) -> None:
    """The default is the first usual one; equal names are one plot, and a polygon without a name gets its number."""
    plots = [SQUARE, OTHER, BOWTIE.convex_hull]
    path = written(tmp_path / "z.gpkg", plots, plot_id=[7.0, 7.0, None], kind=["a", "b", "c"])
    assert {name: shape.area for name, shape in read_zones(path).shapes.items()} == {"7": 150, "3": 100}
    assert list(read_zones(path, named_by="kind").shapes) == ["a", "b", "c"]
    with pytest.raises(ZoneError, match="an attribute 'variety' to name plots by, got plot_id, kind"):
        read_zones(path, named_by="variety")


def test_only_geojson_may_lack_a_crs(tmp_path: Path) -> None:
    """It is WGS 84 then; a shapefile without .prj is refused."""
    bare = {"type": "Feature", "properties": {}, "geometry": SQUARE.__geo_interface__}
    (tmp_path / "z.geojson").write_text("\ufeff" + json.dumps(bare), encoding="utf-8")
    assert read_zones(str(tmp_path / "z.geojson")).crs.to_epsg() == 4326
    path = written(tmp_path / "z.shp", [SQUARE])
    (tmp_path / "z.prj").unlink()
    with pytest.raises(ZoneError, match="has no CRS; save it with one"):
        read_zones(path)


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
def test_files_without_polygons_are_refused(name: str, content: str | None, words: str, tmp_path: Path) -> None:
    """Wrong endings, and missing, empty and foreign files, each raise one error."""
    if content is not None:
        (tmp_path / name).write_text(content)
    with pytest.raises(ZoneError, match=words):
        read_zones(str(tmp_path / name))
