"""What leaving out an effect, or a variant of it, changes beside all others, held against what the decision counts."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from pipeline.simulator.effects.effect import OFF, Effect, Radiance, SweepBlock
from pipeline.simulator.effects.probe import noise_electrons
from pipeline.simulator.render import EFFECTS, READOUT, expected_light
from pipeline.simulator.selection.options import SAFETY, Menu, list_options
from pipeline.simulator.selection.verification import (
    ROUNDING,
    TAILS_PX,
    contrast_about,
    misplaced_electrons,
    misplaced_fraction,
    tails_fraction,
)
from tests.pipeline.simulator.random_cases import Case

DRAWN = frozenset({"jitter", "turbulence"})  # one survey of 1000 may go beyond their bounds
IN_THE_LIGHT: tuple[Effect, ...] = tuple(effect for effect in EFFECTS if effect not in READOUT)


@dataclass(frozen=True)
class Trial:
    """``bound`` is the composed one, with gains of other effects and without `SAFETY`; all in sigma as stored.

    ``unexplained`` is the most that is left of the change at any number without what arithmetic may misplace there.
    """

    effect: str
    variant: str
    binning: int
    bound: float
    measured: float
    unexplained: float
    rounding: float

    @property
    def is_broken(self) -> bool:
        """Whether the change exceeds what the decision counts."""
        return not self.unexplained <= self.bound * SAFETY

    @property
    def looseness(self) -> float:
        """Bound over measured change; NaN where rounding hides the change."""
        return self.bound / self.measured if self.measured > 10 * self.rounding else np.nan


@dataclass(frozen=True)
class _Stored:
    """A case as it is stored in sums of so many samples: what is decided of it, and its noise."""

    binning: int
    menus: tuple[Menu, ...]
    noise: list[Radiance]  # of each block with everything on, of the sums (line, number, band) [e-]
    contrast: list[Radiance]  # of the scene about each sum (1, number, band) [e-]
    rounding: float

    def change(
        self, light: list[Radiance], full: list[Radiance], fraction: float, tails: list[Radiance]
    ) -> tuple[float, float]:
        """Greatest change of a stored number in its own sigmas, and what of it arithmetic does not explain."""
        most, left = 0.0, 0.0
        every = zip(light, full, self.noise, self.contrast, tails, strict=True)
        for one, other, noise, contrast, tail in every:
            change = np.abs(_summed(one - other, self.binning))
            misplaced = misplaced_electrons(_summed(other, self.binning), contrast, fraction)
            misplaced = misplaced + _summed(tail, self.binning)
            most = max(most, float((change / noise).max()))
            left = max(left, float(((change - misplaced) / noise).max()))
        return most, left


@dataclass(frozen=True)
class _Afar:
    """What lies far about the samples of a block; only looked at where tails differ."""

    block: SweepBlock
    render: Callable[..., Radiance]

    @cached_property
    def contrast(self) -> Radiance:
        return np.asarray(contrast_about(self.block, self.render, TAILS_PX))

    def of(self, fraction: Radiance) -> Radiance:
        """What tails misplace at each sample, (1, sample, band) [e-]."""
        return (
            fraction * self.contrast if fraction.any() else np.zeros((1, self.block.rig.camera.samples, len(fraction)))
        )


def trials(case: Case, binnings: Sequence[int] = (1,), only: str = "") -> Iterator[Trial]:
    """Leave out every effect that the rig has, and take each variant, beside all others exact.

    Changes are over the noise of every stored number of all sweeps, with everything on; draws are paired. The same
    light is stored in each of the ``binnings``. ``only`` names the one effect that is tried, where it is not every one.
    """
    probes = [case.stored_in_sums_of(binning).probe() for binning in binnings]
    menus = [list_options(probe, case.rig, IN_THE_LIGHT) for probe in probes]
    present = [menu for menu in menus[0] if menu.present]
    exact: dict[Effect, str] = {menu.effect: menu.exact.variant for menu in present}
    blocks = case.blocks(probes[0])
    full = [expected_light(case.scene, block, exact) for block in blocks]
    render = partial(expected_light, case.scene)
    contrast = [np.asarray(contrast_about(block, render)) for block in blocks]
    afar = [_Afar(block, render) for block in blocks]
    stored = [_stored(full, contrast, case, binning, found) for binning, found in zip(binnings, menus, strict=True)]
    for menu in (one for one in present if only in ("", one.name)):
        for variant in (OFF, *(option.variant for option in menu.variants[1:])):
            chosen = {effect: variant if effect is menu.effect else way for effect, way in exact.items()}
            light = [_light(case, block, chosen) for block in blocks]
            shown = {one: way for one, way in chosen.items() if way != OFF}
            fraction = max(misplaced_fraction(block, exact, shown) for block in blocks)
            tails = [far.of(tails_fraction(block, exact, shown)) for block, far in zip(blocks, afar, strict=True)]
            for one in stored:
                bound = _error(one.menus, menu.name, variant) / SAFETY
                yield Trial(
                    menu.name, variant, one.binning, bound, *one.change(light, full, fraction, tails), one.rounding
                )


def _stored(
    full: list[Radiance], contrast: list[Radiance], case: Case, binning: int, menus: tuple[Menu, ...]
) -> _Stored:
    noise = [np.sqrt(_summed(np.square(noise_electrons(light, case.rig)), binning)) for light in full]
    sums = [_summed(np.abs(light), binning) for light in full]
    level = max(float((light / one).max()) for light, one in zip(sums, noise, strict=True))
    return _Stored(binning, menus, noise, [_summed(one, binning) for one in contrast], ROUNDING * level)


def _summed(values: Radiance, binning: int) -> Radiance:
    """Sums of neighbouring samples, a remainder dropped."""
    count = values.shape[1] // binning
    sums: Radiance = values[:, : count * binning].reshape(len(values), count, binning, -1).sum(axis=2)
    return sums


def _error(menus: tuple[Menu, ...], name: str, variant: str) -> float:
    menu = next(one for one in menus if one.name == name)
    return next(option.error for option in (menu.off, *menu.variants) if option.variant == variant)


def _light(case: Case, block: SweepBlock, chosen: dict[Effect, str]) -> Radiance:
    return expected_light(case.scene, block, {effect: way for effect, way in chosen.items() if way != OFF})
