"""Read polygons from GeoJSON, GeoPackage and shapefile: zones with names, and labels burnt onto a scene's pixels.

A pixel has the class of the last polygon in the file that contains its centre.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pyproj
import shapely
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox
from shapely.geometry.base import BaseGeometry

from spectralzoom.pipeline.errors import PipelineError, SceneError, ZoneError
from spectralzoom.pipeline.geometry.grid import UNLABELLED
from spectralzoom.pipeline.ground.field_places import FieldPlace, GroundPlace, NoPlace, PlacedPicture
from spectralzoom.pipeline.ground.zones import on_field
from spectralzoom.storage.readers.labels import MOST_FOUND_CLASSES, Labels, class_colours
from spectralzoom.storage.readers.scene_toml import SETTINGS_NAME, ClassValue, SceneSettings

if TYPE_CHECKING:
    import geopandas

ZONE_ENDINGS = (".geojson", ".json", ".gpkg", ".shp")
POLYGON_ENDINGS = (".gpkg", ".geojson", ".shp")  # of labels; a .json file may hold anything
USUAL_NAMES = ("name", "plot", "plot_name", "plot_id", "plotid", "id", "label")
_OF_CROPS = ("crop", "crop_type", "species", "category", "land_cover", "landcover", "cover", "type", "code", "name")
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
    one zone. Invalid borders are repaired with a note. Raises ZoneError: there is no such file, layer or attribute, the
    file cannot be read, has no CRS, or has other shapes than polygons.
    """
    table, notes = read_polygons(source)
    shapes: dict[str, BaseGeometry] = {}
    for name, shape in zip(_names(table, named_by, source), table.geometry, strict=True):
        shapes[name] = shape if name not in shapes else shapely.union(shapes[name], shape)
    return ZoneFile(source, table.crs, shapes, notes)


def read_polygons(source: str) -> tuple[geopandas.GeoDataFrame, tuple[str, ...]]:
    """Read the polygons of ``FILE`` or ``FILE.gpkg:LAYER`` with their attributes, without empty ones; and notes.

    GeoJSON without a CRS is WGS 84. The index has the rows of the layer, from 0. Raises ZoneError: as `read_zones`.
    """
    import geopandas
    import pyogrio

    path, layer = split_layer(source)
    if path.suffix.lower() not in ZONE_ENDINGS:
        raise ZoneError(f"{source}: expected polygons as {', '.join(ZONE_ENDINGS)}; save the layer as one of them")
    if not path.is_file():
        raise ZoneError(f"there is no file {path}; give the path of a file with polygons, or leave it out")
    try:
        if path.suffix.lower() == ".gpkg":
            layers = [str(one) for one in pyogrio.list_layers(path)[:, 0]]
            layer = layers[0] if layer is None and len(layers) == 1 else layer
            if layer not in layers:
                asked = "has several layers" if layer is None else f"has no layer {layer!r}"
                example = f"{path}:{layers[0] if layers else 'LAYER'}"
                raise ZoneError(f"{path} {asked}; name one of {', '.join(layers)}: {example}")
        table = geopandas.GeoDataFrame(geopandas.read_file(path, layer=layer))
    except (OSError, ValueError, RuntimeError, pyproj.exceptions.CRSError, shapely.errors.GEOSException) as error:
        raise ZoneError(f"cannot read {source} as polygons: {error}; save it anew from a map program") from None
    shapes = table.geometry if "geometry" in table else geopandas.GeoSeries()
    table = table[~(shapes.isna() | shapes.is_empty)]
    kinds = Counter(kind for kind in shapes[table.index].geom_type if kind not in POLYGONS)
    if kinds or not len(table):
        came = " and ".join(f"{count} {kind}" for kind, count in kinds.items()) or "none"
        raise ZoneError(f"{source}: expected polygons, got {came}; draw areas, zones and plots as closed polygons")
    if table.crs is None:
        raise ZoneError(f"{source} has no CRS; save it with one (a shapefile needs a .prj file)")
    valid = table.geometry.is_valid
    whole = [one if one.is_valid else polygons_of(shapely.make_valid(one)) for one in table.geometry.force_2d()]
    crossed = f"{source}: the borders of {sum(~valid)} of {len(table)} polygons cross or touch themselves"
    return table.set_geometry(whole, crs=table.crs), () if valid.all() else (f"{crossed} and were repaired",)


