"""STAC: one item a run, one collection a folder of exports, with relative links and nothing that needs a server.

Footprints, grids, wavelengths, bands and classes are said in the words of its extensions.
"""

from __future__ import annotations

import importlib
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox
from odc.geo.geom import multipoint

from pipeline.errors import ArchiveError
from storage.archive.whole_files import write_whole
from storage.arrays.class_maps import ClassNames
from storage.arrays.georeference import map_attributes

COG = "image/tiff; application=geotiff; profile=cloud-optimized"
ZARR = "application/vnd.zarr; version=3"
SCHEMAS = {
    "proj": "https://stac-extensions.github.io/projection/v2.0.0/schema.json",
    "processing": "https://stac-extensions.github.io/processing/v1.2.0/schema.json",
    "hsi": "https://stac-extensions.github.io/hsi/v1.0.0/schema.json",
    "classification": "https://stac-extensions.github.io/classification/v2.0.0/schema.json",
    "eo": "https://stac-extensions.github.io/eo/v2.0.0/schema.json",
}
_DIGITS = 9  # of a degree: 0.1 mm


def clean_id(text: str, otherwise: str) -> str:
    """The text as an id that is also a file's name; ``otherwise`` where nothing of it is left."""
    return re.sub(r"[^A-Za-z0-9_-]+", "-", text).strip("-") or otherwise


def bounds(geometry: Mapping[str, Any]) -> list[float]:
    """West, south, east and north of a GeoJSON polygon [degrees]."""
    points = np.array(geometry["coordinates"][0])
    return [*points.min(axis=0).tolist(), *points.max(axis=0).tolist()]


def footprint(geobox: GeoBox, seen: Iterable[tuple[int, NDArray[np.bool_]]]) -> dict[str, Any] | None:
    """Convex outline of what a map shows, as a GeoJSON polygon in longitude and latitude, anticlockwise.

    ``seen`` is first row and (row, x) whether the map shows anything there, in order. To within one pixel of the map;
    None where nothing is seen.
    """
    corners = []
    for first, mask in seen:
        rows = np.flatnonzero(mask.any(axis=1))
        left, right = mask[rows].argmax(axis=1), mask.shape[1] - mask[rows, ::-1].argmax(axis=1)
        for columns in (left, right):
            corners += [np.stack([columns, first + rows + down], axis=-1) for down in (0, 1)]
    points = np.concatenate(corners) if corners else np.empty((0, 2), np.intp)
    if not len(points):
        return None
    a, b, c, d, e, f = (float(number) for number in geobox.affine[:6])
    x, y = points.T
    places = np.stack([a * x + b * y + c, d * x + e * y + f], axis=-1)
    hull = multipoint(places.tolist(), geobox.crs).convex_hull.simplify(float(np.hypot(a, d)))
    to_degrees = pyproj.Transformer.from_crs(map_attributes(geobox)["proj:wkt2"], "EPSG:4326", always_xy=True)
    ring = np.round(np.stack(to_degrees.transform(*np.array(hull.json["coordinates"][0]).T[:2]), axis=-1), _DIGITS)
    x, y = (ring - ring[0]).T
    if float(np.sum(x[:-1] * y[1:] - x[1:] * y[:-1])) < 0:  # twice the area, negative where clockwise
        ring = ring[::-1]
    return {"type": "Polygon", "coordinates": [ring.tolist()]}


def projection(geobox: GeoBox) -> dict[str, Any]:
    """Fields of the projection extension of an image on a map, from what its Zarr store says (PoseError: no CRS)."""
    place = map_attributes(geobox)
    code = place.get("proj:code")
    return {
        "proj:code": code,
        **({"proj:wkt2": place["proj:wkt2"]} if code is None else {}),
        "proj:shape": [int(size) for size in geobox.shape],
        "proj:transform": [float(number) for number in geobox.affine[:6]],
        "proj:bbox": [float(number) for number in geobox.boundingbox.bbox],
    }


