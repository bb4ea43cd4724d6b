"""Polygon files: formats, layers, names, CRS and repaired borders; one error for each mistake."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from threading import Thread
from typing import Any

import geopandas
import pandas as pd
import pyogrio
import pytest
import shapely

from spectralzoom.pipeline.errors import SceneError, ZoneError
from spectralzoom.storage.readers.polygons import read_zones

SQUARE, OTHER = shapely.box(0, 0, 10, 10), shapely.box(20, 0, 25, 10)
BOWTIE = shapely.Polygon([(0, 0), (10, 10), (10, 0), (0, 10)])


def feature(**more: Any) -> str:
    """Return a square as GeoJSON."""
    return json.dumps({"type": "Feature", "properties": {}, "geometry": SQUARE.__geo_interface__} | more)


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
    with pytest.raises(ZoneError, match="has no CRS"):
        read_zones(path)


@pytest.fixture
def server() -> Iterator[HTTPServer]:
    """Run a server on this machine that has only errors, and counts requests."""
    asked: list[str] = []

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            asked.append(self.path)
            self.send_error(404)

        def log_message(self, *words: object) -> None:
            """Print nothing."""

    with HTTPServer(("127.0.0.1", 0), Handler) as running:
        Thread(target=running.serve_forever, daemon=True).start()
        yield running
        running.shutdown()
    assert asked == []


LAYER = '<OGRVRTLayer name="a"><SrcDataSource>{url}/a.json</SrcDataSource></OGRVRTLayer>'


@pytest.mark.parametrize("name", ["z.geojson", "z.gpkg", "z.shp"])
@pytest.mark.parametrize(
    "content",
    [
        "<OGRWFSDataSource><URL>{url}</URL></OGRWFSDataSource>",
        f"<OGRVRTDataSource>{LAYER}</OGRVRTDataSource>",
        feature(crs={"type": "link", "properties": {"href": "{url}/crs"}}),
    ],
)
def test_a_file_by_another_driver_contacts_no_server(
    name: str, content: str, server: HTTPServer, tmp_path: Path
) -> None:
    """GDAL's WFS and VRT, and linked CRS, are refused under every name."""
    (tmp_path / name).write_text(content.replace("{url}", f"http://127.0.0.1:{server.server_port}"))
    with pytest.raises(ZoneError, match="cannot read"):
        read_zones(str(tmp_path / name))


@pytest.mark.parametrize(
    "sql",
    ["CREATE VIRTUAL TABLE v USING VirtualShape('/data/z', 'UTF-8', 32632)", "create/**/\nvirtual table v using x"],
)
def test_a_geopackage_reads_no_other_file(sql: str, tmp_path: Path) -> None:
    """Tables that a module of SQLite fills are refused; the index of shapes is none of them."""
    path = written(tmp_path / "z.gpkg", [SQUARE])
    assert read_zones(path).shapes["1"].area == 100
    with closing(sqlite3.connect(path)) as file:
        file.execute("PRAGMA writable_schema = ON")
        file.execute("INSERT INTO sqlite_master VALUES ('table', 'v', 'v', 0, ?)", [sql])
        file.commit()
    with pytest.raises(ZoneError, match="its table v may read other files"):
        read_zones(path)


def test_a_table_without_shapes_is_no_layer(tmp_path: Path) -> None:
    """GIS programs store styles beside the only layer."""
    path = written(tmp_path / "z.gpkg", [SQUARE])
    pyogrio.write_dataframe(pd.DataFrame({"style": ["red"]}), path, layer="layer_styles")
    assert list(read_zones(path).shapes) == ["1"]


@pytest.mark.parametrize("grid", ["/data/a.gsb", "http://127.0.0.1:9/a.gsb", "../a.gsb"])
def test_a_crs_names_no_file(grid: str, tmp_path: Path) -> None:
    """The .prj file of a shapefile may name grids of PROJ alone."""
    path = written(tmp_path / "z.shp", [SQUARE], crs=f"+proj=utm +zone=32 +ellps=bessel +nadgrids={grid}")
    with pytest.raises(ZoneError, match=f"names the grid file {grid}; give one of EPSG"):
        read_zones(path)
    path = written(tmp_path / "y.shp", [SQUARE], crs="+proj=utm +zone=32 +ellps=bessel +nadgrids=none.gsb")
    with pytest.raises(ZoneError, match="cannot read"):
        read_zones(path)
    path = written(tmp_path / "x.shp", [SQUARE], crs="+proj=utm +zone=32 +ellps=bessel +nadgrids=@null")
    assert len(read_zones(path).shapes) == 1


@pytest.mark.parametrize("part", [".dbf", ".shx", ".prj", ".cpg"])
def test_parts_of_a_shapefile_may_be_links(part: str, tmp_path: Path) -> None:
    """They are followed; one that leads nowhere is refused, as a part that GDAL does not find changes the polygons."""
    (home := tmp_path / "in").mkdir()
    path = written(home / "z.shp", [SQUARE])
    (home / f"z{part}").rename(tmp_path / f"kept{part}")
    (home / f"z{part}").symlink_to(tmp_path / f"kept{part}")
    assert read_zones(path).shapes["1"].area == 100
    (tmp_path / f"kept{part}").unlink()
    with pytest.raises(SceneError, match=f"z{part} is a link that leads nowhere"):
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
        (
            "z.geojson",
            feature(crs={"type": "name", "properties": {"name": "+init=epsg:4326"}}),
            "its CRS .* is no name",
        ),
        ("z.geojson", feature(type="Topology"), "JSON of type 'Topology', expected GeoJSON"),
        ("z.geojson", feature(properties=[1]), "it is no valid GeoJSON"),
        ("z.geojson", '{"features":' + 99999 * "[", "cannot read"),
        ("z.geojson", feature().replace("10.0", "1e5"), "a point at x 100000, y 0, in degrees: is its CRS right"),
        ("z.geojson", feature().replace("10.0", "NaN"), "cannot read"),
        ("z.geojson", feature(crs={"type": "name", "properties": {"name": "EPSG:4978"}}), "neither geographic nor"),
    ],
)
def test_files_without_polygons_are_refused(name: str, content: str | None, words: str, tmp_path: Path) -> None:
    """Wrong endings, and missing, empty and foreign files, each raise one error."""
    if content is not None:
        (tmp_path / name).write_text(content)
    with pytest.raises(ZoneError, match=words):
        read_zones(str(tmp_path / name))
