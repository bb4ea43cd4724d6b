"""Read polygons from GeoJSON, GeoPackage and shapefile: zones with names, and labels burnt onto a scene's pixels.

A pixel has the class of the last polygon in the file that contains its centre.
"""

from __future__ import annotations

import json
import re
import sqlite3
from collections import Counter
from collections.abc import Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyproj
import shapely
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox
from shapely.geometry.base import BaseGeometry

from spectralzoom.pipeline.errors import PipelineError, SceneError, ZoneError
from spectralzoom.pipeline.geometry.grid import UNLABELLED
from spectralzoom.pipeline.ground.field_places import FieldPlace, GroundPlace, NoPlace, PlacedPicture
from spectralzoom.pipeline.ground.georeference import WGS84
from spectralzoom.pipeline.ground.zones import on_field
from spectralzoom.storage.readers.labels import MOST_FOUND_CLASSES, Labels, class_colours
from spectralzoom.storage.readers.scene_toml import SETTINGS_NAME, ClassValue, SceneSettings
from spectralzoom.storage.readers.user_files import is_there, reading_files

if TYPE_CHECKING:
    import geopandas

ZONE_ENDINGS = (".geojson", ".json", ".gpkg", ".shp")
POLYGON_ENDINGS = (".gpkg", ".geojson", ".shp")  # of labels; a .json file may hold anything
SHAPEFILE_PARTS = (".shx", ".dbf", ".prj", ".cpg", ".qix", ".sbn", ".idm", ".ind")
SHAPEFILE_MAGIC, SQLITE_MAGIC = b"\0\0\x27\x0a", b"SQLite format 3\0"
GEOPACKAGE_ID = b"GP"  # at byte 68
VIRTUAL = re.compile(r"\s*create\b.*\bvirtual\b", re.IGNORECASE | re.DOTALL)  # tables that a module of SQLite fills
INDEX = re.compile(r'create virtual table (?:"[^"]+"|\w+) using (?:rtree|fts)\w*\s*\(', re.IGNORECASE)
OF_LIBRARIES = (sqlite3.Error, pyproj.exceptions.ProjError, shapely.errors.GEOSException)
GRID_FILE = re.compile(r'(?:PARAMETERFILE\["[^"]*","|grids=|file=)([^" ]*[/\\:][^" ]*)')  # beyond PROJ's own folder
MOST_DEG, MOST_M = (720.0, 90.1), (1e9, 1e9)  # of x and y
USUAL_NAMES = ("name", "plot", "plot_name", "plot_id", "plotid", "id", "label")
_OF_CROPS = ("crop", "crop_type", "species", "category", "land_cover", "landcover", "type", "code", "name")
CLASS_ATTRIBUTES = ("class", "class_name", "classname", "class_id", "label", *_OF_CROPS)  # in the order tried
POLYGONS = ("Polygon", "MultiPolygon")


@dataclass(frozen=True)
class ZoneFile:
    """Polygons of one file, united by name."""

    path: str
    crs: pyproj.CRS
    shapes: dict[str, BaseGeometry]  # by name, in the order of the file; x before y, longitude before latitude
    notes: tuple[str, ...] = ()


def read_zones(source: str, *, named_by: str | None = None) -> ZoneFile:
    """Read the polygons of ``FILE`` or ``FILE.gpkg:LAYER``, named by the attribute ``named_by``.

    None takes the first attribute of name, plot, plot_id, id and label, else numbers from 1. Polygons of one name are
    one zone. Raises ZoneError: as `read_polygons`, or there is no such attribute.
    """
    table, notes = read_polygons(source)
    fields, found = _attributes(table), named_by
    if named_by is None:
        found = _first_of(USUAL_NAMES, fields)
    elif named_by not in fields:
        known = ", ".join(fields) or "no attribute"
        raise ZoneError(f"{source}: expected an attribute {named_by!r} to name plots by, got {known}")
    words = [""] * len(table) if found is None else [word_of(value) for value in table[found]]
    shapes: dict[str, BaseGeometry] = {}
    for row, word, shape in zip(table.index, words, table.geometry, strict=True):
        name = word or str(row + 1)
        shapes[name] = shape if name not in shapes else shapely.union(shapes[name], shape)
    return ZoneFile(source, table.crs, shapes, notes)


