"""Options of the decision: for every effect, off and each variant with its error and cost.

A bound is the change of a stored number in units of its noise (or in DN), at the worst binning of the survey. If a
drawn displacement or gain moves the light (jitter, turbulence, wind), it is on the change with the same draws. If the
draw is the noise itself (shot, read, dark), the total variation between the distributions of a number with and without
it counts. Noise that changes it by ``t`` counts ``2 t`` deviations, as much as a change that could be detected as
often. Total variation is a metric and no later stage increases it: so all bounds may be summed.

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
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SettingsError
from pipeline.simulator.effects.blurs import airy_gaussians
from pipeline.simulator.effects.effect import OFF, Effect
from pipeline.simulator.effects.probe import (
    GainRange,
    Probe,
    fixed_variance,
    second_difference,
    steepest_difference,
    unit_electrons,
)
from pipeline.simulator.optics.kernel_fit import Moments
from pipeline.simulator.optics.rays import extreme_normals
from pipeline.simulator.rig_model import Rig

SAFETY = 1.2  # maxima are read off a sample of the scene, derivatives off differences
LEAST_COST_NS = 1e-3  # nothing that is computed is free: of two that bound alike, the one without cost stays on longer
ALWAYS_ON = frozenset({"quantisation", "saturation"})  # raw lines are whole numbers of few bits
LINEAR_ACTIONS = ("aim", "displaced", "moments", "gain", "change")
LIGHT_EFFECTS = frozenset({"slit", "smear", "rotation"})  # that the renderer itself does
Floats = NDArray[np.float64]
# Half of the integrals of |s dG/ds| and |s^2 d^2G/ds^2| for either axis, and, for both, of 2 |s^2 d^2G/ds dx|.
_PER_LOG, _PER_LOG_TWICE, _PER_LOG_AND_PX = 0.5, 1.1, 2.3
FINEST_PER_PX = 8.0  # derivatives along the image grow by at most this per order: differences a quarter px apart


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
    """Ask every effect for the bounds of its options; errors are in the unit of the probes.

    Every option has the error of the worst probe; a survey has one for each binning and exposure.

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
    ranges = [_gain_range(one, probe, rig) if there else None for one, there in zip(effects, present, strict=True)]
    blurs = [effect for effect, there in zip(effects, present, strict=True) if there and hasattr(effect, "moments")]
    through = light_through(probe, rig, blurs)
    menus = []
    for place, effect in enumerate(effects):
        arriving = probe
        if hasattr(effect, "change") or hasattr(effect, "gain"):
            arriving = light_after(through, [one for one in ranges[:place] if one is not None], rig)
        growth = 1.0
        if acts_on_light(effect):
            beside = ranges[:place] + ranges[place + 1 :]
            greatest = [np.maximum(one.greatest, 1.0) for one in beside if one is not None]
            others = float(np.prod(greatest, axis=0).max(initial=1.0)) if greatest else 1.0
            growth = error_growth(probe, rig, ranges[place], others)
        menus.append(_menu(effect, arriving, rig, present[place], growth))
    return menus


def _menu(effect: Effect, probe: Probe, rig: Rig, present: bool, gain: float) -> Menu:
    def option(variant: str) -> Option:
        """Bound and price one variant of the effect, or its absence; SettingsError: a bound that is no number."""
        bound = effect.bound(probe, rig, variant)
        if not bound.value >= 0:  # refuses NaN
            raise SettingsError(
                f"effect {effect.name}, {variant}: its bound is {bound.value}, expected 0 or more ({bound.why});"
                " check the rig's numbers and the scene for values that are not finite"
            )
        error = bound.value * gain * SAFETY if bound.value else 0.0
        why = bound.why if probe.binning == 1 or not error else f"{bound.why}, in sums of {probe.binning} samples"
        return Option(variant, error, 0.0 if variant == OFF else max(effect.cost_ns[variant], LEAST_COST_NS), why)

    exact = replace(option(effect.variants[0]), error=0.0, why="exact")
    return Menu(effect, (exact, *map(option, effect.variants[1:])), option(OFF), present)


