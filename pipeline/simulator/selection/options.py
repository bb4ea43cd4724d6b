"""What the decision chooses from: for every effect, off and each variant with its error and cost.

One currency. A bound is the change of a stored number in units of its noise (or in DN), at the worst binning of the
survey. Effects that draw enter the same sum in two ways. Where a drawn displacement or gain moves the light (jitter,
turbulence, wind), the bound is on the change with the same draws: it is as certain as any other. Where the draw is the
noise itself (shot, read, dark), a paired change says nothing about later decisions; what matters is the total variation
between the distributions of a number with and without. A change by ``d`` noise deviations has a total variation of at
most ``d / 2``, so noise that changes it by ``t`` counts ``2 t`` deviations. Total variation is a metric and no later
stage increases it: the sum of all bounds is then twice a bound on how much more often than not one number could tell
the image from the exact one. Noise of samples that are summed grows as their sum's does: its deviations stay.

Composition. Kernels that are not negative and sum to 1 have gain 1 at most, readout none. Gains of light (vignetting,
drift, ...) multiply the errors of all other effects in the light, each by its own greatest factor, and change the unit:
see `passed_light`. Gains and changes are asked for their bounds with the light that earlier gains leave and add.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.errors import SettingsError
from pipeline.simulator.effects.effect import OFF, Bound, Effect, Merged
from pipeline.simulator.effects.gain_range import GainRange
from pipeline.simulator.effects.probe import Probe
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.selection.passed_light import Growth, light_after, light_through

SAFETY = 1.2  # maxima are read off a sample of the scene, derivatives off differences
LEAST_COST_NS = 1e-3  # nothing that is computed is free: of two that bound alike, the one without cost stays on longer
ALWAYS_ON = frozenset({"quantisation", "saturation"})  # raw lines are whole numbers of few bits
LINEAR_ACTIONS = ("aim", "displaced", "moments", "gain", "change")
LIGHT_EFFECTS = frozenset({"slit", "smear", "rotation"})  # that the renderer itself does


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
    merged: Merged | None = None

    @property
    def name(self) -> str:
        """Of the effect."""
        return self.effect.name

    @property
    def exact(self) -> Option:
        """The exact variant."""
        return self.variants[0]

    def cost_beside(self, option: Option, others: Mapping[str, Option]) -> float:
        """Give what an option costs beside those taken for other effects, by name [ns]: draws may be shared."""
        one = self.merged
        if one is None or option.variant == OFF or one.other not in others or others[one.other].variant != one.variant:
            return option.cost_ns
        return max(one.cost_ns, LEAST_COST_NS)

    def cheapest_within(self, error: float) -> Option:
        """Give the cheapest variant, never off, whose own error is no more than this."""
        return min((option for option in self.variants if option.error <= error), key=_by_cost, default=self.exact)


def acts_on_light(effect: Effect) -> bool:
    """Whether it comes before the readout: what it changes, later gains multiply."""
    return effect.name in LIGHT_EFFECTS or any(hasattr(effect, action) for action in LINEAR_ACTIONS)


def list_options(probes: Probe | Sequence[Probe], rig: Rig, effects: Sequence[Effect]) -> tuple[Menu, ...]:
    """Ask every effect for the bounds of its options; errors are in the unit of the probes.

    Of several probes, one for each binning of a survey, every option has the error of the worst.

    Raises
    ------
    SettingsError : two effects have one name, or a bound is negative or not a number; names it.
    """
    _check_names(effects)
    each = [_options_of(probe, rig, effects) for probe in ([probes] if isinstance(probes, Probe) else probes)]
    return tuple(_worst_of(menus) for menus in zip(*each, strict=True))


def _worst_of(menus: Sequence[Menu]) -> Menu:
    """Join one effect's menus of several probes; what it costs they have in common."""

    def worst(options: Iterable[Option]) -> Option:
        return max(options, key=lambda option: option.error)

    variants = zip(*(menu.variants for menu in menus), strict=True)
    return replace(
        menus[0],
        variants=tuple(map(worst, variants)),
        off=worst(menu.off for menu in menus),
        present=any(menu.present for menu in menus),
    )


