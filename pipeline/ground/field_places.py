"""Place fields on the ground: map coordinates to pixels of the scene, and the size and scale of a field."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pyproj
import shapely
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox
from shapely.geometry.base import BaseGeometry

from spectralzoom.pipeline.errors import PoseError
from spectralzoom.pipeline.ground.georeference import Floats, pixel_rows_m2, pixel_side_m
from spectralzoom.pipeline.ground.map_grid import SAMPLES, GroundGrid, least_mapped_sink, median_footprint_m
from spectralzoom.pipeline.ground.view import ROWS_AT_ONCE, GroundView, pixel_places

M2_PER_HECTARE = 10_000.0
SECONDS_PER_HOUR = 3600.0
BORDER_PX = 4.0  # around the field within which polygons are converted, for exact outermost pixels
EDGE_PARTS = 64  # of a side of the outline: straight on the ground, curved on a map


@dataclass(frozen=True)
class GroundFootprint:
    """Part of the ground that a field shows as far as it is mapped, and the ranges to it.

    A long and narrow footprint that goes to the horizon ends where the map does.
    """

    width_m: float  # across the direction of view, at its widest
    depth_m: float  # along the direction of view
    area_m2: float  # as a map shows it
    pixel_m: float  # side of the square that is as large as the median pixel's footprint
    range_m: tuple[float, float, float]  # from the mirror's pivot: nearest, median, farthest


@dataclass(frozen=True)
class FieldScale:
    """The size of a field in pixels and degrees, and in metres if the size of a pixel is known."""

    shape: tuple[int, int]  # (y, x) [px]
    view_deg: tuple[float, float]  # (y, x) of the field of view, edge to edge
    pixel_m: float | None = None
    area_m2: float | None = None
    footprint: GroundFootprint | None = None  # only where the rig's place is known

    @property
    def hectares(self) -> float | None:
        """Return the area of the field; None if the size of a pixel is unknown."""
        return None if self.area_m2 is None else self.area_m2 / M2_PER_HECTARE

    def hectares_per_hour(self, seconds: float) -> float | None:
        """Return the hectares per hour for a field captured in so many seconds; None without seconds or metres."""
        return None if self.hectares is None or seconds <= 0 else self.hectares / seconds * SECONDS_PER_HOUR


def scale_of_pixels(shape: tuple[int, int], ifov_rad: float, pixel_m: float | None) -> FieldScale:
    """Return the scale of a field with square pixels of one side [m]; without metres if that is None."""
    area = None if pixel_m is None else shape[0] * shape[1] * pixel_m**2
    return FieldScale(shape, _view_deg(shape, ifov_rad), pixel_m, area)


def scale_of_view(view: GroundView, shape: tuple[int, int]) -> FieldScale:
    """Return the scale of a field of (y, x) px before a posed rig (PoseError: no ray meets the ground)."""
    found = footprint_of(view, shape)
    return FieldScale(shape, _view_deg(shape, view.ifov_rad), found.pixel_m, found.area_m2, found)


def _view_deg(shape: tuple[int, int], ifov_rad: float) -> tuple[float, float]:
    """Return the angles between the outer edges of a field of (y, x) px around the undeflected direction [deg]."""
    down, across = (2 * np.arctan(size / 2 * ifov_rad) for size in shape)
    return float(np.rad2deg(down)), float(np.rad2deg(across))


def footprint_of(view: GroundView, shape: tuple[int, int]) -> GroundFootprint:
    """Return the ground that a field of (y, x) px shows. Straight lines of the scene are straight on the ground.

    Raises PoseError: no ray of the field meets the ground.
    """
    if not view.count_ground(shape):
        raise PoseError(f"no ray of the field meets the ground from the pose {view.pose}; tilt it further down")
    least = least_mapped_sink(view, shape)
    corners = view.scene_to_ground(view.outline_px(shape, least))[:, :2]
    heading = np.deg2rad(view.pose.heading_deg)
    away = corners @ np.array([[np.cos(heading), np.sin(heading)], [-np.sin(heading), np.cos(heading)]])
    width, depth = np.ptp(away, axis=0).tolist()
    places = (np.linspace(at[0] - 0.5, at[-1] + 0.5, SAMPLES) for at in pixel_places(shape))
    points = np.stack(np.meshgrid(*places, indexing="ij"), axis=-1)
    sink = view.sink(points)
    length = np.sqrt(1 + np.sum((points * view.ifov_rad) ** 2, axis=-1))
    ranges = (length * view.height_m)[sink >= least] / sink[sink >= least]  # from the pivot to the ground
    near, middle, far = float(ranges.min()), float(np.median(ranges)), float(ranges.max())
    x, y = corners.T
    area = float(abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))) / 2)  # by the shoelace formula
    return GroundFootprint(width, depth, area, median_footprint_m(view, shape), (near, middle, far))


def areas_by_number(place: FieldPlace, numbers: NDArray[np.integer], count: int) -> Floats | None:
    """Return the ground area of each number of a field's pixels (y, x), (count,) [m2]; None if it is unknown.

    Pixels with a number below 0 or from ``count`` on are left out, and those that show no ground.
    """
    areas = np.zeros(count)
    for first in range(0, len(numbers), ROWS_AT_ONCE):
        rows = slice(first, min(first + ROWS_AT_ONCE, len(numbers)))
        ground = place.pixel_areas_m2(rows, slice(0, numbers.shape[1]))
        if ground is None:
            return None
        counted = (numbers[rows] >= 0) & (numbers[rows] < count) & np.isfinite(ground)
        areas += np.bincount(numbers[rows][counted], ground[counted], count)
    return areas


@dataclass(frozen=True)
class NoPlace:
    """A field without a place on the earth. The size of a pixel may be known."""

    shape: tuple[int, int]
    pixel_m: float | None = None

    def pixel_areas_m2(self, rows: slice, columns: slice) -> Floats | None:
        """Return the ground area of some pixels (row, column) [m2]; None if it is unknown.

        Pixels that show no ground are NaN.
        """
        size = rows.stop - rows.start, columns.stop - columns.start
        return None if self.pixel_m is None else np.full(size, self.pixel_m**2)

    def scale(self, ifov_rad: float) -> FieldScale:
        return scale_of_pixels(self.shape, ifov_rad, self.pixel_m)


@dataclass(frozen=True)
class PlacedPicture:
    """A georeferenced scene: its pixels are those of a grid on the map."""

    geobox: GeoBox

    @property
    def shape(self) -> tuple[int, int]:
        rows, columns = self.geobox.shape
        return int(rows), int(columns)

    @cached_property
    def crs(self) -> pyproj.CRS:
        assert self.geobox.crs is not None
        return pyproj.CRS.from_wkt(self.geobox.crs.to_wkt())

    @property
    def outline(self) -> BaseGeometry:
        """Return the outline of the field on the map."""
        edges = shapely.segmentize(shapely.box(0, 0, self.shape[1], self.shape[0]), max(self.shape) / EDGE_PARTS)
        return shapely.affinity.affine_transform(edges, self.geobox.affine.to_shapely())

    def to_pixels(self, shape: BaseGeometry) -> BaseGeometry:
        """Convert a polygon from the map to the scene's pixels, x right and y down from the upper left corner."""
        return shapely.affinity.affine_transform(shape, (~self.geobox.affine).to_shapely())

    def pixel_areas_m2(self, rows: slice, columns: slice) -> Floats | None:
        """Return areas on the ellipsoid, whatever the map's scale."""
        return np.stack(list(pixel_rows_m2(self.geobox[rows, columns])))

    def scale(self, ifov_rad: float) -> FieldScale:
        return scale_of_pixels(self.shape, ifov_rad, pixel_side_m(self.geobox))


