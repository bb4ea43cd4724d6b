"""What the farm is painted on: abundances of the day's materials and shares of classes; surfaces that lie anywhere."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.simulator.scenes.farm.farm_plan import FarmPlan
from pipeline.simulator.scenes.farm.land import Field, smooth_noise
from pipeline.simulator.scenes.farm.spectra import wet_share

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
CLASSES, CLASS_COLOURS = tuple(_COLOURS), np.array(list(_COLOURS.values()), np.uint8)

Mixture = dict[str, Field]


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
    """Abundances (pixel, material) and class shares (pixel, class); both grow to a sum of 1 per pixel.

    The pixels of an ``index`` are unique, as everywhere on the farm.
    """

    def __init__(self, shape: tuple[int, int], materials: tuple[str, ...]) -> None:
        self.shape = shape
        self._column = {name: number for number, name in enumerate(materials)}
        self.materials = np.zeros((shape[0] * shape[1], len(materials)), np.float32)
        self.classes = np.zeros((shape[0] * shape[1], len(CLASSES)), np.float32)

    def add(self, index: NDArray[np.intp], cover: Field, mixture: Mixture, shares: Mixture) -> None:
        """Lay a surface beside what is there."""
        for name, part in mixture.items():
            self.materials[index, self._column[name]] += cover * part
        for name, part in shares.items():
            self.classes[index, CLASSES.index(name)] += cover * part

    def over(self, index: NDArray[np.intp], cover: Field, mixture: Mixture, label: str | None) -> None:
        """Lay a surface over what is there; without a label it hides nothing from a farmer (shade)."""
        self.materials[index] *= (1 - cover)[:, None]
        if label is not None:
            self.classes[index] *= (1 - cover)[:, None]
        self.add(index, cover, mixture, {} if label is None else {label: np.ones_like(cover)})

    def dim(self, light: Field) -> None:
        """Replace 1 - ``light`` (y, x) of every pixel by shade."""
        self.materials *= light.reshape(-1, 1)
        self.materials[:, self._column["shade"]] += 1 - light.ravel()

    def drawn(self) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """Abundances (y, x, material), summing to 1, and the class that covers most of each pixel (y, x)."""
        self.materials /= self.materials.sum(axis=1, keepdims=True)
        labels = self.classes.argmax(axis=1).astype(np.uint8)
        return self.materials.reshape(*self.shape, -1), labels.reshape(self.shape)


@dataclass(frozen=True)
class Painting:
    """All that painting needs: the plan, what varies over the land, and the canvas."""

    plan: FarmPlan
    ground: Ground
    canvas: Canvas


def moist_soil(plan: FarmPlan, here: Ground, wetter: float = 0.0) -> Mixture:
    """Bare soil with its water; clods throw longer shadows under a lower sun, up to a third of the pixel."""
    water = plan.moisture + wetter + 0.035 * here.moisture + 0.008 * here.tuft
    wet = wet_share(np.clip(water, 0.02, 0.45))
    low = min(float(np.hypot(*plan.sun.cast)), 3.0)
    rough = low * (0.07 + 0.04 * here.grain + 0.01 * here.tuft)
    shade = np.asarray(np.clip(rough, 0, 0.33), np.float32)
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