def _is_present(effect: Effect, probe: Probe, rig: Rig) -> bool:
    bright = max(probe.brightest_e, rig.camera.full_scale_e)
    loud = replace(_even_probe(probe, 1.0), brightest_e=bright, slit_errors={})
    greatest = max(effect.bound(loud, rig, OFF).value, effect.bound(probe, rig, OFF).value)
    return effect.name in ALWAYS_ON or greatest > 0


def _even_probe(probe: Probe, derivatives: float) -> Probe:
    """Return the probe of a scene of level 1 and the same derivatives in every band."""
    ones, both = np.ones(len(probe.wavelength_nm)), np.full((2, len(probe.wavelength_nm)), derivatives)
    seen = replace(probe, own_e=None, level=ones, spread=ones, span=ones, slope=both, curvature=both)
    return replace(seen, spectral_slope=both[0], spectral_curvature=both[1])


def _gain_range(effect: Effect, probe: Probe, rig: Rig) -> GainRange | None:
    """Return the range of an effect's gain; where a gain does not say, 1 more or less its bound on level 1."""
    if hasattr(effect, "gain_range"):
        stated: GainRange = effect.gain_range(probe, rig)
        return stated
    if not hasattr(effect, "gain"):
        return None
    off = effect.bound(replace(_even_probe(probe, 0.0), unit_least_dn=1.0), rig, OFF).value
    return GainRange.between(max(1 - off, 0.0), 1 + off, len(probe.wavelength_nm), uneven=2 * off)


