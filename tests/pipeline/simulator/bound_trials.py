"""Trials that compare the change from leaving out or approximating an effect with the bound of the decision."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pytest
import scipy

from pipeline.simulator.effects.effect import OFF, Effect, Radiance
from pipeline.simulator.effects.line import SLIT, SMEAR
from pipeline.simulator.effects.probe import noise_electrons
from pipeline.simulator.optics.scene_radiance import TABULATED
from pipeline.simulator.render import EFFECTS, READOUT, expected_light
from pipeline.simulator.selection.options import SAFETY, Menu, list_options
from tests.pipeline.simulator.random_cases import Case
from tests.pipeline.simulator.small_scenes import leave_slit_unmeasured

ROUNDING = 4e-6  # times the brightest light of the lines: float32 sums
KERNELS = 4e-3  # times the light's range: difference of two sets of kernels that are fitted to the same blurs
REACH_PX = 16  # along a line: numerical errors displace light at most this far
IN_THE_LIGHT: tuple[Effect, ...] = tuple(effect for effect in EFFECTS if effect not in READOUT)
BY_FOOTPRINT = frozenset({"slit", "rotation"})  # bounded by the changes between variants of the slit
OTHERS = frozenset(effect.name for effect in IN_THE_LIGHT) - BY_FOOTPRINT


@dataclass(frozen=True)
class Trial:
    """Result for an effect or variant; ``bound`` has gains of other effects but not `SAFETY`. All in sigma as stored.

    ``unexplained`` is the greatest change at any number, minus the light that numerical errors may displace there.
    """

    effect: str
    variant: str
    binning: int
    bound: float
    measured: float
    unexplained: float

    @property
    def is_broken(self) -> bool:
        """Return whether the change exceeds the bound that the decision counts."""
        return not self.unexplained <= self.bound * SAFETY


@dataclass(frozen=True)
class _Stored:
    """A case that is stored in sums of ``binning`` samples: its options and its noise."""

    binning: int
    menus: tuple[Menu, ...]
    noise: list[Radiance]  # of each block with everything on, of the sums (line, number, band) [e-]
    contrast: list[Radiance]  # range of light around each sample, summed (1, number, band) [e-]

    def change(self, light: list[Radiance], full: list[Radiance], fraction: float) -> tuple[float, float]:
        """Return the greatest change of a stored number in its own sigmas, and the greatest beyond numerical errors."""
        most, left = 0.0, 0.0
        for one, other, noise, contrast in zip(light, full, self.noise, self.contrast, strict=True):
            change = np.abs(_summed(one - other, self.binning))
            misplaced = fraction * contrast + self.binning * ROUNDING * float(np.abs(other).max())
            most = max(most, float((change / noise).max()))
            left = max(left, float(((change - misplaced) / noise).max()))
        return most, left


def trials(case: Case, binnings: Sequence[int] = (1,), only: Collection[str] = ()) -> Iterator[Trial]:
    """Yield trials without each effect of the rig and with each of its variants, with all other effects exact.

    Changes are over the noise of every stored number of all sweeps, with everything on; draws are paired. The same
    light is stored in each of the ``binnings``. ``only`` limits the trials to some effects.
    """
    with pytest.MonkeyPatch.context() as patch:
        if only and BY_FOOTPRINT.isdisjoint(only):
            leave_slit_unmeasured(patch)
        probes = [case.stored_in_sums_of(binning).probe() for binning in binnings]
    menus = [list_options(probe, case.rig, IN_THE_LIGHT) for probe in probes]
    present = [menu for menu in menus[0] if menu.present]
    exact: dict[Effect, str] = {menu.effect: menu.exact.variant for menu in present}
    blocks = case.blocks(probes[0])
    full = [expected_light(case.scene, block, exact) for block in blocks]
    stored = [_stored(full, case, binning, found) for binning, found in zip(binnings, menus, strict=True)]
    for menu in (one for one in present if not only or one.name in only):
        for variant in (OFF, *(option.variant for option in menu.variants[1:])):
            chosen = {effect: variant if effect is menu.effect else way for effect, way in exact.items()}
            shown = {one: way for one, way in chosen.items() if way != OFF}
            light = [expected_light(case.scene, block, shown) for block in blocks]
            fraction = misplaced_fraction(exact, shown)
            for one in stored:
                own = next(each for each in one.menus if each.name == menu.name)
                error = next(option.error for option in (own.off, *own.variants) if option.variant == variant)
                changes = one.change(light, full, fraction)
                yield Trial(menu.name, variant, one.binning, error / SAFETY, *changes)


def _stored(full: list[Radiance], case: Case, binning: int, menus: tuple[Menu, ...]) -> _Stored:
    noise = [np.sqrt(_summed(np.square(noise_electrons(light, case.rig)), binning)) for light in full]
    contrast = [_summed(_range_about(light), binning) for light in full]
    return _Stored(binning, menus, noise, contrast)


def _range_about(light: Radiance) -> Radiance:
    """Return the range of light within `REACH_PX` of each sample, over all lines, (1, sample, band) [e-]."""
    most, least = light.max(axis=0), light.min(axis=0)
    size = 2 * REACH_PX + 1
    high = scipy.ndimage.maximum_filter1d(most, size, axis=0, mode="nearest")
    return np.asarray((high - scipy.ndimage.minimum_filter1d(least, size, axis=0, mode="nearest"))[None])


def _summed(values: Radiance, binning: int) -> Radiance:
    """Return sums of neighbouring samples; a remainder is dropped."""
    count = values.shape[1] // binning
    sums: Radiance = values[:, : count * binning].reshape(len(values), count, binning, -1).sum(axis=2)
    return sums


def misplaced_fraction(exact: Mapping[Effect, str], chosen: Mapping[Effect, str]) -> float:
    """Return the fraction of the light's range by which numerical errors may make two renderings differ.

    Tables of weights displace up to `TABULATED` along either axis, in either image. Kernels fitted to all bands differ
    as well, if blurs or held positions do.
    """
    return 2 * TABULATED + (0.0 if _folded(exact) == _folded(chosen) else KERNELS)


def _folded(ways: Mapping[Effect, str]) -> dict[str, str]:
    blurs = {one.name: way for one, way in ways.items() if hasattr(one, "moments") or one.name == SMEAR.name}
    return blurs | {one.name: "box" for one in ways if one.name == SLIT.name}
