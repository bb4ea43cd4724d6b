"""Labels that are polygons: GeoPackage, GeoJSON and shapefile, burnt onto the pixels of a scene.

A pixel has the class of the polygon that its centre lies in, of the later one in the file where several do, and none
outside. On a scene with a place polygons lie where their CRS says; on one without, they are in pixels, x to the right
and y down from the upper left corner.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SceneError, ZoneError
from pipeline.geometry.grid import UNLABELLED
from pipeline.ground.field_places import FieldPlace, NoPlace, PlacedPicture
from pipeline.ground.georeference import WGS84
from pipeline.ground.zones import on_field
from pipeline.lazy import deferred
from storage.readers.labels import MOST_FOUND_CLASSES, Labels, default_colour
from storage.readers.scene_toml import SETTINGS_NAME, ClassValue, SceneSettings
from storage.readers.zone_files import GEOJSON, PolygonLayer, polygons_of, read_polygons, split_layer, word_of

if TYPE_CHECKING:
    import pyproj
    import rasterio.features as rasterio_features
    from odc.geo.geobox import GeoBox
    from shapely.geometry.base import BaseGeometry
else:
    pyproj = deferred("pyproj")
    rasterio_features = deferred("rasterio.features")

POLYGON_ENDINGS = (".gpkg", ".geojson", ".shp")  # a .json is a list of names
_OF_CROPS = ("crop", "crop_type", "species", "category", "land_cover", "landcover", "cover", "type", "code", "name")
CLASS_ATTRIBUTES = ("class", "class_name", "classname", "class_id", "label", *_OF_CROPS)  # in the order tried


def is_polygon_file(address: str | Path) -> bool:
    """Tell by its name whether a label file holds polygons."""
    return split_layer(address)[0].suffix.lower() in POLYGON_ENDINGS


def load_polygon_labels(
    address: str | Path, shape: tuple[int, int], geobox: GeoBox | None, *, settings: SceneSettings
) -> tuple[Labels, tuple[str, ...]]:
    """Burn the polygons of ``FILE`` or ``FILE.gpkg:LAYER`` onto the (y, x) pixels of a scene; and notes.

    Classes are those of the settings, by name or by number, else every value of the attribute that says them. Raises
    SceneError: there is no such file, layer or attribute, no polygon, none on the scene, no CRS where one is needed
    or one where none is known, or a class that the settings lack.
    """
    layer = _read(address)
    attribute, said = _classes_said(layer, address, settings)
    classes = dict(settings.classes) or _named(said, settings.unlabelled, str(address))
    codes = [_index_of(word, classes, settings.unlabelled) for word in said]
    if unknown := [word for word, code in zip(said, codes, strict=True) if code is None and word]:
        raise SceneError(
            f"labels {address} have {unknown.count(unknown[0])} polygons of {attribute} = {unknown[0]!r}, which is no"
            f" class; add it to [classes] or state it as unlabelled in {SETTINGS_NAME}"
        )
    place = NoPlace(shape) if geobox is None else PlacedPicture(geobox)
    moved = _moved(layer, place, address)
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
    values = tuple(classes.values())
    colours = [value if isinstance(value, tuple) else default_colour(at) for at, value in enumerate(values)]
    labels = Labels(index, tuple(classes), values, np.array(colours, np.uint8).reshape(-1, 3))
    shared = int(np.count_nonzero(index != _burn(burnt[::-1], shape)))
    lacking = sum(not word for word in said)
    return labels, (
        f"{len(burnt)} polygons by their attribute {attribute}",
        *layer.notes,
        *([f"{lacking} polygons without a value of {attribute} are left out"] if lacking else []),
        *([f"{shared} px lie in polygons of several classes: the later polygon counts"] if shared else []),
        *(["polygons are taken in pixels of the scene, x to the right and y down"] if geobox is None else []),
    )


def polygon_classes(addresses: Iterable[str | Path], settings: SceneSettings) -> dict[str, ClassValue]:
    """Return every class of several files of polygons: names in their order, or ``class_N`` after numbers.

    Raises SceneError as `load_polygon_labels`, and where there are more than 64 classes.
    """
    said: list[str] = []
    for address in addresses:
        said += _classes_said(_read(address), address, settings)[1]
    return _named(said, settings.unlabelled, "of several files")


def _read(address: str | Path) -> PolygonLayer:
    try:
        return read_polygons(str(address))
    except ZoneError as error:
        raise SceneError(f"labels: {error}") from error


def _classes_said(layer: PolygonLayer, address: str | Path, settings: SceneSettings) -> tuple[str, list[str]]:
    """The attribute that says classes, and its word for each polygon; empty where it says none."""
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


def _named(said: Iterable[str], unlabelled: ClassValue | None, where: str) -> dict[str, ClassValue]:
    """A class for every word: numbers as label pictures have them, other words in their order from 1."""
    words = sorted({word for word in said if word and word != str(unlabelled)})
    if len(words) > MOST_FOUND_CLASSES:
        raise SceneError(
            f"labels {where} have {len(words)} different classes, at most {MOST_FOUND_CLASSES} are taken; name another"
            f" attribute, class_attribute in a {SETTINGS_NAME}"
        )
    if not words:
        raise SceneError(f"labels {where} say no class of any polygon; fill in the attribute, or name another")
    if all(word.isdecimal() for word in words):
        return {f"class_{number}": number for number in sorted(map(int, words))}
    return {word: number for number, word in enumerate(words, 1)}


def _index_of(word: str, classes: dict[str, ClassValue], unlabelled: ClassValue | None) -> int | None:
    """Index of the class that a polygon's word means, by name or number; 255 for unlabelled, None for no class."""
    if word and word == str(unlabelled):
        return UNLABELLED
    names, values = list(classes), list(classes.values())
    if word in names:
        return names.index(word)
    return values.index(int(word)) if word.isdecimal() and int(word) in values else None