def angular(transform: Sequence[float], shape: Sequence[int]) -> dict[str, Any]:
    """Fields of the projection extension of an image without a CRS, its transform in radians."""
    return {"proj:code": None, "proj:shape": list(map(int, shape)), "proj:transform": list(transform)}


def wavelengths(centre_nm: NDArray[np.float64]) -> dict[str, float]:
    """Fields of the hyperspectral extension [micrometres]."""
    return {"hsi:wavelength_min": float(centre_nm.min()) / 1000, "hsi:wavelength_max": float(centre_nm.max()) / 1000}


def spectral_bands(centre_nm: NDArray[np.float64], fwhm_nm: NDArray[np.float64] | None, about: Any) -> dict[str, Any]:
    """Bands of a cube, each with its centre and width [micrometres] and what is true of all of them."""
    bands = [
        {"name": f"B{number:03d}", "eo:center_wavelength": centre / 1000, **about}
        for number, centre in enumerate(centre_nm.tolist())
    ]
    for band, width in zip(bands, [] if fwhm_nm is None else fwhm_nm.tolist(), strict=fwhm_nm is not None):
        band["eo:full_width_half_max"] = width / 1000
    return {"bands": bands}


def classes(legend: ClassNames) -> dict[str, Any]:
    """Fields of the classification extension: every class's number, name and colour."""
    return {
        "classification:classes": [
            {
                "value": number,
                "name": clean_id(name, f"class-{number}"),
                "title": name,
                "color_hint": "{:02X}{:02X}{:02X}".format(*colour),
            }
            for number, (name, colour) in enumerate(zip(legend.names, legend.colours.tolist(), strict=True))
        ]
    }


COLLECTION = "collection.json"
_EVERYWHERE = [-180.0, -90.0, 180.0, 90.0]


@dataclass(frozen=True)
class Item:
    """What one run's item says. Addresses of assets are relative to the item's folder."""

    id: str
    started: str  # ISO 8601
    finished: str
    properties: Mapping[str, Any]
    assets: Mapping[str, Mapping[str, Any]]  # STAC's asset objects by key
    footprint: Mapping[str, Any] | None = None  # GeoJSON geometry; None where the place is not known


@dataclass(frozen=True)
class Collection:
    """What the collection of a folder says."""

    id: str
    title: str
    description: str
    summaries: Mapping[str, Any] = field(default_factory=dict)


def write_stac(folder: Path, collection: Collection, item: Item) -> tuple[Path, Path]:
    """Write ``ID/ID.json`` and the collection of all items that lie in ``folder``; gives both paths.

    Raises ArchiveError: the folder is another collection's, one of its items cannot be read,
    or what would be written does not fit STAC's own schemas.
    """
    pystac = importlib.import_module("pystac")
    check_owner(folder, collection.id)
    root = pystac.Collection(
        collection.id,
        collection.description,
        _extent(pystac, []),
        title=collection.title,
        license="other",
        catalog_type=pystac.CatalogType.SELF_CONTAINED,
    )
    mine = _item(pystac, item)
    others = [other for other in _items_there(pystac, folder) if other.id != item.id]
    items = sorted([mine, *others], key=lambda one: (str(one.datetime), one.id))
    root.add_items(items)
    root.extent = _extent(pystac, items)
    root.summaries = pystac.Summaries(_summaries(items) | dict(collection.summaries))
    root.normalize_hrefs(str(folder))
    paths = folder / item.id / f"{item.id}.json", folder / COLLECTION
    contents = [made.to_dict(include_self_link=False) for made in (mine, root)]
    for path, content in zip(paths, contents, strict=True):
        if problems := stac_problems(content):
            raise ArchiveError(f"{path} would be no valid STAC: {problems[0]}; this is a defect, please report it")
    for path, content in zip(paths, contents, strict=True):
        write_whole(path, json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False) + "\n")
    return paths


def check_owner(folder: Path, collection_id: str) -> None:
    """Refuse a folder whose collection has another id (ArchiveError)."""
    path = folder / COLLECTION
    if path.exists() and (found := _load(path).get("id")) != collection_id:
        raise ArchiveError(
            f"{path} is the collection {found!r} of another archive, expected {collection_id!r}; choose another --out"
        )