def _options_of(probe: Probe, rig: Rig, effects: Sequence[Effect]) -> tuple[Menu, ...]:
    present = [_is_present(effect, probe, rig) for effect in effects]
    ranges = [_gain_range(one, probe, rig) if there else None for one, there in zip(effects, present, strict=True)]
    growth = Growth(probe, rig)
    blurs = [effect for effect, there in zip(effects, present, strict=True) if there and hasattr(effect, "moments")]
    through = light_through(probe, rig, blurs)
    menus = []
    for place, effect in enumerate(effects):
        arriving = probe
        if hasattr(effect, "change") or hasattr(effect, "gain"):
            arriving = light_after(through, [one for one in ranges[:place] if one is not None], rig)
        gain = _gain_beside(effect, ranges, place, growth)
        menus.append(_menu(effect, arriving, rig, present[place], gain))
    return tuple(menus)


def _menu(effect: Effect, probe: Probe, rig: Rig, present: bool, gain: float) -> Menu:
    costs = effect.cost_at(probe, rig) if hasattr(effect, "cost_at") else effect.cost_ns

    def option(variant: str) -> Option:
        bound = _checked_bound(effect, probe, rig, variant)
        error = bound.value * gain * SAFETY if bound.value else 0.0
        why = bound.why if probe.binning == 1 or not error else f"{bound.why}, in sums of {probe.binning} samples"
        return Option(variant, error, _cost_ns(costs, variant), why)

    exact = Option(effect.variants[0], 0.0, _cost_ns(costs, effect.variants[0]), "exact")
    merged: Merged | None = effect.merged(rig) if hasattr(effect, "merged") else None
    return Menu(effect, (exact, *map(option, effect.variants[1:])), option(OFF), present, merged)


def _cost_ns(costs: Mapping[str, float], variant: str) -> float:
    return 0.0 if variant == OFF else max(costs[variant], LEAST_COST_NS)


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
    bright = max(probe.brightest_e, rig.camera.full_well_e)
    loud = replace(_even_probe(probe, 1.0), brightest_e=bright, slit_errors={})
    shown = max(effect.bound(loud, rig, OFF).value, effect.bound(probe, rig, OFF).value)
    return effect.name in ALWAYS_ON or shown > 0


def _even_probe(probe: Probe, derivatives: float) -> Probe:
    """The probe of a scene of level 1 and the same derivatives in every band."""
    ones, both = np.ones(len(probe.wavelength_nm)), np.full((2, len(probe.wavelength_nm)), derivatives)
    seen = replace(probe, level=ones, spread=ones, span=ones, slope=both, curvature=both)
    return replace(seen, spectral_slope=both[0], spectral_curvature=both[1])


def _gain_range(effect: Effect, probe: Probe, rig: Rig) -> GainRange | None:
    """By what an effect multiplies light; where a gain does not say, 1 more or less its bound on level 1."""
    if hasattr(effect, "gain_range"):
        stated: GainRange = effect.gain_range(probe, rig)
        return stated
    if not hasattr(effect, "gain"):
        return None
    off = effect.bound(replace(_even_probe(probe, 0.0), unit_least_dn=1.0), rig, OFF).value
    return GainRange.between(max(1 - off, 0.0), 1 + off, len(probe.wavelength_nm), uneven=2 * off)


def _gain_beside(effect: Effect, ranges: Sequence[GainRange | None], place: int, growth: Growth) -> float:
    """By what all others multiply the error of an effect."""
    if not acts_on_light(effect):
        return 1.0
    beside = [one for other, one in enumerate(ranges) if one is not None and other != place]
    greatest = [np.maximum(one.greatest, 1.0) for one in beside]
    others = float(np.prod(greatest, axis=0).max(initial=1.0)) if greatest else 1.0
    return growth.of_gain(ranges[place], others)


def cost_of(menus: Iterable[Menu], options: Mapping[str, Option]) -> float:
    """Give what options, one for each menu by its name, cost together per px and band [ns]."""
    return math.fsum(menu.cost_beside(options[menu.name], options) for menu in menus)


def _by_cost(option: Option) -> tuple[float, float, str]:
    return option.cost_ns, option.error, option.variant
