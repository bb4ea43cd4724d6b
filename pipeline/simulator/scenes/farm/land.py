"""The land of a farm: points, fields and rows, and what the season makes of its crops.

Positions are (y, x) in px from the scene's centre. Coverage of a pixel by a straight edge is taken as if the edge lay
along the pixel's side. It is exact at right angles, at most 0.043 off at 45 degrees.

The year is a circle of 366 days. Ground cover follows the curve of AquaCrop [1]: exponential growth to half of its end,
then exponential approach. Its numbers, the calendars (a farm at 52 degrees north) and all other laws here are this
project's. A stand's spectrum is a mixture of those of neighbouring stages, straight in days. North is up in the scene
(towards smaller y), east to the right. Hours are true solar time: the sun is in the south at 12.

[1] Steduto et al., "AquaCrop: The FAO crop model to simulate yield response to water: I. Concepts and underlying
   principles", Agronomy Journal 101, 2009. doi:10.2134/agronj2008.0139s
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spectralzoom.pipeline.errors import SceneError
from spectralzoom.pipeline.geometry.grid import cuts
from spectralzoom.pipeline.simulator.scenes.scene import scratch

Field = NDArray[np.float32]
Points = NDArray[np.float64]

ROWS_AT_ONCE = 256  # that are drawn: what is made of them does not grow with the scene
_SPLINE_SD = 0.4794  # of a cubic B-spline through white noise of sd 1, mean over positions, two axes


@dataclass(frozen=True)
class Parcel:
    """A convex piece of land: ``corners`` (n, 2) and the cuts (ny, nx, offset) on whose positive side it lies."""

    corners: Points
    cuts: tuple[tuple[float, float, float], ...] = ()


@dataclass(frozen=True)
class Border:
    """A straight line between parcels, from ``start`` to ``end`` (2,)."""

    start: Points
    end: Points

    @property
    def length(self) -> float:
        return float(np.hypot(*(self.end - self.start)))

    @property
    def step(self) -> Points:
        """Return the way of 1 px along it, (2,)."""
        return (self.end - self.start) / max(self.length, 1e-9)


@dataclass(frozen=True)
class Band:
    """Pixels near a line: flat numbers, signed distance to it and position along it [px]."""

    index: NDArray[np.intp]
    across: Field
    along: Field


def stream(seed: int, name: str) -> np.random.Generator:
    """Return the random stream of one named part: drawing more in one part does not change another."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(zlib.crc32(name.encode()),)))


def rectangle(height: float, width: float) -> Parcel:
    """Return a rectangle about the origin [px]."""
    return Parcel(np.array([[-1, -1], [-1, 1], [1, 1], [1, -1]]) * np.array([height, width]) / 2)


def divide_land(rng: np.random.Generator, whole: Parcel, area: float) -> tuple[list[Parcel], list[Border]]:
    """Split a piece of land until every parcel has about ``area`` px; also return the lines that split it."""
    waiting = [whole]
    turn = rng.uniform(-0.6, 0.6)
    parcels: list[Parcel] = []
    borders: list[Border] = []
    while waiting:
        parcel = waiting.pop()
        if polygon_area(parcel.corners) < area * rng.uniform(1.15, 1.9):
            parcels.append(parcel)
            continue
        spans = [_span(parcel.corners, turn + quarter) for quarter in (0.0, np.pi / 2)]
        angle = turn + (np.pi / 2 if np.ptp(spans[1]) > np.ptp(spans[0]) else 0.0) + rng.uniform(-0.12, 0.12)
        low, high = _span(parcel.corners, angle)
        cut = float(np.cos(angle)), float(np.sin(angle)), float(low + (high - low) * rng.uniform(0.36, 0.64))
        for side in (cut, (-cut[0], -cut[1], -cut[2])):
            waiting.append(Parcel(clip_polygon(parcel.corners, side), (*parcel.cuts, side)))
        ends = clip_polygon(parcel.corners, cut)
        on_cut = ends[np.abs(ends @ np.array(cut[:2]) - cut[2]) < 1e-6]
        borders.append(Border(on_cut[0], on_cut[-1]))
    return parcels, borders


def _span(corners: Points, angle: float) -> tuple[float, float]:
    offset = corners @ np.array([np.cos(angle), np.sin(angle)])
    return float(offset.min()), float(offset.max())