def polygons_of(shape: BaseGeometry) -> BaseGeometry:
    """Return the polygons of a geometry as one shape, without lines and points."""
    parts = [one for one in shapely.get_parts(shape) if one.geom_type in POLYGONS]
    inner = [polygons_of(one) for one in shapely.get_parts(shape) if one.geom_type == "GeometryCollection"]
    return shapely.union_all([*parts, *inner]) if len(parts) + len(inner) != 1 else (parts + inner)[0]


def split_layer(source: str | Path) -> tuple[Path, str | None]:
    """Return path and layer of ``FILE.gpkg:LAYER``."""
    head, mark, layer = str(source).rpartition(".gpkg:")
    return Path(f"{head}.gpkg" if mark else source), layer if mark else None


def _names(table: geopandas.GeoDataFrame, named_by: str | None, source: str) -> list[str]:
    """Return the name of each polygon."""
    numbers = [str(row + 1) for row in table.index]
    fields = _fields(table)
    by_word = {name.lower(): name for name in reversed(fields)}
    if named_by is not None and named_by not in fields:
        known = ", ".join(fields) or "no attribute"
        raise ZoneError(f"{source}: expected an attribute {named_by!r} to name plots by, got {known}")
    found = named_by or next((by_word[word] for word in USUAL_NAMES if word in by_word), None)
    if found is None:
        return numbers
    return [word_of(value) or number for value, number in zip(table[found], numbers, strict=True)]


def _fields(table: geopandas.GeoDataFrame) -> list[str]:
    """Return the names of the attributes."""
    return [str(name) for name in table.columns if name != table.geometry.name]


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
    table, repaired = _labels_in(address)
    attribute, names = _classes_in(table, address, settings)
    classes = dict(settings.classes) or _named(names, settings.unlabelled, str(address))
    codes = [_index_of(name, classes, settings.unlabelled) for name in names]
    if unknown := [name for name, code in zip(names, codes, strict=True) if code is None and name]:
        raise SceneError(
            f"labels {address} have {unknown.count(unknown[0])} polygons of {attribute} = {unknown[0]!r}, which is no"
            f" class; add it to [classes] or state it as unlabelled in {SETTINGS_NAME}"
        )
    moved = _moved(table, NoPlace(shape) if geobox is None else PlacedPicture(geobox), address)
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
        *repaired,
        *([f"{lacking} polygons without a value of {attribute} are left out"] if lacking else []),
        *([f"{shared} px lie in polygons of several classes: the later polygon counts"] if shared else []),
    )
    return Labels(index, tuple(classes), tuple(classes.values()), class_colours(classes, settings.colours), notes)


def polygon_classes(addresses: Iterable[str | Path], settings: SceneSettings) -> dict[str, ClassValue]:
    """Return every class of several files of polygons (SceneError, also for more than 64 classes)."""
    names = [name for one in addresses for name in _classes_in(_labels_in(one)[0], one, settings)[1]]
    return _named(names, settings.unlabelled, "of several files")


def _labels_in(address: str | Path) -> tuple[geopandas.GeoDataFrame, tuple[str, ...]]:
    try:
        return read_polygons(str(address))
    except ZoneError as error:
        raise SceneError(f"labels: {error}") from error


def _classes_in(table: geopandas.GeoDataFrame, address: str | Path, settings: SceneSettings) -> tuple[str, list[str]]:
    """Return the class attribute and each polygon's value of it, empty without one."""
    fields = _fields(table)
    by_word = {name.lower(): name for name in reversed(fields)}
    stated = settings.class_attribute
    found = next((by_word[word] for word in CLASS_ATTRIBUTES if word in by_word), None) if stated is None else stated
    if found is None or found not in fields:
        wanted = "an attribute that says the class" if stated is None else f"the attribute {stated!r}"
        known = ", ".join(fields) or "no attribute"
        raise SceneError(
            f'labels {address} lack {wanted}; they have {known}; write class_attribute = "..." into a'
            f" {SETTINGS_NAME} beside the scene"
        )
    return found, [word_of(value) for value in table[found]]


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


def place_on_earth(place: FieldPlace, address: str | Path, error: type[PipelineError]) -> GroundPlace:
    """Return the place of a field with polygons (``error``: it has none on the earth)."""
    if isinstance(place, NoPlace):
        raise error(
            f"{address} has polygons, and this field has no georeference: give the rig's [pose], or a scene with a CRS"
            " and a transform (gdal_translate -a_srs -a_ullr)"
        )
    return place


def _moved(table: geopandas.GeoDataFrame, place: FieldPlace, address: str | Path) -> list[BaseGeometry]:
    """Return the polygons in pixels of the scene, clipped to it.

    Raises SceneError: none lies on the scene, or the scene has no georeference.
    """
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
