"""Polarisation: the mirror's coating reflects both polarisations unequally, by the incidence and the wavelength."""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from pipeline.simulator.block import SweepBlock
from pipeline.simulator.coatings import reflectance
from pipeline.simulator.effects.effect import OFF, Bound
from pipeline.simulator.effects.vignetting import ahead, sweep_ends
from pipeline.simulator.gain_range import GainRange
from pipeline.simulator.probe import Probe
from pipeline.simulator.rig_model import Rig

Floats = NDArray[np.float64]
Light = NDArray[np.float32]
EXACT = "exact"
REST_RAD = math.radians(45)
_LOOKS = 65  # incidences at which the sweeps' factors are taken for the bounds


@dataclass(frozen=True)
class Polarisation:
    """Light goes with the coating's reflectance at the chief ray's incidence over that at rest, 45 deg.

    By Fresnel's formulae for bare metal, see `coatings`: from 20 to 70 deg aluminium goes from +0.5 to -3.7 % (mean of
    400 to 1000 nm; -5.4 % at 820 nm), gold in the blue from -1.8 to +18 %. Valid where the light is unpolarised and the
    spectrograph takes both polarisations alike; sky mirrored by wet leaves is not, and gratings do not quite. One
    factor for each line and band, at mid exposure.
    """

    name = "polarisation"
    variants = (EXACT,)
    cost_ns = MappingProxyType({EXACT: 0.2})

    def bound(self, probe: Probe, rig: Rig, variant: str = OFF) -> Bound:
        """Bound it by the greatest signal times the factor's greatest difference from 1 over all sweeps."""
        incidence = _incidence(sweep_ends(probe, rig.camera))
        if rig.mirror.coating == "ideal" or not incidence.size:
            return Bound(0.0, "the mirror reflects everything" if incidence.size else "no line is taken")
        if variant == EXACT:
            return Bound(0.0, "exact")
        factors = _factors_between(incidence, rig, probe.wavelength_nm)
        between = np.abs(np.diff(factors, 2, axis=0)).max(axis=0) / 8  # most that a chord misses of what it cuts off
        most = np.abs(factors - 1).max(axis=0) + between
        least_deg, most_deg = np.degrees(incidence.min()), np.degrees(incidence.max())
        where = f" at {probe.wavelength_nm[int(most.argmax())]:.0f} nm" if most.size else ""
        why = (
            f"{rig.mirror.coating}, {100 * most.max(initial=0.0):.2g} % of the light{where}, at incidences of"
            f" {least_deg:.1f} to {most_deg:.1f} deg"
        )
        return Bound(probe.scaled(most), why)

    def gain_range(self, probe: Probe, rig: Rig) -> GainRange:
        """Give the factors of all sweeps, each the same along a line."""
        incidence, nm = _incidence(sweep_ends(probe, rig.camera)), np.asarray(probe.wavelength_nm, np.float64)
        if not incidence.size:
            return GainRange.between(1.0, 1.0, len(nm))
        return GainRange.of(_factors_between(incidence, rig, nm), nm, uneven=0.0)

    def gain(self, block: SweepBlock, variant: str) -> Light:
        """Give the factor of each line, (line, 1, band)."""
        looks = ahead(block.sweep.strip_px, block.scan_px, block.rig.camera)
        factor: Light = _factors(_incidence(looks), block.rig, block.wavelength_nm).astype(np.float32)
        return factor[:, None, :]


POLARISATION = Polarisation()


def _incidence(looks_ahead: Floats) -> Floats:
    """Angle between chief ray and mirror normal where the mirror looks along unit directions of this o_z. [rad]"""
    angle: Floats = np.arccos(np.sqrt((1 - looks_ahead) / 2))
    return angle


def _factors(incidence_rad: Floats, rig: Rig, wavelength_nm: Floats) -> Floats:
    """Reflectance over that at rest, (incidence, band)."""
    at_rest = reflectance(rig.mirror.coating, wavelength_nm, np.array([REST_RAD]))
    return reflectance(rig.mirror.coating, wavelength_nm, incidence_rad) / at_rest


def _factors_between(incidence_rad: Floats, rig: Rig, wavelength_nm: Floats) -> Floats:
    """Factors evenly from the least to the greatest of some incidences: metals may have extremes in between."""
    return _factors(np.linspace(incidence_rad.min(), incidence_rad.max(), _LOOKS), rig, wavelength_nm)
