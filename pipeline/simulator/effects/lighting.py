"""Gains of light: the sun's course, clouds, reflectance by the angle of view; the mirror as stop, and its coating.

[1] Born and Wolf, "Principles of Optics", 7th edition, 1999, section 1.5.2 (Fresnel's formulae).
[2] Rakic, "Algorithm for the determination of intrinsic optical constants of metal films: application to aluminum",
    Applied Optics 34, 1995.
"""

from __future__ import annotations

import math
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.scan import Floats, Sweep, points_of_scan
from spectralzoom.pipeline.simulator.effects.effect import Bound, Gain, Radiance, SweepBlock, survey_stream
from spectralzoom.pipeline.simulator.effects.probe import GainRange, Probe
from spectralzoom.pipeline.simulator.rig_model import Coating, Rig
from spectralzoom.pipeline.simulator.scenes.daylight import knots_within, relative_daylight, sun_elevation_deg

EDGE_FRACTION = 0.1  # width of a shadow's edge, over the shadow's size (assumed)
HOT_SPOT_RAD = float(np.deg2rad(2.0))  # from its peak to 1/e (assumed)
_PROBES = 65  # incidences that bounds are taken at


class Drift(Gain):
    """Light at a line's mid exposure over the light at the survey's start, to which the scene is stated.

    It is SPECTRL2 under a clear sky. A survey that starts in the night is relative to the light of a sun 1 deg high.
    The light is 0 with the sun at the horizon or below. Without a time of day there is none.
    """

    name = "drift"
    cost_ns = MappingProxyType({"spectral": 0.4})

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound by level times the greatest change through the survey; light is straight between its knots."""
        if rig.sky.started is None:
            return Bound(0.0, "the survey has no time of day")
        seconds = probe.seconds + rig.camera.frame_ms * 1e-3  # to the end of the last line
        worst = np.abs(relative_daylight(rig.sky, probe.wavelength_nm, knots_within(rig.sky, seconds)) - 1).max(axis=0)
        low, high = sun_elevation_deg(rig.sky, np.array([0.0, seconds]))
        duration = f"{seconds / 3600:.1f} h" if seconds >= 3600 else f"{seconds:.0f} s"
        course = f"with the sun from {low:.1f} to {high:.1f} deg in {duration}"
        return Bound(probe.scaled(worst), f"light changes by at most {100 * worst.max(initial=0.0):.3g} % {course}")

    def gain_range(self, probe: Probe, rig: Rig) -> GainRange:
        if rig.sky.started is None:
            return GainRange.between(1.0, 1.0, len(probe.wavelength_nm))
        knots = knots_within(rig.sky, probe.seconds + rig.camera.frame_ms * 1e-3)
        light = relative_daylight(rig.sky, probe.wavelength_nm, knots)
        return GainRange.of(light, uneven=float(np.ptp(light, axis=1).max(initial=0.0)))

    def gain(self, block: SweepBlock, variant: str) -> Radiance:
        sky = block.rig.sky
        if sky.started is None:
            return np.ones((1, 1, 1), np.float32)
        return relative_daylight(sky, block.wavelength_nm, block.time_s)[:, None].astype(np.float32)


class Cloud(Gain):
    """Straight bands of shadow, as wide as the gaps between them, that drift over the scene at a constant speed.

    Direction and place follow from the seed alone: all sweeps lie under the same clouds. All bands lose the same
    fraction.
    """

    name = "cloud"
    cost_ns = MappingProxyType({"shadow": 0.3})

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound by level times the fraction that a cloud takes; whether a shadow comes is up to the seed."""
        sky = rig.sky
        if sky.cloud_fraction == 0:
            return Bound(0.0, "the sky is clear")
        why = (
            f"a shadow takes {sky.cloud_fraction:.0%} of the light and moves {sky.cloud_px_per_s:g} px/s over the scene"
        )
        return Bound(probe.scaled(sky.cloud_fraction), why)

    def gain_range(self, probe: Probe, rig: Rig) -> GainRange:
        fraction = rig.sky.cloud_fraction
        return GainRange.between(1 - fraction, 1.0, len(probe.wavelength_nm), uneven=fraction)

    def gain(self, block: SweepBlock, variant: str) -> Radiance:
        """Return 1 less the cloud's shadow at each sample's place and time, (line, sample, 1)."""
        sky = block.rig.sky
        sweep = block.sweep
        along, scan = points_of_scan(sweep.swath_px, block.rig.camera, block.scan_px[:, None], block.slopes)
        x, y = (along, scan) if sweep.along == "x" else (scan, along)
        turn, place = survey_stream(block.seed, self.name).random(2)
        heading = 2 * math.pi * float(turn)
        start = 2 * sky.cloud_size_px * float(place)
        way = x * math.cos(heading) + y * math.sin(heading) - sky.cloud_px_per_s * block.time_s[:, None] + start
        return (1 - sky.cloud_fraction * shadow(way, sky.cloud_size_px))[..., None].astype(np.float32)


