"""Air and depth: distances, parallax, turbulence, wind in the crop; haze and gases.

[1] Andrews and Phillips, "Laser Beam Propagation through Random Media", 2nd edition, SPIE Press, 2005, chapters 6, 8.
[2] Fried, Journal of the Optical Society of America 56, 1966. doi:10.1364/JOSA.56.001372
[3] Koschmieder, "Theorie der horizontalen Sichtweite", Beitraege zur Physik der freien Atmosphaere 12, 1924.
[4] Bird and Riordan, "Simple solar spectral model for direct and diffuse irradiance on horizontal and tilted planes
   at the earth's surface for cloudless atmospheres", TR-215-2436, 1984. doi:10.2172/5986936
[5] Kruse, McGlauchlin and McQuistan, "Elements of Infrared Technology", Wiley, 1962.
"""

from __future__ import annotations

import math
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from spectralzoom.pipeline.geometry.scan import Floats, points_of_scan
from spectralzoom.pipeline.simulator.effects.effect import (
    Aim,
    Bound,
    Displacement,
    Gain,
    LightChange,
    Radiance,
    SweepBlock,
    survey_stream,
)
from spectralzoom.pipeline.simulator.effects.lighting import DRIFT
from spectralzoom.pipeline.simulator.effects.probe import UNITS, GainRange, Probe
from spectralzoom.pipeline.simulator.rig_model import Air, Rig
from spectralzoom.pipeline.simulator.scenes.daylight import relative_daylight

PLANE = 2.91  # angle of arrival of a star's light [1]
NEAR_POINTS = 3 / 8  # of it from a path's end: the mean of (z / d)^(5/3); r0 [2] is (8/3)^(3/5) times as wide
RISK = 1e-3  # fraction of the surveys in which a line may stray further than the bound says
_REST = math.sqrt(0.5)
GUST_M = 3.0  # length of the waves that run over a canopy; assumed
FARTHEST_M = 1e7  # infinity: nothing passes so much air
NOTHING = (0.0, 0.0)  # reach of air before a scene without a distance


