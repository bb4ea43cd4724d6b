"""Read polygons from GeoJSON, GeoPackage and shapefile: zones with names, and labels burnt onto a scene's pixels.

A pixel has the class of the last polygon in the file that contains its centre. On a scene with a place polygons are
transformed from their CRS. On a scene without one they are in pixels, x to the right and y down from the upper left
corner.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import PipelineError, SceneError, ZoneError
from pipeline.geometry.grid import UNLABELLED
from pipeline.ground.field_places import FieldPlace, GroundPlace, NoPlace, PlacedPicture
from pipeline.ground.georeference import WGS84
from pipeline.ground.zones import on_field
from pipeline.lazy import BaseGeometry, GeoBox, pyogrio, pyproj, rasterio_features, shapely
from storage.readers.labels import MOST_FOUND_CLASSES, Labels, class_colours
from storage.readers.scene_toml import SETTINGS_NAME, ClassValue, SceneSettings

GEOJSON = (".geojson", ".json")
ZONE_ENDINGS = (*GEOJSON, ".gpkg", ".shp")
POLYGON_ENDINGS = (".gpkg", ".geojson", ".shp")  # of labels; a .json file may hold anything
USUAL_NAMES = ("name", "plot", "plot_name", "plot_id", "plotid", "id", "label")
_OF_CROPS = ("crop", "crop_type", "species", "category", "land_cover", "landcover", "cover", "type", "code", "name")
CLASS_ATTRIBUTES = ("class", "class_name", "classname", "class_id", "label", *_OF_CROPS)  # in the order tried
POLYGONS = ("Polygon", "MultiPolygon")


@dataclass(frozen=True)
class PolygonLayer:
    """Polygons of one layer, in its order, and their attributes."""

    crs: pyproj.CRS | None  # None if the file names none
    shapes: list[BaseGeometry]  # x before y, longitude before latitude
    rows: list[int]  # of the polygons in the layer, from 0
    fields: dict[str, NDArray[Any]]  # attributes by name, one value a polygon
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class ZoneFile:
    """Polygons of one file, united by name."""

    path: str
    crs: pyproj.CRS | None  # None if the file names none
    shapes: dict[str, BaseGeometry]  # by name, in the order of the file; x before y, longitude before latitude
    notes: tuple[str, ...] = ()


def read_zones(source: str, *, named_by: str | None = None) -> ZoneFile:
    """Read the polygons of ``FILE`` or ``FILE.gpkg:LAYER``, named by the attribute ``named_by``.

    None takes the first attribute of name, plot, plot_id, id and label, else numbers from 1. Polygons of one name are
    one zone. Invalid borders are repaired with a note. Raises ZoneError: there is no such file, layer or attribute, the
    file cannot be read, or it has other shapes than polygons.
    """
    layer = read_polygons(source)
    shapes: dict[str, BaseGeometry] = {}
    for name, shape in zip(_names(layer, named_by, source), layer.shapes, strict=True):
        shapes[name] = shape if name not in shapes else shapely.union(shapes[name], shape)
    return ZoneFile(source, layer.crs, shapes, layer.notes)


def read_polygons(source: str) -> PolygonLayer:
    """Read the polygons of ``FILE`` or ``FILE.gpkg:LAYER`` with their attributes, without empty ones (ZoneError)."""
    path, layer = split_layer(source)
    if path.suffix.lower() not in ZONE_ENDINGS:
        raise ZoneError(f"{source}: expected polygons as {', '.join(ZONE_ENDINGS)}; save the layer as one of them")
    if not path.is_file():
        raise ZoneError(f"there is no file {path}; give the path of a file with polygons, or leave it out")
    try:
        if path.suffix.lower() == ".gpkg":
            layers = [str(one) for one in pyogrio.list_layers(path)[:, 0]]
            if layer is None and len(layers) == 1:
                layer = layers[0]
            if layer not in layers:
                asked = "has several layers" if layer is None else f"has no layer {layer!r}"
                example = f"{path}:{layers[0] if layers else 'LAYER'}"
                raise ZoneError(f"{path} {asked}; name one of {', '.join(layers)}: {example}")
        about, _, found, values = pyogrio.raw.read(path, layer=layer)
        known = about["crs"] is not None
        if known and path.suffix.lower() in GEOJSON:  # GDAL assumes WGS 84
            content = json.loads(path.read_text(encoding="utf-8-sig"))
            known = isinstance(content, dict) and content.get("crs") is not None
        crs = pyproj.CRS.from_user_input(about["crs"]) if known else None
        geometry = [None if one is None else shapely.from_wkb(one) for one in (() if found is None else found)]
    except (OSError, ValueError, RuntimeError, pyproj.exceptions.CRSError, shapely.errors.GEOSException) as error:
        raise ZoneError(f"cannot read {source} as polygons: {error}; save it anew from a map program") from None
    rows = [number for number, one in enumerate(geometry) if one is not None and not one.is_empty]
    kinds = Counter(one.geom_type for one in geometry if one is not None and one.geom_type not in POLYGONS)
    if kinds or not rows:
        came = " and ".join(f"{count} {kind}" for kind, count in kinds.items()) or "none"
        raise ZoneError(f"{source}: expected polygons, got {came}; draw areas, zones and plots as closed polygons")
    shapes = [shapely.force_2d(geometry[number]) for number in rows]
    crossed = sum(not shape.is_valid for shape in shapes)
    shapes = [shape if shape.is_valid else polygons_of(shapely.make_valid(shape)) for shape in shapes]
    note = f"{source}: the borders of {crossed} of {len(rows)} polygons cross or touch themselves and were repaired"
    fields = {str(name): column[rows] for name, column in zip(about["fields"], values, strict=True)}
    return PolygonLayer(crs, shapes, rows, fields, (note,) if crossed else ())


def polygons_of(shape: BaseGeometry) -> BaseGeometry:
    """Return the polygons of a geometry as one shape, without lines and points."""
    parts = [one for one in shapely.get_parts(shape) if one.geom_type in POLYGONS]
    inner = [polygons_of(one) for one in shapely.get_parts(shape) if one.geom_type == "GeometryCollection"]
    return shapely.union_all([*parts, *inner]) if len(parts) + len(inner) != 1 else (parts + inner)[0]


def split_layer(source: str | Path) -> tuple[Path, str | None]:
    """Return path and layer of ``FILE.gpkg:LAYER``."""
    head, mark, layer = str(source).rpartition(".gpkg:")
    return Path(f"{head}.gpkg" if mark else source), layer if mark else None


def _names(content: PolygonLayer, named_by: str | None, source: str) -> list[str]:
    """Return the name of each polygon."""
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
    the file, layer, attribute or a CRS is missing, no polygon lies on the scene, or one has a class that the settings
    lack.
    """
    layer = _labels_in(address)
    attribute, names = _classes_in(layer, address, settings)
    classes = dict(settings.classes) or _named(names, settings.unlabelled, str(address))
    codes = [_index_of(name, classes, settings.unlabelled) for name in names]
    if unknown := [name for name, code in zip(names, codes, strict=True) if code is None and name]:
        raise SceneError(
            f"labels {address} have {unknown.count(unknown[0])} polygons of {attribute} = {unknown[0]!r}, which is no"
            f" class; add it to [classes] or state it as unlabelled in {SETTINGS_NAME}"
        )
    moved = _moved(layer, NoPlace(shape) if geobox is None else PlacedPicture(geobox), address)
    burnt = [
        (one, code)
        for one, code in zip(moved, codes, strict=True)
        if code not in (None, UNLABELLED) and not one.is_empty
    ]
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
        *layer.notes,
        *([f"{lacking} polygons without a value of {attribute} are left out"] if lacking else []),
        *([f"{shared} px lie in polygons of several classes: the later polygon counts"] if shared else []),
    )
    return Labels(index, tuple(classes), tuple(classes.values()), class_colours(classes, settings.colours), notes)