def shadow(way_px: Floats, size_px: float) -> Floats:
    """Return the fraction of a cloud before the sun: 1 about even multiples of the size, 0 about the odd ones."""
    from_middle = np.abs((way_px + size_px) % (2 * size_px) - size_px)
    t = np.clip((size_px / 2 - from_middle) / (EDGE_FRACTION * size_px) + 0.5, 0.0, 1.0)
    return t * t * (3 - 2 * t)


class Brdf(Gain):
    """Reflectance over that in the undeflected direction: 1 + b a + h exp(-phase / 2 deg), never below 0.

    The angle a of view runs along the scene's x axis, in the sun's plane (assumed); b is ``sky.brdf_per_rad``. The
    phase is the angle to the undeflected direction, along which the sun's rays come (assumed); h is ``sky.hot_spot``.
    All materials and bands share it; directions are those of the plan, right to the mirror's own faults of 1e-3 rad.
    """

    name = "brdf"
    cost_ns = MappingProxyType({"angles": 0.2})

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound by level times the greatest change: the slope at the largest angle, and the hot spot's peak."""
        slope, hot = rig.sky.brdf_per_rad, rig.sky.hot_spot
        if slope == 0 and hot == 0:
            return Bound(0.0, "the scene reflects alike in all directions")
        angle = _greatest_angle(probe.sweeps, rig.camera)
        fraction = slope * angle + hot
        peak = f" and a hot spot of {hot:.2g}" if hot else ""
        why = f"reflectance changes by at most {fraction:.2%}: {slope:.2g}/rad up to {np.rad2deg(angle):.2f} deg{peak}"
        return Bound(probe.scaled(fraction), why)

    def gain_range(self, probe: Probe, rig: Rig) -> GainRange:
        change = rig.sky.brdf_per_rad * _greatest_angle(probe.sweeps, rig.camera)
        least, greatest = max(1 - change, 0.0), 1 + change + rig.sky.hot_spot
        return GainRange.between(least, greatest, len(probe.wavelength_nm), uneven=greatest - least)

    def gain(self, block: SweepBlock, variant: str) -> Radiance:
        """Return 1 + b a + h exp(-phase / 2 deg) of each sample's direction, (line, sample, 1), at least 0."""
        sky = block.rig.sky
        angle, phase = _angles(block.sweep, block.rig.camera, block.scan_px, block.slopes)
        factor = 1 + sky.brdf_per_rad * angle + sky.hot_spot * np.exp(-phase / HOT_SPOT_RAD)
        return np.maximum(factor, 0.0)[..., None].astype(np.float32)


def _angles(sweep: Sweep, camera: LineCamera, scan_px: Floats, slopes: Floats) -> tuple[Floats, Floats]:
    along, scan = points_of_scan(sweep.swath_px, camera, scan_px[:, None], slopes)
    x = along if sweep.along == "x" else scan
    return np.arctan(x * camera.ifov_rad), np.arctan(np.hypot(along, scan) * camera.ifov_rad)


