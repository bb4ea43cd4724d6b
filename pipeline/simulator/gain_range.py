"""What the gains of a chain make of light and of errors: by how much they multiply, and what spectra they give it.

Light S that gains multiply by g has an error of g times as many electrons, over a unit that is another one as well: the
noise of g S. With sigma(S)^2 = S + n, g sigma(S) / sigma(g S) grows with g; so the greatest gains count for errors made
elsewhere, and the least of its own for a gain that is left out.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeline.simulator.band_differences import second_difference, steepest_difference
from pipeline.simulator.probe import Probe
from pipeline.simulator.rig_model import Rig

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class GainRange:
    """Factors of light that a gain has anywhere in a survey, (band,) each.

    ``uneven`` is the greatest difference of two factors within one line. ``steepest`` and ``bend`` are the greatest
    first and second differences of the factor over wavelength; ``added_e`` is light that is added, with differences
    of its own.
    """

    least: Floats
    greatest: Floats
    uneven: float
    steepest: Floats  # [1/nm]
    bend: Floats  # [1/nm^2]
    added_e: Floats
    added_steepest: Floats  # [e-/nm]
    added_bend: Floats  # [e-/nm^2]

    @staticmethod
    def between(least: float, greatest: float, bands: int, *, uneven: float = 0.0) -> GainRange:
        """The same in all bands."""
        no = np.zeros(bands)
        return GainRange(np.full(bands, least), np.full(bands, greatest), uneven, no, no, no, no, no)

    @staticmethod
    def of(factors: Floats, wavelength_nm: Floats, *, uneven: float, added_e: Floats | None = None) -> GainRange:
        """Those of (state, band) factors that stand for all that there are, with (state, band) light added."""
        added = np.zeros((1, factors.shape[1])) if added_e is None else added_e
        return GainRange(
            factors.min(axis=0), factors.max(axis=0), uneven, *_differences(factors, wavelength_nm),
            added.max(axis=0), *_differences(added, wavelength_nm),
        )  # fmt: skip


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


def fixed_variance(rig: Rig) -> float:
    """Give the variance of read noise and quantisation, which light does not change. [e-^2]"""
    camera = rig.camera
    return camera.read_noise_e**2 + camera.electrons_per_dn**2 / 12


def unit_electrons(light_e: Floats, probe: Probe, rig: Rig) -> Floats:
    """Give the unit of the probe at some light [e-]; what does not follow the light is the smallest unit met."""
    if probe.unit == "sigma" and not rig.detector.noiseless:
        return np.sqrt((np.maximum(light_e, 0.0) + fixed_variance(rig)) / probe.binning)
    return np.full_like(light_e, probe.unit_least_dn * rig.camera.electrons_per_dn)


def lights_within(probe: Probe, rig: Rig) -> tuple[Floats, Floats]:
    """Give least and greatest light of every band, (band,) each [e-]: where level and span have their units from.

    With U(S)^2 = (S + n) / m for means of m samples, the greatest S has level S / U(S), and the least a difference of
    span U to it, or a smaller.
    """
    if probe.unit != "sigma" or rig.detector.noiseless:
        unit = unit_electrons(probe.level, probe, rig)
        high, way = probe.level * unit, probe.span * unit
    else:
        fixed, level, span = fixed_variance(rig), probe.level**2 / probe.binning, probe.span**2 / probe.binning
        high = (level + np.sqrt(level * (level + 4 * fixed))) / 2
        way = (np.sqrt(span * (span + 4 * (high + fixed))) - span) / 2
    return np.maximum(high - way, probe.darkest_e), high


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


def _differences(factors: Floats, wavelength_nm: Floats) -> tuple[Floats, Floats]:
    nm = np.asarray(wavelength_nm, np.float64)
    if len(nm) < 2:
        return np.zeros(len(nm)), np.zeros(len(nm))
    bent: Floats = np.abs(second_difference(factors, nm)).max(axis=0)  # type: ignore[arg-type]
    steep: Floats = steepest_difference(factors, nm).max(axis=0)  # type: ignore[arg-type]
    return steep, bent