class Turbulence(Aim):
    """Jitter of the lines, normal and equal in both directions: warm air bends the light, anew for every line."""

    name = "turbulence"
    cost_ns = MappingProxyType({"jitter": 0.13})

    def aim(self, block: SweepBlock, variant: str) -> Floats:
        draws = [block.stream(self.name, int(number)).standard_normal(2) for number in block.numbers]
        return turbulence_px(block.rig) * np.array(draws, np.float64).reshape(-1, 1, 2)

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound for all lines at once, but in one survey of 1000: no line of N exceeds sqrt(2 ln(N / risk)) sigma."""
        sigma = turbulence_px(rig)
        if not sigma:
            return Bound(0.0, "no distance or no turbulence")
        farthest = sigma * math.sqrt(2 * math.log(max(probe.lines, 1) / RISK))
        return Bound(
            probe.moved(farthest, farthest),
            f"{sigma:.2g} px (sd) per line, at most {farthest:.2g} px in {probe.lines} lines,"
            f" on edges of at most {np.hypot(*probe.slope).max(initial=0.0):.3g} {UNITS[probe.unit]}/px",
        )


def turbulence_px(rig: Rig) -> float:
    """Return the deviation of the angle of arrival per axis, sqrt(1.09 Cn2 d D^(-1/3)), from the farthest part. [px]

    In spherical waves air near the point tilts them less than air near the aperture, by (z / d)^(5/3) a length of way.
    So 3/8 of a plane wave's 2.91 are left [1]. D is the aperture as seen at rest, 10.6 mm of 15. It is valid for weak
    turbulence by Kolmogorov's spectrum, with one Cn2 all along the way. D lies between inner and outer scale, and the
    Fresnel width sqrt(lambda d) is not much wider. Returns 0 without a distance; no way is longer than `FARTHEST_M`.
    """
    metres = 0.0 if rig.distances_m is None else min(max(rig.distances_m), FARTHEST_M)
    aperture_m = rig.optics.aperture_mm * 1e-3 * _REST
    angle = math.sqrt(NEAR_POINTS * PLANE * rig.air.turbulence_cn2 * metres * aperture_m ** (-1 / 3))
    return angle / rig.camera.ifov_rad


class Wind(Displacement):
    """Crop motion: the scene sways by a travelling wave along the wind, its phase and direction drawn for a survey.

    All of the scene sways, as one that stands at mid exposure. A fast sway shows as a slow one if f t_frame is above
    one half. The smear within an exposure is neither modelled nor counted. It is up to 2 pi f t_exp of the amplitude:
    at 1 Hz 2 % of it in 3 ms, 62 % in 100 ms.
    """

    name = "wind"
    cost_ns = MappingProxyType({"exact": 0.9})

    def displaced(self, block: SweepBlock, along_px: Floats, scan_px: Floats, variant: str) -> tuple[Floats, Floats]:
        """Return the crop's sway at scene points (line, sample): along the line and the scan. [px]

        A plane wave A sin(2 pi (f t - way / gust) + phase), its way and its motion along the wind's heading.
        """
        sway = sway_px(block.rig)
        air = block.rig.air
        if sway == 0 or air.distance_m is None:
            return np.zeros_like(along_px), np.zeros_like(scan_px)
        phase, heading = survey_stream(block.seed, self.name).uniform(0, 2 * math.pi, 2)
        x, y = (along_px, scan_px) if block.sweep.along == "x" else (scan_px, along_px)
        downwind = (x * math.cos(heading) + y * math.sin(heading)) * block.rig.camera.ifov_rad * air.distance_m
        turns = air.wind_hz * block.time_s[:, None] - downwind / GUST_M
        moved = sway * np.sin(2 * math.pi * turns + phase)
        right, down = moved * math.cos(heading), moved * math.sin(heading)
        return (right, down) if block.sweep.along == "x" else (down, right)

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound by the amplitude times the slope, whichever way the wind blows."""
        sway = sway_px(rig)
        if sway == 0:
            return Bound(0.0, "the air is calm")
        return Bound(probe.moved(sway, sway), f"the crop sways by {sway:.2g} px, {rig.air.wind_hz:g} times a second")


def sway_px(rig: Rig) -> float:
    """Return the amplitude of the canopy's sway, A / (d IFOV); 0 for a scene without a distance. [px]"""
    air = rig.air
    return 0.0 if air.distance_m is None else air.wind_amplitude_m / (air.distance_m * rig.camera.ifov_rad)


class Parallax(Displacement):
    """Displacement of what is not at the scene's distance, for which scale and geometry are right.

    The virtual pinhole lies a lever L behind the pivot on the chief ray. A ray meets a surface at distance d, taken
    along the chief ray, beside the point of distance d0, where depth is read. It is off by L (1/d - 1/d0) times its way
    from the line's centre. Occlusion is left out: within a displacement of a step a sample may see the other depth,
    within the bound.
    """

    name = "parallax"
    cost_ns = MappingProxyType({"exact": 0.2})

    def displaced(self, block: SweepBlock, along_px: Floats, scan_px: Floats, variant: str) -> tuple[Floats, Floats]:
        air = block.rig.air
        sweep = block.sweep
        if air.distance_m is None:
            return np.zeros_like(along_px), np.zeros_like(scan_px)
        row = scan_px if sweep.along == "x" else along_px
        fraction = air.lever_m * (closeness(air, row / max((block.shape[0] - 1) / 2, 0.5)) - 1 / air.distance_m)
        return fraction * (along_px - sweep.swath_px), fraction * (scan_px - block.scan_px[:, None])

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound by the slope times the greatest displacement: at a line's ends, at the nearest or farthest surface."""
        air = rig.air
        fraction = 0.0  # greatest displacement a px of distance from the line's centre
        if air.distance_m is not None:
            fraction = air.lever_m * float(np.abs(closeness(air, np.array([-1.0, 1.0])) - 1 / air.distance_m).max())
        if fraction == 0 or not probe.sweeps:
            return Bound(0.0, "all of the scene is at one distance")
        half = np.zeros(2)  # greatest way from a line's centre to its ends, slit and pixel included
        ends = np.array([-1.0, 1.0]) * rig.camera.samples / 2 * rig.camera.ifov_rad
        for sweep in probe.sweeps:
            centre = sweep.line_px()[:, None]
            along, scan = points_of_scan(sweep.swath_px, rig.camera, centre, ends)
            beside = np.abs(along - sweep.swath_px).max(initial=0.0), np.abs(scan - centre).max(initial=0.0)
            half = np.maximum(half, beside)
        most_along, most_scan = (fraction * half).tolist()
        near, far = rig.distances_m or (0.0, 0.0)
        why = f"at the lines' ends {most_along:.2g} px between {near:g} and {far:g} m ({rig.air.relief})"
        return Bound(probe.moved(most_along, most_scan), why)