@reading_files()
def read_polygons(source: str) -> tuple[geopandas.GeoDataFrame, tuple[str, ...]]:
    """Read the polygons of ``FILE`` or ``FILE.gpkg:LAYER`` with their attributes, without empty ones; and notes.

    The content decides whether it is GeoJSON, a GeoPackage or a shapefile; no other format, file or server is read.
    GeoJSON without a CRS is WGS 84. Invalid borders are repaired with a note. The index has the rows of the layer, from
    0. Raises ZoneError: there is no such file or layer, or it has no polygons on a map that can be read.
    """
    path, layer = split_layer(source)
    if path.suffix.lower() not in ZONE_ENDINGS:
        raise ZoneError(f"{source}: expected polygons as {', '.join(ZONE_ENDINGS)}; save the layer as one of them")
    if not is_there(path) or path.is_dir():
        raise ZoneError(f"there is no file {path}; give the path of a file with polygons, or leave it out")
    try:
        table = _read_table(path, layer)
        if "geometry" not in table:
            raise ValueError("it has attributes without shapes")
        table = table[~(table.geometry.isna() | table.geometry.is_empty)]
        _check_coordinates(table)
        valid = table.geometry.is_valid
        whole = [one if one.is_valid else polygons_of(shapely.make_valid(one)) for one in table.geometry.force_2d()]
    except PipelineError:
        raise
    except (OSError, ValueError, RuntimeError, *OF_LIBRARIES) as error:
        raise ZoneError(f"cannot read {source} as polygons: {error}; save it anew from a map program") from None
    kinds = Counter(kind for kind in table.geom_type if kind not in POLYGONS)
    if kinds or not len(table):
        came = " and ".join(f"{count} {kind}" for kind, count in kinds.items()) or "none"
        raise ZoneError(f"{source}: expected polygons, got {came}; draw areas, zones and plots as closed polygons")
    crossed = f"{source}: the borders of {sum(~valid)} of {len(table)} polygons cross or touch themselves"
    return table.set_geometry(whole, crs=table.crs), () if valid.all() else (f"{crossed} and were repaired",)


def _check_coordinates(table: geopandas.GeoDataFrame) -> None:
    """Raise ValueError for a CRS that is no map's or names a file, and for places that are none in it."""
    crs = table.crs
    if crs is None:
        raise ValueError("it has no CRS (a shapefile needs a .prj file)")
    if not (crs.is_geographic or crs.is_projected):
        raise ValueError(f"its CRS {crs.name} is neither geographic nor projected")
    if named := GRID_FILE.search(crs.to_wkt()):
        raise ValueError(f"its CRS {crs.name} names the grid file {named[1]}; give one of EPSG")
    pyproj.Transformer.from_crs(crs, WGS84)  # fails where PROJ lacks a grid
    places = shapely.get_coordinates(table.geometry)
    wrong = ~(np.abs(places) <= (MOST_DEG if crs.is_geographic else MOST_M)).all(axis=1)
    if wrong.any():
        x, y = places[wrong][0].tolist()
        raise ValueError(f"it has a point at x {x:g}, y {y:g}{', in degrees: is its CRS right?' * crs.is_geographic}")


def _read_table(path: Path, layer: str | None) -> geopandas.GeoDataFrame:
    """Read a file by the driver of its content alone (others of GDAL may name any file or server)."""
    import geopandas
    import pyogrio

    with path.open("rb") as file:
        head = file.read(100)
    if head.startswith(SQLITE_MAGIC) and head[68:70] == GEOPACKAGE_ID:
        for end in ("-wal", "-journal", "-shm"):  # which SQLite may write
            is_there(path.with_name(f"{path.name}{end}"), noted=False)
        _check_tables(path)
        address = f"GPKG:{path.absolute()}"
        layers = [str(name) for name, kind in pyogrio.list_layers(address) if kind is not None]
        found = layers[0] if layer is None and len(layers) == 1 else layer
        if found not in layers:
            asked = "has several layers" if layer is None else f"has no layer {layer!r}"
            raise ZoneError(f"{path} {asked}; name one of {', '.join(layers)}: {path}:{[*layers, 'LAYER'][0]}")
        return geopandas.GeoDataFrame(pyogrio.read_dataframe(address, layer=found))
    if head.startswith(SHAPEFILE_MAGIC) and path.suffix.lower() == ".shp":
        for end in (end for part in SHAPEFILE_PARTS for end in (part, part.upper())):
            is_there(path.with_name(f"{path.stem}{end}"))
        if "!" in str(path.absolute()):
            raise ValueError('a "!" in its path stands for an archive; rename that folder')
        return geopandas.GeoDataFrame(pyogrio.read_dataframe(path.absolute()))
    if not head.removeprefix(b"\xef\xbb\xbf").lstrip().startswith(b"{"):
        raise ValueError("its content is none of GeoJSON, GeoPackage and shapefile")
    try:
        return _read_geojson(path.read_text(encoding="utf-8-sig"))
    except (AttributeError, KeyError, TypeError):
        raise ValueError("it is no valid GeoJSON") from None