def _load(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(content, dict):
            raise TypeError("it holds no table")
    except (OSError, ValueError, TypeError) as error:
        raise ArchiveError(f"{path} cannot be read as STAC: {error}; remove it and export again") from error
    return content


def _items_there(pystac: Any, folder: Path) -> list[Any]:
    """Items of earlier exports, each in the folder of its own name."""
    found = []
    for path in sorted(folder.glob("*/*.json")):
        if path.stem == path.parent.name:
            try:
                found.append(pystac.Item.from_dict(_load(path), href=str(path), preserve_dict=False))
            except (pystac.STACError, pystac.STACTypeError, KeyError, TypeError, ValueError) as error:
                raise ArchiveError(f"{path} is no STAC item: {error}; remove its folder and export again") from error
    return found


def _item(pystac: Any, item: Item) -> Any:
    start, end = (datetime.fromisoformat(text) for text in (item.started, item.finished))
    made = pystac.Item(
        item.id,
        None if item.footprint is None else dict(item.footprint),
        None,
        start,
        dict(item.properties),
        start_datetime=start,
        end_datetime=end,
    )
    if item.footprint is not None:
        made.bbox = bounds(item.footprint)
    for key, about in item.assets.items():
        made.add_asset(key, pystac.Asset.from_dict(dict(about)))
    names = {*item.properties, *(name for about in item.assets.values() for name in about)}
    names.update(name for about in item.assets.values() for band in about.get("bands", ()) for name in band)
    made.stac_extensions = [SCHEMAS[prefix] for prefix in SCHEMAS if any(n.startswith(f"{prefix}:") for n in names)]
    return made


def _extent(pystac: Any, items: Sequence[Any]) -> Any:
    """Around all items; everywhere where no item says where it is, which STAC has no other word for."""
    boxes = np.array([item.bbox for item in items if item.bbox is not None])
    box = [*boxes[:, :2].min(axis=0).tolist(), *boxes[:, 2:].max(axis=0).tolist()] if len(boxes) else _EVERYWHERE
    times = [(item.common_metadata.start_datetime, item.common_metadata.end_datetime) for item in items]
    interval = [min(start for start, _ in times), max(end for _, end in times)] if times else [None, None]
    return pystac.Extent(pystac.SpatialExtent([box]), pystac.TemporalExtent([interval]))


def _summaries(items: Sequence[Any]) -> dict[str, Any]:
    """What the items' CRS and wavelengths have between them."""
    found: dict[str, Any] = {}
    codes = sorted({item.properties["proj:code"] for item in items if item.properties.get("proj:code")})
    if codes:
        found["proj:code"] = codes
    for name in ("hsi:wavelength_min", "hsi:wavelength_max"):
        values = [item.properties[name] for item in items if name in item.properties]
        if values:
            found[name] = {"minimum": min(values), "maximum": max(values)}
    return found


def stac_problems(content: Mapping[str, Any]) -> list[str]:
    """What STAC's own schemas say of an item or a collection, without a network; empty where nothing.

    Checked: the core schemas of STAC 1.1 that pystac brings, and GeoJSON's. Not checked: the extensions' schemas,
    which lie on a server.
    """
    jsonschema = importlib.import_module("jsonschema")
    registry = importlib.import_module("referencing").Registry
    resource = importlib.import_module("referencing").Resource
    schemas = importlib.import_module("pystac.validation.local_validator").get_local_schema_cache()
    known = registry().with_resources([(name, resource.from_contents(schema)) for name, schema in schemas.items()])
    kind = "collection" if content.get("type") == "Collection" else "item"
    schema = schemas[f"https://schemas.stacspec.org/v1.1.0/{kind}-spec/json-schema/{kind}.json"]
    errors = jsonschema.Draft7Validator(schema, registry=known).iter_errors(content)
    return [f"{error.json_path}: {error.message}" for error in errors]
