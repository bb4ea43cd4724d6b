"""Air between rig and scene: it takes light out of the way, adds its own, and its gases absorb.

[1] Koschmieder, "Theorie der horizontalen Sichtweite", Beitraege zur Physik der freien Atmosphaere 12, 1924: a
   contrast of 2 % is left at the visibility V, so that extinction is 3.912 / V: all of it, molecules included.
[2] Bird and Riordan, "Simple solar spectral model for direct and diffuse irradiance on horizontal and tilted
   planes at the earth's surface for cloudless atmospheres", TR-215-2436, 1984, with the constant 118.3 of its
   published program. doi:10.2172/5986936
[3] Kruse, McGlauchlin and McQuistan, "Elements of Infrared Technology", Wiley, 1962: Angstrom's exponent is 0.585
   V^(1/3) below 6 km.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from pipeline.simulator.effects.air import has_relief, reach_m, sample_distances, spoken_reach
from pipeline.simulator.effects.effect import OFF, Bound, Gain, LightChange, Radiance, SweepBlock
from pipeline.simulator.effects.lighting import BRDF, CLOUD, DRIFT
from pipeline.simulator.effects.probe import GainRange, Probe, lights_within, unit_electrons
from pipeline.simulator.rig_model import Air, Rig
from pipeline.simulator.scenes.daylight import relative_daylight

Floats = NDArray[np.float64]
RANGE, UNIFORM = "range", "uniform"
# Rows: wavelength [nm], coefficient of [2]; straight between, 0 outside. About 5 nm fine at oxygen A, 10 nm elsewhere.
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
_PROBES = 9  # distances at which the spectrum's course is taken for the bounds of others: it is smooth
_KNOTS = 65  # distances, evenly in the logarithm, between which the transmission is taken as straight in it
_QUADRATURE = np.linspace(-2.0, 2.0, 33)  # over a band, in standard deviations of its Gaussian
KOSCHMIEDER = 3.912  # -ln 0.02 [1]
VISIBLE_NM = 550.0  # of the visibility
ANGSTROM = 1.14  # exponent of a rural aerosol [2]
KRUSE = 0.585  # of the root of 1 km [3]


@dataclass(frozen=True)
class Absorption(Gain):
    """Fraction of the light that gases leave over a distance, averaged over the width of a band.

    Water vapour about 720, 820 and 940 nm, oxygen at 690 and 760 nm: the band model of [2] for whole atmospheres, taken
    to paths of metres (assumed). ``range`` takes each sample's own distance, ``uniform`` the middle.
    """

    name = "absorption"
    cost_ns = MappingProxyType({RANGE: 2.7, UNIFORM: 0.2})  # of a scene with relief

    def cost_at(self, probe: Probe, rig: Rig) -> Mapping[str, float]:
        return self.cost_ns if has_relief(rig) else dict.fromkeys(self.variants, self.cost_ns[UNIFORM])

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound by level times the fraction that gases take, or that a variant misses."""
        reach = reach_m(rig)
        if reach is None:
            return Bound(0.0, "the scene has no distance")
        if variant == UNIFORM and reach[0] == reach[1]:
            return Bound(0.0, "every sample at its own distance")
        near, middle, far = transmission(np.array([reach[0], sum(reach) / 2, reach[1]]), rig, probe.wavelength_nm)
        fraction = 1 - far if variant == OFF else np.maximum(near - middle, middle - far)
        verb = "take" if variant == OFF else "at one distance for all are wrong by"
        where = f" at {probe.wavelength_nm[int(fraction.argmax())]:.0f} nm" if fraction.size else ""
        why = (
            f"oxygen and water vapour {verb} at most {fraction.max(initial=0.0):.2%}{where} over {spoken_reach(reach)}"
        )
        return Bound(probe.scaled(fraction), why)

    def gain_range(self, probe: Probe, rig: Rig) -> GainRange:
        reach, nm = reach_m(rig), np.asarray(probe.wavelength_nm, np.float64)
        if reach is None:
            return GainRange.between(1.0, 1.0, len(nm))
        passed = transmission(np.geomspace(*reach, _PROBES), rig, nm)
        return GainRange.of(passed, nm, uneven=float(passed.max(initial=0.0) - passed.min(initial=1.0)))

    def gain(self, block: SweepBlock, variant: str) -> Radiance:
        """Give the fraction that passes, (line, sample, band), or (1, 1, band) where one distance stands for all.

        Every sample's is read off a table over the logarithm of the distance, by straight lines.
        """
        rig, reach = block.rig, reach_m(block.rig)
        if reach is None:
            return np.ones((1, 1, 1), np.float32)
        if variant == UNIFORM or reach[0] == reach[1]:
            return transmission(np.array([sum(reach) / 2]), rig, block.wavelength_nm)[:, None].astype(np.float32)
        knots = np.geomspace(*reach, _KNOTS)
        table = transmission(knots, rig, block.wavelength_nm).astype(np.float32)
        place = np.log(sample_distances(block) / reach[0]) / np.log(reach[1] / reach[0]) * (_KNOTS - 1)
        low = np.clip(place.astype(np.int64), 0, _KNOTS - 2)
        gain: Radiance = table[low]
        gain += (place - low)[..., None].astype(np.float32) * np.diff(table, axis=0)[low]
        return gain


