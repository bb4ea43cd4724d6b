"""Light on the scene and towards the rig: the sun's course, clouds, and reflectance by the angle of view."""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import Sweep, points_of_scan
from pipeline.simulator.effects.effect import Bound, Gain, Radiance, SweepBlock, survey_stream
from pipeline.simulator.effects.probe import GainRange, Probe
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scenes.daylight import knots_within, relative_daylight, sun_elevation_deg

Floats = NDArray[np.float64]
_KNOTS_AT_ONCE = 512
EDGE_FRACTION = 0.1  # width of a shadow's edge, over the shadow's size (assumed)
HOT_SPOT_RAD = float(np.deg2rad(2.0))  # from its peak to 1/e (assumed)
_PROBES = 65  # lines of a sweep, and samples of a line, at which angles are taken for the bound


@dataclass(frozen=True)
class Drift(Gain):
    """Light at a line's mid exposure over the light at the survey's start, to which the scene is stated.

    It is SPECTRL2 under a clear sky. A survey that starts in the night is relative to the light of a sun 1 deg high.
    The light is 0 with the sun at the horizon or below. Without a time of day there is none.
    """

    name = "drift"
    cost_ns = MappingProxyType({"spectral": 0.4})

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound by level times the greatest change of the light through the survey.

        The light is straight between its knots, so that its extremes lie on them.
        """
        if rig.sky.started is None:
            return Bound(0.0, "the survey has no time of day")
        seconds = probe.seconds + rig.camera.frame_ms * 1e-3  # to the end of the last line
        worst = np.zeros(len(probe.wavelength_nm))
        times = knots_within(rig.sky, seconds)
        for some in np.array_split(times, len(times) // _KNOTS_AT_ONCE + 1):
            change = relative_daylight(rig.sky, probe.wavelength_nm, some) - 1
            worst = np.maximum(worst, np.abs(change).max(axis=0))
        low, high = sun_elevation_deg(rig.sky, np.array([0.0, seconds]))
        spoken = f"{seconds / 3600:.1f} h" if seconds >= 3600 else f"{seconds:.0f} s"
        course = f"with the sun from {low:.1f} to {high:.1f} deg in {spoken}"
        return Bound(probe.scaled(worst), f"light changes by at most {100 * worst.max(initial=0.0):.3g} % {course}")

    def gain_range(self, probe: Probe, rig: Rig) -> GainRange:
        nm = np.asarray(probe.wavelength_nm, np.float64)
        if rig.sky.started is None:
            return GainRange.between(1.0, 1.0, len(nm))
        times = knots_within(rig.sky, probe.seconds + rig.camera.frame_ms * 1e-3)
        light = relative_daylight(rig.sky, nm, times)
        return GainRange.of(light, nm, uneven=float(np.ptp(light, axis=1).max(initial=0.0)))

    def gain(self, block: SweepBlock, variant: str) -> Radiance:
        sky = block.rig.sky
        if sky.started is None:
            return np.ones((1, 1, 1), np.float32)
        return relative_daylight(sky, block.wavelength_nm, block.time_s)[:, None].astype(np.float32)


@dataclass(frozen=True)
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
        sky, sweep = block.rig.sky, block.sweep
        along, scan = points_of_scan(sweep.swath_px, block.rig.camera, block.scan_px[:, None], block.slopes)
        x, y = (along, scan) if sweep.along == "x" else (scan, along)
        turn, place = survey_stream(block.seed, self.name).random(2)
        heading, place = 2 * math.pi * float(turn), 2 * sky.cloud_size_px * float(place)
        way = x * math.cos(heading) + y * math.sin(heading) - sky.cloud_px_per_s * block.time_s[:, None] + place
        return (1 - sky.cloud_fraction * shadow(way, sky.cloud_size_px))[..., None].astype(np.float32)


def shadow(way_px: Floats, size_px: float) -> Floats:
    """Return the fraction of a cloud between the sun and points so far along its way, 0 to 1; the period is 2 sizes.

    It is 1 about every even multiple of the size, 0 about the odd ones, 1/2 in the middle of an edge.
    """
    from_middle = np.abs((way_px + size_px) % (2 * size_px) - size_px)
    t = np.clip((size_px / 2 - from_middle) / (EDGE_FRACTION * size_px) + 0.5, 0.0, 1.0)
    return t * t * (3 - 2 * t)


@dataclass(frozen=True)
class Brdf(Gain):
    """Reflectance over that in the undeflected direction: 1 + b a + h exp(-phase / 2 deg), never below 0.

    The angle a of view runs along the scene's x axis, in the sun's plane (assumed); b is ``sky.brdf_per_rad``. The
    phase is the angle to the undeflected direction, along which the sun's rays come (assumed); h is ``sky.hot_spot``.
    All materials and bands share it; directions are those of the plan, right to the mirror's own faults of 1e-3 rad.
    """

    name = "brdf"
    cost_ns = MappingProxyType({"angles": 0.2})

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound by level times the greatest change: the slope at the largest angle, the hot spot at the least phase."""
        slope, hot = rig.sky.brdf_per_rad, rig.sky.hot_spot
        if slope == 0 and hot == 0:
            return Bound(0.0, "the scene reflects alike in all directions")
        angle, phase = _extremes(probe.sweeps, rig.camera)
        fraction = slope * angle + hot * float(np.exp(-phase / HOT_SPOT_RAD))
        peak = f" and a hot spot of {hot:.2g}" if hot else ""
        why = f"reflectance changes by at most {fraction:.2%}: {slope:.2g}/rad up to {np.rad2deg(angle):.2f} deg{peak}"
        return Bound(probe.scaled(fraction), why)

    def gain_range(self, probe: Probe, rig: Rig) -> GainRange:
        slope, bands = rig.sky.brdf_per_rad, len(probe.wavelength_nm)
        angle, phase = _extremes(probe.sweeps, rig.camera)
        least = max(1 - slope * angle, 0.0)
        greatest = 1 + slope * angle + rig.sky.hot_spot * float(np.exp(-phase / HOT_SPOT_RAD))
        return GainRange.between(least, greatest, bands, uneven=greatest - least)

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


def _extremes(sweeps: tuple[Sweep, ...], camera: LineCamera) -> tuple[float, float]:
    """Return the greatest angle from the undeflected direction and least phase within the sweeps [rad]."""
    greatest, least = 0.0, np.inf
    for sweep in (sweep for sweep in sweeps if sweep.lines):
        ends = [np.linspace(0, count - 1, _PROBES).round().astype(int) for count in (sweep.lines, camera.samples)]
        lines, samples = map(np.unique, ends)
        angle, phase = _angles(sweep, camera, sweep.line_px()[lines], camera.pixel_slopes()[samples])
        steps = [np.abs(np.diff(phase, axis=axis)).max(initial=0.0) for axis in (0, 1)]
        greatest = max(greatest, float(np.abs(angle).max()))
        least = min(least, float(phase.min() - sum(steps) / 2))  # no point is further from one looked at
    return greatest, max(least, 0.0)


DRIFT, CLOUD, BRDF = Drift(), Cloud(), Brdf()
