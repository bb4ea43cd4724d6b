"""Fields on a day: stands in rows, lodged patches, stubble, meadows, bare soil; and the course of rows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.simulator.scenes.farm import land
from spectralzoom.pipeline.simulator.scenes.farm.farm_plan import TWINS, FieldPlan, Ground, Mixture, Painting, blend
from spectralzoom.pipeline.simulator.scenes.farm.land import Crop, Field, Points

Floats = NDArray[np.float64]
ON_ROW = 0.97  # greatest cover
CLOSED = 0.62  # of the period, a row's greatest width; then the gap between rows fills
LODGED_PATCH_PX = 30.0
PASS_ROWS = 8  # sown at a time; each pass lies a little aside
PASS_SD = 0.03  # of the period
PIECE_PX = 14.0  # a gap is 0.15 of this to all of it, short ones oftener
SPECIES: dict[str, tuple[float, float, float]] = {  # share, and first and last day of emergence
    "weed_leafy": (0.55, 95.0, 172.0),
    "weed_red": (0.30, 105.0, 185.0),
    "mustard": (0.15, 92.0, 150.0),
}
FLOWERING = (36.0, 85.0)  # days since mustard came up
CLUSTERED = 0.65  # fraction of plants in clusters
CLUSTER = 22  # plants in one
ALONG_PX, ASIDE_PX = 16.0, 6.0  # spread of a cluster along the rows and across, sd
VOLUNTEERS = 1 / 6000  # single plants of another crop per px
SEEN_PX = 0.35  # least radius of a plant that is drawn


class Content(NamedTuple):
    """Materials and class fractions of a surface, each summing to 1 per pixel."""

    mixture: Mixture
    fractions: Mixture


def paint_fields(work: Painting, lodging: Field | None = None) -> None:
    """Draw every field; ``lodging`` (y, x), of sd about 1, is highest where plants lie first, by default anywhere."""
    plan = work.plan
    standing = any(one.lodging > 0 and one.land_on(plan.day).phase == "crop" for one in plan.fields)
    if lodging is None and land.lodged_fraction(plan.day) > 0 and standing:
        lodging = land.smooth_noise(land.stream(plan.seed, "lodging"), plan.shape, LODGED_PATCH_PX)
    for number, field in enumerate(plan.fields):
        index, cover, centres = land.parcel_pixels(field.parcel, plan.shape)
        if not index.size:
            continue
        down = np.zeros(index.size, np.float32) if lodging is None else _lodged(lodging.ravel()[index], field, plan.day)
        content = _content(work, land.stream(plan.seed, f"paint {number}"), field, centres, work.ground.at(index), down)
        work.canvas.add(index, cover, *content)


def _content(
    work: Painting, rng: np.random.Generator, field: FieldPlan, centres: Points, here: Ground, down: Field
) -> Content:
    state = field.land_on(work.plan.day)
    crop = field.crop
    salt = int(rng.integers(2**31))
    rows = rows_of(rng, field, centres)
    if state.phase == "grass":
        winter = 0.5 + 0.5 * np.cos(2 * np.pi * (work.plan.day - 25) / land.YEAR_DAYS)
        dryness = float(0.18 + 0.34 * np.exp(-state.days / 12) + 0.24 * winter)
        bands = land.stripes(rows.across, field.row_period_px, field.row_period_px / 2)
        return Content(blend(here.grass(dryness), here.grass(dryness + 0.16), bands), {"grass": np.ones_like(bands)})
    soil = work.plan.soil(here, field.wetter)
    if state.phase == "soil":
        furrow = land.stripes(rows.place, field.row_period_px if crop is None else 10.5, 3.0)
        content = Content(blend(soil, {"shade": np.ones_like(furrow)}, 0.15 * furrow), {"soil": np.ones_like(furrow)})
        return _with_wheel_marks(content, field, rows, soil) if crop is None else content
    if crop is None or state.phase == "stubble":
        return _stubble_field(rows, field, here, soil, state.days)
    return _standing_crop(work, field, crop, rows, here, soil, row_gaps(salt, field, rows, here), down)


def _standing_crop(
    work: Painting, field: FieldPlan, crop: Crop, rows: Rows, here: Ground, soil: Mixture, gaps: Field, down: Field
) -> Content:
    age = field.land_on(work.plan.day).days
    local = age + np.clip(4 * here.vigour + 1.5 * here.tuft, -land.UNEVEN_DAYS, land.UNEVEN_DAYS)
    period = field.row_period_px
    closed = land.canopy_cover(crop, local)
    width = np.minimum(closed * period / ON_ROW, CLOSED * period)
    between = np.clip((closed * period - width * ON_ROW) / (period - width), 0, ON_ROW)
    row = stripes_of(rows.place, period, width)
    uneven = closed * (0.06 * here.tuft * row + 0.03 * here.grain)
    growth = np.clip(1 + 0.32 * np.minimum(here.vigour + 1.9, 0), 0.15, 1)  # bare spots where vigour fails
    plants = growth * np.clip(between + (ON_ROW - between) * row + uneven, 0, 0.99) * (1 - gaps * (1 - 0.6 * closed))
    plants = np.asarray(plants + down * (ON_ROW - plants), np.float32)
    room = np.maximum(period - width, 0)
    cast = float(np.interp(age, *np.array(crop.heights).T)) * (rows.normal @ work.plan.sun.cast)  # of the rows' shadow
    shift = np.clip(cast, -room, room)
    both = stripes_of(rows.place - shift / 2, period, width + np.abs(shift))
    shaded = np.asarray(np.clip(both - row, 0, 1), np.float32)  # outside the rows themselves
    dense = np.clip(0.2 + 0.3 * width, 0, 0.75) * (1 - gaps) * (1 - down)  # seedlings let light through
    soil = blend(soil, {"shade": np.ones_like(plants)}, np.asarray(dense * shaded, np.float32))
    deep = np.asarray(0.24 * (1 - row) * closed * (1 - down), np.float32)  # between rows that have closed
    leaves = blend(_stand(field, crop, here, local, down), {"shade": np.ones_like(plants)}, deep)
    content = Content(blend(soil, leaves, plants), {crop.label: plants, "soil": 1 - plants})
    return _with_wheel_marks(content, field, rows, soil)


def _stand(field: FieldPlan, crop: Crop, here: Ground, local: Points, down: Field) -> Mixture:
    """Return plants alone, by stage; wheat stands and lies, and 0.80 of a pixel has its own variety's red land.edge."""
    fractions = land.stage_fractions(crop, local)
    if field.use not in TWINS:
        return fractions
    if down.max(initial=0) > 0:
        ripe = fractions.get(f"{field.use}_ripe", np.zeros_like(down))
        swirl = np.clip(0.07 + 0.07 * here.tuft, 0, 0.3)  # stems lie this way and that
        lying = {f"{field.use}_lodged": (1 - ripe) * (1 - swirl), f"{field.use}_lodged_ripe": ripe * (1 - swirl)}
        fractions = blend(fractions, lying | {"shade": swirl}, down)
    own = np.clip(0.80 + 0.05 * here.vigour + 0.17 * here.grain, 0, 1)
    stand = {name: part * own for name, part in fractions.items()}
    for name, part in fractions.items():
        other = name.replace(field.use, TWINS[field.use])
        stand[other] = stand.get(other, np.float32(0)) + part * (1 - own)
    return stand