def transmission(metres: Floats, rig: Rig, wavelength_nm: Floats) -> Floats:
    """Give the fraction of light that passes so much air near the ground, (distance, band).

    The bands are Gaussians of ``optics.fwhm_nm``, cut at 2 standard deviations.
    """
    sigma = rig.optics.fwhm_nm / np.sqrt(8 * np.log(2))
    weight = np.exp(-(_QUADRATURE**2) / 2)
    fine = wavelength_nm[:, None] + sigma * _QUADRATURE  # (band, node)
    mass = metres[:, None, None] / AIR_MASS_M
    water_cm = metres[:, None, None] * rig.air.vapour_g_per_m3 * 1e-4  # as liquid: 1 g/m^2 is 1e-4 cm
    water, oxygen = (np.interp(fine, table[:, 0], table[:, 1], left=0.0, right=0.0) for table in (WATER, OXYGEN))
    x, y = water * water_cm, oxygen * mass
    passed = np.exp(-0.2385 * x / (1 + 20.07 * x) ** 0.45)  # [2] Eq. 2-8
    passed *= np.exp(-1.41 * y / (1 + 118.3 * y) ** 0.45)  # [2] Eq. 2-11
    return np.asarray((passed * (weight / weight.sum())).sum(axis=-1))


@dataclass(frozen=True)
class PathRadiance(LightChange):
    """Light L at a distance d arrives as L exp(-beta d) + H (1 - exp(-beta d)), beta of ``extinction_per_m``.

    H, the light of endless air, is ``air.airlight_fraction`` of the white reference's and follows the daylight; none is added
    where the white reference's light is not known. ``range`` takes each sample's own distance, ``uniform`` the middle.
    """

    name = "path-radiance"
    cost_ns = MappingProxyType({RANGE: 3.1, UNIFORM: 0.5})  # of a scene with relief

    def cost_at(self, probe: Probe, rig: Rig) -> Mapping[str, float]:
        return self.cost_ns if has_relief(rig) else dict.fromkeys(self.variants, self.cost_ns[UNIFORM])

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound by the fraction that is lost, or that a variant misses, times the greatest difference of signal and H.

        Over the noise of the signal that difference is greatest where the signal is greatest, or least.
        """
        reach = reach_m(rig)
        if reach is None:
            return Bound(0.0, "the scene has no distance")
        if variant == UNIFORM and reach[0] == reach[1]:
            return Bound(0.0, "every sample at its own distance")
        depth = extinction_per_m(rig.air, probe.wavelength_nm)
        lost = -np.expm1(-depth * reach[1])
        if variant == UNIFORM:
            middle = depth * sum(reach) / 2
            lost = np.maximum(_between(depth * reach[0], middle), _between(middle, depth * reach[1]))
        worst = float((_contrast(probe, rig) * lost).max(initial=0.0))
        verb = "takes" if variant == OFF else "at one distance for all is wrong by"
        most = f"at most {lost.max(initial=0.0):.2%} of the light"
        return Bound(worst, f"air {verb} {most} and adds its own, over {spoken_reach(reach)}")

    def gain_range(self, probe: Probe, rig: Rig) -> GainRange:
        """Give what passes between the nearest and the farthest sample, and the greatest light that air adds. [e-]

        Added light is the airlight's fraction of the white reference's, where that is known, times what the daylight grows by.
        """
        reach, nm = reach_m(rig), np.asarray(probe.wavelength_nm, np.float64)
        if reach is None:
            return GainRange.between(1.0, 1.0, len(nm))
        passed = np.exp(-np.geomspace(*reach, _PROBES)[:, None] * extinction_per_m(rig.air, nm))
        uneven = float(passed.max(initial=0.0) - passed.min(initial=1.0))
        if probe.white_e is None:
            return GainRange.of(passed, nm, uneven=uneven)
        sun = DRIFT.gain_range(probe, rig)
        still = rig.air.airlight_fraction * probe.white_e * (1 - passed)
        alone = GainRange.of(passed, nm, uneven=uneven, added_e=still)
        most = sun.greatest.max(initial=1.0)
        return replace(
            alone,
            added_e=alone.added_e * most,
            added_steepest=alone.added_steepest * most + alone.added_e * sun.steepest,
            added_bend=alone.added_bend * most + 2 * alone.added_steepest * sun.steepest + alone.added_e * sun.bend,
        )

    def change(self, light: Radiance, block: SweepBlock, variant: str) -> Radiance:
        """Give light (line, sample, band) [e-] with what air takes of it and adds; changed in place."""
        reach = reach_m(block.rig)
        if reach is None:
            return light
        metres = np.full((1, 1), sum(reach) / 2) if variant == UNIFORM else sample_distances(block)
        depth = (extinction_per_m(block.rig.air, block.wavelength_nm) * metres[..., None]).astype(np.float32)
        lost = -np.expm1(-depth)
        light *= 1 - lost
        if block.white_e is not None:
            sky, still = block.rig.sky, block.rig.air.airlight_fraction * np.asarray(block.white_e, np.float64)
            if sky.started is not None:
                still = still * relative_daylight(sky, block.wavelength_nm, block.time_s)
            horizon = np.atleast_2d(still)[:, None].astype(np.float32)  # of endless air, (line or 1, 1, band)
            light += (horizon * lost).astype(np.float32, copy=False)
        return light


def extinction_per_m(air: Air, wavelength_nm: Floats) -> Floats:
    """Give the extinction of aerosol and molecules near the ground, (band,) [1/m]: 0.17 /km in all at 23 km, 550 nm.

    At 550 nm it is Koschmieder's for the visibility [1], no less than the molecules'; what these do not explain is
    aerosol, which falls by Angstrom's exponent: 1.14 [2], below 7.4 km Kruse's 0.585 V^(1/3) [3]. Above 336 km no
    aerosol is left. Valid from 400 to 1000 nm beside the lines of gases, and down to some 0.5 km of visibility.
    """
    molecules = rayleigh_per_m(np.array([VISIBLE_NM]))[0]
    aerosol = max(KOSCHMIEDER / air.visibility_km * 1e-3 - molecules, 0.0)
    exponent = min(ANGSTROM, KRUSE * air.visibility_km ** (1 / 3))
    return np.asarray(aerosol * (wavelength_nm / VISIBLE_NM) ** -exponent + rayleigh_per_m(wavelength_nm))


def rayleigh_per_m(wavelength_nm: Floats) -> Floats:
    """Give what molecules scatter at sea level, (band,) [1/m]: the optical depth of [2], Eq. 2-4, over 8434 m."""
    micron = wavelength_nm * 1e-3
    return 1 / (micron**4 * (115.6406 - 1.3366 / micron**2)) / AIR_MASS_M


def _contrast(probe: Probe, rig: Rig) -> Floats:
    """Greatest difference of a signal and the light of endless air, over the signal's unit, (band,).

    Daylight multiplies both; clouds and the angle of view change the signal alone: H counts over their greatest factor,
    and the darkest signal after their least.
    """
    if probe.white_e is None:
        return probe.level
    horizon, (low, high) = rig.air.airlight_fraction * probe.white_e, lights_within(probe, rig)
    cloud, view = CLOUD.gain_range(probe, rig), BRDF.gain_range(probe, rig)
    lit, shaded = np.maximum(cloud.greatest * view.greatest, 1.0), cloud.least * view.least
    brightest = lit * high
    fraction = np.divide(
        horizon, brightest, out=np.ones_like(brightest), where=brightest > horizon
    )  # a band may be black
    above = probe.level * np.clip(1 - fraction, 0.0, 1.0)
    sun = DRIFT.gain_range(probe, rig)
    below = np.maximum(horizon - shaded * low, 0.0) * np.maximum(sun.greatest, 1.0)
    return np.asarray(np.maximum(above, below / unit_electrons(shaded * np.minimum(sun.least, 1.0) * low, probe, rig)))


def _between(near: Floats, far: Floats) -> Floats:
    """Fraction of the light lost between two optical depths, exp(-near) - exp(-far), however near they lie."""
    return -np.exp(-near) * np.expm1(near - far)


ABSORPTION, PATH_RADIANCE = Absorption(), PathRadiance()
