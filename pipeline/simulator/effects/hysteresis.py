"""Slow errors of the mirror: a smooth field over its disk with the sign of the scan's direction, and warming up."""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from pipeline.scan import Sweep, line_positions
from pipeline.simulator.block import SweepBlock
from pipeline.simulator.effects.effect import OFF, Bound
from pipeline.simulator.effects.line_ends import at_line_ends
from pipeline.simulator.probe import Probe
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.streams import unit_stream

Floats = NDArray[np.float64]
_MODES = 6


@dataclass(frozen=True)
class Hysteresis:
    """A systematic error of pointing: smooth over the mirror's disk, one field for each copy of the rig.

    The field is at most ``hysteresis_px`` in either axis; a scan the other way meets it with the other sign.
    """

    name = "hysteresis"
    variants = ("exact",)
    cost_ns = MappingProxyType({"exact": 0.07})

    def aim(self, block: SweepBlock, variant: str) -> Floats:
        """Give the shift, (line, 1, 2) along the line and the scan. [px]"""
        return _course(block.rig, block.sweep, block.middle)[:, None]

    def bound(self, probe: Probe, rig: Rig, variant: str = OFF) -> Bound:
        """Bound by slope times the greatest shift that any line of the sweeps has: the field is known."""
        if variant != OFF or rig.mirror.hysteresis_px == 0 or not probe.sweeps:
            return Bound(0.0, "the mirror comes to the same place from either side" if variant == OFF else "exact")
        ways = [_course(rig, sweep, line_positions(sweep, rig.camera)) for sweep in probe.sweeps]
        along, scan = np.abs(np.concatenate(ways)).max(axis=0, initial=0.0)
        why = f"lines lie up to {along:.2g} px off along the line and {scan:.2g} px along the scan"
        return Bound(probe.moved(*at_line_ends(probe.sweeps, rig.camera, along, scan)), why)


@dataclass(frozen=True)
class ThermalDrift:
    """The view walks in one direction as the unit warms up; each copy of the rig has a direction of its own."""

    name = "thermal-drift"
    variants = ("exact",)
    cost_ns = MappingProxyType({"exact": 0.06})

    def aim(self, block: SweepBlock, variant: str) -> Floats:
        """Give the shift since the survey's start, (line, 1, 2) along the line and the scan. [px]"""
        walked = block.rig.mirror.drift_px_per_min / 60 * block.time_s
        return np.stack([walked * one for one in _along_and_scan(block.rig)], axis=-1)[:, None]

    def bound(self, probe: Probe, rig: Rig, variant: str = OFF) -> Bound:
        """Bound by slope times the way walked until the last line."""
        rate = rig.mirror.drift_px_per_min
        if variant != OFF or rate == 0 or not probe.sweeps:
            return Bound(0.0, "the view does not drift" if variant == OFF else "exact")
        walked = rate / 60 * (probe.seconds + rig.camera.frame_ms * 1e-3)
        along, scan = (walked * abs(one) for one in _along_and_scan(rig))
        why = f"the view drifts by {walked:.2g} px, {rate:g} px/min for {probe.seconds:.3g} s"
        return Bound(probe.moved(*at_line_ends(probe.sweeps, rig.camera, along, scan)), why)


HYSTERESIS = Hysteresis()
THERMAL_DRIFT = ThermalDrift()


def pointing_field(unit: int, position: Floats) -> Floats:
    """Give a smooth field over the disk, (..., 2) for positions (..., 2); between -1 and 1 on it. [-]

    A sum of the six Zernike polynomials up to degree 2 in the disk's own coordinates, each at most 1 in size, with
    normal deviates for weights whose sizes sum to 1.
    """
    x, y = position[..., 0], position[..., 1]
    modes = np.stack([np.ones_like(x), x, y, 2 * (x * x + y * y) - 1, x * x - y * y, 2 * x * y], axis=-1)
    weights = unit_stream(unit, Hysteresis.name).standard_normal((_MODES, 2))
    field: Floats = (modes[..., None] * (weights / np.abs(weights).sum(axis=0))).sum(axis=-2)
    return field


def _course(rig: Rig, sweep: Sweep, position: Floats) -> Floats:
    """Shift (line, 2) of lines at some positions of a sweep. [px]"""
    return rig.mirror.hysteresis_px * scan_sign(sweep) * pointing_field(rig.detector.unit, position)


def scan_sign(sweep: Sweep) -> float:
    """Give 1 for a scan towards greater coordinates (or one that stands still), -1 for one that comes back."""
    held = sweep.held_px().ravel()
    return -1.0 if len(held) > 1 and held[-1] < held[0] else 1.0


def _along_and_scan(rig: Rig) -> tuple[float, float]:
    """Part of the drift along the line and along the scan; the mirror's own axes are the line's and the scan's."""
    turn = unit_stream(rig.detector.unit, ThermalDrift.name).uniform(0, 2 * math.pi)
    return math.cos(turn), math.sin(turn)
