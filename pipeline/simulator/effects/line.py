"""Geometry of a line in the scene, and what its samples cover: rotation, slit and pixel, motion smear."""

from __future__ import annotations

import math
from types import MappingProxyType

import numpy as np

from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.scan import Floats, Sweep, points_of_scan
from spectralzoom.pipeline.simulator.effects.air import turbulence_px
from spectralzoom.pipeline.simulator.effects.effect import OFF, Bound, Effect, SweepBlock
from spectralzoom.pipeline.simulator.effects.pointing import beside_plan, greatest_lag_px, transient
from spectralzoom.pipeline.simulator.effects.probe import Probe
from spectralzoom.pipeline.simulator.optics.kernel_fit import BETWEEN_ROWS, SCALE_STEP, TABULATED
from spectralzoom.pipeline.simulator.rig_model import Rig

MARGIN = 1.5  # over what the probe measured at the roughest places found
UPRIGHT = "1x1"  # the slit's variant of one box that does not lie turned
_RAY_PER_TILT = 2.6  # a ray turns by twice the tilt; the scene plane is oblique to it by up to 30 deg
_PROBES = 33  # lines of a sweep and samples of a line at which its course is taken; both are smooth
BOXES = {"9x3": (9, 3), "5x2": (5, 2), "3x1": (3, 1), UPRIGHT: (1, 1)}  # of the slit's variants, across and along
POSITIONS, FOLDED = "positions", "folded"


def beside_plan_px(probe: Probe, rig: Rig) -> tuple[float, float]:
    """Return how far beside its plan the rig may look by drift, hysteresis, jitter, turbulence and lag. [px]

    Along the line and the scan. Lines lie turned by where the mirror looks: the farther from the middle, the more.
    """
    mirror = rig.mirror
    drift = mirror.drift_px_per_min / 60 * (probe.seconds + rig.camera.frame_ms * 1e-3)
    jitter = _RAY_PER_TILT * mirror.repeatability_urad * 1e-6 / rig.camera.ifov_rad
    drawn = (jitter + turbulence_px(rig)) * math.sqrt(2 * math.log(max(probe.lines, 1) / 1e-3))
    way = drift + mirror.hysteresis_px + drawn
    return way, way + greatest_lag_px(rig, probe.sweeps)


class Rotation(Effect):
    """Line rotation and projective scale, by rays. Off, every line lies straight along its axis at nominal scale."""

    name = "rotation"
    cost_ns = MappingProxyType({"rays": 0.0})  # straight lines take as long

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound by slope times the greatest way between where rays meet the scene and where straight lines would."""
        beside = beside_plan_px(probe, rig)
        ways = [
            _course(sweep, rig.camera, (along, scan))
            for sweep in probe.sweeps
            if sweep.lines
            for along in {-beside[0], 0.0, beside[0]}
            for scan in {-beside[1], 0.0, beside[1]}
        ]
        along, scan = (max(way[0] for way in ways), max(way[1] for way in ways)) if ways else (0.0, 0.0)
        most = f"{round(along, 9):.3g} px along and {round(scan, 9):.3g} px along the scan"
        # The footprint does not lie turned either: the same as one box that does not.
        shape = MARGIN * probe.slit_errors.get(UPRIGHT, 0.0)
        return Bound(probe.moved(along, scan) + shape, f"lines are turned and stretched by at most {most}")


def _course(sweep: Sweep, camera: LineCamera, beside: tuple[float, float]) -> tuple[float, float]:
    slopes = camera.pixel_slopes()
    slopes = slopes[np.unique(np.linspace(0, len(slopes) - 1, _PROBES).round().astype(int))]
    numbers = np.unique(np.linspace(0, sweep.lines - 1, _PROBES).round().astype(int))
    swath, scan = sweep.swath_px + beside[0], sweep.line_px()[numbers][:, None] + beside[1]
    along_px, scan_px = points_of_scan(swath, camera, scan, slopes)
    straight = swath + slopes / camera.ifov_rad
    return float(np.abs(along_px - straight).max()), float(np.abs(scan_px - scan).max())


class SlitBox(Effect):
    """The footprint of slit and pixel, a box in closed form. Off, a sample sees what its middle ray meets.

    A variant parts it into boxes across and along that do not lie turned; two across and more have its covariance.
    """

    name = "slit"
    cost_ns = MappingProxyType({"9x3": 10.0, "5x2": 3.4, "3x1": 0.5, UPRIGHT: 0.0})  # one box is no dearer than none

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound by half as much again as the probe measured; where it has not, by the box's variance and the span.

        Rounding in tables adds a little, and so do lines that turn more where the mirror looks beside its plan.
        """
        width = rig.camera.slit_px
        bands = len(probe.wavelength_nm)
        instead = "its middle ray" if variant == OFF else f"{variant.replace('x', ' x ')} boxes that are not turned"
        why = f"{instead} in place of a footprint {width:.2g} px wide and 1 px long"
        box = np.array([[1.0], [width**2]]) / 12
        if variant not in probe.slit_errors:
            return Bound(probe.blurred(np.repeat(box, bands, axis=1)), why)
        value = MARGIN * probe.slit_errors[variant]
        if variant != OFF:
            turned = max(beside_plan_px(probe, rig)) * rig.camera.ifov_rad * (width**2 + 1) / 12
            value += probe.blurred(np.repeat(SCALE_STEP * box + BETWEEN_ROWS, bands, axis=1))
            value += probe.blurred(np.full((2, bands), turned)) + TABULATED * float(probe.span.max(initial=0.0))
        return Bound(value, f"{why}, measured where the scene is roughest")


def box_of(variant: str, rig: Rig) -> tuple[float, float]:
    """Return the widths of slit and pixel; 0 where the footprint is off. [px]"""
    return (0.0, 0.0) if variant == OFF else (rig.camera.slit_px, 1.0)


class Smear(Effect):
    """The positions held within an exposure while the mirror moves on. Off, it stands at mid exposure.

    ``folded`` takes them into the footprint, as if all lines of an exposure lay as its middle one does.
    """

    name = "smear"
    cost_ns = MappingProxyType({POSITIONS: 18.0, FOLDED: 0.2})

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound what a blur of the positions' variance changes; 0 where every line has one position.

        They vary as the mirror runs: without them its course within an exposure is left out as well. A fold differs
        from the mirror's positions by no more than both differ from the one at mid exposure.
        """
        most = max((sweep.positions for sweep in probe.sweeps), default=1)
        variance = (most**2 - 1) / 12  # of positions 1 px apart
        if variance == 0:
            return Bound(0.0, "the mirror stands still while a line is exposed")
        both = np.zeros(probe.slope.shape)
        both[1] = variance
        for sweep in {(one.lines, one.step): one for one in probe.sweeps if one.lines and one.positions > 1}.values():
            numbers = np.arange(sweep.lines)  # the held positions beside their plan, (line, step) [px]
            held = transient(rig, sweep, numbers) + beside_plan(rig.mirror.positions_per_line, sweep.step, numbers)
            both[1] = np.maximum(both[1], (held + np.arange(held.shape[1])).var(axis=1).max())
        ways = 2 if variant == FOLDED else 1
        return Bound(ways * probe.blurred(both), f"the mirror moves {most} px in an exposure")


def smeared_positions(block: SweepBlock, variant: str) -> Floats:
    """Return the mirror positions (line, step, 2) at which a footprint stands in an exposure."""
    return block.positions if variant == POSITIONS and block.sweep.positions > 1 else block.middle[:, None]


ROTATION, SLIT, SMEAR = Rotation(), SlitBox(), Smear()