def polygon_classes(addresses: Iterable[str | Path], settings: SceneSettings) -> dict[str, ClassValue]:
    """Return every class of several files of polygons (SceneError, also for more than 64 classes)."""
    names = [name for one in addresses for name in _classes_in(_labels_in(one), one, settings)[1]]
    return _named(names, settings.unlabelled, "of several files")


def _labels_in(address: str | Path) -> PolygonLayer:
    try:
        return read_polygons(str(address))
    except ZoneError as error:
        raise SceneError(f"labels: {error}") from error


def _classes_in(layer: PolygonLayer, address: str | Path, settings: SceneSettings) -> tuple[str, list[str]]:
    """Return the class attribute and each polygon's value of it, empty without one."""
    by_word = {name.lower(): name for name in reversed(layer.fields)}
    stated = settings.class_attribute
    found = next((by_word[word] for word in CLASS_ATTRIBUTES if word in by_word), None) if stated is None else stated
    if found is None or found not in layer.fields:
        wanted = "an attribute that says the class" if stated is None else f"the attribute {stated!r}"
        known = ", ".join(layer.fields) or "no attribute"
        raise SceneError(
            f'labels {address} lack {wanted}; they have {known}; write class_attribute = "..." into a'
            f" {SETTINGS_NAME} beside the scene"
        )
    return found, [word_of(value) for value in layer.fields[found]]


