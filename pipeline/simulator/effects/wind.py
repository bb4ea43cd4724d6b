"""Wind in the crop: gusts run over the canopy as waves, and every line sees it where it has swayed to by then."""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from pipeline.simulator.block import SweepBlock
from pipeline.simulator.effects.effect import OFF, Bound
from pipeline.simulator.probe import Probe
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.streams import sweep_stream

Floats = NDArray[np.float64]
GUST_M = 3.0  # length of the waves that run over a canopy; assumed


@dataclass(frozen=True)
class Wind:
    """Crop motion: the scene sways by a travelling wave along the wind, its phase and direction drawn for a survey.

    All of the scene sways, bare soil too, as one that stands at mid exposure. Lines sample the sway at the frame rate:
    where f t_frame is above one half, a fast sway shows as a slow one.

    The smear within an exposure is not modelled, nor counted in the bound: up to 2 pi f t_exp of the amplitude, which
    is 2 % of it at 1 Hz in 3 ms and 62 % in 100 ms. ``why`` tells how many px that are.
    """

    name = "wind"
    variants = ("exact",)
    cost_ns = MappingProxyType({"exact": 0.9})

    def displaced(self, block: SweepBlock, along_px: Floats, scan_px: Floats, variant: str) -> tuple[Floats, Floats]:
        """Give what to add to points (line, sample), along the line and along the scan. [px]"""
        sway, air = sway_px(block.rig), block.rig.air
        if sway == 0 or air.distance_m is None:
            return np.zeros_like(along_px), np.zeros_like(scan_px)
        phase, heading = sweep_stream(block.seed, "", self.name).uniform(0, 2 * math.pi, 2)
        x, y = (along_px, scan_px) if block.sweep.along == "x" else (scan_px, along_px)
        downwind = (x * math.cos(heading) + y * math.sin(heading)) * block.rig.camera.ifov_rad * air.distance_m
        turns = air.wind_hz * block.time_s[:, None] - downwind / GUST_M
        moved = sway * np.sin(2 * math.pi * turns + phase)
        right, down = moved * math.cos(heading), moved * math.sin(heading)
        return (right, down) if block.sweep.along == "x" else (down, right)

    def bound(self, probe: Probe, rig: Rig, variant: str = OFF) -> Bound:
        """Bound by the amplitude times the length of the steepest gradient, whichever way the wind blows."""
        sway = sway_px(rig)
        if variant != OFF or sway == 0:
            return Bound(0.0, "the air is calm" if variant == OFF else "exact")
        steep = sway * np.hypot(probe.slope[0], probe.slope[1])
        return Bound(float(np.minimum(steep, probe.span).max(initial=0.0)), _reason(rig, sway))


WIND = Wind()


def sway_px(rig: Rig) -> float:
    """Give the amplitude of the canopy's sway, A / (d IFOV); 0 for a scene without a distance. [px]"""
    air = rig.air
    return 0.0 if air.distance_m is None else air.wind_amplitude_m / (air.distance_m * rig.camera.ifov_rad)


def sway_gradient(rig: Rig) -> float:
    """Give by how much the sway differs from one px to the next at most, 2 pi A over the length of a gust."""
    return 2 * math.pi * rig.air.wind_amplitude_m / GUST_M if sway_px(rig) else 0.0


def line_to_line_px(rig: Rig) -> float:
    """Give the most that the crop moves from one line to the next, 2 A |sin(pi f t_frame)| / (d IFOV). [px]"""
    return 2 * sway_px(rig) * abs(math.sin(math.pi * sways_per_line(rig)))


def within_exposure_px(rig: Rig) -> float:
    """Give the most that the crop moves while a line is exposed, 2 A |sin(pi f t_exp)| / (d IFOV) up to 2 A. [px]"""
    sways = min(rig.air.wind_hz * rig.camera.exposure_ms * 1e-3, 0.5)
    return 2 * sway_px(rig) * math.sin(math.pi * sways)


def sways_per_line(rig: Rig) -> float:
    """Give f t_frame; above one half the sway is aliased."""
    return rig.air.wind_hz * rig.camera.frame_ms * 1e-3


def _reason(rig: Rig, sway: float) -> str:
    aliased = ", too fast for the lines to follow" if sways_per_line(rig) > 0.5 else ""
    smeared = f"up to {within_exposure_px(rig):.2g} px of smear within an exposure are not modelled"
    return f"the crop sways by {sway:.2g} px, {line_to_line_px(rig):.2g} px from line to line{aliased}; {smeared}"