def _greatest_angle(sweeps: tuple[Sweep, ...], camera: LineCamera) -> float:
    """Return the greatest angle of view along the scene's x axis at the ends of lines within the sweeps [rad]."""
    angles = [
        np.abs(_angles(sweep, camera, sweep.line_px(), camera.pixel_slopes()[[0, -1]])[0]).max()
        for sweep in sweeps
        if sweep.lines
    ]
    return float(max(angles, default=0.0))


DRIFT, CLOUD, BRDF = Drift(), Cloud(), Brdf()


REST_RAD = math.radians(45)
# Rows: wavelength [nm], n, k; straight between. Evaporated films at room temperature.
_ALUMINIUM = np.array([  # [2]
    (309.96, 0.28003, 3.7081), (326.28, 0.31474, 3.9165), (364.66, 0.39877, 4.3957), (413.28, 0.52135, 5.0008),
    (442.80, 0.60790, 5.3676), (476.87, 0.72780, 5.7781), (516.60, 0.87340, 6.2418), (563.57, 1.0728, 6.7839),
    (619.93, 1.3660, 7.4052), (652.25, 1.5724, 7.7354), (688.81, 1.8301, 8.0601), (729.32, 2.1606, 8.3565),
    (774.91, 2.6154, 8.4914), (794.78, 2.7675, 8.3866), (815.69, 2.7668, 8.2573), (837.74, 2.6945, 8.1878),
    (885.61, 2.2802, 8.1134), (911.66, 1.9739, 8.3058), (939.28, 1.6784, 8.5970), (968.63, 1.4867, 9.0655),
    (999.88, 1.4359, 9.4939), (1033.2, 1.3998, 9.8914), (1127.1, 1.3281, 10.969), (1239.9, 1.3157, 12.245),
    (1377.6, 1.3899, 13.784), (1549.8, 1.5782, 15.656), (1771.2, 1.9205, 17.991), (2066.4, 2.4738, 20.982),
])  # fmt: skip


class Vignetting(Gain):
    """Light goes with the mirror's area as the camera sees it: |n_z| over |n_z| at rest, in the mean of an exposure."""

    name = "vignetting"
    cost_ns = MappingProxyType({"held": 0.2})

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound by level times the factor furthest from 1, at the ends of the sweeps: it never turns round between."""
        ends = sweep_ends(probe, rig.camera)
        if not ends.size:
            return Bound(0.0, "no line is taken")
        fractions = np.sqrt(1 - ends)  # |n_z|^2 = (1 - o_z) / 2
        why = f"the mirror passes {fractions.min():.3f} to {fractions.max():.3f} of its light at rest"
        return Bound(probe.scaled(float(np.abs(fractions - 1).max())), why)

    def gain_range(self, probe: Probe, rig: Rig) -> GainRange:
        fractions = np.sqrt(1 - np.append(sweep_ends(probe, rig.camera), 0.0))  # and at rest
        return GainRange.between(float(fractions.min()), float(fractions.max()), len(probe.wavelength_nm))

    def gain(self, block: SweepBlock, variant: str) -> Radiance:
        sweep = block.sweep
        fraction = np.sqrt(1 - ahead(sweep.swath_px, sweep.held_px()[block.numbers], block.rig.camera)).mean(axis=1)
        return np.asarray(fraction.astype(np.float32)[:, None, None])


def sweep_ends(probe: Probe, camera: LineCamera) -> Floats:
    """Return o_z at the first and the last position of every sweep, (2 sweep,); it never turns round in between."""
    found = [ahead(sweep.swath_px, sweep.held_px().ravel()[[0, -1]], camera) for sweep in probe.sweeps]
    return np.concatenate(found) if found else np.zeros(0)


def ahead(along_px: float, scan_px: Floats, camera: LineCamera) -> Floats:
    """Return o_z, the part along the camera's axis, of the unit directions to points of the scene."""
    xi, eta = along_px * camera.ifov_rad, scan_px * camera.ifov_rad
    return eta / np.sqrt(1 + xi**2 + eta**2)


