"""Convert metres around the rig's foot to a projected CRS and back, and lay a map's grid over a field.

The metres are those of the plane through the foot that is normal to the ellipsoid's normal (east, north, up). PROJ
converts them to longitude and latitude through Cartesian coordinates of the earth, without a flat-earth approximation
and without network access.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
import odc.geo.geobox as odc_geobox
import pyproj
from numpy.typing import ArrayLike, NDArray
from odc.geo.geobox import GeoBox

from spectralzoom.pipeline.errors import PoseError
from spectralzoom.pipeline.geometry.grid import cuts
from spectralzoom.pipeline.ground.georeference import WGS84, Floats
from spectralzoom.pipeline.ground.view import LEAST_SINK, GroundView, RigPose, pixel_places
from spectralzoom.pipeline.rectify.resample import resample

Pixel = TypeVar("Pixel", bound=np.generic)

UTM_LATITUDES = (-80.0, 84.0)
POLAR = {False: 5042, True: 5041}  # universal polar stereographic, south and north, axes east and north
FAR_PIXELS = 8.0  # pixels of the scene with a footprint of more than so many times the median's side are left out
MOST_GROWTH = 8  # most pixels of a map, times the scene's
TIE = 32  # map pixels between exact places
ROUND_STEPS = (1.0, 1.2, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)
SAMPLES = 129  # places a side for the median footprint
EDGE_POINTS = 33  # on each side of the footprint: straight on the ground, curved on the map


def default_epsg(pose: RigPose) -> int:
    """Return the EPSG code of the rig's UTM zone (WGS 84), of polar stereographic beyond 84 N and 80 S."""
    south, north = UTM_LATITUDES
    if not south <= pose.lat_deg <= north:
        return POLAR[pose.lat_deg > 0]
    return (32600 if pose.lat_deg >= 0 else 32700) + int((pose.lon_deg + 180) % 360 // 6) + 1


@dataclass(frozen=True)
class MapFrame:
    """Convert between the plane of ground under a posed rig and the coordinates of a map (x east, y north) [m]."""

    view: GroundView
    crs: pyproj.CRS

    def ground_to_geodetic(self, ground_m: ArrayLike) -> Floats:
        """Return (..., 3) longitude, latitude [deg] and ellipsoidal height [m] of east, north, up of the foot."""
        east, north, up = np.moveaxis(np.asarray(ground_m, np.float64), -1, 0)
        return _stacked(self._around_foot.transform(east, north, up, direction="INVERSE"))

    def ground_to_map(self, ground_m: ArrayLike) -> Floats:
        """Return map coordinates (..., 2) of points (..., 3) east, north, up of the foot [m]; NaN for NaN."""
        place = self.ground_to_geodetic(ground_m)
        return _stacked(self._on_map.transform(place[..., 0], place[..., 1]))

    def map_to_ground(self, map_m: ArrayLike) -> Floats:
        """Return the points of the ground's plane at map coordinates (..., 2): (..., 3) east, north, up of the foot.

        The map gives longitude and latitude. The height is where their vertical meets the plane.
        """
        place = np.asarray(map_m, np.float64)
        lon, lat = self._on_map.transform(place[..., 0], place[..., 1], direction="INVERSE")
        level = np.full_like(np.asarray(lon, np.float64), self.view.pose.elevation_m)
        point = _stacked(self._around_foot.transform(lon, lat, level))
        away = np.deg2rad(np.asarray(lon) - self.view.pose.lon_deg)
        here, foot = np.deg2rad(np.asarray(lat)), np.deg2rad(self.view.pose.lat_deg)
        north = np.sin(here) * np.cos(foot) - np.cos(here) * np.sin(foot) * np.cos(away)
        up = np.sin(here) * np.sin(foot) + np.cos(here) * np.cos(foot) * np.cos(away)
        vertical: Floats = np.stack([np.cos(here) * np.sin(away), north, up], axis=-1)  # the ellipsoid's normals
        rise = -(point @ self.view.normal) / (vertical @ self.view.normal)
        return point + rise[..., None] * vertical

    @cached_property
    def _around_foot(self) -> pyproj.Transformer:
        pose = self.view.pose
        return pyproj.Transformer.from_pipeline(
            "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84"
            f" +step +proj=topocentric +ellps=WGS84 +lon_0={float(pose.lon_deg)!r} +lat_0={float(pose.lat_deg)!r}"
            f" +h_0={float(pose.elevation_m)!r}"
        )

    @cached_property
    def _on_map(self) -> pyproj.Transformer:
        return pyproj.Transformer.from_crs(WGS84, self.crs, always_xy=True)


def _stacked(parts: tuple[ArrayLike, ...]) -> Floats:
    """Return the coordinates on the last axis; NaN where PROJ fails and returns infinity."""
    whole = np.stack([np.asarray(part, np.float64) for part in parts], axis=-1)
    return np.where(np.isfinite(whole), whole, np.nan)


@dataclass(frozen=True)
class GroundGrid:
    """A map's grid and the field that it shows, made by ``ground_grid``."""

    frame: MapFrame
    scene_shape: tuple[int, int]  # (y, x) [px]
    geobox: GeoBox
    least_sink: float  # rays that sink less meet the ground too far away to be mapped

    @property
    def key(self) -> dict[str, Any]:
        """Return the parameters that the grid was made of."""
        view = self.frame.view
        return {"pose": view.pose, "ifov_rad": view.ifov_rad, "scene_shape": self.scene_shape}

    @property
    def shape(self) -> tuple[int, int]:
        """Return (y, x) of the map."""
        rows, columns = self.geobox.shape
        return int(rows), int(columns)

    def scene_pixels(self, rows: slice, columns: slice) -> Floats:
        """Return the places of map pixels in the scene's image, (row, column, 2); integers are centres of its pixels.

        NaN where the field does not show the ground, or shows it beyond the map's reach.
        """
        size = np.array(self.scene_shape, np.float64)
        points = self.frame.view.ground_to_scene(self.ground_m(rows, columns))
        inside: NDArray[np.bool_] = np.all(np.abs(points) <= size / 2, axis=-1)
        inside &= self.frame.view.sink(np.where(inside[..., None], points, 0.0)) >= self.least_sink
        return np.where(inside[..., None], points + (size - 1) / 2, np.nan)

    def ground_m(self, rows: slice, columns: slice) -> Floats:
        """Return the ground at the centres of map pixels, (row, column, 3) east, north and up of the foot [m].

        Exact every ``TIE`` pixels and linear between. A map curves against the ground's plane with about the earth's
        radius R. So the error is TIE^2 resolution / 8 R of a pixel: 1e-6 at 5 cm, 2e-5 at 1 m (tested).
        """
        affine = self.geobox.affine
        cuts = (-(-(part.stop - part.start) // TIE) + 1 for part in (rows, columns))
        row, column = (np.linspace(part.start, part.stop, cut) for part, cut in zip((rows, columns), cuts, strict=True))
        x, y = np.meshgrid(affine.c + affine.a * column, affine.f + affine.e * row)
        exact = self.frame.map_to_ground(np.stack([x, y], axis=-1))
        return _between(_between(exact, columns, 1), rows, 0)

    def counts(self) -> dict[str, int]:
        """Count the scene's pixels that the map shows, that meet the ground beyond its reach, and that meet none."""
        total = self.scene_shape[0] * self.scene_shape[1]
        near, ground = (self.frame.view.count_ground(self.scene_shape, sink) for sink in (self.least_sink, LEAST_SINK))
        return {"mapped_px": near, "beyond_reach_px": ground - near, "no_ground_px": total - ground}


def ground_grid(view: GroundView, scene_shape: tuple[int, int]) -> GroundGrid:
    """Lay a map's grid over the footprint of a field of (y, x) px, in the UTM zone of the rig.

    Its pixels start at multiples of their side, the rounded median side of a scene pixel's footprint. A long and narrow
    footprint gets larger pixels, so that the map is not far larger than the scene.

    Raises PoseError: no ray of the field meets the ground, or its footprint does not fit on the map.
    """
    frame = MapFrame(view, pyproj.CRS.from_epsg(default_epsg(view.pose)))
    if not view.count_ground(scene_shape):
        raise PoseError(
            f"no ray of the field meets the ground from the pose {view.pose}; tilt it further down, or check roll_deg "
            "and slope_deg"
        )
    least = least_mapped_sink(view, scene_shape)
    outline = view.outline_px(scene_shape, least)  # its sides are lines on the ground, and curved on the map
    sides = outline + np.linspace(0, 1, EDGE_POINTS)[:, None, None] * (np.roll(outline, -1, axis=0) - outline)
    places = frame.ground_to_map(view.scene_to_ground(sides.reshape(-1, 2)))
    if not np.isfinite(places).all():
        raise PoseError(f"the field's footprint does not fit on the map {frame.crs.name} (pose {view.pose})")
    left, bottom = places.min(axis=0).tolist()
    right, top = places.max(axis=0).tolist()
    finest = float(np.sqrt((right - left) * (top - bottom) / (MOST_GROWTH * scene_shape[0] * scene_shape[1])))
    step = round_step(max(median_footprint_m(view, scene_shape), finest))
    geobox = odc_geobox.GeoBox.from_bbox((left, bottom, right, top), crs=frame.crs, resolution=step)
    return GroundGrid(frame, scene_shape, geobox, least)


def least_mapped_sink(view: GroundView, scene_shape: tuple[int, int]) -> float:
    """Return the sink below which a field's rays meet the ground too far away to be mapped."""
    farther: float = FAR_PIXELS ** (2 / 3)  # a footprint's area goes as w^-3
    return max(median_sink(view, scene_shape) / farther, LEAST_SINK)


def grid_of_map(view: GroundView, scene_shape: tuple[int, int], geobox: GeoBox) -> GroundGrid:
    """Return the grid of an existing map, as ``ground_grid`` made it for the view and scene."""
    assert geobox.crs is not None
    frame = MapFrame(view, pyproj.CRS.from_wkt(geobox.crs.to_wkt()))
    return GroundGrid(frame, scene_shape, geobox, least_mapped_sink(view, scene_shape))


def median_sink(view: GroundView, scene_shape: tuple[int, int]) -> float:
    """Return the median sink of the rays of a field that meet the ground; NaN if none does."""
    y, x = (np.linspace(places[0], places[-1], min(len(places), SAMPLES)) for places in pixel_places(scene_shape))
    sink = view.sink(np.stack(np.meshgrid(y, x, indexing="ij"), axis=-1))
    # w is linear, so that one of the corners, which are among the samples, sinks the most
    met = sink[sink > LEAST_SINK]
    return float(np.median(met)) if met.size else float("nan")


def median_footprint_m(view: GroundView, scene_shape: tuple[int, int]) -> float:
    """Return the side of the square with the area of the median footprint of pixels that meet the ground [m]."""
    return float(view.height_m * view.ifov_rad * median_sink(view, scene_shape) ** -1.5)


def round_step(step_m: float) -> float:
    """Return the nearest of 1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 8 times a power of ten, by ratio."""
    power = int(np.floor(np.log10(step_m)))
    ratios = np.abs(np.log(np.array(ROUND_STEPS) * 10.0**power / step_m))
    return float(f"{ROUND_STEPS[int(np.argmin(ratios))]:g}e{power}")


def _between(exact: Floats, pixels: slice, axis: int) -> Floats:
    """Interpolate values at tie points linearly to the centres of the pixels along one axis."""
    count = pixels.stop - pixels.start
    last = exact.shape[axis] - 1
    place = (np.arange(count) + 0.5) * (last / count)
    index = np.minimum(place.astype(np.intp), last - 1)
    fraction = np.expand_dims(place - index, [other for other in range(exact.ndim) if other != axis])
    lower, upper = np.take(exact, index, axis), np.take(exact, index + 1, axis)
    return np.asarray(lower + fraction * (upper - lower))


def map_blocks(shape: tuple[int, int], block: tuple[int, int]) -> Iterator[tuple[slice, slice]]:
    """Cut a map of (y, x) px into blocks of at most ``block`` px, row by row."""
    return ((rows, columns) for rows in cuts(shape[0], block[0]) for columns in cuts(shape[1], block[1]))


def nearest_at(image: NDArray[Pixel], pixels: Floats, nothing: float) -> NDArray[Pixel]:
    """Return the pixels of an image (y, x) at scene places (row, column, 2); ``nothing`` where the place is NaN."""
    known: NDArray[np.bool_] = np.all(np.isfinite(pixels), axis=-1)
    last = np.array(image.shape) - 1
    index = np.clip(np.floor(np.where(known[..., None], pixels, 0) + 0.5).astype(np.intp), 0, last)
    return np.where(known, image[index[..., 0], index[..., 1]], image.dtype.type(nothing))


def image_at(image: NDArray[np.float32], pixels: Floats) -> NDArray[np.float32]:
    """Read an image (y, x, band) bilinearly at scene places (row, column, 2).

    The result is (row, column, band) float32; NaN without a place or a value. NaN of the image is left out, as in
    ``resample``.
    """
    out = np.full((*pixels.shape[:2], image.shape[2]), np.nan, np.float32)
    known: NDArray[np.bool_] = np.all(np.isfinite(pixels), axis=-1)
    if not known.any():
        return out
    inside = np.clip(pixels[known], 0, np.array(image.shape[:2]) - 1)  # the border pixels' outer halves
    first, last = np.floor(inside.min(axis=0)).astype(int), np.ceil(inside.max(axis=0)).astype(int) + 1
    window = np.ascontiguousarray(image[first[0] : last[0], first[1] : last[1]])
    valid: NDArray[np.bool_] = np.all(np.isfinite(window), axis=2)
    out[known] = resample(np.where(valid[..., None], window, 0), valid, inside - first, "bilinear")[0]
    return out
