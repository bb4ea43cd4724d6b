"""Polarisation: the mirror reflects, and the spectrograph takes, a share of the light that goes with the incidence."""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from pipeline.simulator.block import Block
from pipeline.simulator.effects.effect import OFF, Bound
from pipeline.simulator.effects.vignetting import ahead, sweep_ends
from pipeline.simulator.gain_range import GainRange
from pipeline.simulator.probe import Probe
from pipeline.simulator.rig_model import Rig

Floats = NDArray[np.float64]
Light = NDArray[np.float32]
EXACT = "exact"
REST_RAD = math.radians(45)
RIM_RAD = math.radians(70)  # the most oblique incidence that the mirror reaches


@dataclass(frozen=True)
class Polarisation:
    """Reflectance falls by a straight line of the chief ray's incidence: 1 at rest, 1 - p at 70 deg, 1 + p at 20 deg.

    The same at all wavelengths: no curve was measured. One factor for each line, at mid exposure.
    """

    name = "polarisation"
    variants = (EXACT,)
    cost_ns = MappingProxyType({EXACT: 0.2})

    def bound(self, probe: Probe, rig: Rig, variant: str = OFF) -> Bound:
        """Bound it by the greatest signal times the factor's greatest difference from 1 over all sweeps."""
        share = rig.optics.polarisation
        ends = sweep_ends(probe, rig.camera)
        if share == 0 or not ends.size:
            return Bound(0.0, "the reflectance does not depend on the incidence" if ends.size else "no line is taken")
        if variant == EXACT:
            return Bound(0.0, "exact")
        incidence = _incidence(ends)
        most = float(np.abs(_factor(incidence, share) - 1).max())
        least_deg, most_deg = np.degrees(incidence.min()), np.degrees(incidence.max())
        why = f"{100 * most:.2g} % of the light, at incidences of {least_deg:.1f} to {most_deg:.1f} deg"
        return Bound(probe.scaled(most), why)

    def gain_range(self, probe: Probe, rig: Rig) -> GainRange:
        """Give the factors of all sweeps, each the same along a line."""
        factors = _factor(_incidence(sweep_ends(probe, rig.camera)), rig.optics.polarisation)
        least, greatest = float(factors.min(initial=1.0)), float(factors.max(initial=1.0))
        return GainRange.between(least, greatest, len(probe.wavelength_nm))

    def gain(self, block: Block, variant: str) -> Light:
        """Give the factor of each line, (line, 1, 1)."""
        looks = ahead(block.sweep.strip_px, block.scan_px, block.rig.camera)
        factor = _factor(_incidence(looks), block.rig.optics.polarisation)
        return np.asarray(factor[:, None, None], np.float32)


POLARISATION = Polarisation()


def _incidence(looks_ahead: Floats) -> Floats:
    """Angle between chief ray and mirror normal where the mirror looks along unit directions of this o_z. [rad]"""
    angle: Floats = np.arccos(np.sqrt((1 - looks_ahead) / 2))
    return angle


def _factor(incidence_rad: Floats, share: float) -> Floats:
    return 1 - share * (incidence_rad - REST_RAD) / (RIM_RAD - REST_RAD)
