"""Turbulence: warm air between rig and scene bends the light, anew for every line.

References
----------
.. [1] Andrews and Phillips, "Laser Beam Propagation through Random Media", 2nd edition, SPIE Press, 2005, chapters 6
   (angle of arrival) and 8 (scintillation).
.. [2] Fried, "Optical resolution through a randomly inhomogeneous medium for very long and very short exposures",
   Journal of the Optical Society of America 56, 1966. doi:10.1364/JOSA.56.001372
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from pipeline.simulator.block import SweepBlock
from pipeline.simulator.effects.blurring import UNITS
from pipeline.simulator.effects.effect import OFF, Bound
from pipeline.simulator.effects.sight import FARTHEST_M
from pipeline.simulator.probe import Probe
from pipeline.simulator.rig_model import Rig

Floats = NDArray[np.float64]

PLANE = 2.91  # angle of arrival of a star's light [1]
NEAR_POINTS = 3 / 8  # of it from a path's end: the mean of (z / d)^(5/3); r0 [2] is (8/3)^(3/5) times as wide
RISK = 1e-3  # share of the surveys in which a line may stray further than the bound says
_REST = math.sqrt(0.5)


@dataclass(frozen=True)
class Turbulence:
    """Jitter of the lines, normal and equal in both directions."""

    name = "turbulence"
    variants = ("jitter",)
    cost_ns = MappingProxyType({"jitter": 0.13})

    def aim(self, block: SweepBlock, variant: str) -> Floats:
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
        strength = rytov_variance(rig, float(np.min(probe.wavelength_nm, initial=np.inf)))
        beyond = f"; a guess, beyond weak turbulence (Rytov variance {strength:.2g})" if strength > 1 else ""
        return Bound(
            change,
            f"{sigma:.2g} px (sd) per line, at most {farthest:.2g} px in {probe.lines} lines,"
            f" on edges of at most {steep.max(initial=0.0):.3g} {UNITS[probe.unit]}/px{beyond}",
        )


TURBULENCE = Turbulence()


def turbulence_px(rig: Rig) -> float:
    """Give the standard deviation of the angle of arrival per axis, sqrt(1.09 Cn2 d D^(-1/3)), from the farthest part.

    A point of the scene sends spherical waves: air near the point tilts them less than air near the aperture, by
    (z / d)^(5/3) a length of way, so that 3/8 of a plane wave's 2.91 are left [1]. D is the aperture as seen at rest,
    10.6 mm of 15. Valid for Kolmogorov's spectrum with the same Cn2 all along the way (level, over even ground); for D
    between its inner scale (some mm) and its outer one (some 0.1 m and more); where the first Fresnel zone,
    sqrt(lambda d), is not much wider than D; and for weak turbulence, a `rytov_variance` up to 1: the bound says where
    it is more. A scene without a distance has none. No way through the air is longer than `FARTHEST_M`, however far the
    scene is. [px]
    """
    metres = _way_m(rig)
    aperture_m = rig.optics.aperture_mm * 1e-3 * _REST
    angle = math.sqrt(NEAR_POINTS * PLANE * rig.air.turbulence_cn2 * metres * aperture_m ** (-1 / 3))
    return angle / rig.camera.ifov_rad


def rytov_variance(rig: Rig, wavelength_nm: float) -> float:
    """Give how strong the turbulence is: of the light's logarithm in spherical waves, 0.5 Cn2 k^(7/6) d^(11/6) [1]."""
    waves_per_m = 2 * math.pi / (wavelength_nm * 1e-9)
    variance: float = 0.5 * rig.air.turbulence_cn2 * waves_per_m ** (7 / 6) * _way_m(rig) ** (11 / 6)
    return variance


def _way_m(rig: Rig) -> float:
    return 0.0 if rig.distances_m is None else min(max(rig.distances_m), FARTHEST_M)
