"""What the decision chooses from: for every effect, off and each variant with its error and cost.

One currency. A bound is the change of a sample in units of the noise at it (or in DN). Effects that draw enter the same
sum in two ways. Where a drawn displacement or gain moves the light (jitter, turbulence, wind), the bound is on the
change with the same draws: it is as certain as any other. Where the draw is the noise itself (shot, read, dark), a
paired change says nothing about later decisions; what matters is the total variation between the distributions of a
sample with and without. A change by ``d`` noise deviations has a total variation of at most ``d / 2``, so noise that
changes it by ``t`` counts ``2 t`` deviations. Total variation is a metric and no later stage increases it: the sum of
all bounds is then twice a bound on how much more often than not one sample could tell the image from the exact one.

Composition. Kernels that are not negative and sum to 1 have gain 1 at most, readout none. Gains of light (vignetting,
drift, ...) multiply the errors of all other linear effects; each is at most 1 + its own bound on light of level 1.
Catmull-Rom's 1.5625 would multiply errors made in the scene's pixels: no effect is so early.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.errors import SettingsError
from pipeline.simulator.effects.effect import OFF, Bound, Effect
from pipeline.simulator.probe import Probe
from pipeline.simulator.rig_model import Rig

SAFETY = 1.2  # maxima are read off a sample of the scene, derivatives off differences
LEAST_COST_NS = 1e-3  # nothing that is computed is free: of two that bound alike, the one without cost stays on longer
ALWAYS_ON = frozenset({"quantisation", "saturation"})  # raw lines are whole numbers of few bits
LINEAR_ACTIONS = ("aim", "displaced", "moments", "gain", "change")


@dataclass(frozen=True)
class Option:
    """One way to treat an effect. ``error`` is what it takes of the tolerance: bound times gains times `SAFETY`."""

    variant: str
    error: float
    cost_ns: float
    why: str


@dataclass(frozen=True)
class Menu:
    """All options of one effect: variants from exact to cheap, and off. ``present``: the rig has the effect."""

    effect: Effect
    variants: tuple[Option, ...]
    off: Option
    present: bool

    @property
    def name(self) -> str:
        """Of the effect."""
        return self.effect.name

    @property
    def exact(self) -> Option:
        """The exact variant."""
        return self.variants[0]

    def cheapest_within(self, error: float) -> Option:
        """Give the cheapest variant, never off, whose own error is no more than this."""
        return min((option for option in self.variants if option.error <= error), key=_by_cost, default=self.exact)


def list_options(probe: Probe, rig: Rig, effects: Sequence[Effect]) -> tuple[Menu, ...]:
    """Ask every effect for the bounds of its options; errors are in the unit of the probe.

    Raises
    ------
    SettingsError : two effects have one name, or a bound is negative or not a number; names it.
    """
    _check_names(effects)
    present = {effect.name: _is_present(effect, probe, rig) for effect in effects}
    growth = {effect.name: _greatest_gain(effect, probe, rig) if present[effect.name] else 1.0 for effect in effects}
    return tuple(_menu(effect, probe, rig, present[effect.name], _gain_of_others(effect, growth)) for effect in effects)


def _menu(effect: Effect, probe: Probe, rig: Rig, present: bool, gain: float) -> Menu:
    def option(variant: str) -> Option:
        bound = _checked_bound(effect, probe, rig, variant)
        error = bound.value * gain * SAFETY if bound.value else 0.0
        return Option(variant, error, _cost_ns(effect, variant), bound.why)

    exact = Option(effect.variants[0], 0.0, _cost_ns(effect, effect.variants[0]), "exact")
    return Menu(effect, (exact, *map(option, effect.variants[1:])), option(OFF), present)


def _cost_ns(effect: Effect, variant: str) -> float:
    return 0.0 if variant == OFF else max(effect.cost_ns[variant], LEAST_COST_NS)


def _checked_bound(effect: Effect, probe: Probe, rig: Rig, variant: str) -> Bound:
    bound = effect.bound(probe, rig, variant)
    if not bound.value >= 0:  # refuses NaN
        raise SettingsError(
            f"effect {effect.name}, {variant}: its bound is {bound.value}, expected 0 or more ({bound.why});"
            " check the rig's numbers and the scene for values that are not finite"
        )
    return bound


def _check_names(effects: Iterable[Effect]) -> None:
    seen: set[str] = set()
    for effect in effects:
        if effect.name in seen:
            raise SettingsError(f"two effects are named {effect.name!r}; register each once")
        seen.add(effect.name)


def _is_present(effect: Effect, probe: Probe, rig: Rig) -> bool:
    """Whether the rig has the effect: leaving it out would change a scene that shows everything."""
    ones = np.ones(len(probe.wavelength_nm))
    loud = replace(
        probe, level=ones, spread=ones, span=ones, spectral_slope=ones, spectral_curvature=ones,
        slope=np.ones((2, len(ones))), curvature=np.ones((2, len(ones))),
        brightest_e=max(probe.brightest_e, rig.camera.full_well_e), slit_errors={},
    )  # fmt: skip
    shown = max(effect.bound(loud, rig, OFF).value, effect.bound(probe, rig, OFF).value)
    return effect.name in ALWAYS_ON or shown > 0


def _greatest_gain(effect: Effect, probe: Probe, rig: Rig) -> float:
    """By how much an effect can multiply light, at most: 1 and its bound on light of level 1 without detail."""
    if not hasattr(effect, "gain"):
        return 1.0
    nothing, ones = np.zeros(len(probe.wavelength_nm)), np.ones(len(probe.wavelength_nm))
    even = replace(
        probe, level=ones, spread=ones, span=ones, spectral_slope=nothing, spectral_curvature=nothing,
        slope=np.zeros((2, len(ones))), curvature=np.zeros((2, len(ones))), unit_least_dn=1.0,
    )  # fmt: skip
    return 1.0 + effect.bound(even, rig, OFF).value


def _gain_of_others(effect: Effect, growth: Mapping[str, float]) -> float:
    if not any(hasattr(effect, action) for action in LINEAR_ACTIONS):
        return 1.0
    return math.prod(sorted(gain for name, gain in growth.items() if name != effect.name))  # sorted: order of no matter


def _by_cost(option: Option) -> tuple[float, float, str]:
    return option.cost_ns, option.error, option.variant