class Polarisation(Gain):
    """Light goes with the coating's reflectance at the chief ray's incidence over that at rest, 45 deg.

    Fresnel's equations for bare metal give it. From 20 to 70 deg aluminium goes from +0.5 to -3.7 % (mean of 400 to
    1000 nm; -5.4 % at 820 nm). Valid for unpolarised light and a spectrograph that takes both polarisations alike. One
    factor for each line and band, at mid exposure.
    """

    name = "polarisation"
    cost_ns = MappingProxyType({"exact": 0.2})

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound by level times the factor furthest from 1 in each band, over all incidences that the sweeps have."""
        incidence = _incidence(sweep_ends(probe, rig.camera))
        if rig.mirror.coating == "ideal" or not incidence.size:
            return Bound(0.0, "the mirror reflects everything" if incidence.size else "no line is taken")
        most = np.abs(_factors_between(incidence, rig, probe.wavelength_nm) - 1).max(axis=0)
        angles = f"{np.degrees(incidence.min()):.1f} to {np.degrees(incidence.max()):.1f} deg"
        changed = f"{100 * most.max():.2g} % of the light at {probe.wavelength_nm[int(most.argmax())]:.0f} nm"
        return Bound(probe.scaled(most), f"{rig.mirror.coating} changes {changed}, at incidences from {angles}")

    def gain_range(self, probe: Probe, rig: Rig) -> GainRange:
        incidence = _incidence(sweep_ends(probe, rig.camera))
        return GainRange.of(_factors_between(incidence, rig, probe.wavelength_nm), uneven=0.0)

    def gain(self, block: SweepBlock, variant: str) -> Radiance:
        incidence = _incidence(ahead(block.sweep.swath_px, block.scan_px, block.rig.camera))
        return _factors(incidence, block.rig, block.wavelength_nm)[:, None].astype(np.float32)


def _incidence(view_directions: Floats) -> Floats:
    """Return the angle between chief ray and mirror normal for unit look directions with this o_z. [rad]"""
    return np.arccos(np.sqrt((1 - view_directions) / 2))


def _factors(incidence_rad: Floats, rig: Rig, wavelength_nm: Floats) -> Floats:
    at_rest = reflectance(rig.mirror.coating, wavelength_nm, np.array([REST_RAD]))
    return reflectance(rig.mirror.coating, wavelength_nm, incidence_rad) / at_rest


def _factors_between(incidence_rad: Floats, rig: Rig, wavelength_nm: Floats) -> Floats:
    return _factors(np.linspace(incidence_rad.min(), incidence_rad.max(), _PROBES), rig, wavelength_nm)


def reflectance(coating: Coating, wavelength_nm: Floats, incidence_rad: Floats) -> Floats:
    """Return the fraction of unpolarised light that a coating reflects, (incidence, band): both polarisations' mean.

    Valid from 310 to 2066 nm, beyond which the index of the nearest end is held, for films of 50 nm or more.
    """
    if coating == "ideal":
        return np.ones((len(incidence_rad), len(wavelength_nm)))
    nm, n, k = _ALUMINIUM.T
    index = np.interp(wavelength_nm, nm, n) + 1j * np.interp(wavelength_nm, nm, k)
    across, within = fresnel(index, incidence_rad[:, None])
    return (across + within) / 2


def fresnel(index: NDArray[np.complex128], incidence_rad: Floats) -> tuple[Floats, Floats]:
    """Return what a surface in air reflects of light polarised across (s) and within (p) the plane of incidence [1]."""
    cosine = np.cos(incidence_rad)
    square = index**2
    beyond = np.sqrt(square - np.sin(incidence_rad) ** 2)  # index times the cosine behind the surface
    across = np.abs((cosine - beyond) / (cosine + beyond)) ** 2
    within = np.abs((square * cosine - beyond) / (square * cosine + beyond)) ** 2
    return across, within


VIGNETTING, POLARISATION = Vignetting(), Polarisation()
