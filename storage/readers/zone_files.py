"""Polygons with names out of GeoJSON, GeoPackage and shapefile: areas of interest, zones that are left out, plots."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import ZoneError
from pipeline.lazy import deferred

if TYPE_CHECKING:
    import pyogrio
    import pyproj
    import shapely
    from shapely.geometry.base import BaseGeometry
else:  # two seconds to import, for surveys with zones alone
    pyogrio = deferred("pyogrio")
    pyproj = deferred("pyproj")
    shapely = deferred("shapely")

GEOJSON = (".geojson", ".json")
ZONE_ENDINGS = (*GEOJSON, ".gpkg", ".shp")
USUAL_NAMES = ("name", "plot", "plot_name", "plot_id", "plotid", "id", "label")
POLYGONS = ("Polygon", "MultiPolygon")


@dataclass(frozen=True)
class PolygonLayer:
    """Polygons of one layer, in its order, and their attributes."""

    crs: pyproj.CRS | None  # None where the file names none
    shapes: list[BaseGeometry]  # x before y, longitude before latitude
    rows: list[int]  # of the layer, from 0, that the polygons stand in
    fields: dict[str, NDArray[Any]]  # attributes by name, one value a polygon
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class ZoneFile:
    """Polygons of one file, those of one name together, and what was mended of them."""

    path: str
    crs: pyproj.CRS | None  # None where the file names none
    shapes: dict[str, BaseGeometry]  # by name, in the order of the file; x before y, longitude before latitude
    notes: tuple[str, ...] = ()


def read_zones(source: str, *, named_by: str | None = None) -> ZoneFile:
    """Read the polygons of ``FILE`` or ``FILE.gpkg:LAYER``, named by the attribute ``named_by``.

    None takes the first of name, plot, plot_id, id and label that there is, else numbers from 1. Polygons of one name
    are one zone. Those whose borders cross or touch themselves are mended, and a note says so. Raises ZoneError: no
    such file, layer or attribute, a file that cannot be read, or one with anything but polygons.
    """
    layer = read_polygons(source)
    called = _names(layer, named_by, source)
    shapes: dict[str, BaseGeometry] = {}
    for name, shape in zip(called, layer.shapes, strict=True):
        shapes[name] = shape if name not in shapes else shapely.union(shapes[name], shape)
    return ZoneFile(source, layer.crs, shapes, layer.notes)


def read_polygons(source: str) -> PolygonLayer:
    """Read the polygons of ``FILE`` or ``FILE.gpkg:LAYER`` with their attributes; ZoneError as for `read_zones`.

    Polygons whose borders cross or touch themselves are mended, and a note says so; empty ones are left out.
    """
    path, layer = split_layer(source)
    if path.suffix.lower() not in ZONE_ENDINGS:
        raise ZoneError(f"{source}: expected polygons as {', '.join(ZONE_ENDINGS)}; save the layer as one of them")
    if not path.is_file():
        raise ZoneError(f"there is no file {path}; give the path of a file with polygons, or leave it out")
    content = _read(path, _layer_of(path, layer, source), source)
    geometry = [None if one is None else shapely.from_wkb(one) for one in content.geometry]
    rows = [number for number, one in enumerate(geometry) if one is not None and not one.is_empty]
    kinds = Counter(one.geom_type for one in geometry if one is not None and one.geom_type not in POLYGONS)
    if kinds or not rows:
        came = " and ".join(f"{count} {kind}" for kind, count in kinds.items()) or "none"
        raise ZoneError(f"{source}: expected polygons, got {came}; draw areas, zones and plots as closed polygons")
    shapes = [shapely.force_2d(geometry[number]) for number in rows]
    crossed = sum(not shape.is_valid for shape in shapes)
    shapes = [shape if shape.is_valid else polygons_of(shapely.make_valid(shape)) for shape in shapes]
    told = f"{source}: the borders of {crossed} of {len(rows)} polygons cross or touch themselves and were mended"
    fields = {name: column[rows] for name, column in content.fields.items()}
    return PolygonLayer(content.crs, shapes, rows, fields, (told,) if crossed else ())


def polygons_of(shape: BaseGeometry) -> BaseGeometry:
    """What of a geometry has an area, as one polygon or several; lines and points that mending left are dropped."""
    parts = [one for one in shapely.get_parts(shape) if one.geom_type in POLYGONS]
    inner = [polygons_of(one) for one in shapely.get_parts(shape) if one.geom_type == "GeometryCollection"]
    return shapely.union_all([*parts, *inner]) if len(parts) + len(inner) != 1 else (parts + inner)[0]


def split_layer(source: str | Path) -> tuple[Path, str | None]:
    """``FILE.gpkg:LAYER`` -> path and layer; None where none is named."""
    head, mark, layer = str(source).rpartition(".gpkg:")
    return Path(f"{head}.gpkg" if mark else source), layer if mark else None


def _layer_of(path: Path, layer: str | None, source: str) -> str | None:
    if path.suffix.lower() != ".gpkg":
        return None
    try:
        layers = [str(one) for one in pyogrio.list_layers(path)[:, 0]]
    except (pyogrio.errors.DataSourceError, pyogrio.errors.DataLayerError) as error:
        raise ZoneError(f"cannot read {source}: {error}") from None
    if layer is None and len(layers) == 1:
        return layers[0]
    if layer is None or layer not in layers:
        asked = "has several layers" if layer is None else f"has no layer {layer!r}"
        raise ZoneError(f"{path} {asked}; name one of {', '.join(layers)}: {path}:{layers[0] if layers else 'LAYER'}")
    return layer


@dataclass(frozen=True)
class _VectorLayer:
    crs: pyproj.CRS | None
    fields: dict[str, NDArray[Any]]
    geometry: Sequence[bytes | None]


def _read(path: Path, layer: str | None, source: str) -> _VectorLayer:
    try:
        about, _, geometry, values = pyogrio.raw.read(path, layer=layer)
        # GDAL takes WGS 84 for granted in GeoJSON; whether that is meant is the survey's to say
        known = about["crs"] is not None and (path.suffix.lower() not in GEOJSON or _names_crs(path))
        crs = pyproj.CRS.from_user_input(about["crs"]) if known else None
    except (OSError, ValueError, RuntimeError, pyproj.exceptions.CRSError) as error:  # GDAL's are RuntimeErrors
        raise ZoneError(f"cannot read {source} as polygons: {error}; save it anew from a map program") from None
    fields = {str(name): column for name, column in zip(about["fields"], values, strict=True)}
    return _VectorLayer(crs, fields, [] if geometry is None else list(geometry))


def _names_crs(path: Path) -> bool:
    content = json.loads(path.read_text(encoding="utf-8-sig"))
    return isinstance(content, dict) and content.get("crs") is not None


def _names(content: PolygonLayer, named_by: str | None, source: str) -> list[str]:
    """What each polygon is called."""
    numbers = [str(row + 1) for row in content.rows]
    by_word = {name.lower(): name for name in reversed(content.fields)}
    if named_by is not None and named_by not in content.fields:
        known = ", ".join(content.fields) or "no attribute"
        raise ZoneError(f"{source}: expected an attribute {named_by!r} to name plots by, got {known}")
    found = named_by or next((by_word[word] for word in USUAL_NAMES if word in by_word), None)
    if found is None:
        return numbers
    return [word_of(value) or number for value, number in zip(content.fields[found], numbers, strict=True)]


def word_of(value: object) -> str:
    """An attribute as a name; empty where it says nothing."""
    if value is None or (isinstance(value, float | np.floating) and np.isnan(value)):
        return ""
    if isinstance(value, float | np.floating) and float(value).is_integer():
        return str(int(value))
    return str(value).strip()