def _check_tables(path: Path) -> None:
    """Raise ValueError for a table that a module of SQLite fills from another file; rtree and fts are indices."""
    with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True)) as file:
        made = file.execute("SELECT name, sql FROM sqlite_master WHERE sql IS NOT NULL").fetchall()
    for name, sql in made:
        if VIRTUAL.match(sql) and not INDEX.match(sql):
            raise ValueError(f"its table {name} may read other files")


def _read_geojson(text: str) -> geopandas.GeoDataFrame:
    """Read features; their CRS must be a name, as a linked one would contact a server."""
    import geopandas

    content: dict[str, Any] = json.loads(text)
    kind = content.get("type")
    features = content["features"] if kind == "FeatureCollection" else [content] if kind == "Feature" else None
    if features is None:
        raise ValueError(f"it is JSON of type {kind!r}, expected GeoJSON's FeatureCollection")
    shapes = [shapely.from_geojson(json.dumps(one["geometry"])) if one.get("geometry") else None for one in features]
    rows = [{**({"id": one["id"]} if "id" in one else {}), **(one.get("properties") or {})} for one in features]
    crs = content.get("crs") or {"type": "name", "properties": {"name": "EPSG:4326"}}
    name = str(crs["properties"].get("name"))
    if crs["type"] != "name" or not re.fullmatch(r"[\w:/.-]+", name):  # a definition may name files
        raise ValueError(f"its CRS {json.dumps(crs)} is no name such as urn:ogc:def:crs:EPSG::25832")
    return geopandas.GeoDataFrame(rows, geometry=shapes, crs=pyproj.CRS(name))


def polygons_of(shape: BaseGeometry) -> BaseGeometry:
    """Return the polygons of a geometry as one shape, without lines and points."""
    parts = [one for one in shapely.get_parts(shapely.get_parts([shape])) if one.geom_type == "Polygon"]
    return parts[0] if len(parts) == 1 else shapely.union_all(parts)


def split_layer(source: str | Path) -> tuple[Path, str | None]:
    """Return path and layer of ``FILE.gpkg:LAYER``."""
    head, mark, layer = str(source).rpartition(".gpkg:")
    return Path(f"{head}.gpkg" if mark else source), layer if mark else None


def _attributes(table: geopandas.GeoDataFrame) -> list[str]:
    return [str(name) for name in table.columns if name != table.geometry.name]


def _first_of(words: Sequence[str], fields: Sequence[str]) -> str | None:
    """Return the first attribute that has one of the names, in the order of these, in any case."""
    by_word = {name.lower(): name for name in reversed(fields)}
    return next((by_word[word] for word in words if word in by_word), None)


def word_of(value: object) -> str:
    """Return the text of an attribute; empty if it has no value."""
    if value is None or (isinstance(value, float | np.floating) and np.isnan(value)):
        return ""
    if isinstance(value, float | np.floating) and float(value).is_integer():
        return str(int(value))
    return str(value).strip()


def is_polygon_file(address: str | Path) -> bool:
    """Return whether a label file holds polygons, by its name."""
    return split_layer(address)[0].suffix.lower() in POLYGON_ENDINGS


def load_polygon_labels(
    address: str | Path, shape: tuple[int, int], geobox: GeoBox | None, *, settings: SceneSettings
) -> Labels:
    """Burn the polygons of ``FILE`` or ``FILE.gpkg:LAYER`` onto the (y, x) pixels of a scene.

    Classes are those of the settings, by name or by number, else every value of the class attribute. Raises SceneError:
    they cannot be read, lie off the scene, or have a class that the settings lack.
    """
    table, attribute, names, repaired = _labelled(address, settings)
    classes = dict(settings.classes) or _named(names, settings, str(address))
    of_word: dict[str, int] = {str(value): number for number, value in enumerate(classes.values())}
    of_word |= {name: number for number, name in enumerate(classes)}
    of_word |= {"": UNLABELLED, _word_of_none(settings): UNLABELLED}
    if unknown := [name for name in names if name not in of_word]:
        raise SceneError(
            f"labels {address} have {unknown.count(unknown[0])} polygons of {attribute} = {unknown[0]!r}, which is no"
            f" class; add it to [classes] or state it as unlabelled in {SETTINGS_NAME}"
        )
    codes = [of_word[name] for name in names]
    moved = _moved(table, NoPlace(shape) if geobox is None else PlacedPicture(geobox), address)
    burnt = [pair for pair in zip(moved, codes, strict=True) if pair[1] != UNLABELLED and not pair[0].is_empty]
    index = _burn(burnt, shape)
    if (index == UNLABELLED).all():
        raise SceneError(
            f"labels {address}: no pixel's centre lies in a polygon that has a class; give polygons larger than a"
            f" pixel, with a value of {attribute}"
        )
    shared = int(np.count_nonzero(index != _burn(burnt[::-1], shape)))
    lacking = names.count("")
    notes = (
        f"{len(burnt)} polygons by their attribute {attribute}",
        *repaired,
        *([f"{lacking} polygons without a value of {attribute} are left out"] if lacking else []),
        *([f"{shared} px lie in polygons of several classes: the later polygon counts"] if shared else []),
    )
    return Labels(index, tuple(classes), tuple(classes.values()), class_colours(classes, settings.colours), notes)