def clip_polygon(corners: Points, cut: tuple[float, float, float]) -> Points:
    """Return part of a convex polygon where ny y + nx x >= offset, (m, 2); m may be 0."""
    height = corners @ np.array(cut[:2]) - cut[2]
    kept: list[Points] = []
    for here, there, a, b in zip(corners, np.roll(corners, -1, axis=0), height, np.roll(height, -1), strict=True):
        if a >= 0:
            kept.append(here)
        if (a >= 0) != (b >= 0):
            kept.append(here + (there - here) * (a / (a - b)))
    return np.array(kept).reshape(-1, 2)


def polygon_area(corners: Points) -> float:
    """Return the area of a polygon by the shoelace formula [px^2]; 0 for fewer than 3 corners."""
    y, x = corners[:, 0], corners[:, 1]
    return float(abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))) / 2)


def visible_area(parcel: Parcel, shape: tuple[int, int]) -> float:
    corners = parcel.corners
    for ny, nx in ((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)):
        corners = clip_polygon(corners, (ny, nx, -shape[0 if ny else 1] / 2))
    return polygon_area(corners)


def allot(rng: np.random.Generator, sizes: list[float], fractions: dict[str, float]) -> list[str]:
    """Return every piece a kind so that sizes approach the shares, each kind at least once where pieces suffice.

    The shares are first blurred by a log-normal factor (sigma 0.25), so that no two farms are alike.
    """
    wanted = {kind: fraction * float(np.exp(0.25 * rng.standard_normal())) for kind, fraction in fractions.items()}
    scale = sum(sizes) / sum(wanted.values())
    lack = {kind: fraction * scale for kind, fraction in wanted.items()}
    kinds = [""] * len(sizes)
    missing = set(fractions)
    order = sorted(range(len(sizes)), key=lambda piece: -sizes[piece])
    for rank, piece in enumerate(order):
        forced = missing and len(order) - rank <= len(missing)
        kind = max(sorted(missing) if forced else lack, key=lambda name: lack[name])
        kinds[piece] = kind
        lack[kind] -= sizes[piece]
        missing.discard(kind)
    return kinds


def parcel_pixels(parcel: Parcel, shape: tuple[int, int]) -> tuple[NDArray[np.intp], Field, Points]:
    """Return the pixels of a parcel: flat numbers (n,), coverage (n,), centres (n, 2). Parcels' coverages sum to 1."""
    low, high = parcel.corners.min(axis=0) - 1, parcel.corners.max(axis=0) + 1
    middle = (np.array(shape) - 1) / 2
    first = np.clip(np.floor(low + middle), 0, shape).astype(int)
    last = np.clip(np.ceil(high + middle) + 1, 0, shape).astype(int)
    y = (np.arange(first[0], last[0]) - middle[0])[:, None]
    x = (np.arange(first[1], last[1]) - middle[1])[None, :]
    cover = np.ones((y.size, x.size), np.float32)
    for ny, nx, offset in parcel.cuts:
        cover *= np.clip((y * ny - offset + 0.5).astype(np.float32) + (x * nx).astype(np.float32), 0, 1)
    rows, columns = np.nonzero(cover)
    centres = np.stack([rows + (first[0] - middle[0]), columns + (first[1] - middle[1])], axis=-1)
    return (rows + first[0]) * shape[1] + columns + first[1], cover[rows, columns], centres


def band_pixels(border: Border, reach: float, shape: tuple[int, int]) -> Band:
    """Return the pixels within ``reach`` of a line, and a little more at its ends, row by row or column by column."""
    step = border.step
    major = int(abs(step[1]) >= abs(step[0]))
    middle = (np.array(shape) - 1) / 2
    ends = np.sort([border.start[major], border.end[major]]) + middle[major]
    count = np.clip([np.floor(ends[0]), np.ceil(ends[1]) + 1], 0, shape[major])
    m = np.arange(*count.astype(int))
    slope = step[1 - major] / step[major]
    centre = border.start[1 - major] + (m - middle[major] - border.start[major]) * slope + middle[1 - major]
    width = int(np.ceil(reach / abs(step[major]))) + 1
    k = np.rint(centre)[:, None].astype(int) + np.arange(-width, width + 1)
    inside = (k >= 0) & (k < shape[1 - major])
    m, k = np.broadcast_to(m[:, None], k.shape)[inside], k[inside]
    y, x = (k, m) if major else (m, k)
    dy, dx = y - middle[0] - border.start[0], x - middle[1] - border.start[1]
    across, along = dx * step[0] - dy * step[1], dy * step[0] + dx * step[1]
    return Band(y * shape[1] + x, across.astype(np.float32), along.astype(np.float32))


