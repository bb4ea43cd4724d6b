"""STAC items and collections are written relative to their folder, without network access."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from odc.geo.geobox import GeoBox

from pipeline.errors import ArchiveError
from storage.export.stac_items import COG, COLLECTION, ZARR, Item, clean_id, footprint, projection, write_stac

BOX = GeoBox.from_bbox((500000, 5770000, 500050, 5770040), crs="EPSG:32632", resolution=0.5)
ABOUT = "field-a"


def item(name: str, *, day: int = 1, placed: bool = True) -> Item:
    """Return an item with an image and a store."""
    image: dict[str, Any] = {"href": "class_map.tif", "type": COG, "roles": ["data"]}
    image["bands"] = [{"name": "class", "data_type": "uint8", "nodata": 255}]
    store: dict[str, Any] = {"href": "../../a/mosaic.zarr", "type": ZARR, "roles": ["data"]}
    properties = {"processing:level": "L4", "processing:software": {"spectralzoom": "0.1.0"}}
    place = None
    if placed:
        properties["proj:code"] = "EPSG:32632"
        image |= projection(BOX)
        store["proj:code"] = None
        place = footprint(BOX)
    times = f"2026-05-{day:02d}T10:00:00Z", f"2026-05-{day:02d}T11:00:00Z"
    return Item(name, *times, properties, {"class_map": image, "mosaic": store}, place)


def read(path: Path) -> dict[str, Any]:
    """Return the content of a JSON file."""
    found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return found


def test_an_item_without_a_position_has_no_geometry(tmp_path: Path) -> None:
    """Geometry is null, there is no bbox and no CRS; the collection's extent is the whole earth."""
    path, collection = write_stac(tmp_path, ABOUT, "Surveys", item("r1", placed=False))
    content = read(path)
    assert content["geometry"] is None
    assert "bbox" not in content
    assert "proj:" not in path.read_text()
    assert not any("projection" in uri for uri in content["stac_extensions"])
    assert read(collection)["extent"]["spatial"]["bbox"] == [[-180, -90, 180, 90]]


@pytest.mark.parametrize("name", ["maps", "maps of #1? 50%20"])  # characters with a meaning in addresses
def test_items_of_a_folder_form_one_collection(tmp_path: Path, name: str) -> None:
    """Items are in order of time, earlier item files stay unchanged, and the extents cover all items."""
    folder = tmp_path / name
    first, _ = write_stac(folder, ABOUT, "Surveys", item("r2", day=2))
    before = first.read_bytes()
    write_stac(folder, ABOUT, "Surveys", item("r1", day=1, placed=False))
    write_stac(folder, ABOUT, "Surveys", item("r3", day=3))
    assert first.read_bytes() == before
    assert [one["href"] for one in read(first)["links"]] == ["../collection.json"] * 3
    content = read(folder / COLLECTION)
    links = [link["href"] for link in content["links"] if link["rel"] == "item"]
    assert links == ["./r1/r1.json", "./r2/r2.json", "./r3/r3.json"]
    assert content["extent"]["temporal"]["interval"] == [["2026-05-01T10:00:00Z", "2026-05-03T11:00:00Z"]]
    assert content["extent"]["spatial"]["bbox"] == [read(first)["bbox"]]
    assert sorted(path.name for path in folder.iterdir()) == [COLLECTION, "r1", "r2", "r3"]


def test_links_are_relative(tmp_path: Path) -> None:
    """The folder can be moved: links and assets hold no path of this machine, and no link has the relation self."""
    paths = write_stac(tmp_path, ABOUT, "Surveys", item("r1"))
    texts = [path.read_bytes() for path in paths]
    assert [path.read_bytes() for path in write_stac(tmp_path, ABOUT, "Surveys", item("r1"))] == texts  # no clock
    for path in paths:
        content = read(path)
        hrefs = [about["href"] for about in (*content["links"], *content.get("assets", {}).values())]
        assert not any(Path(href).is_absolute() or ":" in href for href in hrefs)
        assert "self" not in {link["rel"] for link in content["links"]}
        assert str(tmp_path) not in path.read_text()