def closeness(air: Air, row: Floats) -> Floats:
    """Return 1 / distance at rows of the scene, -1 its first and 1 its last. [1/m]

    A ``step`` is farthest up to the middle row and nearest from there on; along a ``plane`` it runs evenly between
    them.
    """
    if air.distance_m is None:
        return np.zeros_like(row)
    near, far = 1 / (air.nearest_m or air.distance_m), 1 / (air.farthest_m or air.distance_m)
    if air.relief == "flat":
        return np.full_like(row, 1 / air.distance_m)
    if air.relief == "step":
        return np.where(row < 0, far, near)
    fraction = (np.clip(row, -1, 1) + 1) / 2
    return far * (1 - fraction) + near * fraction


def reach_m(rig: Rig) -> tuple[float, float] | None:
    """Return the nearest and the farthest distance that the scene's relief has [m]; None for one without a distance."""
    if rig.air.distance_m is None or rig.distances_m is None:
        return None
    ends = (rig.air.distance_m,) if rig.air.relief == "flat" else rig.distances_m
    return min(*ends, FARTHEST_M), min(max(ends), FARTHEST_M)


def sample_distances(block: SweepBlock) -> Floats:
    """Return the distance at which each sample looks by the plan, (line, sample) [m]; (1, 1) if all are alike."""
    ends = reach_m(block.rig)
    if ends is None or ends[0] == ends[1]:
        return np.full((1, 1), FARTHEST_M if ends is None else ends[0])
    sweep = block.sweep
    along, scan = points_of_scan(sweep.swath_px, block.rig.camera, block.scan_px[:, None], block.slopes)
    row = scan if sweep.along == "x" else along
    return 1 / np.clip(closeness(block.rig.air, row / max((block.shape[0] - 1) / 2, 0.5)), 1 / ends[1], 1 / ends[0])


def format_reach(ends: tuple[float, float]) -> str:
    return f"{ends[1]:g} m" if ends[0] == ends[1] else f"{ends[0]:g} to {ends[1]:g} m"


TURBULENCE, WIND, PARALLAX = Turbulence(), Wind(), Parallax()


# Rows: wavelength [nm], coefficient of [4]; straight between, 0 outside. About 5 nm fine at oxygen A, 10 nm elsewhere.
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
_KNOTS = 65  # distances, evenly in the logarithm, between which the transmission is taken as straight in it
_QUADRATURE = np.linspace(-2.0, 2.0, 33)  # over a band, in standard deviations of its Gaussian
KOSCHMIEDER = 3.912  # -ln 0.02: a contrast of 2 % is left at the visibility, molecules included [3]
VISIBLE_NM = 550.0  # of the visibility
ANGSTROM = 1.14  # exponent of a rural aerosol [4]
KRUSE = 0.585  # of the root of 1 km: Angstrom's exponent is 0.585 V^(1/3) below 6 km [5]


