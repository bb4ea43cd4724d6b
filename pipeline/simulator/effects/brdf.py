"""Reflectance by the angle of view: a slope over the field, and the hot spot about the sun's own direction."""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from pipeline.camera import LineCamera
from pipeline.scan import Sweep, points_of_scan
from pipeline.simulator.block import SweepBlock
from pipeline.simulator.effects.effect import OFF, Bound, Light
from pipeline.simulator.gain_range import GainRange
from pipeline.simulator.probe import Probe
from pipeline.simulator.rig_model import Rig

Floats = NDArray[np.float64]
HOT_SPOT_RAD = float(np.deg2rad(2.0))  # from its peak to 1/e (assumed)
_LOOKS = 65  # lines of a sweep, and samples of a line, at which angles are taken for the bound


@dataclass(frozen=True)
class Brdf:
    """Reflectance over that in the undeflected direction: 1 + b a + h exp(-phase / 2 deg), never below 0.

    The angle a of view runs along the scene's x axis, which lies in the sun's plane (assumed); b is
    ``sky.brdf_per_rad``. The phase is the angle to the undeflected direction, along which the sun's rays come from
    behind the rig (assumed); h is ``sky.hot_spot``, and at its peak the slope breaks: a cusp. All materials and bands
    share it, and directions are those of the plan, right to the mirror's own faults of 1e-3 rad.
    """

    name = "brdf"
    variants = ("angles",)
    cost_ns = MappingProxyType({"angles": 0.2})

    def bound(self, probe: Probe, rig: Rig, variant: str = OFF) -> Bound:
        """Bound by level times the greatest slope part plus the greatest hot spot within the sweeps."""
        slope, hot = rig.sky.brdf_per_rad, rig.sky.hot_spot
        if slope == 0 and hot == 0:
            return Bound(0.0, "the scene reflects alike in all directions")
        if variant != OFF:
            return Bound(0.0, "every sample at its own angle")
        angle, phase = _extremes(probe.sweeps, rig.camera)
        share = slope * angle + hot * float(np.exp(-phase / HOT_SPOT_RAD))
        peak = f" and a hot spot of {hot:.2g}" if hot else ""
        why = f"reflectance changes by at most {share:.2%}: {slope:.2g}/rad up to {np.rad2deg(angle):.2f} deg{peak}"
        return Bound(probe.scaled(share), why)

    def gain_range(self, probe: Probe, rig: Rig) -> GainRange:
        """Give the slope's ends, the hot spot on the upper one."""
        slope, bands = rig.sky.brdf_per_rad, len(probe.wavelength_nm)
        if not slope and not rig.sky.hot_spot:
            return GainRange.between(1.0, 1.0, bands)
        angle, phase = _extremes(probe.sweeps, rig.camera)
        least = max(1 - slope * angle, 0.0)
        greatest = 1 + slope * angle + rig.sky.hot_spot * float(np.exp(-phase / HOT_SPOT_RAD))
        return GainRange.between(least, greatest, bands, uneven=greatest - least)

    def gain(self, block: SweepBlock, variant: str) -> Light:
        """Give (line, sample, 1)."""
        sky = block.rig.sky
        if sky.brdf_per_rad == 0 and sky.hot_spot == 0:
            return np.ones((1, 1, 1), np.float32)
        angle, phase = _angles(block.sweep, block.rig.camera, block.scan_px, block.slopes)
        factor = 1 + sky.brdf_per_rad * angle
        if sky.hot_spot:
            factor = factor + sky.hot_spot * np.exp(-phase / HOT_SPOT_RAD)
        return np.maximum(factor, 0.0)[..., None].astype(np.float32)


BRDF = Brdf()


def _angles(sweep: Sweep, camera: LineCamera, scan_px: Floats, slopes: Floats) -> tuple[Floats, Floats]:
    """Angle of view along the scene's x axis and phase, (line, sample) each [rad]."""
    along, scan = points_of_scan(sweep.strip_px, camera, scan_px[:, None], slopes)
    x = along if sweep.along == "x" else scan
    return np.arctan(x * camera.ifov_rad), np.arctan(np.hypot(along, scan) * camera.ifov_rad)


def _extremes(sweeps: tuple[Sweep, ...], camera: LineCamera) -> tuple[float, float]:
    """Greatest angle from the undeflected direction and least phase within the sweeps [rad]."""
    greatest, least = 0.0, np.inf
    for sweep in (sweep for sweep in sweeps if sweep.lines):
        angle, phase = _angles(sweep, camera, *(_looks(part) for part in (sweep.line_px(), camera.pixel_slopes())))
        steps = [np.abs(np.diff(phase, axis=axis)).max(initial=0.0) for axis in (0, 1)]
        greatest = max(greatest, float(np.abs(angle).max()))
        least = min(least, float(phase.min() - sum(steps) / 2))  # no point is further from one looked at
    return greatest, max(least, 0.0)


def _looks(values: Floats) -> Floats:
    """Take some of them, with both ends."""
    some: Floats = values[np.unique(np.linspace(0, len(values) - 1, _LOOKS).round().astype(int))]
    return some
