"""Turbulence: warm air between rig and scene bends the light, anew for every line."""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from pipeline.simulator.block import Block
from pipeline.simulator.effects.blurring import UNITS
from pipeline.simulator.effects.effect import OFF, Bound
from pipeline.simulator.effects.sight import FARTHEST_M
from pipeline.simulator.probe import Probe
from pipeline.simulator.rig_model import Rig

Floats = NDArray[np.float64]

RISK = 1e-3  # share of the surveys in which a line may stray further than the bound says
_REST = math.sqrt(0.5)


@dataclass(frozen=True)
class Turbulence:
    """Jitter of the lines, normal and equal in both directions."""

    name = "turbulence"
    variants = ("jitter",)
    cost_ns = MappingProxyType({"jitter": 0.13})

    def aim(self, block: Block, variant: str) -> Floats:
        """Give how far each line looks beside its plan, (line, 1, 2) along the line and the scan. [px]"""
        sigma = turbulence_px(block.rig)
        draws = [block.stream(self.name, int(number)).standard_normal(2) for number in block.numbers]
        return sigma * np.array(draws, np.float64).reshape(-1, 1, 2)

    def bound(self, probe: Probe, rig: Rig, variant: str = OFF) -> Bound:
        """Bound the error of leaving the lines where they are, for all lines at once but in one survey of 1000.

        The way of a line is Rayleigh's: it exceeds m sigma with the probability exp(-m^2 / 2), so that no line of N
        exceeds sqrt(2 ln(N / risk)) sigma but with the risk; 5.3 for 1000 lines.
        """
        if variant != OFF:
            return Bound(0.0, "exact")
        sigma = turbulence_px(rig)
        if not sigma:
            return Bound(0.0, "no distance or no turbulence")
        farthest = sigma * math.sqrt(2 * math.log(max(probe.lines, 1) / RISK))
        steep = np.hypot(*probe.slope)
        change = float(np.minimum(steep * farthest, probe.span).max(initial=0.0))
        return Bound(
            change,
            f"{sigma:.2g} px (sd) per line, at most {farthest:.2g} px in {probe.lines} lines,"
            f" on edges of at most {steep.max(initial=0.0):.3g} {UNITS[probe.unit]}/px",
        )


TURBULENCE = Turbulence()


def turbulence_px(rig: Rig) -> float:
    """Give the standard deviation of the angle of arrival per axis, sqrt(2.91 Cn2 d D^(-1/3)), from the farthest part.

    D is the aperture as seen at rest, 10.6 mm of 15; a scene without a distance has none. No way through the air is
    longer than `FARTHEST_M`, however far the scene is. [px]
    """
    if rig.distances_m is None:
        return 0.0
    metres = min(max(rig.distances_m), FARTHEST_M)
    aperture_m = rig.optics.aperture_mm * 1e-3 * _REST
    angle = math.sqrt(2.91 * rig.air.turbulence_cn2 * metres * aperture_m ** (-1 / 3))
    return angle / rig.camera.ifov_rad