def _named(names: Iterable[str], unlabelled: ClassValue | None, where: str) -> dict[str, ClassValue]:
    """Return a class for every name: ``class_N`` for numbers, other names sorted and numbered from 1."""
    words = sorted({name for name in names if name and name != str(unlabelled)})
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


def _index_of(word: str, classes: dict[str, ClassValue], unlabelled: ClassValue | None) -> int | None:
    """Return the class index of a polygon's name or number; 255 for unlabelled, None for no class."""
    if word and word == str(unlabelled):
        return UNLABELLED
    if word in classes:
        return list(classes).index(word)
    values = list(classes.values())
    return values.index(int(word)) if word.isdecimal() and int(word) in values else None


def placed_on(
    place: FieldPlace, crs: pyproj.CRS | None, address: str | Path, error: type[PipelineError]
) -> tuple[GroundPlace, pyproj.CRS]:
    """Return the place of a field, and the CRS of polygons on it: WGS 84 for GeoJSON without one.

    Raises ``error``: the field has no place on the earth, or another format than GeoJSON has no CRS.
    """
    if isinstance(place, NoPlace):
        raise error(
            f"{address} has polygons, and this field has no georeference: give the rig's [pose], or a scene with a CRS"
            " and a transform (gdal_translate -a_srs -a_ullr)"
        )
    if crs is not None:
        return place, crs
    if split_layer(address)[0].suffix.lower() not in GEOJSON:
        raise error(f"{address} has no CRS; save it with one (a shapefile needs a .prj file)")
    return place, pyproj.CRS.from_epsg(WGS84)


def _moved(layer: PolygonLayer, place: FieldPlace, address: str | Path) -> list[BaseGeometry]:
    """Return the polygons in pixels of the scene, clipped to it.

    Raises SceneError: none lies on the scene, or the scene or the polygons have no georeference.
    """
    on, crs = placed_on(place, layer.crs, address, SceneError)
    moved = [polygons_of(on_field(shape, crs, on)) for shape in layer.shapes]
    height, width = on.shape
    if all(one.is_empty or not one.intersects(shapely.box(0, 0, width, height)) for one in moved):
        given = np.array([shape.bounds for shape in layer.shapes])
        west, south = given[:, :2].min(axis=0)
        east, north = given[:, 2:].max(axis=0)
        raise SceneError(
            f"labels {address} do not lie on the scene: all polygons are within x {west:g} to {east:g}, y {south:g} to"
            f" {north:g} in {crs.name}, off its {height} x {width} px (y x x); are they of this scene, and is their CRS"
            " right?"
        )
    return moved


def _burn(polygons: Sequence[tuple[BaseGeometry, int | None]], shape: tuple[int, int]) -> NDArray[np.uint8]:
    """Return the (y, x) class index at each pixel's centre; the last polygon wins."""
    if not polygons:
        return np.full(shape, UNLABELLED, np.uint8)
    return np.asarray(rasterio_features.rasterize(polygons, out_shape=shape, fill=UNLABELLED, dtype="uint8"))
