"""What grows on the built-in farm's parcels, painted on a canvas of abundances that keeps class shares beside them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.simulator.farm_layout import Field, Parcel, Points, edge, parcel_pixels, smooth_noise, stripes
from pipeline.simulator.spectra import MATERIALS

CLASSES: tuple[str, ...] = (
    "soil", "maize", "sugar_beet", "wheat_a", "wheat_b", "stubble", "grass", "weed", "track", "water", "tree",
)  # fmt: skip

Mixture = dict[str, Field]


@dataclass(frozen=True)
class Sowing:
    """How a parcel is sown: rows of ``width`` px every ``period`` px, plants' cover on the row and in the gap."""

    crop: str
    period: float
    width: float
    row: float
    gap: float
    vigour: float  # mean share of the dense stand
    tram_chance: float
    weeds: float  # plants per px where they are thickest


SOWINGS: dict[str, Sowing] = {
    "maize": Sowing("maize", 6.0, 3.8, 0.97, 0.66, 0.75, 0.25, 0.14),
    "sugar_beet": Sowing("sugar_beet", 5.0, 3.2, 0.96, 0.68, 0.70, 0.25, 0.14),
    "wheat_a": Sowing("wheat_a", 3.4, 2.0, 0.93, 0.74, 0.70, 0.7, 0.01),
    "wheat_b": Sowing("wheat_b", 3.4, 2.0, 0.93, 0.74, 0.70, 0.7, 0.01),
    "young_maize": Sowing("maize", 9.0, 4.2, 0.88, 0.04, 0.35, 0.2, 0.06),
    "young_beet": Sowing("sugar_beet", 7.5, 3.6, 0.88, 0.04, 0.35, 0.2, 0.06),
}
TWINS = {"wheat_a": "wheat_b", "wheat_b": "wheat_a"}


@dataclass(frozen=True)
class Ground:
    """What varies over the whole farm, (y, x) each, sd about 1 except ``light`` (share of full light)."""

    moisture: Field
    vigour: Field
    tuft: Field  # a few px wide
    grain: Field  # from pixel to pixel
    light: Field

    @classmethod
    def draw(cls, rng: np.random.Generator, shape: tuple[int, int]) -> Ground:
        """Draw the fields: moisture 70 and 22 px wide, vigour 55 px, tufts 3 px, light 260 px."""
        moisture = 0.85 * smooth_noise(rng, shape, 70) + 0.5 * smooth_noise(rng, shape, 22)
        light = np.clip(0.95 + 0.03 * smooth_noise(rng, shape, 260), 0.85, 1)
        grain = rng.standard_normal(shape, dtype=np.float32)
        return cls(moisture, smooth_noise(rng, shape, 55), smooth_noise(rng, shape, 3), grain, light)

    def at(self, index: NDArray[np.intp]) -> Ground:
        """The fields at flat pixel numbers, (n,) each."""
        parts = (self.moisture, self.vigour, self.tuft, self.grain, self.light)
        return Ground(*(part.ravel()[index] for part in parts))


class Canvas:
    """Abundances (material, pixel) and class shares (class, pixel); both grow to a sum of 1 per pixel."""

    def __init__(self, shape: tuple[int, int]) -> None:
        self.shape = shape
        self.materials = np.zeros((len(MATERIALS), shape[0] * shape[1]), np.float32)
        self.classes = np.zeros((len(CLASSES), shape[0] * shape[1]), np.float32)

    def add(self, index: NDArray[np.intp], cover: Field, mixture: Mixture, shares: Mixture) -> None:
        """Lay a surface beside what is there; the pixels of ``index`` are unique, as everywhere here."""
        for name, part in mixture.items():
            self.materials[MATERIALS.index(name), index] += cover * part
        for name, part in shares.items():
            self.classes[CLASSES.index(name), index] += cover * part

    def over(self, index: NDArray[np.intp], cover: Field, mixture: Mixture, label: str | None) -> None:
        """Lay a surface over what is there; without a label it hides nothing from a farmer (shade)."""
        self.materials[:, index] *= 1 - cover
        if label is not None:
            self.classes[:, index] *= 1 - cover
        self.add(index, cover, mixture, {} if label is None else {label: np.ones_like(cover)})

    def dim(self, light: Field) -> None:
        """Replace 1 - ``light`` of every pixel by shade."""
        self.materials *= light.ravel()
        self.materials[MATERIALS.index("shade")] += 1 - light.ravel()