def polygon_classes(addresses: Iterable[str | Path], settings: SceneSettings) -> dict[str, ClassValue]:
    """Return every class of several files of polygons (SceneError, also for more than 64 classes)."""
    names = [name for one in addresses for name in _labelled(one, settings)[2]]
    return _named(names, settings, "of several files")


def _labelled(
    address: str | Path, settings: SceneSettings
) -> tuple[geopandas.GeoDataFrame, str, list[str], tuple[str, ...]]:
    """Return the polygons, their class attribute, each one's value of it (empty without one), and notes."""
    try:
        table, notes = read_polygons(str(address))
    except ZoneError as error:
        raise SceneError(f"labels: {error}") from error
    fields, stated = _attributes(table), settings.class_attribute
    found = _first_of(CLASS_ATTRIBUTES, fields) if stated is None else stated
    if found is None or found not in fields:
        wanted = "an attribute that says the class" if stated is None else f"the attribute {stated!r}"
        raise SceneError(
            f"labels {address} lack {wanted}; they have {', '.join(fields) or 'no attribute'}; write"
            f' class_attribute = "..." into a {SETTINGS_NAME} beside the scene'
        )
    words = [word_of(value) for value in table[found]]
    plain = [str(int(word)) if word.isdecimal() and word not in settings.classes else word for word in words]
    return table, found, plain, notes


def _word_of_none(settings: SceneSettings) -> str:
    return "" if settings.unlabelled is None else str(settings.unlabelled)


def _named(names: Iterable[str], settings: SceneSettings, where: str) -> dict[str, ClassValue]:
    """Return a class for every name: ``class_N`` for numbers, other names sorted and numbered from 1."""
    words = sorted(set(names) - {"", _word_of_none(settings)})
    if len(words) > MOST_FOUND_CLASSES:
        raise SceneError(
            f"labels {where} have {len(words)} different classes, at most {MOST_FOUND_CLASSES} are taken; name another"
            f" attribute, class_attribute in a {SETTINGS_NAME}"
        )
    if not words:
        raise SceneError(f"labels {where} have no class for any polygon; fill in the attribute, or name another")
    if all(word.isdecimal() for word in words):
        return {f"class_{number}": number for number in sorted(map(int, words))}
    return {word: number for number, word in enumerate(words, 1)}


def place_on_earth(place: FieldPlace, address: str | Path, error: type[PipelineError]) -> GroundPlace:
    """Return the place of a field with polygons (``error``: it has none on the earth)."""
    if isinstance(place, NoPlace):
        raise error(
            f"{address} has polygons, and this field has no georeference: give the rig's [pose], or a scene with a CRS"
            " and a transform (gdal_translate -a_srs -a_ullr)"
        )
    return place


def _moved(table: geopandas.GeoDataFrame, place: FieldPlace, address: str | Path) -> list[BaseGeometry]:
    """Return the polygons in pixels of the scene (SceneError: none lies on it, or it has no georeference)."""
    on = place_on_earth(place, address, SceneError)
    moved = [polygons_of(on_field(shape, table.crs, on)) for shape in table.geometry]
    height, width = on.shape
    if all(one.is_empty or not one.intersects(shapely.box(0, 0, width, height)) for one in moved):
        west, south, east, north = table.total_bounds
        raise SceneError(
            f"labels {address} do not lie on the scene: all polygons are within x {west:g} to {east:g}, y {south:g} to"
            f" {north:g} in {table.crs.name}, off its {height} x {width} px (y x x); are they of this scene, and is"
            " their CRS right?"
        )
    return moved


def _burn(polygons: Sequence[tuple[BaseGeometry, int | None]], shape: tuple[int, int]) -> NDArray[np.uint8]:
    """Return the (y, x) class index at each pixel's centre; the last polygon wins."""
    import rasterio.features as rasterio_features

    if not polygons:
        return np.full(shape, UNLABELLED, np.uint8)
    return np.asarray(rasterio_features.rasterize(polygons, out_shape=shape, fill=UNLABELLED, dtype="uint8"))
