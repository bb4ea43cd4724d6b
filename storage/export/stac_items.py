"""Write STAC: an item for each run and a collection for a folder of exports, with relative links."""

from __future__ import annotations

import importlib
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import shapely
import shapely.affinity
from odc.geo.geobox import GeoBox

from pipeline.errors import ArchiveError
from storage.archive.whole_files import write_whole
from storage.arrays.georeference import map_attributes

COG = "image/tiff; application=geotiff; profile=cloud-optimized"
ZARR = "application/vnd.zarr; version=3"
SCHEMAS = {
    "proj": "https://stac-extensions.github.io/projection/v2.0.0/schema.json",
    "processing": "https://stac-extensions.github.io/processing/v1.2.0/schema.json",
}
EDGE_POINTS = 16  # of an outline, at least
_DIGITS = 9  # of a degree: 0.1 mm


def clean_id(text: str, otherwise: str) -> str:
    """Return the text as an id that can name a file; ``otherwise`` where nothing of it is left."""
    return re.sub(r"[^A-Za-z0-9_-]+", "-", text).strip("-") or otherwise


def footprint(geobox: GeoBox) -> dict[str, Any]:
    """Return the outline of a map as a GeoJSON polygon in longitude and latitude, anticlockwise.

    A map across 180 degrees of longitude is cut there, as RFC 7946 asks for; one around a pole has all longitudes.
    """
    place = map_attributes(geobox)
    height, width = geobox.shape
    transformer = pyproj.Transformer.from_crs(place["proj:wkt2"], "EPSG:4326", always_xy=True)
    a, b, c, d, e, f = place["spatial:transform"]
    outline = shapely.segmentize(shapely.box(0, 0, width, height), max(height, width) / EDGE_POINTS)
    x, y = shapely.get_coordinates(outline).T
    lon, lat = (one.round(_DIGITS) for one in transformer.transform(a * x + b * y + c, d * x + e * y + f))
    lon = np.unwrap(lon, period=360)
    on_earth = shapely.Polygon(np.stack([lon - 360 * ((lon.min() + 180) // 360), lat], axis=-1).round(_DIGITS))
    if abs(lon[-1] - lon[0]) > 180:  # the outline goes around a pole
        on_earth = shapely.box(-180, *((lat.min(), 180, 90) if lat.mean() > 0 else (-90, 180, lat.max())))
    elif on_earth.bounds[2] > 180:
        there = shapely.affinity.translate(on_earth.intersection(shapely.box(180, -90, 540, 90)), -360)
        halves = [on_earth.intersection(shapely.box(-180, -90, 180, 90)), there]
        on_earth = shapely.MultiPolygon([shapely.geometry.polygon.orient(one) for one in halves])
    else:
        on_earth = shapely.geometry.polygon.orient(on_earth)
    return dict(shapely.geometry.mapping(on_earth))


def projection(geobox: GeoBox) -> dict[str, Any]:
    """Return the fields of the projection extension of an image on a map, by its Zarr store.

    Raises PoseError: the map has no CRS.
    """
    place = map_attributes(geobox)
    code = place.get("proj:code")
    return {
        "proj:code": code,
        **({"proj:wkt2": place["proj:wkt2"]} if code is None else {}),
        "proj:shape": [int(size) for size in geobox.shape],
        "proj:transform": [float(number) for number in geobox.affine[:6]],
        "proj:bbox": [float(number) for number in geobox.boundingbox.bbox],
    }


COLLECTION = "collection.json"
_EVERYWHERE = [-180.0, -90.0, 180.0, 90.0]


@dataclass(frozen=True)
class Item:
    """Content of one run's item. Addresses of assets are relative to the item's folder."""

    id: str
    started: str  # ISO 8601
    finished: str
    properties: Mapping[str, Any]
    assets: Mapping[str, Mapping[str, Any]]  # STAC's asset objects by key
    footprint: Mapping[str, Any] | None = None  # GeoJSON geometry; None where the place is not known


def write_stac(folder: Path, collection_id: str, description: str, item: Item) -> tuple[Path, Path]:
    """Write ``ID/ID.json`` and the collection of all items in ``folder``; return both paths.

    Raises ArchiveError: the folder is another collection's, or one of its items cannot be read.
    """
    pystac = importlib.import_module("pystac")
    check_owner(folder, collection_id)
    root = pystac.Collection(
        collection_id,
        description,
        _extent(pystac, []),
        title=f"Surveys of {collection_id}",
        license="other",
        catalog_type=pystac.CatalogType.SELF_CONTAINED,
    )
    mine = _item(pystac, item)
    items = [mine]
    for path in sorted(folder.glob("*/*.json")):  # earlier exports, each in the folder of its own name
        if path.stem == path.parent.name and path.stem != item.id:
            try:
                items.append(pystac.Item.from_dict(_load(path), href=f"/{path.relative_to(folder)}"))
            except (pystac.STACError, pystac.STACTypeError, KeyError, TypeError, ValueError) as error:
                raise ArchiveError(f"{path} is no STAC item: {error}; remove its folder and export again") from error
    items.sort(key=lambda one: (str(one.datetime), one.id))
    root.add_items(items)
    root.extent = _extent(pystac, items)
    root.normalize_hrefs("/")  # links are relative; a folder's name may have characters of addresses, as # and ?
    paths = folder / item.id / f"{item.id}.json", folder / COLLECTION
    for path, made in zip(paths, (mine, root), strict=True):
        content = made.to_dict(include_self_link=False)
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
        parts = shapely.get_parts(shapely.geometry.shape(item.footprint))
        first, last = parts[0].bounds, parts[-1].bounds  # west is more than east across 180 degrees
        made.bbox = [first[0], min(first[1], last[1]), last[2], max(first[3], last[3])]
    for key, about in item.assets.items():
        made.add_asset(key, pystac.Asset.from_dict(dict(about)))
    names = {*item.properties, *(name for about in item.assets.values() for name in about)}
    made.stac_extensions = [SCHEMAS[prefix] for prefix in SCHEMAS if any(n.startswith(f"{prefix}:") for n in names)]
    return made


def _extent(pystac: Any, items: Sequence[Any]) -> Any:
    """Return the narrowest box around all items, its west more than its east across 180 degrees, or the whole earth."""
    west, south, east, north = np.array([item.bbox for item in items if item.bbox is not None] or [_EVERYWHERE]).T
    reach = ((west - west[:, None]) % 360 + 360 * (west > east) + east - west).max(axis=1)  # from the west of each
    begin, end = float(west[reach.argmin()]), round(float(west[reach.argmin()] + reach.min()), _DIGITS)
    box = [begin, float(south.min()), end - 360 * (end > 180), float(north.max())]
    times = [(item.common_metadata.start_datetime, item.common_metadata.end_datetime) for item in items]
    interval = [min(start for start, _ in times), max(end for _, end in times)] if times else [None, None]
    return pystac.Extent(pystac.SpatialExtent([box]), pystac.TemporalExtent([interval]))
