"""Absorption along the path: water vapour about 720, 820 and 940 nm, oxygen at 690 and 760 nm.

References
----------
.. [1] Bird and Riordan, "Simple solar spectral model for direct and diffuse irradiance on horizontal and tilted
   planes at the earth's surface for cloudless atmospheres", TR-215-2436, 1984, equations 2-8 and 2-11 with the
   constant 118.3 of its published program. doi:10.2172/5986936
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from pipeline.simulator.block import SweepBlock
from pipeline.simulator.effects.effect import OFF, Bound, Light
from pipeline.simulator.effects.sight import has_relief, reach_m, sample_distances, spoken_reach
from pipeline.simulator.gain_range import GainRange
from pipeline.simulator.probe import Probe
from pipeline.simulator.rig_model import Rig

Floats = NDArray[np.float64]
RANGE, UNIFORM = "range", "uniform"
# Rows: wavelength [nm], coefficient of [1]; straight between, 0 outside. About 5 nm fine at oxygen A, 10 nm elsewhere.
WATER = np.array([
    (570.0, 0.0), (593.0, 0.075), (610.0, 0.0), (667.6, 0.0), (690.0, 0.016), (710.0, 0.0125), (718.0, 1.8),
    (724.4, 2.5), (740.0, 0.061), (752.5, 0.0008), (780.0, 0.0006), (800.0, 0.036), (816.0, 1.6), (823.7, 2.5),
    (831.5, 0.5), (840.0, 0.155), (860.0, 1e-5), (880.0, 0.0026), (905.0, 7.0), (915.0, 5.0), (925.0, 5.0),
    (930.0, 27.0), (937.0, 55.0), (948.0, 45.0), (965.0, 4.0), (980.0, 1.48), (993.5, 0.1), (1040.0, 1e-5),
])  # fmt: skip
OXYGEN = np.array([
    (667.6, 0.0), (690.0, 0.15), (710.0, 0.0), (757.5, 0.0), (762.5, 4.0), (767.5, 0.35), (780.0, 0.0),
])  # fmt: skip
AIR_MASS_M = 8434.0  # air at the ground that holds as much as the whole atmosphere above it: standard, 15 deg C
_LOOKS = 9  # distances at which the spectrum's course is taken for the bounds of others: it is smooth
_KNOTS = 65  # distances, evenly in the logarithm, between which the transmission is taken as straight in it
_QUADRATURE = np.linspace(-2.0, 2.0, 33)  # over a band, in standard deviations of its Gaussian


@dataclass(frozen=True)
class Absorption:
    """Share of the light that gases leave over a distance, averaged over the width of a band.

    The band model of [1] for whole atmospheres, taken to paths of metres (assumed: no source for these at 6 nm).
    ``range`` takes each sample's own distance, ``uniform`` the middle of nearest and farthest.
    """

    name = "absorption"
    variants = (RANGE, UNIFORM)
    cost_ns = MappingProxyType({RANGE: 2.7, UNIFORM: 0.2})  # of a scene with relief

    def cost_at(self, probe: Probe, rig: Rig) -> Mapping[str, float]:
        """Give the cost for the scene's relief: without any, samples share one distance."""
        return self.cost_ns if has_relief(rig) else dict.fromkeys(self.variants, self.cost_ns[UNIFORM])

    def bound(self, probe: Probe, rig: Rig, variant: str = OFF) -> Bound:
        """Bound by level times the share that gases take, or that a variant misses."""
        reach = reach_m(rig)
        if reach is None:
            return Bound(0.0, "the scene has no distance")
        if variant == RANGE or (variant == UNIFORM and reach[0] == reach[1]):
            return Bound(0.0, "every sample at its own distance")
        near, middle, far = transmission(np.array([reach[0], sum(reach) / 2, reach[1]]), rig, probe.wavelength_nm)
        share = 1 - far if variant == OFF else np.maximum(near - middle, middle - far)
        verb = "take" if variant == OFF else "at one distance for all are wrong by"
        where = f" at {probe.wavelength_nm[int(share.argmax())]:.0f} nm" if share.size else ""
        why = f"oxygen and water vapour {verb} at most {share.max(initial=0.0):.2%}{where} over {spoken_reach(reach)}"
        return Bound(probe.scaled(share), why)

    def gain_range(self, probe: Probe, rig: Rig) -> GainRange:
        """Give the transmission between the nearest and the farthest distance."""
        reach, nm = reach_m(rig), np.asarray(probe.wavelength_nm, np.float64)
        if reach is None:
            return GainRange.between(1.0, 1.0, len(nm))
        passed = transmission(np.geomspace(*reach, _LOOKS), rig, nm)
        return GainRange.of(passed, nm, uneven=float(passed.max(initial=0.0) - passed.min(initial=1.0)))

    def gain(self, block: SweepBlock, variant: str) -> Light:
        """Give (line, sample, band), or (1, 1, band) where all is at one distance."""
        rig, reach = block.rig, reach_m(block.rig)
        if reach is None:
            return np.ones((1, 1, 1), np.float32)
        if variant == UNIFORM or reach[0] == reach[1]:
            return transmission(np.array([sum(reach) / 2]), rig, block.wavelength_nm)[:, None].astype(np.float32)
        knots = np.geomspace(*reach, _KNOTS)
        table = transmission(knots, rig, block.wavelength_nm).astype(np.float32)
        place = np.log(sample_distances(block) / reach[0]) / np.log(reach[1] / reach[0]) * (_KNOTS - 1)
        low = np.clip(place.astype(np.int64), 0, _KNOTS - 2)
        gain: Light = table[low]
        gain += (place - low)[..., None].astype(np.float32) * np.diff(table, axis=0)[low]
        return gain


ABSORPTION = Absorption()


def transmission(metres: Floats, rig: Rig, wavelength_nm: Floats) -> Floats:
    """Give the share of light that passes so much air near the ground, (distance, band).

    The bands are Gaussians of ``optics.fwhm_nm``, cut at 2 standard deviations.
    """
    sigma = rig.optics.fwhm_nm / np.sqrt(8 * np.log(2))
    weight = np.exp(-(_QUADRATURE**2) / 2)
    fine = wavelength_nm[:, None] + sigma * _QUADRATURE  # (band, node)
    mass = metres[:, None, None] / AIR_MASS_M
    water_cm = metres[:, None, None] * rig.air.vapour_g_per_m3 * 1e-4  # as liquid: 1 g/m^2 is 1e-4 cm
    passed = _water(_coefficient(WATER, fine), water_cm)
    passed *= _oxygen(_coefficient(OXYGEN, fine), mass)
    mean: Floats = (passed * (weight / weight.sum())).sum(axis=-1)
    return mean


def _coefficient(table: Floats, wavelength_nm: Floats) -> Floats:
    return np.interp(wavelength_nm, table[:, 0], table[:, 1], left=0.0, right=0.0)


def _water(coefficient: Floats, centimetres: Floats) -> Floats:
    x = coefficient * centimetres  # [1] Eq. 2-8
    passed: Floats = np.exp(-0.2385 * x / (1 + 20.07 * x) ** 0.45)
    return passed


def _oxygen(coefficient: Floats, mass: Floats) -> Floats:
    x = coefficient * mass  # [1] Eq. 2-11
    passed: Floats = np.exp(-1.41 * x / (1 + 118.3 * x) ** 0.45)
    return passed
