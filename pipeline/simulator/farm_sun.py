"""Where the sun stands over the farm, and the shadows it gives: of round crowns, and of rows on the soil between them.

North is up in the scene (towards smaller y), east to the right. Hours are true solar time: the sun is in the south
at 12.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SceneError
from pipeline.simulator.farm_layout import Points

LATITUDE_DEG = 52.0
LOWEST_SUN_DEG = 5.0
DAYS = (1, 366)


@dataclass(frozen=True)
class Sun:
    """``azimuth_deg`` from north over east, ``elevation_deg`` above the horizon."""

    azimuth_deg: float
    elevation_deg: float

    @property
    def cast(self) -> Points:
        """Where the tip of a post 1 px high throws its shadow, (y, x) from its foot [px]: away from the sun."""
        azimuth, length = np.deg2rad(self.azimuth_deg), 1 / np.tan(np.deg2rad(self.elevation_deg))
        return np.array([np.cos(azimuth) * length, -np.sin(azimuth) * length])


def sun_over_farm(day: int, hour: float) -> Sun:
    """Give the sun's place: declination by Spencer's series [1]_, hour angle 15 degrees an hour.

    Right to 0.7 degrees in the years about 2025; refraction is left out.

    Raises
    ------
    SceneError : the day is not 1 to 366, or the sun is lower than 5 degrees at the hour.

    References
    ----------
    .. [1] Spencer, "Fourier series representation of the position of the sun", Search 2 (5), 1971.
    """
    if not DAYS[0] <= day <= DAYS[1]:
        raise SceneError(f"the farm's day is {DAYS[0]} to {DAYS[1]}, counted from 1 January, got {day}")
    year = 2 * np.pi * (day - 1) / 365
    declination = (
        0.006918 - 0.399912 * np.cos(year) + 0.070257 * np.sin(year) - 0.006758 * np.cos(2 * year)
        + 0.000907 * np.sin(2 * year) - 0.002697 * np.cos(3 * year) + 0.00148 * np.sin(3 * year)
    )  # fmt: skip
    latitude, turned = np.deg2rad(LATITUDE_DEG), np.deg2rad(15 * (hour - 12))
    up = np.sin(latitude) * np.sin(declination) + np.cos(latitude) * np.cos(declination) * np.cos(turned)
    north = np.cos(latitude) * np.sin(declination) - np.sin(latitude) * np.cos(declination) * np.cos(turned)
    east = -np.cos(declination) * np.sin(turned)
    elevation = float(np.degrees(np.arcsin(np.clip(up, -1, 1))))
    if not elevation >= LOWEST_SUN_DEG:  # refuses NaN
        raise SceneError(
            f"at hour {hour:g} of day {day} the sun stands at {elevation:.1f} degrees, the farm needs at least "
            f"{LOWEST_SUN_DEG:g}; take an hour nearer to 12"
        )
    return Sun(float(np.degrees(np.arctan2(east, north)) % 360), elevation)


def crown_shadows(
    centres: Points, radius: NDArray[np.float64], sun: Sun, shape: tuple[int, int]
) -> NDArray[np.float32]:
    """Cover of the ground by shadows of ellipsoid crowns, (y, x) from 0 to 1.

    A crown is ``radius`` wide and 0.9 ``radius`` high each way about a point 1.2 ``radius`` above the ground; its
    shadow is an ellipse, and where shadows meet the darker counts.
    """
    covered = np.zeros(shape, np.float32)
    length = float(np.hypot(*sun.cast))
    along = sun.cast / length
    middles = centres + 1.2 * radius[:, None] * sun.cast + (np.array(shape) - 1) / 2
    for (y0, x0), width in zip(middles, radius, strict=True):
        reach = float(np.hypot(width, 0.9 * width * length))
        top, bottom = (int(np.clip(y0 + side * (reach + 1), 0, shape[0])) for side in (-1, 1))
        left, right = (int(np.clip(x0 + side * (reach + 1), 0, shape[1])) for side in (-1, 1))
        dy = (np.arange(top, bottom + 1) - y0)[: shape[0] - top, None]
        dx = (np.arange(left, right + 1) - x0)[None, : shape[1] - left]
        far = np.hypot((dy * along[0] + dx * along[1]) / reach, (dx * along[0] - dy * along[1]) / width)
        cover = np.clip((1 - far) * width + 0.5, 0, 1)
        window = covered[top : top + dy.size, left : left + dx.size]
        np.maximum(window, cover.astype(np.float32), out=window)
    return covered


def row_shift(sun: Sun, height: float, normal: Points) -> NDArray[np.float64]:
    """How far rows of a height throw their shadow across themselves, along unit normals (..., 2) [px]."""
    shift: NDArray[np.float64] = height * (normal @ sun.cast)
    return shift