@dataclass(frozen=True)
class PosedField:
    """A field before a rig with a known pose."""

    grid: GroundGrid

    @property
    def shape(self) -> tuple[int, int]:
        return self.grid.scene_shape

    @property
    def view(self) -> GroundView:
        return self.grid.frame.view

    @property
    def crs(self) -> pyproj.CRS:
        return self.grid.frame.crs

    @property
    def outline(self) -> BaseGeometry:
        seen = shapely.segmentize(self._seen(0.0), max(self.shape) / EDGE_PARTS)
        frame = self.grid.frame
        return shapely.transform(seen, lambda points: frame.ground_to_map(self.view.scene_to_ground(points[:, ::-1])))

    def _seen(self, border_px: float) -> BaseGeometry:
        """Return the part of the field that the map reaches, (x, y) from its centre [px]."""
        rows, columns = self.shape
        size = rows + 2 * round(border_px), columns + 2 * round(border_px)
        return shapely.Polygon(self.view.outline_px(size, self.grid.least_sink)[:, ::-1])

    def to_pixels(self, shape: BaseGeometry) -> BaseGeometry:
        """Project the part of a polygon that the field shows; the ground behind the rig has no pixels."""
        shown = shapely.transform(
            self._seen(BORDER_PX), lambda points: self.view.scene_to_ground(points[:, ::-1])[:, :2]
        )
        on_plane = shapely.transform(shape, lambda places: self.grid.frame.map_to_ground(places)[:, :2])
        return shapely.transform(shapely.intersection(shapely.make_valid(on_plane), shown), self._pixels)

    def _pixels(self, plane: Floats) -> Floats:
        normal = self.view.normal
        seen = self.view.ground_to_scene(np.column_stack([plane, -(plane @ normal[:2]) / normal[2]]))
        return np.asarray(seen[:, ::-1] + np.array([self.shape[1] / 2, self.shape[0] / 2]))

    def pixel_areas_m2(self, rows: slice, columns: slice) -> Floats | None:
        y, x = pixel_places(self.shape)
        points = np.stack(np.meshgrid(y[rows], x[columns], indexing="ij"), axis=-1)
        return np.asarray(np.where(self.view.sink(points) > self.grid.least_sink, self.view.area_m2(points), np.nan))

    def scale(self, ifov_rad: float) -> FieldScale:
        return scale_of_view(self.view, self.shape)


GroundPlace = PlacedPicture | PosedField  # of a field with a place on the earth
FieldPlace = NoPlace | GroundPlace  # where a field lies
