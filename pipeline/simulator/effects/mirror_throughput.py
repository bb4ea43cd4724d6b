"""How much light the tilted mirror passes: as the aperture stop (vignetting), and by its coating (polarisation)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.camera import LineCamera
from pipeline.simulator.block import SweepBlock
from pipeline.simulator.effects.effect import Bound, Gain
from pipeline.simulator.effects.gain_range import GainRange
from pipeline.simulator.effects.probe import Probe
from pipeline.simulator.optics.coatings import reflectance
from pipeline.simulator.rig_model import Rig

Floats = NDArray[np.float64]
Light = NDArray[np.float32]
HELD, MIDDLE = "held", "middle"
# The share is sqrt(1 - eta / sqrt(1 + xi^2 + eta^2)) of tangents xi and eta. Its second derivative over eta is largest
# at xi = 0 and eta = -tan 20 deg or so.
MOST_BEND = 0.46
EXACT = "exact"
REST_RAD = math.radians(45)
_LOOKS = 65  # incidences at which the sweeps' factors are taken for the bounds


@dataclass(frozen=True)
class Vignetting(Gain):
    """Light goes with the mirror's area as the camera sees it: |n_z| over |n_z| at rest, one factor for each line.

    ``held`` averages over the positions of an exposure, ``middle`` takes the one at mid exposure. A single patch sees
    next to one factor, yet not that of rest; so it is the difference from rest that counts.
    """

    name = "vignetting"
    cost_ns = MappingProxyType({HELD: 0.2, MIDDLE: 0.2})

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound it by the greatest signal times the factor's greatest difference from 1 over all sweeps."""
        if variant == MIDDLE:
            most = max((sweep.step for sweep in probe.sweeps), default=1)
            bend = MOST_BEND / 2 * rig.camera.ifov_rad**2 * (most**2 - 1) / 12
            return Bound(probe.scaled(bend), f"the factor bends by {bend:.1g} within the {most} px of an exposure")
        ends = sweep_ends(probe, rig.camera)
        if not ends.size:
            return Bound(0.0, "no line is taken")
        shares = np.sqrt(1 - ends)  # |n_z|^2 = (1 - o_z) / 2
        why = f"the mirror passes {shares.min():.3f} to {shares.max():.3f} of its light at rest"
        return Bound(probe.scaled(float(np.abs(shares - 1).max())), why)

    def gain_range(self, probe: Probe, rig: Rig) -> GainRange:
        """Give the factors of all sweeps, each the same along a line."""
        shares = np.sqrt(1 - sweep_ends(probe, rig.camera))
        least, greatest = float(shares.min(initial=1.0)), float(shares.max(initial=1.0))
        return GainRange.between(least, greatest, len(probe.wavelength_nm))

    def gain(self, block: SweepBlock, variant: str) -> Light:
        """Give the factor of each line, (line, 1, 1)."""
        sweep, camera = block.sweep, block.rig.camera
        scan_px = sweep.held_px() if variant == HELD else sweep.line_px()[:, None]
        share = np.sqrt(1 - ahead(sweep.strip_px, scan_px[block.numbers], camera)).mean(axis=1)
        factor: Light = share.astype(np.float32)[:, None, None]
        return factor


VIGNETTING = Vignetting()


def sweep_ends(probe: Probe, camera: LineCamera) -> Floats:
    """Give o_z at the first and the last position of every sweep, (2 sweep,); it never turns round in between."""
    ends = [sweep.held_px().ravel()[[0, -1]] for sweep in probe.sweeps]
    found = [ahead(sweep.strip_px, px, camera) for sweep, px in zip(probe.sweeps, ends, strict=True)]
    return np.concatenate(found) if found else np.zeros(0)


def ahead(along_px: float, scan_px: Floats, camera: LineCamera) -> Floats:
    """Give o_z, the part along the camera's axis, of the unit directions to points of the scene."""
    xi, eta = along_px * camera.ifov_rad, scan_px * camera.ifov_rad
    part: Floats = eta / np.sqrt(1 + xi**2 + eta**2)
    return part


@dataclass(frozen=True)
class Polarisation(Gain):
    """Light goes with the coating's reflectance at the chief ray's incidence over that at rest, 45 deg.

    By Fresnel's formulae for bare metal, see `coatings`: from 20 to 70 deg aluminium goes from +0.5 to -3.7 % (mean of
    400 to 1000 nm; -5.4 % at 820 nm), gold in the blue from -1.8 to +18 %. Valid where the light is unpolarised and the
    spectrograph takes both polarisations alike; sky mirrored by wet leaves is not, and gratings do not quite. One
    factor for each line and band, at mid exposure.
    """

    name = "polarisation"
    cost_ns = MappingProxyType({EXACT: 0.2})

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound it by the greatest signal times the factor's greatest difference from 1 over all sweeps."""
        incidence = _incidence(sweep_ends(probe, rig.camera))
        if rig.mirror.coating == "ideal" or not incidence.size:
            return Bound(0.0, "the mirror reflects everything" if incidence.size else "no line is taken")
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
