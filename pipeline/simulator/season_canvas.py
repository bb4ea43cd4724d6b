"""What ``farm@2`` is painted on: abundances of the day's materials and shares of the classes, pixel by pixel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.simulator.farm_fields import CLASSES, Ground, Mixture
from pipeline.simulator.farm_layout import Field
from pipeline.simulator.farm_plan import FarmPlan
from pipeline.simulator.season_spectra import wet_share


class SeasonCanvas:
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
class Work:
    """All that painting needs: the plan, what varies over the land, and the canvas."""

    plan: FarmPlan
    ground: Ground
    canvas: SeasonCanvas


def moist_soil(plan: FarmPlan, here: Ground, wetter: float = 0.0) -> Mixture:
    """Bare soil with its water; clods throw longer shadows under a lower sun, up to a third of the pixel."""
    water = plan.moisture + wetter + 0.035 * here.moisture + 0.008 * here.tuft
    wet = wet_share(np.clip(water, 0.02, 0.45))
    low = min(float(np.hypot(*plan.sun.cast)), 3.0)
    rough = low * (0.07 + 0.04 * here.grain + 0.01 * here.tuft)
    shade = np.asarray(np.clip(rough, 0, 0.33), np.float32)
    return {"soil_dry": (1 - wet) * (1 - shade), "soil_wet": wet * (1 - shade), "shade": shade}
