"""Diffraction at the mirror, the aperture stop: an Airy pattern, stretched along the scan by the elliptic pupil.

The pattern has no variance: its rings hold 2 / (pi v) of the light beyond v = pi D theta / lambda, and what it passes
of a slow wave falls in proportion to the wave's frequency. The exact variant is the pupil's own transfer function in
every band, far tails included: `kernel_fit` finds few kernels for it. The others put a Gaussian in its place, of the
variance of what lies inside the third dark ring (94 % of the light); they pass up to 0.08 more of a wave.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from pipeline.simulator.effects.blurring import mixture_bound
from pipeline.simulator.effects.effect import OFF, Bound, Moments
from pipeline.simulator.effects.pupil import normals_met, pupil_contrast, spread_of_waves
from pipeline.simulator.probe import Probe
from pipeline.simulator.rig_model import Rig

Floats = NDArray[np.float64]

AIRY, GAUSSIAN, ONE_WIDTH = "airy", "gaussian", "one-width"
WIDTH = 1.029  # full width at half maximum of the Airy pattern [lambda / D]
THIRD_RING = 10.173468135062722  # third zero of J1


@dataclass(frozen=True)
class Diffraction:
    """Blur that grows with the wavelength: by the pupil, or a Gaussian of each band's own, or of the middle's."""

    name = "diffraction"
    variants = (AIRY, GAUSSIAN, ONE_WIDTH)
    # Through boxes of a few parts. Each kernel costs: of the pattern's core, of its tails, of the bands' own widths.
    cost_ns = MappingProxyType({AIRY: 6.7, GAUSSIAN: 3.4, ONE_WIDTH: 0.3})

    def moments(self, rig: Rig, wavelength_nm: Floats, variant: str, normal: Floats | None = None) -> Moments:
        """Give the blur of each band; ``normal`` (3,) is the mirror's in the camera frame, None at rest."""
        waves, none = _waves(rig, wavelength_nm, normal), np.zeros((2, len(wavelength_nm)))
        if variant == AIRY:
            return Moments(none, none, waves)
        return Moments(none, _gaussian(waves, variant))

    def bound(self, probe: Probe, rig: Rig, variant: str = OFF) -> Bound:
        """Bound the error of no blur, or of a Gaussian, over all positions of the sweeps.

        The pattern is a sum of Gaussians of many widths: each changes the image, or a Gaussian in its place, by no more
        than the difference of their variances does.
        """
        if variant == AIRY:
            return Bound(0.0, "exact")
        share, size = airy_gaussians()
        found = [_waves(rig, probe.wavelength_nm, normal) for normal in normals_met(probe, rig)]
        missing = []
        for waves in found:
            instead = _gaussian(waves, variant) if variant != OFF else np.zeros_like(waves)
            missing.append([np.abs((one * waves) ** 2 - instead) for one in size])
        cause = "diffraction" if variant == OFF else f"diffraction as a Gaussian, {variant},"
        return mixture_bound(probe, share, np.max(missing, axis=0), cause)


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
def airy_gaussians() -> tuple[Floats, Floats]:
    """Give shares, none below 0, of sum 1, and widths (sd) [lambda / D] of Gaussians whose sum is an Airy pattern.

    By least squares on what the pupil passes of waves, those that a slit passes counting most: within 0.004 of it up to
    0.6 of its cut-off. For bounds; what is rendered follows the pupil itself.
    """
    from scipy.optimize import nnls

    size, u = np.geomspace(0.1, 160.0, 24), np.concatenate([np.geomspace(1e-3, 0.02, 30), np.linspace(0.03, 1.5, 150)])
    weight = 1 / (1 + (u / 0.5) ** 4)
    passed = np.exp(-2 * (np.pi * np.outer(u, size)) ** 2)
    system = np.concatenate([passed * weight[:, None], np.full((1, len(size)), 1e3)])
    share = nnls(system, np.append(pupil_contrast(u) * weight, 1e3))[0]
    held = share > 0
    return share[held] / share.sum(), size[held]


@cache
def _spread() -> float:
    """Variance per axis of the Gaussian in the pattern's place [(lambda / D)^2]."""
    return airy_variance(THIRD_RING) / math.pi**2


def _gaussian(waves: Floats, variant: str) -> Floats:
    """Variance (2, band) of the Gaussian: each band's, or halfway between those of the narrowest and the widest."""
    variance = _spread() * waves**2
    if variant == GAUSSIAN or not waves.size:
        return variance
    middle = (variance.min(axis=1) + variance.max(axis=1)) / 2
    return np.repeat(middle[:, None], waves.shape[1], axis=1)


def _waves(rig: Rig, wavelength_nm: Floats, normal: Floats | None) -> Floats:
    """lambda over the pupil's widths along line and scan, (2, band). [px]"""
    waves: Floats = _radian_px(rig, wavelength_nm) * np.sqrt(spread_of_waves(normal))[:, None]
    return waves


def _radian_px(rig: Rig, wavelength_nm: Floats) -> Floats:
    """lambda / D over the IFOV, (band,)."""
    angle: Floats = np.asarray(wavelength_nm, np.float64) * 1e-9 / (rig.optics.aperture_mm * 1e-3)
    return angle / rig.camera.ifov_rad