def error_growth(probe: Probe, rig: Rig, own: GainRange | None, others: float) -> float:
    """Return the most that gains multiply an error, with the unit that follows the light.

    ``others`` is the greatest product of the other gains, 1 or more. ``own`` is the range of an effect's own gain: its
    error is made in light without it.
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
    fixed = fixed_variance(rig)
    ends = (max(probe.darkest_e, 0.0), max(probe.brightest_e, 0.0))
    return max(math.sqrt((light + fixed) / (gain * light + fixed)) for light in ends)


def light_after(probe: Probe, ranges: Iterable[GainRange], rig: Rig) -> Probe:
    """Return the probe of light after some gains, their greatest factors taken off: those are for `error_growth`.

    Leibniz' rule for differences gives (g I)' <= g I' + g' I and (g I)'' <= g I'' + 2 g' I' + g'' I. Added light has
    its own differences. Light that the factor does not reduce counts by the unit of the darkest.
    """
    passed = list(ranges)
    if not passed:
        return probe
    bands = len(probe.wavelength_nm)
    least, steep, bend = np.ones(bands), np.zeros(bands), np.zeros(bands)
    added, added_steep, added_bend = np.zeros(bands), np.zeros(bands), np.zeros(bands)
    uneven = 0.0
    for one in passed:
        most = np.maximum(one.greatest, 1.0)
        bend = bend + one.bend / most + 2 * steep * one.steepest / most
        steep = steep + one.steepest / most
        least = least * np.minimum(one.least, 1.0)
        uneven += one.uneven
        added_bend = added_bend + 2 * added_steep * one.steepest + added * one.bend + one.added_bend
        added_steep = added_steep + added * one.steepest + one.added_steepest
        added = added + one.added_e
    ratio = unit_ratio(probe, rig, float(least.min()))
    unit_e = probe.unit_least_dn * rig.camera.electrons_per_dn / ratio
    follows = probe.unit == "sigma" and not rig.detector.noiseless
    return replace(
        probe,
        level=probe.level + added / (unit_electrons(added, probe, rig) if follows else unit_e),
        spectral_slope=probe.spectral_slope + ratio * probe.level * steep + added_steep / unit_e,
        spectral_curvature=probe.spectral_curvature
        + 2 * ratio * steep * probe.spectral_slope
        + ratio * probe.level * bend
        + added_bend / unit_e,
        spread=probe.spread + min(uneven, 1.0) * ratio * (probe.level + probe.spread) + added / unit_e,
        brightest_e=probe.brightest_e + float(added.max(initial=0.0)),
        darkest_e=probe.darkest_e * max(1 - uneven, 0.0),
        unit_least_dn=probe.unit_least_dn / ratio,
    )


def light_through(probe: Probe, rig: Rig, blurs: Iterable[Any]) -> Probe:
    """Return the probe of light that has passed blurs (their exact variants), with the spectral differences they make.

    A kernel of shift s and variance v makes I(x + s) blurred. Its derivative over wavelength is s' I_x + v' I_xx / 2,
    beside the scene's own. Its second one is s'' I_x + v'' I_xx / 2 + (s' + v' d/dx / 2)^2 I_xx. At a step v' I_xx / 2
    is at most I_x times the change of the width. Diffraction is a sum of Gaussians whose widths grow with the
    wavelength. The derivatives of a wide one over the width's logarithm are at most certain parts of the span.
    """
    passed = list(blurs)
    if not passed or len(probe.wavelength_nm) < 2:
        return probe
    steep, bend = np.zeros((2, *probe.slope.shape))
    for normal in extreme_normals(probe.sweeps, rig.camera):
        first, second = _differences(probe, rig, passed, normal)
        steep, bend = np.maximum(steep, first), np.maximum(bend, second)
    return replace(
        probe,
        spectral_slope=probe.spectral_slope + steep.sum(axis=0),
        spectral_curvature=probe.spectral_curvature + bend.sum(axis=0),
    )


def _differences(probe: Probe, rig: Rig, blurs: list[Any], normal: Floats) -> tuple[Floats, Floats]:
    """Return the greatest first and second differences over wavelength, (2, band) each for either axis of the image."""
    nm = np.asarray(probe.wavelength_nm, np.float64)
    blurred = Moments.together([blur.moments(rig, nm, blur.variants[0], normal) for blur in blurs], len(nm))
    steep, bend = np.zeros((2, *probe.slope.shape))
    fractions, widths = np.ones(1), np.zeros((1, *blurred.variance.shape))
    if blurred.waves is not None:  # diffraction is a sum of Gaussians
        fractions, sizes = airy_gaussians()
        widths = sizes[:, None, None] * blurred.waves
    for fraction, waves in zip(fractions.tolist(), widths, strict=True):
        first, second = _by_gaussian(probe, nm, blurred.shift, blurred.variance + waves**2, waves)
        steep, bend = steep + fraction * first, bend + fraction * second
    return steep, bend


def _by_gaussian(probe: Probe, nm: Floats, shift: Floats, variance: Floats, width: Floats) -> tuple[Floats, Floats]:
    """Return the greatest differences through Gaussians of a shift and variance in each band, (2, band) each.

    ``width`` (2, band) is the part of it that grows in proportion to the wavelength.
    """
    moved, spread, wider = (steepest_difference(values, nm) for values in (shift, variance, np.sqrt(variance)))
    shift_bend, spread_bend = (np.abs(second_difference(values, nm)) for values in (shift, variance))
    steep = probe.slope * moved + np.minimum(probe.curvature * spread / 2, probe.slope * wider)
    turned = spread_bend / 2 + (moved + spread * FINEST_PER_PX / 2) ** 2
    bend = probe.slope * shift_bend + probe.curvature * turned
    if not width.any():
        return steep, bend
    grown = steepest_difference(width, nm) / width
    by_span = probe.slope * moved + _PER_LOG * probe.span * grown
    across = probe.slope * shift_bend + probe.curvature * moved**2
    bend_by_span = across + probe.span * grown * (_PER_LOG_AND_PX * moved / width + _PER_LOG_TWICE * grown)
    return np.minimum(steep, by_span), np.minimum(bend, bend_by_span)
