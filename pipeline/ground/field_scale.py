"""How large a field is and how finely it is seen: field of view, ground pixel, range, footprint, hectares an hour."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import PoseError
from pipeline.ground.map_grid import SAMPLES, least_mapped_sink, median_footprint_m
from pipeline.ground.view import GroundView, pixel_places

Floats = NDArray[np.float64]

M2_PER_HECTARE = 10_000.0
SECONDS_PER_HOUR = 3600.0


@dataclass(frozen=True)
class GroundFootprint:
    """What of the ground a field shows as far as it is mapped, from where.

    A long and narrow footprint that goes to the horizon ends where the map does.
    """

    outline_m: Floats  # (corner, 2) east and north of the rig's foot, in order
    width_m: float  # across the direction of view, at its widest
    depth_m: float  # along the direction of view
    area_m2: float  # as a map shows it
    pixel_m: float  # side of the square that is as large as the median pixel's footprint
    range_m: tuple[float, float, float]  # from the mirror's pivot: nearest, median, farthest


@dataclass(frozen=True)
class FieldScale:
    """A field in pixels and degrees, and in metres where something says how large a pixel is."""

    shape: tuple[int, int]  # (y, x) [px]
    view_deg: tuple[float, float]  # (y, x) of the field of view, edge to edge
    pixel_m: float | None = None
    area_m2: float | None = None
    footprint: GroundFootprint | None = None  # only where the rig's place is known

    @property
    def hectares(self) -> float | None:
        """The ground that the field shows; None where nothing says how large a pixel is."""
        return None if self.area_m2 is None else self.area_m2 / M2_PER_HECTARE

    def hectares_per_hour(self, seconds: float) -> float | None:
        """Ground in an hour of the camera where this field takes so many seconds; None without seconds or metres."""
        return None if self.hectares is None or seconds <= 0 else self.hectares / seconds * SECONDS_PER_HOUR

    def seconds_per_hectare(self, seconds: float) -> float | None:
        """Seconds of the camera for a hectare where this field takes so many; None where there are no metres."""
        return seconds / self.hectares if self.hectares else None


def field_of_view_deg(shape: tuple[int, int], ifov_rad: float) -> tuple[float, float]:
    """Angles between the outer edges of a field of (y, x) px around the undeflected direction [deg]."""
    down, across = (2 * np.arctan(size / 2 * ifov_rad) for size in shape)
    return float(np.rad2deg(down)), float(np.rad2deg(across))


def scale_of_angles(shape: tuple[int, int], ifov_rad: float) -> FieldScale:
    """Tell the field of view of a field of (y, x) px of which nobody knows how far away it lies."""
    return FieldScale(shape, field_of_view_deg(shape, ifov_rad))


def scale_of_pixels(shape: tuple[int, int], ifov_rad: float, pixel_m: float) -> FieldScale:
    """Tell the scale of a field whose pixels are all squares of one side [m], such as a georeferenced picture's."""
    area = shape[0] * shape[1] * pixel_m**2
    return FieldScale(shape, field_of_view_deg(shape, ifov_rad), pixel_m, area)


def scale_of_view(view: GroundView, shape: tuple[int, int]) -> FieldScale:
    """Tell the scale of a field of (y, x) px before a rig of which the place is known.

    Raises PoseError: no ray of the field meets the ground.
    """
    found = footprint_of(view, shape)
    return FieldScale(shape, field_of_view_deg(shape, view.ifov_rad), found.pixel_m, found.area_m2, found)


def footprint_of(view: GroundView, shape: tuple[int, int]) -> GroundFootprint:
    """Find what of the ground a field of (y, x) px shows. Straight lines of the scene are straight on the ground.

    Raises PoseError: no ray of the field meets the ground.
    """
    if not view.count_ground(shape):
        raise PoseError(f"no ray of the field meets the ground from the pose {view.pose}; tilt it further down")
    least = least_mapped_sink(view, shape)
    corners = view.scene_to_ground(view.outline_px(shape, least))[:, :2]
    heading = np.deg2rad(view.pose.heading_deg)
    away = corners @ np.array([[np.cos(heading), np.sin(heading)], [-np.sin(heading), np.cos(heading)]])
    width, depth = np.ptp(away, axis=0).tolist()
    near, middle, far = _ranges(view, shape, least)
    return GroundFootprint(corners, width, depth, _area(corners), median_footprint_m(view, shape), (near, middle, far))


def _ranges(view: GroundView, shape: tuple[int, int], least: float) -> tuple[float, float, float]:
    """Least, median and greatest distance from the pivot to the ground along rays of the field [m]."""
    places = (np.linspace(at[0] - 0.5, at[-1] + 0.5, SAMPLES) for at in pixel_places(shape))
    points = np.stack(np.meshgrid(*places, indexing="ij"), axis=-1)
    sink = view.sink(points)
    length = np.sqrt(1 + np.sum((points * view.ifov_rad) ** 2, axis=-1))
    away = (length * view.height_m)[sink >= least] / sink[sink >= least]
    return float(away.min()), float(np.median(away)), float(away.max())


def _area(corners: Floats) -> float:
    """Area within corners in order, (corner, 2), by the shoelace formula."""
    x, y = corners.T
    return float(abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))) / 2)
