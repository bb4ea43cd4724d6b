"""What leaving out an effect, or a variant of it, changes beside all others, held against what the decision counts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pipeline.simulator.block import Block
from pipeline.simulator.effects.effect import OFF, Effect, Light
from pipeline.simulator.effects.registry import EFFECTS, READOUT
from pipeline.simulator.options import SAFETY, Menu, list_options
from pipeline.simulator.render import expected_light
from pipeline.simulator.survey_probe import noise_electrons
from tests.pipeline.simulator.random_cases import Case

ROUNDING = 4e-6  # of the light over the unit: sums of float32 in another order
DRAWN = frozenset({"jitter", "turbulence"})  # one survey of 1000 may go beyond their bounds
IN_THE_LIGHT: tuple[Effect, ...] = tuple(effect for effect in EFFECTS if effect not in READOUT)


@dataclass(frozen=True)
class Trial:
    """``bound`` is the composed one, with gains of other effects and without `SAFETY`; both in sigma."""

    effect: str
    variant: str
    bound: float
    measured: float
    rounding: float

    @property
    def is_broken(self) -> bool:
        """Whether the change exceeds what the decision counts."""
        return not self.measured <= self.bound * SAFETY + self.rounding

    @property
    def looseness(self) -> float:
        """Bound over measured change; NaN where rounding hides the change."""
        return self.bound / self.measured if self.measured > 10 * self.rounding else np.nan


def trials(case: Case) -> Iterator[Trial]:
    """Leave out every effect that the rig has, and take each variant, beside all others exact.

    Changes are over the noise at every sample of all sweeps, with everything on; draws are paired.
    """
    probe = case.probe()
    menus = [menu for menu in list_options(probe, case.rig, IN_THE_LIGHT) if menu.present]
    exact: dict[Effect, str] = {menu.effect: menu.exact.variant for menu in menus}
    blocks = case.blocks(probe)
    full = [expected_light(case.scene, block, exact) for block in blocks]
    units = [noise_electrons(light, case.rig) for light in full]
    rounding = ROUNDING * max(float((np.abs(light) / unit).max()) for light, unit in zip(full, units, strict=True))
    for menu, variant, error in _options(menus):
        chosen = {effect: variant if effect is menu.effect else way for effect, way in exact.items()}
        changes = (
            np.abs(_light(case, block, chosen) - light) / unit
            for block, light, unit in zip(blocks, full, units, strict=True)
        )
        yield Trial(menu.name, variant, error / SAFETY, max(float(change.max()) for change in changes), rounding)


def _options(menus: list[Menu]) -> Iterator[tuple[Menu, str, float]]:
    for menu in menus:
        yield menu, OFF, menu.off.error
        for option in menu.variants[1:]:
            yield menu, option.variant, option.error


def _light(case: Case, block: Block, chosen: dict[Effect, str]) -> Light:
    return expected_light(case.scene, block, {effect: way for effect, way in chosen.items() if way != OFF})
