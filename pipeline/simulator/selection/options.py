"""Options of the decision: for every effect, off and each variant with its error and cost.

A bound is the change of a stored number in units of its noise (or in DN). If a drawn displacement or gain moves the
light (jitter, turbulence, wind), it is on the change with the same draws. If the draw is the noise itself (shot, read,
dark), the total variation between the distributions of a number with and without it counts. Noise that changes it by
``t`` counts ``2 t`` deviations, as much as a change that could be detected as often. Total variation is a metric and no
later stage increases it: so all bounds may be summed.

Kernels that are not negative and sum to 1 have gain 1 at most, readout none. Gains of light (vignetting, drift, ...)
multiply the errors of all other effects in the light, each by its own greatest factor, and change the unit. With
sigma(S)^2 = S + n, g sigma(S) / sigma(g S) grows with g. So the greatest gains count for errors made elsewhere, and the
least of its own for a gain that is left out. Blurs and shifts of each band's own colour edges: light then changes over
wavelength where the scene's does not.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from spectralzoom.pipeline.errors import SettingsError
from spectralzoom.pipeline.simulator.effects.effect import OFF, Effect
from spectralzoom.pipeline.simulator.effects.probe import GainRange, Probe, fixed_variance, rising_gaps
from spectralzoom.pipeline.simulator.rig_model import Rig

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

    @property
    def name(self) -> str:
        return self.effect.name

    @property
    def exact(self) -> Option:
        return self.variants[0]


def acts_on_light(effect: Effect) -> bool:
    """Return whether it comes before the readout: what it changes, later gains multiply."""
    return effect.name in LIGHT_EFFECTS or any(hasattr(effect, action) for action in LINEAR_ACTIONS)


def list_options(probes: Probe | Sequence[Probe], rig: Rig, effects: Sequence[Effect]) -> tuple[Menu, ...]:
    """Ask every effect for the bounds of its options, by the worst probe (one for each exposure), in its unit.

    Raises SettingsError: a bound is negative or not a number; names it.
    """
    some = [probes] if isinstance(probes, Probe) else probes
    each = [_options_of(probe, rig.taking(probe.sweeps[0]) if probe.sweeps else rig, effects) for probe in some]

    def worst(options: Iterable[Option]) -> Option:
        return max(options, key=lambda option: option.error)

    return tuple(
        Menu(
            menus[0].effect,
            tuple(map(worst, zip(*(menu.variants for menu in menus), strict=True))),
            worst(menu.off for menu in menus),
            any(menu.present for menu in menus),
        )
        for menus in zip(*each, strict=True)
    )


def _options_of(probe: Probe, rig: Rig, effects: Sequence[Effect]) -> list[Menu]:
    present = [_is_present(effect, probe, rig) for effect in effects]
    ranges: list[GainRange | None] = [
        effect.gain_range(probe, rig) if there and hasattr(effect, "gain_range") else None
        for effect, there in zip(effects, present, strict=True)
    ]
    blurs = [effect for effect, there in zip(effects, present, strict=True) if there and hasattr(effect, "moments")]
    blurred = math.fsum(blur.bound(probe, rig).value for blur in blurs)
    menus: list[Menu] = []
    for place, effect in enumerate(effects):
        arriving = probe
        if hasattr(effect, "change") or hasattr(effect, "gain"):
            arriving = light_after(probe, rig, [one for one in ranges[:place] if one is not None], blurred)
        elif not acts_on_light(effect):
            arriving = light_read(probe, rig, [one for one in ranges if one is not None])
        growth = 1.0
        if acts_on_light(effect):
            apart = [one for one in ranges[:place] + ranges[place + 1 :] if one is not None]
            greatest = [np.maximum(one.greatest, 1.0) for one in apart]
            others = float(np.prod(greatest, axis=0).max(initial=1.0)) if greatest else 1.0
            growth = error_growth(probe, rig, ranges[place], others)
        menus.append(_menu(effect, arriving, rig, present[place], growth))
    return menus


def _menu(effect: Effect, probe: Probe, rig: Rig, present: bool, gain: float) -> Menu:
    def option(variant: str) -> Option:
        """Bound and price one variant of the effect, or its absence."""
        bound = effect.bound(probe, rig, variant)
        if not bound.value >= 0:  # refuses NaN
            raise SettingsError(
                f"effect {effect.name}, {variant}: its bound is {bound.value}, expected 0 or more ({bound.why});"
                " check the rig's numbers and the scene for values that are not finite"
            )
        error = bound.value * gain * SAFETY if bound.value else 0.0
        cost_ns = 0.0 if variant == OFF else max(effect.cost_ns[variant], LEAST_COST_NS)
        return Option(variant, error, cost_ns, bound.why)

    exact = replace(option(effect.variants[0]), error=0.0, why="exact")
    return Menu(effect, (exact, *map(option, effect.variants[1:])), option(OFF), present)


def _is_present(effect: Effect, probe: Probe, rig: Rig) -> bool:
    ones = np.ones(len(probe.wavelength_nm))
    both = np.ones((2, len(probe.wavelength_nm)))
    loud = replace(
        probe,
        level=ones,
        span=ones,
        slope=both,
        curvature=both,
        spectral_slope=ones,
        brightest_e=max(probe.brightest_e, rig.camera.full_scale_e),
        slit_errors={},
    )
    return effect.name in ALWAYS_ON or max(effect.bound(one, rig, OFF).value for one in (loud, probe)) > 0


def error_growth(probe: Probe, rig: Rig, own: GainRange | None, others: float) -> float:
    """Return the most that gains multiply an error, with the unit that follows the light.

    ``others`` is the greatest product of the other gains, 1 or more; ``own`` is the range of an effect's own gain.
    """
    low, high = (1.0, 1.0) if own is None else (float(own.least.min(initial=1.0)), float(own.greatest.max(initial=1.0)))
    off = max(abs(high - 1), abs(low - 1))
    if off == 0:
        return others * unit_ratio(probe, rig, others)
    return others * max(abs(end - 1) / off * unit_ratio(probe, rig, end * others) for end in (low, high))


def unit_ratio(probe: Probe, rig: Rig, gain: float) -> float:
    """Return the most that a unit is over the one that light multiplied by ``gain`` has."""
    if probe.unit == "dn" or rig.detector.noiseless:
        return 1.0
    fixed = fixed_variance(rig.camera)
    ends = (max(probe.darkest_e, 0.0), max(probe.brightest_e, 0.0))
    return max(math.sqrt((light + fixed) / (gain * light + fixed)) for light in ends)


def light_after(probe: Probe, rig: Rig, gains: Sequence[GainRange], blurred: float = 0.0) -> Probe:
    """Return the probe of light after some gains, their greatest factors taken off: those are for `error_growth`.

    Light that the factor does not reduce counts by the unit of the darkest. ``blurred`` is the most that blurs changed
    in any band before. Differences over wavelength grow by what two bands may be changed apart. Blurs do so, and added
    light, and factors that are not the same in all bands.
    """
    least = np.ones(len(probe.wavelength_nm))
    kept = 1.0
    for one in gains:
        least = least * np.minimum(one.least, 1.0)
        if np.ptp(one.least) > 0 or np.ptp(one.greatest) > 0:
            kept *= float((one.least / np.maximum(one.greatest, 1.0)).min())
    added = sum((one.added_e for one in gains), np.zeros(len(probe.wavelength_nm)))
    ratio = unit_ratio(probe, rig, float(least.min(initial=1.0)))
    unit_e = probe.unit_least_dn * rig.camera.electrons_per_dn / ratio
    apart = float((2 * blurred + ratio * (1 - kept) * probe.level + added / unit_e).max(initial=0.0))
    gaps = rising_gaps(probe.wavelength_nm)
    follows = probe.unit == "sigma" and not rig.detector.noiseless
    own_e = np.sqrt(np.maximum(added, 0.0) + fixed_variance(rig.camera)) if follows else unit_e
    return replace(
        probe,
        level=probe.level + added / own_e,
        spectral_slope=probe.spectral_slope + (apart / gaps.min() if gaps.size else 0.0),
        brightest_e=probe.brightest_e + float(added.max(initial=0.0)),
        darkest_e=probe.darkest_e * max(1 - sum(one.uneven for one in gains), 0.0),
        unit_least_dn=probe.unit_least_dn / ratio,
    )


def light_read(probe: Probe, rig: Rig, gains: Sequence[GainRange]) -> Probe:
    """Return the probe of light after all gains, which the readout gets: by their greatest product, or by the least."""
    greatest = math.prod(float(np.maximum(one.greatest, 1.0).max(initial=1.0)) for one in gains)
    after = light_after(probe, rig, gains)
    return replace(
        after,
        level=after.level * error_growth(probe, rig, None, greatest),
        brightest_e=after.brightest_e * greatest,
        darkest_e=probe.darkest_e * math.prod(float(np.minimum(one.least, 1.0).min(initial=1.0)) for one in gains),
    )