def _with_wheel_marks(content: Content, field: FieldPlan, rows: Rows, soil: Mixture) -> Content:
    """Return the field with its tramlines, which also turn on the headland."""
    trams = field.tramlines
    if trams is None:
        return content
    shift = rows.across + trams.shift
    pair = sum(land.stripes(shift + wheel, trams.spacing, trams.width) for wheel in (0.0, trams.gauge))
    middle = field.headland_px / 2
    turn = land.edge(trams.width / 2 - np.abs(np.abs(rows.ends - middle) - trams.gauge / 2))
    inside = land.edge(rows.ends - middle - trams.gauge / 2)
    marks: Field = np.asarray(np.clip(np.maximum(pair * inside, turn), 0, 1), np.float32)
    mixture = blend(content.mixture, blend(soil, {"gravel": np.ones_like(marks)}, np.full_like(marks, 0.22)), marks)
    return Content(mixture, blend(content.fractions, {"track": np.ones_like(marks)}, marks))


def _stubble_field(rows: Rows, field: FieldPlan, here: Ground, soil: Mixture, days: float) -> Content:
    row = land.stripes(rows.place, field.row_period_px, CLOSED * field.row_period_px)
    swath = land.stripes(rows.across, 44.0, 12.0) * np.float32(days < 9)
    lying = 0.52 + 0.17 * row + 0.22 * swath + 0.05 * here.tuft + 0.03 * here.grain
    fresh = np.clip(0.17 + 0.10 * here.vigour + 0.05 * here.tuft, 0.01, 0.5)
    green = np.asarray(fresh * (1 - np.exp(-days / 60)), np.float32)
    straw = np.asarray(np.clip(lying, 0.52, 0.97) * (1 - green), np.float32)
    grey = np.float32(1 - np.exp(-days / 70))
    mixture: Mixture = {name: part * (1 - straw - green) for name, part in soil.items()}
    mixture |= {"straw": straw * (1 - grey), "straw_grey": straw * grey, "grass_green": green}
    return _with_wheel_marks(Content(mixture, {"stubble": straw + green, "soil": 1 - straw - green}), field, rows, soil)