def stripes(position: NDArray[np.floating], period: float, width: float) -> Field:
    """Return each pixel's cover by stripes of ``width`` centred on multiples of ``period`` (box of 1 px)."""
    start = np.asarray(position, dtype=np.float64) + (width - 1) / 2
    whole, rest = np.divmod(np.stack([start, start + 1]), period)
    filled = whole * width + np.minimum(rest, width)
    return np.asarray(filled[1] - filled[0], dtype=np.float32)


def edge(distance: NDArray[np.floating]) -> Field:
    """Return the coverage of a pixel whose centre lies ``distance`` inside an edge."""
    return np.asarray(np.clip(np.asarray(distance, dtype=np.float32) + np.float32(0.5), 0, 1))


def disc_pixels(
    centres: Points, radius: NDArray[np.float64], shape: tuple[int, int]
) -> Iterator[tuple[NDArray[np.intp], Field, NDArray[np.intp]]]:
    """Yield pixels under discs by strips: flat numbers, coverage, number of the disc that covers most, (n,) each."""
    places = centres + (np.array(shape) - 1) / 2
    for rows in cuts(shape[0], ROWS_AT_ONCE):
        near = np.flatnonzero((places[:, 0] + radius > rows.start - 1) & (places[:, 0] - radius < rows.stop))
        reach = int(np.ceil(radius[near].max(initial=0.0) + 1))
        offset = np.arange(-reach, reach + 1)
        place = places[near, :, None, None]
        base = np.rint(place).astype(int)
        y = base[:, 0] + offset[:, None] + np.zeros_like(offset)
        x = base[:, 1] + offset + np.zeros_like(offset)[:, None]
        cover = edge(radius[near, None, None] - np.hypot(y - place[:, 0], x - place[:, 1]))
        hit = (cover > 0) & (y >= rows.start) & (y < rows.stop) & (x >= 0) & (x < shape[1])
        index, cover, disc = (y * shape[1] + x)[hit], cover[hit], near[np.nonzero(hit)[0]]
        order = np.lexsort((cover, index))
        last = order[np.flatnonzero(np.diff(index[order], append=-1))]
        yield index[last], cover[last], disc[last]


def scene_points(index: NDArray[np.intp], shape: tuple[int, int]) -> Points:
    return np.stack(np.divmod(index, shape[1]), axis=-1) - (np.array(shape) - 1) / 2


def smooth_noise(rng: np.random.Generator, shape: tuple[int, int], cell: float, sd: float = 1.0) -> Field:
    """Return noise of about ``sd`` with bumps about ``cell`` px wide: a cubic B-spline over white noise, (y, x)."""
    knots = rng.standard_normal([int(size / cell) + 5 for size in shape]).astype(np.float32)
    down, across = (np.arange(size) / cell + shift for size, shift in zip(shape, rng.uniform(0, 1, 2), strict=True))
    field = scratch(shape)
    for rows in cuts(shape[0], ROWS_AT_ONCE):
        field[rows] = sd * (_spline(_spline(knots, down[rows]).T, across).T / np.float32(_SPLINE_SD))
    return field


def _spline(knots: Field, position: Points) -> Field:
    """Return cubic B-spline along the first axis at ``position`` (in knots, from the second on)."""
    first = position.astype(int)
    t = (position - first).astype(np.float32).reshape(-1, *[1] * (knots.ndim - 1))
    weights = ((1 - t) ** 3 / 6, (3 * t**3 - 6 * t**2 + 4) / 6, (-3 * t**3 + 3 * t**2 + 3 * t + 1) / 6, t**3 / 6)
    total = weights[0] * knots[first]
    for tap in (1, 2, 3):
        total += weights[tap] * knots[first + tap]
    return np.asarray(total, dtype=np.float32)


