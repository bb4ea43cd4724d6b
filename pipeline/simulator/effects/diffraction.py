"""Diffraction at the mirror, the aperture stop: an Airy pattern, stretched along the scan by the elliptic pupil.

The pattern has no variance: its rings hold 2 / (pi v) of the light beyond v = pi D theta / lambda. What is folded with
the other blurs is the kernel inside the third dark ring, which holds 94 % of the light, as a Gaussian of its variance.
Behind the footprint of pixel and 20 um slit the contrast of any sine from 400 to 1000 nm is then within 0.08 of that of
the whole pattern (0.065 up to half a period per px), less than with the Gaussian of the same full width at half maximum
(0.10) or of the first or second dark ring. The 6 % beyond the ring, which change no number by more than 6 % of
the span of the signal, are stray light.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from pipeline.simulator.effects.blurring import blurred_bound
from pipeline.simulator.effects.effect import OFF, Bound, Moments
from pipeline.simulator.effects.pupil import normals_met, spread_of_waves
from pipeline.simulator.probe import Probe
from pipeline.simulator.rig_model import Rig

Floats = NDArray[np.float64]

AIRY = "airy"
WIDTH = 1.029  # full width at half maximum of the Airy pattern [lambda / D]
THIRD_RING = 10.173468135062722  # third zero of J1


@dataclass(frozen=True)
class Diffraction:
    """Blur that grows with the wavelength; ``one-width`` blurs all bands as the middle of them."""

    name = "diffraction"
    variants = (AIRY, "one-width")
    # Through boxes of a few parts. A kernel for each of several widths, by bands, costs; one that is wider does not.
    cost_ns = MappingProxyType({AIRY: 5.8, "one-width": 0.3})

    def moments(self, rig: Rig, wavelength_nm: Floats, variant: str, normal: Floats | None = None) -> Moments:
        """Give the blur of each band; ``normal`` (3,) is the mirror's in the camera frame, None at rest."""
        variance = _spread() * _size(rig, wavelength_nm, variant) * spread_of_waves(normal)[:, None]
        return Moments(np.zeros_like(variance), variance)

    def bound(self, probe: Probe, rig: Rig, variant: str = OFF) -> Bound:
        """Bound the error of no blur, or of the middle band's, over all positions of the sweeps."""
        if variant == "airy":
            return Bound(0.0, "exact")
        widest = np.max([spread_of_waves(normal) for normal in normals_met(probe, rig)], axis=0)
        missing = _size(rig, probe.wavelength_nm, "airy")
        if variant != OFF:
            missing = np.abs(missing - _size(rig, probe.wavelength_nm, variant))
        cause = "diffraction" if variant == OFF else "diffraction of other bands in place of their own"
        return blurred_bound(probe, _spread() * missing * widest[:, None], cause)


DIFFRACTION = Diffraction()


def diffraction_fwhm(rig: Rig, wavelength_nm: Floats, normal: Floats | None = None) -> Floats:
    """Give the full width at half maximum, (2, band) along line and scan: 1.03 lambda / (pupil's width IFOV). [px]"""
    return WIDTH * _radian_px(rig, wavelength_nm) * np.sqrt(spread_of_waves(normal))[:, None]


def airy_energy(v: float) -> float:
    """Give the share of the light of an Airy pattern within v = pi D theta / lambda (Rayleigh): 1 - J0^2 - J1^2."""
    from scipy.special import j0, j1

    return float(1 - j0(v) ** 2 - j1(v) ** 2)


def airy_variance(v: float) -> float:
    """Give the variance per axis of an Airy pattern cut off at v and scaled to sum 1, in units of v^2.

    The integral of t J1(t)^2, which is v^2 (J0^2 + J1^2) / 2 - v J0 J1, over the energy; towards 0 it is v^2 / 4.
    """
    from scipy.special import j0, j1

    if v < 1e-2:
        return v * v / 4
    inside = v * v / 2 * (j0(v) ** 2 + j1(v) ** 2) - v * j0(v) * j1(v)
    return float(inside) / airy_energy(v)


@cache  # not at import: SciPy takes its time
def _spread() -> float:
    """Variance per axis of what is folded [(lambda / D)^2]."""
    return airy_variance(THIRD_RING) / math.pi**2


def _size(rig: Rig, wavelength_nm: Floats, variant: str) -> Floats:
    """(lambda / (D IFOV))^2 of each band, or halfway between those of the first and last, (band,) [px^2]."""
    size = _radian_px(rig, wavelength_nm) ** 2
    if variant == "airy" or not size.size:
        return size
    return np.full(size.shape, (size.min() + size.max()) / 2)


def _radian_px(rig: Rig, wavelength_nm: Floats) -> Floats:
    """lambda / D over the IFOV, (band,)."""
    angle: Floats = np.asarray(wavelength_nm, np.float64) * 1e-9 / (rig.optics.aperture_mm * 1e-3)
    return angle / rig.camera.ifov_rad