class Absorption(Gain):
    """Fraction of the light that gases leave over a distance, averaged over the width of a band.

    It has water vapour about 720, 820 and 940 nm, and oxygen at 690 and 760 nm. The band model of [4] for whole
    atmospheres is taken to paths of metres (assumed). Each sample has its own distance.
    """

    name = "absorption"
    cost_ns = MappingProxyType({"range": 2.7})  # of a scene with relief

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound by level times the fraction that gases take."""
        reach = reach_m(rig)
        if reach is None:
            return Bound(0.0, "the scene has no distance")
        fraction = 1 - transmission(np.array([reach[1]]), rig, probe.wavelength_nm)[0]
        where = f" at {probe.wavelength_nm[int(fraction.argmax())]:.0f} nm" if fraction.size else ""
        most = f"{fraction.max(initial=0.0):.2%}{where}"
        return Bound(probe.scaled(fraction), f"oxygen and water vapour take at most {most} over {format_reach(reach)}")

    def gain_range(self, probe: Probe, rig: Rig) -> GainRange:
        passed = transmission(np.array(reach_m(rig) or NOTHING), rig, probe.wavelength_nm)
        return GainRange.of(passed, uneven=float(passed.max(initial=0.0) - passed.min(initial=1.0)))

    def gain(self, block: SweepBlock, variant: str) -> Radiance:
        """Return the fraction that passes, (line, sample, band), or (1, 1, band) where one distance stands for all.

        Every sample's is read off a table over the logarithm of the distance, by straight lines.
        """
        reach = reach_m(block.rig) or NOTHING
        if reach[0] == reach[1]:
            return transmission(np.array(reach[:1]), block.rig, block.wavelength_nm)[:, None].astype(np.float32)
        table = transmission(np.geomspace(*reach, _KNOTS), block.rig, block.wavelength_nm).astype(np.float32)
        place = np.log(sample_distances(block) / reach[0]) / np.log(reach[1] / reach[0]) * (_KNOTS - 1)
        low = np.clip(place.astype(np.int64), 0, _KNOTS - 2)
        gain: Radiance = table[low]
        gain += (place - low)[..., None].astype(np.float32) * np.diff(table, axis=0)[low]
        return gain


def transmission(metres: Floats, rig: Rig, wavelength_nm: Floats) -> Floats:
    """Return the fraction of light that passes so much air near the ground, (distance, band).

    The bands are Gaussians of ``optics.fwhm_nm``, cut at 2 standard deviations.
    """
    sigma = rig.optics.fwhm_nm / np.sqrt(8 * np.log(2))
    weight = np.exp(-(_QUADRATURE**2) / 2)
    fine = wavelength_nm[:, None] + sigma * _QUADRATURE  # (band, node)
    water_cm = metres[:, None, None] * rig.air.vapour_g_per_m3 * 1e-4  # as liquid: 1 g/m^2 is 1e-4 cm
    water, oxygen = (np.interp(fine, table[:, 0], table[:, 1], left=0.0, right=0.0) for table in (WATER, OXYGEN))
    x = water * water_cm
    y = oxygen * (metres[:, None, None] / AIR_MASS_M)
    passed = np.exp(-0.2385 * x / (1 + 20.07 * x) ** 0.45)  # [4] Eq. 2-8
    passed *= np.exp(-1.41 * y / (1 + 118.3 * y) ** 0.45)  # [4] Eq. 2-11; 118.3 is that of its published program
    return np.asarray((passed * (weight / weight.sum())).sum(axis=-1))


class PathRadiance(LightChange):
    """Light L at a distance d arrives as L exp(-beta d) + H (1 - exp(-beta d)), beta of ``extinction_per_m``.

    H, the light of endless air, is ``air.airlight_fraction`` of the white reference's and follows the daylight. Each
    sample has its own distance.
    """

    name = "path-radiance"
    cost_ns = MappingProxyType({"range": 3.1})  # of a scene with relief

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound by the fraction that is lost times the greatest difference of signal and H."""
        reach = reach_m(rig)
        if reach is None:
            return Bound(0.0, "the scene has no distance")
        lost = -np.expm1(-extinction_per_m(rig.air, probe.wavelength_nm) * reach[1])
        horizon = rig.air.airlight_fraction * probe.white_e * np.maximum(DRIFT.gain_range(probe, rig).greatest, 1.0)
        contrast = np.maximum(probe.level, horizon / (probe.unit_least_dn * rig.camera.electrons_per_dn))  # the greater
        why = f"air takes at most {lost.max(initial=0.0):.2%} of the light and adds its own, over {format_reach(reach)}"
        return Bound(float((contrast * lost).max(initial=0.0)), why)

    def gain_range(self, probe: Probe, rig: Rig) -> GainRange:
        """Return what passes between the nearest and the farthest sample, and the greatest light that air adds. [e-]

        Added light is the airlight's fraction of the white reference's, times what the daylight grows by.
        """
        passed = np.exp(-np.array(reach_m(rig) or NOTHING)[:, None] * extinction_per_m(rig.air, probe.wavelength_nm))
        alone = GainRange.of(passed, uneven=float(passed.max(initial=0.0) - passed.min(initial=1.0)))
        most = DRIFT.gain_range(probe, rig).greatest.max(initial=1.0)
        return replace(alone, added_e=rig.air.airlight_fraction * probe.white_e * (1 - passed[1]) * most)

    def change(self, light: Radiance, block: SweepBlock, variant: str) -> Radiance:
        """Return light (line, sample, band) [e-] with what air takes of it and adds; changed in place."""
        if reach_m(block.rig) is None:
            return light
        metres = sample_distances(block)[..., None]
        lost = -np.expm1(-(extinction_per_m(block.rig.air, block.wavelength_nm) * metres).astype(np.float32))
        light *= 1 - lost
        sky = block.rig.sky
        horizon = np.atleast_2d(block.rig.air.airlight_fraction * block.white_e)  # of endless air, (line or 1, band)
        if sky.started is not None:
            horizon = horizon * relative_daylight(sky, block.wavelength_nm, block.time_s)
        light += horizon[:, None].astype(np.float32) * lost
        return light


