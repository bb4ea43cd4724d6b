r"""Convert scene points to metres east, north and up of the foot of a posed rig, and back, in closed form.

Scene points are (y, x) px from the scene's centre, the undeflected view direction v. Seen along v, x points right and y
points down for any direction of the lines; row 0 of an image is up. The foot is the ground straight below the pivot::

       the scene, along v           from the side: tilt t          from above: heading h

      +---------------+           pivot o - - - - horizon              north   v
      |       v       |                 | \ t                            |    /
      |       o---> x |          height |   \ v                          | h /
      |       |       |                 |     \                          |  /
      |       y       |        ---------+-------x--- ground              | /
      +---------------+               foot                           foot o------ east

A heading of 0 looks north and grows clockwise. A tilt of 0 looks at the horizon, and of 90 straight down, where the
heading is that of the image's upper edge. A positive roll turns the rig's right side down. The ground is a plane
through the foot that falls by ``slope_deg`` towards ``aspect_deg`` (clockwise from north).
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spectralzoom.pipeline.errors import PoseError
from spectralzoom.pipeline.setting_fields import REQUIRED, settings_table, stated

Floats = NDArray[np.float64]

LEAST_SINK = 1e-12  # a ray that sinks less along its depth counts as parallel to the ground
ROWS_AT_ONCE = 256


@settings_table
class RigPose:
    """Place of the mirror's pivot, its undeflected direction, and the plane of ground that it looks at.

    Give ``height_m`` above the foot, or ``range_m`` to the ground along the undeflected direction.

    Raises PoseError: not exactly one of height and range is given.
    """

    lon_deg: float = stated(REQUIRED, "Longitude, WGS 84; west is negative", "deg", -180, 180, example=9.5)
    lat_deg: float = stated(REQUIRED, "Latitude, WGS 84; south is negative", "deg", -90, 90, example=52.1)
    heading_deg: float = stated(
        REQUIRED, "Azimuth of the undeflected view direction, clockwise from north", "deg", -360, 360, example=30.0
    )
    tilt_deg: float = stated(REQUIRED, "Angle below the horizon; 90 looks straight down", "deg", -90, 90, example=35.0)
    height_m: float | None = stated(
        None,
        "Height of the mirror's pivot above the ground below it; or instead range_m",
        "m",
        0.01,
        20_000,
        example=493.0,
    )
    range_m: float | None = stated(
        None, "Distance to the ground along the undeflected direction; or height_m", "m", 0.01, 50_000, example=860.0
    )
    roll_deg: float = stated(0.0, "Turn about the view direction; positive turns the right side down", "deg", -180, 180)
    slope_deg: float = stated(0.0, "Slope of the ground", "deg", 0, 80)
    aspect_deg: float = stated(0.0, "Direction in which the slope falls, clockwise from north", "deg", -360, 360)
    # 1000 m are 1.6e-4 of the map's scale
    elevation_m: float = stated(0.0, "Height of the ground below the rig above the ellipsoid", "m", -500, 9000)

    def __post_init__(self) -> None:
        if (self.height_m is None) == (self.range_m is None):
            raise PoseError(
                "the rig's pose needs height_m or range_m, one of the two; got "
                f"height_m = {self.height_m}, range_m = {self.range_m}"
            )

    def __str__(self) -> str:
        return ", ".join(f"{name} {value:g}" for name, value in asdict(self).items() if value is not None)


@dataclass(frozen=True)
class GroundView:
    """A posed rig with its pixel's angle: every scene point's ray and where it meets the ground.

    A ray is v + x r + y d, with tangents x and y, and r right, d down. It sinks by w = -n . ray per unit of depth, with
    the ground's normal n, n_up = 1. It meets the ground at the depth height / w. All methods use that w is linear in
    the scene.
    """

    pose: RigPose
    ifov_rad: float

    @cached_property
    def axes(self) -> Floats:
        """Return (3, 3) view, right and down as rows, in east, north, up."""
        heading, tilt, roll = np.deg2rad([self.pose.heading_deg, self.pose.tilt_deg, self.pose.roll_deg])
        away, up = np.array([np.sin(heading), np.cos(heading), 0.0]), np.array([0.0, 0.0, 1.0])
        view = np.cos(tilt) * away - np.sin(tilt) * up
        right = np.array([np.cos(heading), -np.sin(heading), 0.0])
        down = -np.sin(tilt) * away - np.cos(tilt) * up
        c, s = np.cos(roll), np.sin(roll)
        return np.stack([view, c * right + s * down, c * down - s * right])

    @cached_property
    def normal(self) -> Floats:
        """Return the (3,) normal of the ground with 1 upwards, in east, north, up."""
        slope, aspect = np.deg2rad([self.pose.slope_deg, self.pose.aspect_deg])
        return np.array([np.tan(slope) * np.sin(aspect), np.tan(slope) * np.cos(aspect), 1.0])

    @cached_property
    def sinks(self) -> Floats:
        """Return (3,) w of view, right and down."""
        return -self.axes @ self.normal

    @cached_property
    def height_m(self) -> float:
        """Return the height of the pivot above the foot.

        Raises PoseError: a range is given, and the undeflected direction does not meet the ground.
        """
        if self.pose.height_m is not None:
            return self.pose.height_m
        if self.sinks[0] <= LEAST_SINK:
            raise PoseError(
                f"a range needs a view direction that meets the ground, got {self.pose}; tilt it below the horizon, "
                "or give height_m instead"
            )
        return float(self.pose.range_m * self.sinks[0])

    def sink(self, points_px: ArrayLike) -> Floats:
        """Return w of scene points (..., 2): above 0 where the ray meets the ground, 0 at the horizon."""
        tangents = np.asarray(points_px, np.float64) * self.ifov_rad
        return np.asarray(self.sinks[0] + tangents[..., 1] * self.sinks[1] + tangents[..., 0] * self.sinks[2])

    def scene_to_ground(self, points_px: ArrayLike) -> Floats:
        """Return where rays of scene points (..., 2), y and x [px], meet the ground: (..., 3) from the foot [m].

        NaN where the ray is at or above the horizon.
        """
        tangents = np.asarray(points_px, np.float64) * self.ifov_rad
        view, right, down = self.axes
        rays = view + tangents[..., 1:] * right + tangents[..., :1] * down
        w = self.sink(points_px)
        points: Floats = rays * (self.height_m / np.where(w > LEAST_SINK, w, np.nan))[..., None]
        points[..., 2] += self.height_m
        return points

    def ground_to_scene(self, ground_m: ArrayLike) -> Floats:
        """Return the scene points (..., 2) [px] of points (..., 3) east, north, up of the foot [m].

        The inverse of ``scene_to_ground``, also for points above or below the plane. NaN for points beside or behind
        the pivot.
        """
        seen = (np.asarray(ground_m, np.float64) - np.array([0.0, 0.0, self.height_m])) @ self.axes.T
        depth = np.where(seen[..., :1] > 0, seen[..., :1], np.nan)
        return np.asarray(seen[..., :0:-1] / (depth * self.ifov_rad))

    def area_m2(self, points_px: ArrayLike) -> Floats:
        """Return the ground area of a pixel on a map (of a slope its level part), (...) [m2]; NaN off the ground.

        The cross product of the two sides of the footprint is -n (height ifov)^2 / w^3. Its level part depends on the
        direction through w only.
        """
        w = self.sink(points_px)
        return (self.height_m * self.ifov_rad) ** 2 / np.where(w > LEAST_SINK, w, np.nan) ** 3

    def count_ground(self, scene_shape: tuple[int, int], least_sink: float = LEAST_SINK) -> int:
        """Count the pixels of a scene of (y, x) px whose rays meet the ground, sinking by more than ``least_sink``."""
        y, x = pixel_places(scene_shape)
        across = self.ifov_rad * self.sinks[1] * x
        down = self.sinks[0] + self.ifov_rad * self.sinks[2] * y
        return sum(
            int(np.count_nonzero(down[first : first + ROWS_AT_ONCE, None] + across > least_sink))
            for first in range(0, len(y), ROWS_AT_ONCE)
        )

    def outline_px(self, scene_shape: tuple[int, int], least_sink: float) -> Floats:
        """Return the corners (corner, 2) [px] of the part of a scene that sinks by ``least_sink`` or more, in order."""
        half_y, half_x = scene_shape[0] / 2, scene_shape[1] / 2
        corners = np.array([[-half_y, -half_x], [-half_y, half_x], [half_y, half_x], [half_y, -half_x]])
        excess = self.sink(corners) - least_sink
        kept: list[Floats] = []
        for here, there in zip(range(4), (1, 2, 3, 0), strict=True):
            if excess[here] >= 0:
                kept.append(corners[here])
            if (excess[here] >= 0) != (excess[there] >= 0):
                fraction = excess[here] / (excess[here] - excess[there])
                kept.append(corners[here] + fraction * (corners[there] - corners[here]))
        return np.array(kept).reshape(-1, 2)


def pixel_places(scene_shape: tuple[int, int]) -> tuple[Floats, Floats]:
    """Return y of every row and x of every column of a scene, from its centre [px]."""
    rows, columns = (np.arange(size, dtype=np.float64) for size in scene_shape)
    return rows - (scene_shape[0] - 1) / 2, columns - (scene_shape[1] - 1) / 2
