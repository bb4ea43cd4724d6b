"""From a map in whatever CRS to degrees, and to a plane in metres: by PROJ."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pyproj
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox

from storage.arrays.georeference import map_attributes

Floats = NDArray[np.float64]
Places = Callable[[Floats, Floats], Floats]
WGS84 = "EPSG:4326"
APART_DEG = 1e-3  # of places between which a degree is measured


def crs_wkt(geobox: GeoBox) -> str:
    """A map's CRS as WKT (PoseError: it has none)."""
    return str(map_attributes(geobox)["proj:wkt2"])


def to_degrees(geobox: GeoBox) -> Places:
    """What gives (..., 2) latitude and longitude [deg] of a map's x and y."""
    transformer = pyproj.Transformer.from_crs(crs_wkt(geobox), WGS84, always_xy=True)
    return lambda x, y: np.stack(transformer.transform(x, y)[::-1], axis=-1)


def degree_m(geobox: GeoBox) -> tuple[float, float]:
    """Metres of a degree to the north and of one to the east, in the middle of a map."""
    middle = geobox.affine * (geobox.shape[1] / 2, geobox.shape[0] / 2)
    lat, lon = to_degrees(geobox)(*np.array(middle)[:, None])[0].tolist()
    geod = pyproj.Geod(ellps="WGS84")
    north, east = (
        geod.inv(lon, lat, lon + across, lat + along)[2] / APART_DEG
        for along, across in ((APART_DEG, 0.0), (0.0, APART_DEG))
    )
    return float(north), float(east)


def to_plane(geobox: GeoBox) -> tuple[Places, str]:
    """What gives (..., 2) metres east and north of a map's x and y, and the CRS (WKT) that they are in.

    The map's own where it is projected in metres, else the UTM zone of its middle.
    """
    crs = pyproj.CRS.from_wkt(crs_wkt(geobox))
    if crs.is_projected and all(axis.unit_conversion_factor == 1 for axis in crs.axis_info[:2]):
        return (lambda x, y: np.stack([x, y], axis=-1)), crs.to_wkt()
    middle = geobox.affine * (geobox.shape[1] / 2, geobox.shape[0] / 2)
    lat, lon = to_degrees(geobox)(*np.array(middle)[:, None])[0]
    zone = pyproj.CRS.from_epsg((32600 if lat >= 0 else 32700) + int((lon + 180) % 360 // 6) + 1)
    transformer = pyproj.Transformer.from_crs(crs, zone, always_xy=True)
    return (lambda x, y: np.stack(transformer.transform(x, y), axis=-1)), zone.to_wkt()