class Content(NamedTuple):
    """Materials and class shares of a surface, each summing to 1 per pixel."""

    mixture: Mixture
    shares: Mixture


def bare_soil(ground: Ground) -> Mixture:
    """Dry and wet soil by moisture; clods and their shadows from pixel to pixel."""
    wet = np.clip(0.42 + 0.16 * ground.moisture + 0.04 * ground.tuft, 0.05, 0.9)
    shade = np.clip(0.06 + 0.035 * ground.grain, 0, 0.25)
    return {"soil_dry": (1 - wet) * (1 - shade), "soil_wet": wet * (1 - shade), "shade": shade}


def grass(ground: Ground, dryness: float = 0.3) -> Mixture:
    """Green and dry grass in tufts over a little soil."""
    dry = np.clip(dryness - 0.14 * ground.moisture + 0.10 * ground.tuft + 0.04 * ground.grain, 0.02, 0.85)
    soil = np.clip(0.06 + 0.03 * ground.grain, 0, 0.2)
    return {"grass_green": (1 - dry) * (1 - soil), "grass_dry": dry * (1 - soil), "soil_dry": soil}


def hard_track(ground: Ground, gravel: float) -> Mixture:
    """Gravel trodden into dry soil."""
    stone = np.clip(gravel + 0.08 * ground.tuft + 0.05 * ground.grain, 0, 1)
    return {"gravel": stone, "soil_dry": 0.85 * (1 - stone), "soil_wet": 0.15 * (1 - stone)}


def blend(lower: Mixture, upper: Mixture, cover: Field) -> Mixture:
    """Lay ``upper`` with ``cover`` over ``lower``."""
    mixed = {name: part * (1 - cover) for name, part in lower.items()}
    for name, part in upper.items():
        mixed[name] = mixed.get(name, np.float32(0)) + part * cover
    return mixed


def stand(sowing: Sowing, ground: Ground) -> Mixture:
    """Plants alone: dense and sparse stands by vigour; wheat's chlorophyll varies, so that twins overlap."""
    dense = np.clip(sowing.vigour + 0.14 * ground.vigour + 0.07 * ground.tuft, 0.05, 1)
    if sowing.crop not in TWINS:
        name = "beet" if sowing.crop == "sugar_beet" else sowing.crop
        return {f"{name}_dense": dense, f"{name}_sparse": 1 - dense}
    own = np.clip(0.80 + 0.05 * ground.vigour + 0.17 * ground.grain, 0, 1)
    twin = TWINS[sowing.crop]
    mixture = {f"{sowing.crop}_dense": dense * own, f"{sowing.crop}_sparse": (1 - dense) * own}
    return mixture | {f"{twin}_dense": dense * (1 - own), f"{twin}_sparse": (1 - dense) * (1 - own)}


def row_crop(rng: np.random.Generator, sowing: Sowing, parcel: Parcel, centres: Points, ground: Ground) -> Content:
    """Rows along the parcel, turned at its ends, soil between them shaded by the plants, and tramlines."""
    across, ends = _row_axes(parcel, centres)
    headland = edge(rng.uniform(14, 24) - ends)
    phase = rng.uniform(0, sowing.period)
    rows = stripes(across + phase, sowing.period, sowing.width)
    rows += headland * (stripes(ends, sowing.period, sowing.width) - rows)
    growth = np.clip(1 + 0.32 * np.minimum(ground.vigour + 1.9, 0), 0.15, 1)  # bare spots where vigour fails
    uneven = 0.06 * ground.tuft * rows + 0.03 * ground.grain
    cover = growth * np.clip(sowing.gap + (sowing.row - sowing.gap) * rows + uneven, 0, 0.99)
    soil = bare_soil(ground)
    under = 0.45 * cover * (1 - rows)
    soil = blend(soil, {"shade": np.ones_like(cover)}, under)
    mixture = blend(soil, stand(sowing, ground), cover)
    shares = {sowing.crop: cover, "soil": 1 - cover}
    if rng.uniform() < sowing.tram_chance:
        trams = _trams(rng, across)
        mixture = blend(mixture, hard_track(ground, 0.30), trams)
        shares = blend(shares, {"track": np.ones_like(trams)}, trams)
    return Content(mixture, shares)


