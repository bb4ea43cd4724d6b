"""The farm's year: what stands on a field on a day, how crops, weeds and trees grow, water in the soil, and the sun.

The year is a circle of 366 days. Ground cover follows the curve of AquaCrop [1]: exponential growth to half of its
end, then exponential approach. Its numbers, the calendars (a farm at 52 degrees north) and all other laws here are this
project's. A stand's spectrum is a mixture of those of neighbouring stages, straight in days. North is up in the scene
(towards smaller y), east to the right; hours are true solar time: the sun is in the south at 12.

[1] Steduto et al., "AquaCrop: The FAO crop model to simulate yield response to water: I. Concepts and underlying
   principles", Agronomy Journal 101, 2009. doi:10.2134/agronj2008.0139s
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.errors import SceneError
from pipeline.simulator.scenes.farm.land import Field, Points, stream

LATITUDE_DEG = 52.0
LOWEST_SUN_DEG = 5.0
YEAR_DAYS = 366
LEAF_OUT, LEAF_TURN, LEAF_FALL = (105.0, 125.0), (270.0, 295.0), (300.0, 318.0)
MOWN_ON = (141.0, 192.0, 248.0)
HARROWED_ON = (62.0, 148.0, 238.0)
LODGES = (160.0, 205.0)  # from the first patch to the last

Phase = Literal["crop", "stubble", "soil", "grass"]


@dataclass(frozen=True)
class Crop:
    """One crop: its class, dates (day of the year), stages and cover.

    ``stages`` are (days since emergence, spectrum) with straight mixing between, ``heights`` (days, px). ``cover`` is
    AquaCrop's: fraction of the ground at emergence, growth a day, and share in the end.
    """

    label: str
    emergence: float
    harvest: float
    tillage: float  # the land is bare from here to emergence, and stubble from harvest to here
    stages: tuple[tuple[float, str], ...]
    heights: tuple[tuple[float, float], ...]
    cover: tuple[float, float, float]
    row_px: tuple[float, float]  # least and greatest distance between rows
    weeds: tuple[float, float]  # plants per 1000 px, least and greatest
    tram_chance: float = 0.3
    lodging: float = 0.0  # greatest fraction of a field that lies in the end


class Land(NamedTuple):
    """What a field is on a day, and for how many days: since emergence, harvest, tillage or mowing."""

    phase: Phase
    days: float


_MAIZE = ((12.0, "maize_young"), (55.0, "maize_full"), (98.0, "maize_full"), (128.0, "maize_ripe"))
_BEET = ((10.0, "beet_young"), (55.0, "beet_full"), (140.0, "beet_full"), (190.0, "beet_old"))
_TALL, _LOW, _EARS = ((0, 0.2), (30, 4.0), (75, 20.0)), ((0, 0.1), (60, 4.0)), ((0, 0.3), (150, 1.0), (225, 7.0))


def _wheat(variety: str) -> Crop:
    spectra = [f"{variety}_{stage}" for stage in ("young", "young", "full", "full", "filling", "ripe", "ripe")]
    stages = tuple(zip((20.0, 150.0, 200.0, 226.0, 252.0, 273.0, 300.0), spectra, strict=True))
    return Crop(variety, 297, 213, 264, stages, _EARS, (0.06, 0.018, 0.95), (2.9, 3.5), (0.3, 3.0), 0.8, 0.22)


CROPS: dict[str, Crop] = {
    "maize": Crop("maize", 128, 270, 85, _MAIZE, _TALL, (0.005, 0.12, 0.96), (5.8, 6.6), (3.0, 18.0)),
    "sugar_beet": Crop("sugar_beet", 105, 290, 290, _BEET, _LOW, (0.010, 0.10, 0.95), (4.2, 5.0), (3.0, 18.0)),
    "wheat_a": _wheat("wheat_a"),
    "wheat_b": _wheat("wheat_b"),
    "late_maize": Crop("maize", 152, 284, 118, _MAIZE, _TALL, (0.012, 0.12, 0.96), (7.6, 9.0), (1.5, 9.0), 0.2),
    "late_beet": Crop("sugar_beet", 146, 305, 305, _BEET, _LOW, (0.020, 0.10, 0.95), (6.6, 7.6), (1.5, 9.0), 0.2),
}


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
    """Give the sun's place: declination by Spencer's series [1], hour angle 15 degrees an hour.

    Right to 0.7 degrees in the years about 2025; refraction is left out.

    Raises SceneError: the day is not 1 to 366, or the sun is lower than 5 degrees at the hour.

    [1] Spencer, "Fourier series representation of the position of the sun", Search 2 (5), 1971.
    """
    if not 1 <= day <= YEAR_DAYS:
        raise SceneError(f"the farm's day is 1 to {YEAR_DAYS}, counted from 1 January, got {day}")
    year = 2 * np.pi * (day - 1) / 365
    declination = 0.006918 - 0.399912 * np.cos(year) + 0.070257 * np.sin(year) - 0.006758 * np.cos(2 * year)
    declination = declination + 0.000907 * np.sin(2 * year) - 0.002697 * np.cos(3 * year) + 0.00148 * np.sin(3 * year)
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


def since(day: float, event: float) -> float:
    """Days from the last time that the year's circle passed an event, from 0 to below 366."""
    return (day - event) % YEAR_DAYS