def _lodged(noise: Field, field: FieldPlan, day: int) -> Field:
    fraction = field.lodging * land.lodged_fraction(day)
    if fraction <= 0 or field.crop is None or field.land_on(day).phase != "crop" or field.land_on(day).days < 150:
        return np.zeros_like(noise)
    return np.asarray(np.clip((noise - NormalDist().inv_cdf(1 - fraction)) / 0.2 + 0.5, 0, 1), np.float32)


@dataclass(frozen=True)
class Rows:
    """Pixels against the rows, (n,) each; on headlands rows run along the field's end.

    ``across`` is the distance in the field's own frame. ``place`` is the distance across the rows where the pixel is,
    ``onward`` along them, ``ends`` to the nearest end of the field [px]. ``normal`` (n, 2) points across the rows.
    """

    across: Floats
    ends: Floats
    place: Floats
    onward: Floats
    normal: Points


def rows_of(rng: np.random.Generator, field: FieldPlan, centres: Points) -> Rows:
    """Lay a field's rows; ``rng`` gives how far each pass of the drill lies aside."""
    angle = np.deg2rad(field.row_angle_deg)
    normal, ahead = np.array([np.cos(angle), -np.sin(angle)]), np.array([np.sin(angle), np.cos(angle)])
    across, along = centres @ normal + field.row_phase_px, centres @ ahead
    ends, end_normal = np.full(len(centres), 1e4), np.tile(normal, (len(centres), 1))
    for ny, nx, offset in field.parcel.cuts:
        if abs(ahead @ (ny, nx)) > 0.7:
            distance = centres @ np.array([ny, nx]) - offset
            nearer = distance < ends
            ends[nearer] = distance[nearer]
            end_normal[nearer] = (ny, nx)
    aside = rng.normal(0, PASS_SD * field.row_period_px, 512)
    passes = np.floor(across / (PASS_ROWS * field.row_period_px) - 0.5 / PASS_ROWS).astype(int)
    turned = ends < field.headland_px
    place = np.where(turned, ends, across + aside[passes % 512])
    normals = np.where(turned[:, None], end_normal, normal)
    return Rows(across, ends, place, np.where(turned, across, along), normals)


def row_gaps(salt: int, field: FieldPlan, rows: Rows, here: Ground) -> Field:
    """Return the fraction of each pixel where nothing came up: pieces of rows, more of them where vigour is poor."""
    number = np.rint(rows.place / field.row_period_px).astype(np.int64)
    position = rows.onward / PIECE_PX + _scatter(number, number, salt)
    piece = np.floor(position).astype(np.int64)
    inside = (position - piece) * PIECE_PX
    length = PIECE_PX * (0.15 + 0.85 * _scatter(number, piece, salt + 1) ** 2)
    fails = _scatter(number, piece, salt + 2) < field.gap_rate * np.clip(1 - 0.6 * here.vigour, 0.2, 3)
    onto = np.abs(rows.place - number * field.row_period_px) / field.row_period_px  # 0 on the row, 0.5 between rows
    cover = land.edge(np.minimum(inside, length - inside)) * fails * np.clip(2.2 - 3.4 * onto, 0, 1)
    return np.asarray(cover, np.float32)


def stripes_of(place: Floats, period: float, width: Floats) -> Field:
    """Return the cover of each pixel by land.stripes whose width differs from pixel to pixel (``land.stripes``)."""
    start = place + (width - 1) / 2
    whole, rest = np.divmod(start, period)
    last, left = np.divmod(start + 1, period)
    return np.asarray((last - whole) * width + np.minimum(left, width) - np.minimum(rest, width), np.float32)


def _scatter(first: NDArray[np.int64], second: NDArray[np.int64], salt: int) -> Floats:
    """Return evenly spread numbers from 0 to below 1 that only depend on what is given (integer hash)."""
    mixed = first.astype(np.uint32) * np.uint32(0x9E3779B1) ^ second.astype(np.uint32) * np.uint32(0x85EBCA6B)
    mixed ^= np.uint32((salt * 0xC2B2AE35) & 0xFFFFFFFF)
    for shift, factor in ((16, 0x7FEB352D), (15, 0x846CA68B)):
        mixed = (mixed ^ (mixed >> np.uint32(shift))) * np.uint32(factor)
    return np.asarray(mixed ^ (mixed >> np.uint32(16)), np.float64) / 2**32