def _row_axes(parcel: Parcel, centres: Points) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Distance across the rows, which follow the longest side, and distance to the nearest end of the parcel."""
    sides = np.roll(parcel.corners, -1, axis=0) - parcel.corners
    lengths = np.hypot(sides[:, 0], sides[:, 1])
    dy, dx = sides[lengths.argmax()] / lengths.max()
    across = centres @ np.array([-dx, dy])
    ends = np.full(len(centres), np.inf)
    for ny, nx, offset in parcel.cuts:
        if abs(ny * dy + nx * dx) > 0.7:
            np.minimum(ends, centres @ np.array([ny, nx]) - offset, out=ends)
    return across, np.minimum(ends, 1e4)


def _trams(rng: np.random.Generator, across: NDArray[np.float64]) -> Field:
    """Pairs of wheel marks 2.2-3.2 px wide, 14-17 px apart, every 130-180 px."""
    gauge, spacing, width = rng.uniform(14, 17), rng.uniform(130, 180), rng.uniform(2.2, 3.2)
    shift = across + rng.uniform(0, spacing)
    return np.asarray(np.clip(stripes(shift, spacing, width) + stripes(shift + gauge, spacing, width), 0, 1))


def stubble(rng: np.random.Generator, parcel: Parcel, centres: Points, ground: Ground) -> Content:
    """Straw in cut rows, swaths every 36-48 px, soil showing between, a little green coming back."""
    across, _ = _row_axes(parcel, centres)
    swath = stripes(across + rng.uniform(0, 40), rng.uniform(36, 48), 12.0)
    rows = stripes(across, 4.0, 2.2)
    straw = np.clip(0.58 + 0.14 * rows + 0.20 * swath + 0.05 * ground.tuft + 0.03 * ground.grain, 0.52, 0.97)
    green = np.clip(0.04 + 0.05 * ground.vigour, 0, 0.2) * (1 - straw)
    mixture = {name: part * (1 - straw - green) for name, part in bare_soil(ground).items()}
    mixture |= {"straw": straw, "grass_green": green}
    return Content(mixture, {"stubble": straw + green, "soil": 1 - straw - green})


def meadow(rng: np.random.Generator, parcel: Parcel, centres: Points, ground: Ground) -> Content:
    """Grass mown in bands 18-26 px wide that differ in dryness."""
    across, _ = _row_axes(parcel, centres)
    band = rng.uniform(18, 26)
    mown = stripes(across, 2 * band, band)
    mixture = blend(grass(ground, 0.22), grass(ground, 0.42), mown)
    return Content(mixture, {"grass": np.ones_like(mown)})


def fallow(rng: np.random.Generator, parcel: Parcel, centres: Points, ground: Ground) -> Content:
    """Bare soil, harrowed every 9-13 px, sometimes crossed by a tractor's marks."""
    across, _ = _row_axes(parcel, centres)
    furrow = stripes(across, rng.uniform(9, 13), 3.0)
    soil = blend(bare_soil(ground), {"shade": np.ones_like(furrow)}, 0.16 * furrow)
    if rng.uniform() > 0.5:
        return Content(soil, {"soil": np.ones_like(furrow)})
    trams = _trams(rng, across)
    shares = {"soil": 1 - trams, "track": trams}
    return Content(blend(soil, hard_track(ground, 0.35), trams), shares)


def paint_parcel(rng: np.random.Generator, canvas: Canvas, ground: Ground, parcel: Parcel, use: str) -> None:
    """Draw one parcel."""
    index, cover, centres = parcel_pixels(parcel, canvas.shape)
    if not index.size:
        return
    here = ground.at(index)
    if use in SOWINGS:
        content = row_crop(rng, SOWINGS[use], parcel, centres, here)
    else:
        content = {"stubble": stubble, "grass": meadow, "soil": fallow}[use](rng, parcel, centres, here)
    canvas.add(index, cover, *content)
