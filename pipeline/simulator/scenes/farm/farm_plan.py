"""The plan of the farm: abundances of the day's materials, fractions of classes, and surfaces that lie anywhere."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.errors import SceneError
from spectralzoom.pipeline.geometry.grid import cuts
from spectralzoom.pipeline.simulator.scenes.farm import land
from spectralzoom.pipeline.simulator.scenes.farm.land import Border, Crop, Field, Land, Parcel, Sun
from spectralzoom.pipeline.simulator.scenes.farm.spectra import MATERIALS, MOISTURE_EXPONENT
from spectralzoom.pipeline.simulator.scenes.scene import Drawn, scratch

_COLOURS = {
    "soil": (158, 119, 82),
    "maize": (240, 200, 40),
    "sugar_beet": (196, 60, 130),
    "wheat_a": (60, 140, 60),
    "wheat_b": (130, 200, 90),
    "stubble": (235, 220, 165),
    "grass": (165, 215, 190),
    "weed": (220, 30, 30),
    "track": (120, 120, 120),
    "water": (40, 110, 220),
    "tree": (15, 75, 45),
}
CLASSES = tuple(_COLOURS)
CLASS_COLOURS = np.array(list(_COLOURS.values()), np.uint8)

Mixture = dict[str, Field]
PARCEL_AREA_PX = 95_000.0
USE_FRACTIONS = {
    **{"maize": 0.16, "sugar_beet": 0.15, "wheat_a": 0.15, "wheat_b": 0.15, "stubble": 0.09, "grass": 0.08},
    **{"soil": 0.11, "late_maize": 0.045, "late_beet": 0.045},
}
BORDER_FRACTIONS = {"road": 0.20, "ditch": 0.38, "hedge": 0.17, "margin": 0.25}  # of the lines between parcels
TWINS = {"wheat_a": "wheat_b", "wheat_b": "wheat_a"}
_ROWS_ELSEWHERE = {"stubble": (3.4, 4.4), "grass": (36.0, 52.0), "soil": (9.0, 13.0)}
_WEEDS_ELSEWHERE = {"stubble": (1.0, 6.0), "grass": (0.2, 2.0), "soil": (0.5, 4.0)}


@dataclass(frozen=True)
class Ground:
    """Variation over the whole farm, (y, x) each, sd about 1 except ``light`` (fraction of full light)."""

    moisture: Field
    vigour: Field
    tuft: Field  # a few px wide
    grain: Field  # from pixel to pixel
    light: Field

    @classmethod
    def draw(cls, rng: np.random.Generator, shape: tuple[int, int]) -> Ground:
        """Draw the fields: moisture 70 and 22 px wide, vigour 55 px, tufts 3 px, light 260 px."""
        moisture = land.smooth_noise(rng, shape, 70, sd=0.85)
        moisture += land.smooth_noise(rng, shape, 22, sd=0.5)
        light = land.smooth_noise(rng, shape, 260, sd=0.03)
        np.clip(np.add(light, 0.95, out=light), 0.85, 1, out=light)
        grain = rng.standard_normal(dtype=np.float32, out=scratch(shape))
        return cls(moisture, land.smooth_noise(rng, shape, 55), land.smooth_noise(rng, shape, 3), grain, light)

    def at(self, index: NDArray[np.intp]) -> Ground:
        """Return the fields at flat pixel numbers, (n,) each."""
        return Ground(*(getattr(self, one.name).ravel()[index] for one in fields(self)))

    def grass(self, dryness: float) -> Mixture:
        """Return green and dry grass in tufts over a little soil."""
        dry = np.clip(dryness - 0.14 * self.moisture + 0.10 * self.tuft + 0.04 * self.grain, 0.02, 0.85)
        soil = np.clip(0.06 + 0.03 * self.grain, 0, 0.2)
        return {"grass_green": (1 - dry) * (1 - soil), "grass_dry": dry * (1 - soil), "soil_dry": soil}


class Canvas:
    """Abundances (pixel, material) and class shares (pixel, class); both grow to a sum of 1 per pixel.

    The pixels of an ``index`` are unique, as everywhere on the farm.
    """

    def __init__(self, shape: tuple[int, int], materials: tuple[str, ...]) -> None:
        self.shape = shape
        self._column = {name: number for number, name in enumerate(materials)}
        self.materials, self.classes = (scratch((shape[0] * shape[1], len(one))) for one in (materials, CLASSES))

    def add(self, index: NDArray[np.intp], cover: Field, mixture: Mixture, fractions: Mixture) -> None:
        """Lay a surface beside what is there."""
        for name, part in mixture.items():
            self.materials[index, self._column[name]] += cover * part
        for name, part in fractions.items():
            self.classes[index, CLASSES.index(name)] += cover * part

    def over(self, index: NDArray[np.intp], cover: Field, mixture: Mixture, label: str | None) -> None:
        """Lay a surface over what is there; without a label it hides nothing from a farmer (shade)."""
        self.materials[index] *= (1 - cover)[:, None]
        if label is not None:
            self.classes[index] *= (1 - cover)[:, None]
        self.add(index, cover, mixture, {} if label is None else {label: np.ones_like(cover)})

    def stripe(self, band: land.Band, half: float, mixture: Mixture, label: str) -> None:
        """Lay a stripe of half a width [px] along the middle of a band over what is there."""
        cover = land.edge(half - np.abs(band.across))
        hit = np.flatnonzero(cover)
        self.over(band.index[hit], cover[hit], {name: part[hit] for name, part in mixture.items()}, label)


@dataclass(frozen=True)
class Painting:
    """All that painting needs: the plan, what varies over the land, and the canvas."""

    plan: FarmPlan
    ground: Ground
    canvas: Canvas

    @classmethod
    def of(cls, plan: FarmPlan) -> Painting:
        """Return the painting of a plan before anything is painted."""
        ground = Ground.draw(land.stream(plan.seed, "ground"), plan.shape)
        return cls(plan, ground, Canvas(plan.shape, plan.materials))

    def drawn(self) -> Drawn:
        """Return abundances (y, x, material), summing to 1 with the missing light as shade, and main classes (y, x)."""
        canvas, light = self.canvas, self.ground.light
        materials, classes = (one.reshape(*canvas.shape, -1) for one in (canvas.materials, canvas.classes))
        labels = np.empty(canvas.shape, np.uint8)
        for rows in cuts(canvas.shape[0], land.ROWS_AT_ONCE):
            materials[rows] *= light[rows, :, None]
            materials[rows, :, self.plan.materials.index("shade")] += 1 - light[rows]
            materials[rows] /= materials[rows].sum(axis=2, keepdims=True)
            labels[rows] = classes[rows].argmax(axis=2)
        return materials, labels


def blend(lower: Mixture, upper: Mixture, cover: Field) -> Mixture:
    """Lay ``upper`` with ``cover`` over ``lower``."""
    mixed = {name: part * (1 - cover) for name, part in lower.items()}
    for name, part in upper.items():
        mixed[name] = mixed.get(name, np.float32(0)) + part * cover
    return mixed


@dataclass(frozen=True)
class Tramlines:
    """Pairs of wheel marks: ``gauge`` apart and ``width`` wide, every ``spacing``, from ``shift`` on [px]."""

    spacing: float
    gauge: float
    width: float
    shift: float

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Tramlines:
        """Draw the wheel marks of a field."""
        return cls(rng.uniform(130, 180), rng.uniform(14, 17), rng.uniform(2.2, 3.2), rng.uniform(0, 180))


@dataclass(frozen=True)
class FieldPlan:
    """One field. Rows lie where y cos a - x sin a + phase is a multiple of the period, a the angle from x towards y."""

    parcel: Parcel
    use: str
    row_angle_deg: float
    row_period_px: float
    row_phase_px: float
    headland_px: float
    tramlines: Tramlines | None
    late_days: float
    gap_rate: float  # fraction of the row's pieces that did not come up
    lodging: float  # fraction of the field that lies in the end
    weeds: float  # plants per 1000 px
    wetter: float  # water in the topsoil against the farm's, by volume

    @property
    def crop(self) -> Crop | None:
        """Return what is sown; None on grass, fallow and old stubble."""
        return land.CROPS.get(self.use)

    def land_on(self, day: int) -> Land:
        """Return what the field is on a day."""
        return land.land_on(self.use, day, self.late_days)

    def materials_on(self, day: int) -> set[str]:
        """Return spectra of the crop that may stand on the field on a day."""
        crop = self.crop
        state = self.land_on(day)
        if crop is None or state.phase != "crop":
            return set()
        ages = np.linspace(state.days - land.UNEVEN_DAYS, state.days + land.UNEVEN_DAYS, 37)
        names = set(land.stage_fractions(crop, ages))
        if self.use in TWINS:
            if self.lodging * land.lodged_fraction(day) > 0:
                names |= {f"{self.use}_lodged", f"{self.use}_lodged_ripe"}
            names |= {name.replace(self.use, TWINS[self.use]) for name in names}
        return names


@dataclass(frozen=True)
class FarmPlan:
    """The farm of a seed and shape, with the day of the year and the hour (true solar time) it is looked at."""

    seed: int
    shape: tuple[int, int]
    day: int
    hour: float
    sun: Sun
    fields: tuple[FieldPlan, ...]
    borders: tuple[tuple[Border, str], ...]

    @cached_property
    def moisture(self) -> float:
        """Return the water in the topsoil by volume, 0.05 (dry) to 0.38, before it varies over the farm.

        It follows an antecedent precipitation index, P + k P', with k 0.85 in July and 0.95 in January. Rain falls on
        32 % of the days of a year of this seed, 5 mm each on average.
        """
        rng = land.stream(self.seed, "rain")
        rain = np.where(rng.uniform(size=land.YEAR_DAYS) < 0.32, rng.exponential(5.0, land.YEAR_DAYS), 0.0)
        index = 0.0
        for date in range(self.day - 120, self.day + 1):
            kept = 0.90 + 0.05 * np.cos(2 * np.pi * (date - 15) / land.YEAR_DAYS)
            index = kept * index + rain[date % land.YEAR_DAYS]
        return float(0.05 + 0.33 * (1 - np.exp(-index / 26.0)))

    @cached_property
    def materials(self) -> tuple[str, ...]:
        """Return spectra that the scene mixes, in the order of its planes: those that the day can show."""
        there = {"soil_dry", "soil_wet", "gravel", "water", "straw", "straw_grey", "grass_green", "grass_dry", "shade"}
        there |= {"weed_leafy", "weed_red", "volunteer", "blossom"}
        there |= {name for name, fraction in land.foliage(self.day).items() if fraction > 0}
        there = there.union(*(one.materials_on(self.day) for one in self.fields))
        return tuple(name for name in MATERIALS if name in there)

    def soil(self, here: Ground, wetter: float) -> Mixture:
        """Return bare soil with its water; clods throw longer shadows under a lower sun, up to a third of the pixel."""
        # by volume in the topsoil; the exponential law of [3] in `spectra` has one exponent for all bands
        moisture = np.clip(self.moisture + wetter + 0.035 * here.moisture + 0.008 * here.tuft, 0.02, 0.45)
        wet = np.asarray(1 - np.exp(-MOISTURE_EXPONENT * moisture), np.float32)
        low = min(float(np.hypot(*self.sun.cast)), 3.0)
        shade = np.asarray(np.clip(low * (0.07 + 0.04 * here.grain + 0.01 * here.tuft), 0, 0.33), np.float32)
        return {"soil_dry": (1 - wet) * (1 - shade), "soil_wet": wet * (1 - shade), "shade": shade}


def farm_plan(seed: int, shape: tuple[int, int] = (1024, 1280), *, day: int = 172, hour: float = 11.0) -> FarmPlan:
    """Plan the farm: no pixel is drawn.

    Raises SceneError: a negative seed, an empty shape, a day that is not 1 to 366, or the sun below 5 degrees.
    """
    whole = land_of(seed, shape)
    sun = land.sun_over_farm(day, hour)
    parcels, borders = land.divide_land(land.stream(seed, "land"), whole, PARCEL_AREA_PX)
    uses = land.allot(land.stream(seed, "use"), [land.visible_area(parcel, shape) for parcel in parcels], USE_FRACTIONS)
    kinds = land.allot(land.stream(seed, "borders"), [border.length for border in borders], BORDER_FRACTIONS)
    fields = tuple(
        plan_field(land.stream(seed, f"field {number}"), parcel, use)
        for number, (parcel, use) in enumerate(zip(parcels, uses, strict=True))
    )
    return FarmPlan(seed, shape, day, hour, sun, fields, tuple(zip(borders, kinds, strict=True)))


def land_of(seed: int, shape: tuple[int, int]) -> Parcel:
    """Return the land about a scene: 80 px more each way, and at least 640. Refuse a bad seed or shape (SceneError)."""
    if seed < 0 or min(shape) < 1:
        raise SceneError(f"the farm needs a seed >= 0 and a shape of at least 1 x 1 px, got seed {seed}, shape {shape}")
    return land.rectangle(max(shape[0] + 80, 640), max(shape[1] + 80, 640))


def plan_field(rng: np.random.Generator, parcel: Parcel, use: str) -> FieldPlan:
    """Draw how a field is kept. Rows run along its longest side, up to 3 degrees off."""
    crop = land.CROPS.get(use)
    sides = np.roll(parcel.corners, -1, axis=0) - parcel.corners
    dy, dx = sides[np.hypot(sides[:, 0], sides[:, 1]).argmax()]
    period = rng.uniform(*(_ROWS_ELSEWHERE[use] if crop is None else crop.row_px))
    trams = Tramlines.draw(rng)
    tram_chance = {"soil": 0.3}.get(use, 0.0) if crop is None else crop.tram_chance
    return FieldPlan(
        parcel=parcel,
        use=use,
        row_angle_deg=float((np.degrees(np.arctan2(dy, dx)) + rng.uniform(-3, 3)) % 180),
        row_period_px=float(period),
        row_phase_px=float(rng.uniform(0, period)),
        headland_px=float(rng.uniform(18, 34)),
        tramlines=trams if rng.uniform() < tram_chance else None,
        late_days=float(rng.uniform(-6, 6)),
        gap_rate=float(rng.uniform(0.005, 0.06)),
        lodging=float(max(0.0, rng.uniform(-0.3, 1)) * crop.lodging) if crop else 0.0,
        weeds=float(np.exp(rng.uniform(*np.log(_WEEDS_ELSEWHERE[use] if crop is None else crop.weeds)))),
        wetter=float(rng.normal(0, 0.025)),
    )
