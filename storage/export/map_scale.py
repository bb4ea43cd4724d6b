"""Metres and degrees of a map's grid, in whatever CRS: by PROJ on the WGS 84 ellipsoid."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pyproj
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox

from storage.arrays.georeference import map_attributes

Floats = NDArray[np.float64]
Places = Callable[[Floats, Floats], Floats]
WGS84 = "EPSG:4326"
APART_DEG = 1e-3  # of places between which a degree is measured


@dataclass(frozen=True)
class MapScale:
    """Sizes at the middle of a map."""

    pixel_m2: float
    degree_m: tuple[float, float]  # metres of a degree to the north, and to the east

    @property
    def pixel_m(self) -> float:
        """Side of a square as large as a pixel."""
        return float(np.sqrt(self.pixel_m2))

    @classmethod
    def of(cls, geobox: GeoBox) -> MapScale:
        """Measure the pixel in the middle, and degrees there."""
        y, x = (size // 2 for size in geobox.shape)
        corners = [geobox.affine * corner for corner in ((x, y), (x + 1, y), (x + 1, y + 1), (x, y + 1))]
        place = to_degrees(geobox)(*np.array(corners, np.float64).T)
        geod = pyproj.Geod(ellps="WGS84")
        area, _ = geod.polygon_area_perimeter(place[:, 1], place[:, 0])
        lat, lon = place.mean(axis=0)
        north, east = (
            geod.inv(lon, lat, lon + across, lat + along)[2] / APART_DEG
            for along, across in ((APART_DEG, 0.0), (0.0, APART_DEG))
        )
        return cls(abs(float(area)), (float(north), float(east)))


def crs_wkt(geobox: GeoBox) -> str:
    """A map's CRS as WKT (PoseError: it has none)."""
    return str(map_attributes(geobox)["proj:wkt2"])


def to_degrees(geobox: GeoBox) -> Places:
    """What gives (..., 2) latitude and longitude [deg] of a map's x and y."""
    transformer = pyproj.Transformer.from_crs(crs_wkt(geobox), WGS84, always_xy=True)
    return lambda x, y: np.stack(transformer.transform(x, y)[::-1], axis=-1)


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