def land_on(use: str, day: float, late: float) -> Land:
    """Say what a field is on a day; all its dates are ``late`` days behind the calendar."""
    if use == "grass":
        return Land("grass", min(since(day, date + late) for date in MOWN_ON))
    if use == "soil":
        return Land("soil", min(since(day, date + late) for date in HARROWED_ON))
    if use == "stubble":  # left to itself since the year before
        return Land("stubble", since(day, 212 + late))
    crop = CROPS[use]
    passed: list[tuple[float, Phase]] = [
        (since(day, crop.emergence + late), "crop"),
        (since(day, crop.tillage + late), "soil"),  # where both fall on a day, the lifted crop leaves bare soil
        (since(day, crop.harvest + late), "stubble"),
    ]
    days, phase = min(passed, key=lambda event: event[0])
    return Land(phase, days)


def canopy_cover(crop: Crop, age: ArrayLike) -> NDArray[np.float64]:
    """Fraction of the ground under plants, by days since emergence; 0 before, never falling: brown plants cover too."""
    first, growth, last = crop.cover
    days = np.asarray(age, np.float64)
    half_way = np.log(last / (2 * first)) / growth
    early = first * np.exp(growth * np.minimum(days, half_way))
    late = last - 0.25 * last**2 / first * np.exp(-growth * np.maximum(days, 0))
    return np.where(days < 0, 0.0, np.where(days < half_way, early, late))


def stage_fractions(crop: Crop, age: ArrayLike) -> dict[str, Field]:
    """Mix a stand's spectra by days since emergence: shares that sum to 1, without those that are 0 all over."""
    days, names = [day for day, _ in crop.stages], [name for _, name in crop.stages]
    fractions: dict[str, Field] = {}
    for name in dict.fromkeys(names):
        fraction = np.interp(np.asarray(age, np.float64), days, [float(other == name) for other in names])
        if fraction.size and fraction.max() > 0:
            fractions[name] = np.asarray(fraction, np.float32)
    return fractions


def crop_height(crop: Crop, age: float) -> float:
    days, heights = np.array(crop.heights).T
    return float(np.interp(age, days, heights))


def lodged_fraction(day: float) -> float:
    """Fraction of what will lodge in a cereal that lies already: 0 before ``LODGES``, 1 after, smooth between."""
    t = float(np.clip((day - LODGES[0]) / (LODGES[1] - LODGES[0]), 0, 1))
    return t * t * (3 - 2 * t)


def weed_size(day: float, emergence: NDArray[np.float64], turned: NDArray[np.float64]) -> NDArray[np.float64]:
    """Fraction of its full radius that a weed has, by the day it comes up and days since its soil was turned; 0: none.

    It grows to 63 % in 22 days, is killed by tillage, and dies 170 days old.
    """
    age = (day - emergence) % YEAR_DAYS
    return np.where((age < turned) & (age < 170), 1 - np.exp(-age / 22), 0.0)


def days_since_turned(use: str, day: float, late: float) -> float:
    """Days since weeds were last killed on a field by tillage, sowing included; a whole year where nobody tills."""
    if use in CROPS:
        crop = CROPS[use]
        return min(since(day, crop.tillage + late), since(day, crop.emergence + late - 9))
    return land_on(use, day, late).days if use == "soil" else float(YEAR_DAYS)


def foliage(day: float) -> dict[str, float]:
    """Shares of green leaves, turning leaves and bare twigs of a crown, summing to 1."""
    out, turn, fall = (float(np.interp(day, ends, (0, 1))) for ends in (LEAF_OUT, LEAF_TURN, LEAF_FALL))
    leaves = out * (1 - fall)
    return {"tree": leaves * (1 - turn), "tree_autumn": leaves * turn, "twigs": 1 - leaves}


def soil_moisture(seed: int, day: int) -> float:
    """Water in the topsoil by volume, 0.05 (dry) to 0.38: rain of a year of this seed, drained day by day.

    An antecedent precipitation index, P + k P', of rain on 32 % of days, 5 mm each on average; k is 0.85 in July and
    0.95 in January.
    """
    rng = stream(seed, "rain")
    rain = np.where(rng.uniform(size=YEAR_DAYS) < 0.32, rng.exponential(5.0, YEAR_DAYS), 0.0)
    index = 0.0
    for date in range(day - 120, day + 1):
        kept = 0.90 + 0.05 * np.cos(2 * np.pi * (date - 15) / YEAR_DAYS)
        index = kept * index + rain[date % YEAR_DAYS]
    return float(0.05 + 0.33 * (1 - np.exp(-index / 26.0)))
