"""STAC: one item a run, one collection a folder of exports, with relative links and nothing that needs a server.

Footprints, grids, wavelengths, bands and classes are said in the words of its extensions.
"""

from __future__ import annotations

import importlib
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import shapely
import shapely.affinity
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox

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
    points = np.concatenate(corners) if corners else np.empty((0, 2))
    if not len(points):
        return None
    hull = shapely.MultiPoint(points.astype(np.float64)).convex_hull
    place = map_attributes(geobox)
    to_degrees = pyproj.Transformer.from_crs(place["proj:wkt2"], "EPSG:4326", always_xy=True)
    a, b, c, d, e, f = place["spatial:transform"]
    on_map = shapely.affinity.affine_transform(hull, [a, b, d, e, c, f]).simplify(float(np.hypot(a, d)))
    on_earth = shapely.transform(on_map, lambda xy: np.stack(to_degrees.transform(*xy.T), axis=-1).round(_DIGITS))
    return dict(shapely.geometry.mapping(shapely.geometry.polygon.orient(on_earth)))


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


def write_stac(folder: Path, collection_id: str, description: str, item: Item) -> tuple[Path, Path]:
    """Write ``ID/ID.json`` and the collection of all items that lie in ``folder``; gives both paths.

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
                items.append(pystac.Item.from_dict(_load(path), href=str(path), preserve_dict=False))
            except (pystac.STACError, pystac.STACTypeError, KeyError, TypeError, ValueError) as error:
                raise ArchiveError(f"{path} is no STAC item: {error}; remove its folder and export again") from error
    items.sort(key=lambda one: (str(one.datetime), one.id))
    root.add_items(items)
    root.extent = _extent(pystac, items)
    root.normalize_hrefs(str(folder))
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
        made.bbox = list(shapely.geometry.shape(item.footprint).bounds)
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