def plant_weeds(work: Painting) -> None:
    """Draw the weeds of every field."""
    grown: dict[str, list[NDArray[np.float64]]] = {}
    for number, field in enumerate(work.plan.fields):
        for name, plants in field_weeds(land.stream(work.plan.seed, f"weeds {number}"), field, work.plan.day).items():
            grown.setdefault(name, []).append(plants)
    draw_weeds(work, {name: np.concatenate(parts) for name, parts in grown.items()})


def draw_weeds(work: Painting, grown: Mapping[str, Points]) -> None:
    """Draw plants, each a disc of one spectrum: y, x and radius (n, 3) by spectrum."""
    for name, plants in sorted(grown.items()):
        for index, cover, _ in land.disc_pixels(plants[:, :2], plants[:, 2], work.plan.shape):
            work.canvas.over(index, 0.92 * cover, {name: np.ones_like(cover)}, "weed")


def field_weeds(rng: np.random.Generator, field: FieldPlan, day: int) -> dict[str, Points]:
    """Return the weeds of one field on a day: y, x and radius (n, 3) by spectrum.

    Their number is Poisson distributed; they are clustered as by Thomas [1].

    [1] Thomas, "A generalization of Poisson's binomial limit for use in ecology", Biometrika 36, 1949.
    """
    corners = field.parcel.corners
    area = land.polygon_area(corners)
    count, single = rng.poisson(field.weeds * area / 1000), rng.poisson(VOLUNTEERS * area)
    places = _clustered(rng, field, count)
    radius = rng.uniform(0.9, 2.4, count)
    kinds = rng.choice(list(SPECIES), count, p=[fraction for fraction, _, _ in SPECIES.values()])
    first, last = (np.array([SPECIES[kind][end] for kind in kinds]).reshape(-1) for end in (1, 2))
    emergence = rng.uniform(size=count) * (last - first) + first
    kinds = np.append(kinds, np.full(single, "volunteer"))
    places = np.concatenate([places, points_within(rng, corners, single)])
    radius = np.append(radius, rng.uniform(1.0, 2.0, single))
    emergence = np.append(emergence, rng.uniform(110, 190, single))
    turned = np.full(count + single, land.days_since_turned(field.use, day, field.late_days))
    age = (day - emergence) % land.YEAR_DAYS
    state = field.land_on(day)
    cut = np.where((age > state.days) & (state.phase in ("grass", "stubble")), 0.5, 1.0)  # saw mowing or harvest
    alive = (age < turned) & (age < 170)  # tillage kills a weed, and so does its age; it grows to 63 % in 22 days
    size = radius * np.where(alive, 1 - np.exp(-age / 22), 0.0) * cut
    flowers = (kinds == "mustard") & (age >= FLOWERING[0]) & (age < FLOWERING[1])
    spectra = np.where(flowers, "blossom", np.where(kinds == "mustard", "weed_leafy", kinds))
    seen = size > SEEN_PX
    plants = np.column_stack([places, size])
    return {str(name): plants[seen & (spectra == name)] for name in np.unique(spectra[seen])}


def _clustered(rng: np.random.Generator, field: FieldPlan, count: int) -> Points:
    """Return places of plants, (n, 2): some anywhere, the rest round parents, none beyond the border."""
    corners = field.parcel.corners
    places = points_within(rng, corners, count)
    parents = points_within(rng, corners, max(1, round(CLUSTERED * count / CLUSTER)))
    angle = np.deg2rad(field.row_angle_deg)
    ahead, aside = np.array([np.sin(angle), np.cos(angle)]), np.array([np.cos(angle), -np.sin(angle)])
    thrown = rng.normal(0, ALONG_PX, (count, 1)) * ahead + rng.normal(0, ASIDE_PX, (count, 1)) * aside
    near = parents[rng.integers(len(parents), size=count)] + thrown
    inside = np.ones(count, bool)
    for ny, nx, offset in field.parcel.cuts:
        inside &= near @ np.array([ny, nx]) > offset
    return np.where((inside & (rng.uniform(size=count) < CLUSTERED))[:, None], near, places)


def points_within(rng: np.random.Generator, corners: Points, count: int) -> Points:
    """Return points spread evenly over a convex polygon, (n, 2)."""
    fans = [corners[[0, number, number + 1]] for number in range(1, len(corners) - 1)]
    areas = np.array([land.polygon_area(fan) for fan in fans])
    chosen = np.array(fans)[rng.choice(len(fans), count, p=areas / areas.sum())]
    u, v = rng.uniform(size=(2, count, 1))
    over = u + v > 1
    u, v = np.where(over, 1 - u, u), np.where(over, 1 - v, v)
    origin = chosen[:, 0]
    return np.asarray(origin + u * (chosen[:, 1] - origin) + v * (chosen[:, 2] - origin), np.float64)
