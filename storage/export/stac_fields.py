"""What STAC items are made of: footprints, grids, wavelengths, bands and classes, in the words of its extensions."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pyproj
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox
from odc.geo.geom import multipoint

from storage.arrays.georeference import map_attributes
from storage.arrays.ground_maps import ClassLegend

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

    Parameters
    ----------
    seen
        First row and (row, x) whether the map shows anything there, in order.

    Returns
    -------
    To within one pixel of the map; None where nothing is seen.
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
    a, _, c, _, e, f = (float(number) for number in geobox.affine[:6])
    places = np.stack([c + a * points[:, 0], f + e * points[:, 1]], axis=-1)
    hull = multipoint(places.tolist(), geobox.crs).convex_hull.simplify(abs(a))
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


def classes(legend: ClassLegend) -> dict[str, Any]:
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
