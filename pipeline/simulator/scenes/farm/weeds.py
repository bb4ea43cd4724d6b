"""Weeds: plants at fixed places, thrown in clusters along the rows, that come up, grow and die."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.simulator.scenes.farm.canvas import Painting
from pipeline.simulator.scenes.farm.farm_plan import FieldPlan
from pipeline.simulator.scenes.farm.land import Points, disc_pixels, polygon_area, stream
from pipeline.simulator.scenes.farm.seasons import YEAR_DAYS, days_since_turned, weed_size

Floats = NDArray[np.float64]
SPECIES: dict[str, tuple[float, float, float]] = {  # share, and first and last day of emergence
    "weed_leafy": (0.55, 95.0, 172.0),
    "weed_red": (0.30, 105.0, 185.0),
    "mustard": (0.15, 92.0, 150.0),
}
FLOWERING = (36.0, 85.0)  # days since mustard came up
CLUSTERED, CLUSTER = 0.65, 22  # share of plants in clusters, and plants in one
ALONG_PX, ASIDE_PX = 16.0, 6.0  # spread of a cluster along the rows and across, sd
VOLUNTEERS = 1 / 6000  # single plants of another crop per px
SEEN_PX = 0.35  # least radius of a plant that is drawn


def plant_weeds(work: Painting) -> None:
    """Draw the weeds of every field, each a disc of one spectrum."""
    grown: dict[str, list[NDArray[np.float64]]] = {}
    for number, field in enumerate(work.plan.fields):
        for name, plants in field_weeds(stream(work.plan.seed, f"weeds {number}"), field, work.plan.day).items():
            grown.setdefault(name, []).append(plants)
    for name, parts in sorted(grown.items()):
        plants = np.concatenate(parts)
        index, cover, _ = disc_pixels(plants[:, :2], plants[:, 2], work.plan.shape)
        work.canvas.over(index, 0.92 * cover, {name: np.ones_like(cover)}, "weed")


def field_weeds(rng: np.random.Generator, field: FieldPlan, day: int) -> dict[str, Points]:
    """Weeds of one field on a day: y, x and radius (n, 3) by spectrum. Poisson in number, clustered as by Thomas [1]_.

    References
    ----------
    .. [1] Thomas, "A generalization of Poisson's binomial limit for use in ecology", Biometrika 36, 1949.
    """
    corners = field.parcel.corners
    area = polygon_area(corners)
    count, single = rng.poisson(field.weeds * area / 1000), rng.poisson(VOLUNTEERS * area)
    places, radius = _clustered(rng, field, count), rng.uniform(0.9, 2.4, count)
    kinds = rng.choice(list(SPECIES), count, p=[share for share, _, _ in SPECIES.values()])
    first, last = (np.array([SPECIES[kind][end] for kind in kinds]).reshape(-1) for end in (1, 2))
    emergence = rng.uniform(size=count) * (last - first) + first
    kinds = np.append(kinds, np.full(single, "volunteer"))
    places = np.concatenate([places, points_within(rng, corners, single)])
    radius = np.append(radius, rng.uniform(1.0, 2.0, single))
    emergence = np.append(emergence, rng.uniform(110, 190, single))
    turned = np.full(count + single, days_since_turned(field.use, day, field.late_days))
    age = (day - emergence) % YEAR_DAYS
    size = radius * weed_size(day, emergence, turned) * _cut(field, day, age)
    flowers = (kinds == "mustard") & (age >= FLOWERING[0]) & (age < FLOWERING[1])
    spectra = np.where(flowers, "blossom", np.where(kinds == "mustard", "weed_leafy", kinds))
    seen = size > SEEN_PX
    plants = np.column_stack([places, size])
    return {str(name): plants[seen & (spectra == name)] for name in np.unique(spectra[seen])}


def _cut(field: FieldPlan, day: int, age: Floats) -> Floats:
    """Plants that saw mowing or harvest are half as wide."""
    land = field.land_on(day)
    return np.where((age > land.days) & (land.phase in ("grass", "stubble")), 0.5, 1.0)


def _clustered(rng: np.random.Generator, field: FieldPlan, count: int) -> Points:
    """Places of plants, (n, 2): some anywhere, the rest round parents; those thrown over the border fall anywhere."""
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
    kept = inside & (rng.uniform(size=count) < CLUSTERED)
    return np.where(kept[:, None], near, places)


def points_within(rng: np.random.Generator, corners: Points, count: int) -> Points:
    """Points spread evenly over a convex polygon, (n, 2)."""
    fans = [corners[[0, number, number + 1]] for number in range(1, len(corners) - 1)]
    areas = np.array([polygon_area(fan) for fan in fans])
    chosen = np.array(fans)[rng.choice(len(fans), count, p=areas / areas.sum())]
    u, v = rng.uniform(size=(2, count, 1))
    over = u + v > 1
    u, v = np.where(over, 1 - u, u), np.where(over, 1 - v, v)
    origin = chosen[:, 0]
    return np.asarray(origin + u * (chosen[:, 1] - origin) + v * (chosen[:, 2] - origin), np.float64)
