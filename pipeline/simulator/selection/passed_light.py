"""The probe of light that has passed gains and blurs: by how much these multiply errors, and what spectra they give it.

Light S that gains multiply by g has an error of g times as many electrons, over a unit that is another one as well: the
noise of g S. With sigma(S)^2 = S + n, g sigma(S) / sigma(g S) grows with g; so the greatest gains count for errors made
elsewhere, and the least of its own for a gain that is left out. Blurs and shifts of each band's own colour edges: light
changes over wavelength where the scene's does not.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.simulator.effects.blurs import airy_gaussians
from pipeline.simulator.effects.gain_range import GainRange, second_difference, steepest_difference
from pipeline.simulator.effects.light_units import fixed_variance, unit_electrons
from pipeline.simulator.effects.probe import Probe
from pipeline.simulator.optics.kernel_fit import Moments
from pipeline.simulator.optics.rays import normals_met
from pipeline.simulator.rig_model import Rig

Floats = NDArray[np.float64]
# Half of the integrals of |s dG/ds| and |s^2 d^2G/ds^2| for either axis, and, for both, of 2 |s^2 d^2G/ds dx|.
_PER_LOG, _PER_LOG_TWICE, _PER_LOG_AND_PX = 0.5, 1.1, 2.3
FINEST_PER_PX = 8.0  # derivatives along the image grow by no more per order: they are differences a quarter px apart


@dataclass(frozen=True)
class Growth:
    """By how much gains multiply an error, with the unit that follows the light."""

    probe: Probe
    rig: Rig

    def of_errors(self, gain: float) -> float:
        """Give the most that gains up to ``gain``, 1 or more, multiply an error made elsewhere."""
        return gain * self.unit_ratio(gain)

    def of_gain(self, own: GainRange | None, others: float) -> float:
        """Give the most that the other gains, and its own light, multiply the error of a gain that is left out."""
        if own is None:
            return self.of_errors(others)
        low, high = float(own.least.min(initial=1.0)), float(own.greatest.max(initial=1.0))
        off = max(abs(high - 1), abs(low - 1))
        if off == 0:
            return self.of_errors(others)
        ends = ((abs(end - 1) / off * self.unit_ratio(end * others)) for end in (low, high))
        return others * max(ends)

    def unit_ratio(self, gain: float) -> float:
        """Give the most that a unit is over the one that light multiplied by ``gain`` has."""
        if self.probe.unit == "dn" or self.rig.detector.noiseless:
            return 1.0
        fixed = fixed_variance(self.rig)
        ends = (max(self.probe.darkest_e, 0.0), max(self.probe.brightest_e, 0.0))
        return max(math.sqrt((light + fixed) / (gain * light + fixed)) for light in ends)


def light_after(probe: Probe, ranges: Iterable[GainRange], rig: Rig) -> Probe:
    """Give the probe of light after some gains, their greatest factors taken off: those are for `Growth`.

    By Leibniz' rule for differences, (g I)' <= g I' + g' I and (g I)'' <= g I'' + 2 g' I' + g'' I; where light is
    added, its own. What does not shrink with the light counts by the unit of the darkest.
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
    ratio = Growth(probe, rig).unit_ratio(float(least.min()))
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
    """Give the probe of light that has passed blurs (their exact variants), with the spectral differences they make.

    A kernel of shift s and variance v makes I(x + s) blurred, whose derivative over wavelength is s' I_x + v' I_xx / 2
    beside the scene's own (the heat equation in v), and its second one s'' I_x + v'' I_xx / 2 + (s' + v' d/dx / 2)^2
    I_xx. At a step or a point, where I_xx has no end, v' I_xx / 2 is at most I_x times the change of the width.

    Diffraction is a sum of Gaussians whose widths grow with the wavelength. What a wide one shows hardly depends on I_x
    any more: its derivatives over the width's logarithm are at most certain parts of the span, whatever the image.
    """
    passed = list(blurs)
    if not passed or len(probe.wavelength_nm) < 2:
        return probe
    steep, bend = np.zeros((2, *probe.slope.shape))
    for normal in normals_met(probe.sweeps, rig.camera):
        first, second = _differences(probe, rig, passed, normal)
        steep, bend = np.maximum(steep, first), np.maximum(bend, second)
    return replace(
        probe,
        spectral_slope=probe.spectral_slope + steep.sum(axis=0),
        spectral_curvature=probe.spectral_curvature + bend.sum(axis=0),
    )


def _differences(probe: Probe, rig: Rig, blurs: list[Any], normal: Floats) -> tuple[Floats, Floats]:
    """Greatest first and second differences over wavelength, (2, band) each for either axis of the image."""
    nm = np.asarray(probe.wavelength_nm, np.float64)
    blurred = Moments.together([blur.moments(rig, nm, blur.variants[0], normal) for blur in blurs], len(nm))
    steep, bend = np.zeros((2, *probe.slope.shape))
    shares, widths = np.ones(1), np.zeros((1, *blurred.variance.shape))
    if blurred.waves is not None:  # diffraction is a sum of Gaussians
        shares, sizes = airy_gaussians()
        widths = sizes[:, None, None] * blurred.waves
    for share, waves in zip(shares.tolist(), widths, strict=True):
        first, second = _by_gaussian(probe, nm, blurred.shift, blurred.variance + waves**2, waves)
        steep, bend = steep + share * first, bend + share * second
    return steep, bend


def _by_gaussian(probe: Probe, nm: Floats, shift: Floats, variance: Floats, width: Floats) -> tuple[Floats, Floats]:
    """Greatest differences through Gaussians of a shift and variance in each band, (2, band) each.

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