def _moved(layer: PolygonLayer, place: FieldPlace, address: str | Path) -> list[BaseGeometry]:
    """Polygons in pixels of the scene, as far as they lie on it (SceneError: none does, or their CRS does not fit)."""
    crs = layer.crs
    if place.crs is None and crs is not None:
        raise SceneError(
            f"labels {address} are in {crs.name}, and the scene does not say where it lies: give the scene a CRS and a"
            " transform, or the polygons in pixels of the scene as GeoJSON without a CRS"
        )
    if place.crs is not None and crs is None:
        if split_layer(address)[0].suffix.lower() not in GEOJSON:
            raise SceneError(f"labels {address} do not say their CRS; save them with one (a shapefile has a .prj)")
        crs = pyproj.CRS.from_epsg(WGS84)
    moved = [polygons_of(on_field(shape, crs, place)) for shape in layer.shapes]
    if all(one.is_empty or not one.intersects(_outline(place)) for one in moved):
        given = np.array([shape.bounds for shape in layer.shapes])
        west, south = given[:, :2].min(axis=0)
        east, north = given[:, 2:].max(axis=0)
        there = f"in {crs.name}" if crs is not None else "in pixels"
        size = f"{place.shape[0]} x {place.shape[1]} px (y x x)"
        raise SceneError(
            f"labels {address} do not lie on the scene: all polygons are within x {west:g} to {east:g}, y {south:g} to"
            f" {north:g} {there}, off its {size}; are they of this scene, and is their CRS right?"
        )
    return moved


def _outline(place: FieldPlace) -> BaseGeometry:
    return NoPlace(place.shape).outline


def _burn(polygons: Sequence[tuple[BaseGeometry, int | None]], shape: tuple[int, int]) -> NDArray[np.uint8]:
    """(y, x) index of the class of each pixel's centre, the last polygon's where several hold it."""
    if not polygons:
        return np.full(shape, UNLABELLED, np.uint8)
    return np.asarray(rasterio_features.rasterize(polygons, out_shape=shape, fill=UNLABELLED, dtype="uint8"))