LATITUDE_DEG = 52.0
LOWEST_SUN_DEG = 5.0
YEAR_DAYS = 366
UNEVEN_DAYS = 9.0  # by which plants of one field are at most ahead of or behind the rest
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
    """State of a field on a day, and for how many days: since emergence, harvest, tillage or mowing."""

    phase: Phase
    days: float


_MAIZE = ((12.0, "maize_young"), (55.0, "maize_full"), (98.0, "maize_full"), (128.0, "maize_ripe"))
_BEET = ((10.0, "beet_young"), (55.0, "beet_full"), (140.0, "beet_full"), (190.0, "beet_old"))
_TALL = ((0, 0.2), (30, 4.0), (75, 20.0))
_LOW = ((0, 0.1), (60, 4.0))
_EARS = ((0, 0.3), (150, 1.0), (225, 7.0))


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
        """Return where the tip of a post 1 px high throws its shadow, (y, x) from its foot [px]: away from the sun."""
        azimuth = np.deg2rad(self.azimuth_deg)
        length = 1 / np.tan(np.deg2rad(self.elevation_deg))
        return np.array([np.cos(azimuth) * length, -np.sin(azimuth) * length])


def sun_over_farm(day: int, hour: float) -> Sun:
    """Return the sun's place: declination by Spencer's series [1], hour angle 15 degrees an hour.

    Right to 0.7 degrees in the years about 2025; refraction is left out. Raises SceneError: the day is not 1 to 366, or
    the sun is lower than 5 degrees at the hour.

    [1] Spencer, "Fourier series representation of the position of the sun", Search 2 (5), 1971.
    """
    if not 1 <= day <= YEAR_DAYS:
        raise SceneError(f"the day is 1 to {YEAR_DAYS}, counted from 1 January, got {day}")
    year = 2 * np.pi * (day - 1) / 365
    declination = 0.006918 - 0.399912 * np.cos(year) + 0.070257 * np.sin(year) - 0.006758 * np.cos(2 * year)
    declination = declination + 0.000907 * np.sin(2 * year) - 0.002697 * np.cos(3 * year) + 0.00148 * np.sin(3 * year)
    latitude = np.deg2rad(LATITUDE_DEG)
    turned = np.deg2rad(15 * (hour - 12))
    up = np.sin(latitude) * np.sin(declination) + np.cos(latitude) * np.cos(declination) * np.cos(turned)
    north = np.cos(latitude) * np.sin(declination) - np.sin(latitude) * np.cos(declination) * np.cos(turned)
    east = -np.cos(declination) * np.sin(turned)
    elevation = float(np.degrees(np.arcsin(np.clip(up, -1, 1))))
    if not elevation >= LOWEST_SUN_DEG:  # refuses NaN
        raise SceneError(
            f"at hour {hour:g} of day {day} the sun stands at {elevation:.1f} degrees, the scene needs at least "
            f"{LOWEST_SUN_DEG:g}; take an hour nearer to 12"
        )
    return Sun(float(np.degrees(np.arctan2(east, north)) % 360), elevation)


def since(day: float, event: float) -> float:
    """Return the days from the last time that the year's circle passed an event, from 0 to below 366."""
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
    """Return the fraction of the ground under plants, brown ones included, by days since emergence; 0 before."""
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


def lodged_fraction(day: float) -> float:
    """Return the fraction of a cereal's lodging that is done on a day: 0 before ``LODGES``, 1 after, smooth between."""
    t = float(np.clip((day - LODGES[0]) / (LODGES[1] - LODGES[0]), 0, 1))
    return t * t * (3 - 2 * t)


def days_since_turned(use: str, day: float, late: float) -> float:
    """Return the days since weeds were last killed on a field by tillage, sowing included; a year without tillage."""
    if use in CROPS:
        crop = CROPS[use]
        return min(since(day, crop.tillage + late), since(day, crop.emergence + late - 9))
    return land_on(use, day, late).days if use == "soil" else float(YEAR_DAYS)


def foliage(day: float) -> dict[str, float]:
    """Return shares of green leaves, turning leaves and bare twigs of a crown, summing to 1."""
    out, turn, fall = (float(np.interp(day, ends, (0, 1))) for ends in (LEAF_OUT, LEAF_TURN, LEAF_FALL))
    leaves = out * (1 - fall)
    return {"tree": leaves * (1 - turn), "tree_autumn": leaves * turn, "twigs": 1 - leaves}
