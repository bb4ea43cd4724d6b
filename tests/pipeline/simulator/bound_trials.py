"""Trials that compare the change from leaving out or approximating an effect with the bound of the decision."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import pytest
import scipy

from spectralzoom.pipeline.simulator.effects.counting import READOUT
from spectralzoom.pipeline.simulator.effects.effect import OFF, Effect, Radiance
from spectralzoom.pipeline.simulator.effects.line import SLIT, SMEAR
from spectralzoom.pipeline.simulator.effects.probe import noise_electrons
from spectralzoom.pipeline.simulator.optics.kernel_fit import TABULATED
from spectralzoom.pipeline.simulator.render import EFFECTS, expected_light
from spectralzoom.pipeline.simulator.rig_model import Rig
from spectralzoom.pipeline.simulator.selection.options import SAFETY, list_options
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
    """Result for an effect or variant; ``bound`` has gains of other effects but not `SAFETY`. All in sigma.

    ``unexplained`` is the greatest change at any number, minus the light that numerical errors may displace there.
    """

    effect: str
    variant: str
    bound: float
    measured: float
    unexplained: float

    @property
    def is_broken(self) -> bool:
        """Return whether the change exceeds the bound that the decision counts."""
        return not self.unexplained <= self.bound * SAFETY


def trials(case: Case, only: Collection[str] = ()) -> Iterator[Trial]:
    """Yield trials without each effect of the rig and with each of its variants, with all other effects exact.

    Changes are over the noise of every number of all sweeps, with everything on; draws are paired. ``only`` limits the
    trials to some effects.
    """
    with pytest.MonkeyPatch.context() as patch:
        if only and BY_FOOTPRINT.isdisjoint(only):
            leave_slit_unmeasured(patch)
        probe = case.probe()
    present = [menu for menu in list_options(probe, case.rig, IN_THE_LIGHT) if menu.present]
    exact: dict[Effect, str] = {menu.effect: menu.exact.variant for menu in present}
    blocks = case.blocks(probe)
    full = [expected_light(case.scene, block, exact) for block in blocks]
    for menu in (one for one in present if not only or one.name in only):
        for option in (menu.off, *menu.variants[1:]):
            chosen = {effect: option.variant if effect is menu.effect else way for effect, way in exact.items()}
            shown = {one: way for one, way in chosen.items() if way != OFF}
            light = [expected_light(case.scene, block, shown) for block in blocks]
            changes = _changes(light, full, case.rig, misplaced_fraction(exact, shown))
            yield Trial(menu.name, option.variant, option.error / SAFETY, *changes)


def _changes(light: list[Radiance], full: list[Radiance], rig: Rig, fraction: float) -> tuple[float, float]:
    """Return the greatest change of a number in its own sigmas, and the greatest beyond numerical errors."""
    most, left = 0.0, 0.0
    for one, other in zip(light, full, strict=True):
        noise = noise_electrons(other, rig)
        change = np.abs(one - other)
        misplaced = fraction * _range_about(other) + ROUNDING * float(np.abs(other).max())
        most = max(most, float((change / noise).max()))
        left = max(left, float(((change - misplaced) / noise).max()))
    return most, left


def _range_about(light: Radiance) -> Radiance:
    """Return the range of light within `REACH_PX` of each sample, over all lines, (1, sample, band) [e-]."""
    most, least = light.max(axis=0), light.min(axis=0)
    size = 2 * REACH_PX + 1
    high = scipy.ndimage.maximum_filter1d(most, size, axis=0, mode="nearest")
    return np.asarray((high - scipy.ndimage.minimum_filter1d(least, size, axis=0, mode="nearest"))[None])


def misplaced_fraction(exact: Mapping[Effect, str], chosen: Mapping[Effect, str]) -> float:
    """Return the fraction of the light's range by which numerical errors may make two renderings differ.

    Tables of weights displace up to `TABULATED` along either axis, in either image. Kernels fitted to all bands differ
    as well, if blurs or held positions do.
    """
    return 2 * TABULATED + (0.0 if _folded(exact) == _folded(chosen) else KERNELS)


def _folded(ways: Mapping[Effect, str]) -> dict[str, str]:
    blurs = {one.name: way for one, way in ways.items() if hasattr(one, "moments") or one.name == SMEAR.name}
    return blurs | {one.name: "box" for one in ways if one.name == SLIT.name}