def test_projection_fields_follow_the_extension() -> None:
    """The fields are code, shape, and the transform in rasterio's order; a CRS without a code has WKT."""
    assert projection(BOX) == {
        "proj:code": "EPSG:32632",
        "proj:shape": [80, 100],
        "proj:transform": [0.5, 0, 500000, 0, -0.5, 5770040],
        "proj:bbox": [500000, 5770000, 500050, 5770040],
    }
    own = GeoBox(BOX.shape, BOX.affine, "+proj=tmerc +lat_0=52.1 +lon_0=9.5 +units=m +datum=WGS84")
    assert projection(own)["proj:code"] is None
    assert projection(own)["proj:wkt2"].startswith("PROJCRS")


def test_clean_id_is_a_valid_file_name() -> None:
    """An id keeps only letters, digits, - and _; a text without any of them becomes the default."""
    assert (clean_id("Feld 3/Süd", "x"), clean_id("???", "class-1")) == ("Feld-3-S-d", "class-1")


def test_a_folder_of_another_archive_is_refused(tmp_path: Path) -> None:
    """The folder's collection stays, and nothing is written."""
    write_stac(tmp_path, ABOUT, "Surveys", item("r1"))
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(ArchiveError, match="collection 'field-a' of another archive, expected 'field-b'"):
        write_stac(tmp_path, "field-b", "Surveys", item("r2"))
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("text", ["", "{", "[]", '{"type": "Feature"}', '{"type": "Feature", "id": "r1"}'])
def test_a_damaged_earlier_item_is_reported(tmp_path: Path, text: str) -> None:
    """The error names the file to remove."""
    (tmp_path / "r1").mkdir()
    (tmp_path / "r1" / "r1.json").write_text(text)
    with pytest.raises(ArchiveError, match=r"r1\.json .*remove"):
        write_stac(tmp_path, ABOUT, "Surveys", item("r2"))


def test_the_footprint_is_the_grid_in_degrees() -> None:
    """The footprint is an anticlockwise ring of the grid's area, within 1 %."""
    ring = np.array(footprint(BOX)["coordinates"][0])
    assert (ring[0] == ring[-1]).all()
    area = np.sum(ring[:-1, 0] * ring[1:, 1] - ring[1:, 0] * ring[:-1, 1]) / 2
    assert area * np.cos(np.deg2rad(ring[0, 1])) * 111_300**2 == pytest.approx(50 * 40, rel=0.01)
    west, south, east, north = shapely.geometry.shape(footprint(BOX)).bounds
    assert 9 <= west < east < 9.001
    assert 52 < south < north < 52.1


@pytest.mark.parametrize(("crs", "south", "north"), [("EPSG:3413", 88.7, 90), ("EPSG:3031", -90, -88.7)])
def test_a_map_around_a_pole_has_all_longitudes(crs: str, south: float, north: float) -> None:
    """The bounds reach from the map's farthest corner to the pole."""
    place = footprint(GeoBox.from_bbox((-1e5, -1e5, 1e5, 1e5), crs=crs, shape=(20, 20)))
    assert shapely.geometry.shape(place).bounds == pytest.approx((-180, south, 180, north), abs=0.05)


@pytest.mark.parametrize(
    ("crs", "bounds"),
    [("EPSG:32701", (179_000, 8_140_000, 181_000, 8_142_000)), ("EPSG:4326", (179.99, -17, 180.01, -16.98))],
)
def test_a_footprint_across_180_degrees_is_split(tmp_path: Path, crs: str, bounds: tuple[float, ...]) -> None:
    """A map of 2 km has two polygons, and a bbox whose west exceeds its east, as in RFC 7946.

    The collection of it and a field east of it has such a narrow extent too.
    """
    place = footprint(GeoBox.from_bbox(bounds, crs=crs, shape=(200, 200)))
    shape = shapely.geometry.shape(place)
    assert place["type"] == "MultiPolygon"
    assert shape.area < 0.03**2
    path, _ = write_stac(tmp_path, ABOUT, "Surveys", replace(item("r1"), footprint=place))
    beside = footprint(GeoBox.from_bbox((-179.9, -17, -179.8, -16.9), crs="EPSG:4326", shape=(9, 9)))
    _, collection = write_stac(tmp_path, ABOUT, "Surveys", replace(item("r2"), footprint=beside))
    assert read(collection)["extent"]["spatial"]["bbox"][0][::2] == [read(path)["bbox"][0], -179.8]
    west, south, east, north = read(path)["bbox"]
    assert 179.9 < west < 180
    assert -180 < east < -179.9
    assert south < north