def extinction_per_m(air: Air, wavelength_nm: Floats) -> Floats:
    """Return the extinction of aerosol and molecules near the ground, (band,) [1/m]: 0.17 /km in all at 23 km, 550 nm.

    At 550 nm it is Koschmieder's for the visibility [3], no less than the molecules'. The rest is aerosol, which falls
    by Angstrom's exponent: 1.14 [4], below 7.4 km Kruse's 0.585 V^(1/3) [5]. Above 336 km no aerosol is left. Valid
    from 400 to 1000 nm beside the lines of gases, and down to some 0.5 km of visibility.
    """
    aerosol = max(KOSCHMIEDER / air.visibility_km * 1e-3 - rayleigh_per_m(np.array([VISIBLE_NM]))[0], 0.0)
    exponent = min(ANGSTROM, KRUSE * air.visibility_km ** (1 / 3))
    return np.asarray(aerosol * (wavelength_nm / VISIBLE_NM) ** -exponent + rayleigh_per_m(wavelength_nm))


def rayleigh_per_m(wavelength_nm: Floats) -> Floats:
    """Return the scattering by molecules at sea level, (band,) [1/m]: the optical depth of [4] (2-4) over 8434 m."""
    micron = wavelength_nm * 1e-3
    return 1 / (micron**4 * (115.6406 - 1.3366 / micron**2)) / AIR_MASS_M


ABSORPTION, PATH_RADIANCE = Absorption(), PathRadiance()
