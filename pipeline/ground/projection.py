"""From metres around the rig's foot to longitude, latitude and a projected map, and back. By PROJ, without a network.

The metres are of the plane that touches the ellipsoid's normal at the foot (east, north, up); they go to longitude and
latitude through Cartesian coordinates of the earth, so that nothing is taken for flat.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.errors import PoseError
from pipeline.ground.view import GroundView, RigPose

if TYPE_CHECKING:
    from pyproj import CRS, Transformer

Floats = NDArray[np.float64]

WGS84 = 4326
UTM_LATITUDES = (-80.0, 84.0)
POLAR = {False: 5042, True: 5041}  # universal polar stereographic, south and north, axes east and north
AREA_SLACK_DEG = 1.0  # a field may lie this far outside the area that a CRS is made for


def default_epsg(pose: RigPose) -> int:
    """Give the EPSG code of the rig's UTM zone (WGS 84), of polar stereographic beyond 84 N and 80 S."""
    south, north = UTM_LATITUDES
    if not south <= pose.lat_deg <= north:
        return POLAR[pose.lat_deg > 0]
    zone = int((pose.lon_deg + 180) % 360 // 6) + 1
    return (32600 if pose.lat_deg >= 0 else 32700) + zone


def map_crs(pose: RigPose, epsg: int | None = None) -> CRS:
    """Give the projected CRS of a map around the rig: the one asked for, or that of ``default_epsg``.

    Raises
    ------
    PoseError : no such code, not a projected CRS in metres, or the rig stands outside the area it is made for.
    """
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    code = default_epsg(pose) if epsg is None else epsg
    hint = f"leave epsg out for EPSG:{default_epsg(pose)}"
    try:
        crs = CRS.from_epsg(code)
    except CRSError:
        raise PoseError(f"there is no EPSG:{code}; give the code of a projected CRS in metres, or {hint}") from None
    if not crs.is_projected or any(axis.unit_conversion_factor != 1 for axis in crs.axis_info[:2]):
        raise PoseError(f"EPSG:{code} ({crs.name}) is no projected CRS in metres; {hint}")
    if not _made_for(crs, pose):
        assert crs.area_of_use is not None
        west, south, east, north = crs.area_of_use.bounds
        raise PoseError(
            f"EPSG:{code} ({crs.name}) is made for longitudes {west:g} to {east:g}, latitudes {south:g} to {north:g}; "
            f"the rig stands at lon_deg {pose.lon_deg:g}, lat_deg {pose.lat_deg:g}; {hint}"
        )
    return crs


def _made_for(crs: CRS, pose: RigPose) -> bool:
    """Whether the rig stands in the CRS's area, which may reach across the date line."""
    if crs.area_of_use is None:
        return True
    west, south, east, north = crs.area_of_use.bounds
    if not south - AREA_SLACK_DEG <= pose.lat_deg <= north + AREA_SLACK_DEG:
        return False
    width = (east - west) % 360 or 360.0
    return (pose.lon_deg - west + AREA_SLACK_DEG) % 360 <= width + 2 * AREA_SLACK_DEG


@dataclass(frozen=True)
class MapFrame:
    """Between the plane of ground under a posed rig and the coordinates of a map (x east, y north) [m]."""

    view: GroundView
    crs: CRS

    def ground_to_geodetic(self, ground_m: ArrayLike) -> Floats:
        """Give (..., 3) longitude, latitude [deg] and height above the ellipsoid [m] of east, north, up of the foot."""
        ground = np.asarray(ground_m, np.float64)
        east, north, up = np.moveaxis(ground, -1, 0)
        return _stacked(self._around_foot.transform(east, north, up, direction="INVERSE"))

    def ground_to_map(self, ground_m: ArrayLike) -> Floats:
        """Give map coordinates (..., 2) of points (..., 3) east, north, up of the foot [m]; NaN for NaN."""
        place = self.ground_to_geodetic(ground_m)
        return _stacked(self._on_map.transform(place[..., 0], place[..., 1]))

    def map_to_ground(self, map_m: ArrayLike) -> Floats:
        """Give the point of the ground's plane over map coordinates (..., 2), as (..., 3) east, north, up of the foot.

        The map gives longitude and latitude; the height follows from where their vertical meets the plane.
        """
        place = np.asarray(map_m, np.float64)
        lon, lat = self._on_map.transform(place[..., 0], place[..., 1], direction="INVERSE")
        level = np.full_like(np.asarray(lon, np.float64), self.view.pose.elevation_m)
        point = _stacked(self._around_foot.transform(lon, lat, level))
        up = self._vertical(np.asarray(lon), np.asarray(lat))
        rise = -(point @ self.view.normal) / (up @ self.view.normal)
        ground: Floats = point + rise[..., None] * up
        return ground

    def _vertical(self, lon_deg: Floats, lat_deg: Floats) -> Floats:
        """(..., 3) normals of the ellipsoid at other places, in east, north, up of the foot."""
        away = np.deg2rad(lon_deg - self.view.pose.lon_deg)
        lat, foot = np.deg2rad(lat_deg), np.deg2rad(self.view.pose.lat_deg)
        north = np.sin(lat) * np.cos(foot) - np.cos(lat) * np.sin(foot) * np.cos(away)
        up = np.sin(lat) * np.sin(foot) + np.cos(lat) * np.cos(foot) * np.cos(away)
        return np.stack([np.cos(lat) * np.sin(away), north, up], axis=-1)

    @cached_property
    def _around_foot(self) -> Transformer:
        from pyproj import Transformer

        pose = self.view.pose
        return Transformer.from_pipeline(
            "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84"
            f" +step +proj=topocentric +ellps=WGS84 +lon_0={float(pose.lon_deg)!r} +lat_0={float(pose.lat_deg)!r}"
            f" +h_0={float(pose.elevation_m)!r}"
        )

    @cached_property
    def _on_map(self) -> Transformer:
        from pyproj import Transformer

        return Transformer.from_crs(WGS84, self.crs, always_xy=True)


def _stacked(parts: tuple[ArrayLike, ...]) -> Floats:
    """Coordinates on the last axis; PROJ marks what it cannot do as infinite."""
    whole = np.stack([np.asarray(part, np.float64) for part in parts], axis=-1)
    return np.where(np.isfinite(whole), whole, np.nan)
