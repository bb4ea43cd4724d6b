"""Spectral response: the rig's bands are wider than the scene's own, so that fine features of a spectrum are lost."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.simulator.band_differences import rising_runs
from pipeline.simulator.block import SweepBlock
from pipeline.simulator.effects.effect import OFF, Bound
from pipeline.simulator.probe import Probe
from pipeline.simulator.rig_model import Rig

Floats = NDArray[np.float64]
Light = NDArray[np.float32]
EXACT = "exact"
FWHM2_PER_VARIANCE = 8 * math.log(2)
GROUP = 32  # bands that one product makes
LEAST_WEIGHT = 1e-8
REACH_SD = 6.0  # the kernel's weight beyond it is below 1e-8


class BandGroup(NamedTuple):
    """Bands ``made`` are the bands ``taken`` times ``weights`` (taken, made)."""

    made: slice
    taken: slice
    weights: Light


@dataclass(frozen=True)
class Response:
    """Each band is averaged over its neighbours so that variances add up to the rig's: fwhm_rig^2 - fwhm_scene^2.

    ``exact`` is the heat kernel exp(v/2 D) of the bands' second divided difference D: no weight below 0, sum 1, mean 0
    and variance v exactly, on bands at any distance. The first and the last band keep their light: what lies beyond
    is not known.
    """

    name = "response"
    variants = (EXACT,)
    cost_ns = MappingProxyType({EXACT: 2.2})
    whole_line = True  # a product's rounding depends on how many samples it has: a line is made whole, then cut

    def bound(self, probe: Probe, rig: Rig, variant: str = OFF) -> Bound:
        """Bound it by I'' v / 2, or by I' sqrt(v) where that is less; 0 where the scene's bands are as wide.

        The kernel solves a heat equation: the change is the mean of D I over the time v / 2, so the bound holds on any
        spectrum.
        """
        wavelength = np.asarray(probe.wavelength_nm, np.float64)
        variance = missing_variance(rig.optics.fwhm_nm, probe.fwhm_nm, len(wavelength))
        if not variance.any():
            return Bound(0.0, _why_nothing(probe, rig))
        if variant == EXACT:
            return Bound(0.0, "exact")
        near = np.abs(wavelength[:, None] - wavelength) <= REACH_SD * np.sqrt(variance)[:, None]
        curved = np.where(near, probe.spectral_curvature, 0).max(axis=1) * variance / 2
        steep = np.where(near, probe.spectral_slope, 0).max(axis=1) * np.sqrt(variance)
        sd, known = float(np.sqrt(variance.max())), probe.fwhm_nm
        why = f"bands widen from {0.0 if known is None else np.nanmin(known):.3g} to {rig.optics.fwhm_nm:.3g} nm"
        return Bound(float(np.minimum(curved, steep).max()), f"{why}: {sd:.2g} nm sd more")

    def change(self, light: Light, block: SweepBlock, variant: str) -> Light:
        """Give the light of a block in the rig's bands."""
        return widen_bands(light, block.wavelength_nm, block.fwhm_nm, block.rig.optics.fwhm_nm)


RESPONSE = Response()


def widen_bands(spectra: Light, wavelength_nm: Floats, fwhm_nm: Floats | None, wanted_nm: float) -> Light:
    """Give spectra as bands of width ``wanted_nm`` see them; any linear measure of light, (..., band).

    Factors of light serve as well as light: (component, band) electrons.

    Parameters
    ----------
    wavelength_nm, fwhm_nm
        (band,) centres, and widths of the spectra's own bands; None or NaN where not known, and then nothing is done.

    Returns
    -------
    Array of the same shape and type; ``spectra`` itself where its bands are all as wide already.
    """
    variance = missing_variance(wanted_nm, fwhm_nm, spectra.shape[-1])
    if not variance.any():
        return spectra
    out = np.empty_like(spectra)
    for made, taken, weights in _band_groups(tuple(map(float, wavelength_nm)), tuple(map(float, variance))):
        np.matmul(spectra[..., taken], weights.astype(spectra.dtype, copy=False), out=out[..., made])
    return out


def missing_variance(wanted_nm: float, fwhm_nm: Floats | None, bands: int) -> Floats:
    """Give the variance that Gaussian bands lack to be ``wanted_nm`` wide, (band,); 0 where not known. [nm^2]"""
    if fwhm_nm is None:
        return np.zeros(bands)
    widths = np.nan_to_num(np.asarray(fwhm_nm, np.float64), nan=np.inf, posinf=np.inf)
    return np.maximum(wanted_nm**2 - np.minimum(widths, wanted_nm) ** 2, 0) / FWHM2_PER_VARIANCE


@lru_cache(maxsize=8)
def _band_groups(wavelength_nm: tuple[float, ...], variance: tuple[float, ...]) -> tuple[BandGroup, ...]:
    """Cut the kernel into products of few bands each: most of its weights are 0."""
    kernel = np.zeros((len(wavelength_nm), len(wavelength_nm)))
    for run in rising_runs(np.array(wavelength_nm)):
        kernel[run, run] = _heat_kernel(np.array(wavelength_nm[run]), np.array(variance[run]))
    groups = []
    for start in range(0, len(kernel), GROUP):
        made = slice(start, min(start + GROUP, len(kernel)))
        used = np.flatnonzero((np.abs(kernel[made]) > LEAST_WEIGHT).any(axis=0))
        taken = slice(int(used[0]), int(used[-1]) + 1)
        groups.append(BandGroup(made, taken, np.ascontiguousarray(kernel[made, taken].T, dtype=np.float32)))
    return tuple(groups)


def _heat_kernel(wavelength_nm: Floats, variance: Floats) -> Floats:
    """Rows of exp(v/2 D), (band, band), each with its own variance v.

    D leaves straight lines and both ends as they are. So a spectrum is parted into the line through its ends, which
    stays, and a rest that is 0 there; on the rest D is a symmetric matrix after scaling by the root of the gaps.
    """
    bands = len(wavelength_nm)
    if bands < 3:
        return np.eye(bands)
    from scipy.linalg import eigh_tridiagonal

    gaps = np.diff(wavelength_nm)
    root = np.sqrt((gaps[:-1] + gaps[1:]) / 2)
    rate, mode = eigh_tridiagonal(-(1 / gaps[:-1] + 1 / gaps[1:]) / root**2, 1 / gaps[1:-1] / root[:-1] / root[1:])
    grown = np.exp(np.minimum(rate, 0) * variance[1:-1, None] / 2) * (mode / root[:, None])
    inner = grown @ (mode * root[:, None]).T
    place = (wavelength_nm - wavelength_nm[0]) / (wavelength_nm[-1] - wavelength_nm[0])
    kernel = np.eye(bands)
    kernel[1:-1, 1:-1] = inner
    kernel[1:-1, 0] = 1 - place[1:-1] - inner @ (1 - place[1:-1])
    kernel[1:-1, -1] = place[1:-1] - inner @ place[1:-1]
    return kernel


def _why_nothing(probe: Probe, rig: Rig) -> str:
    if probe.fwhm_nm is None or not np.isfinite(probe.fwhm_nm).any():
        return "the width of the scene's bands is not known; they are taken as they are"
    return f"the scene's bands are {rig.optics.fwhm_nm:g} nm wide already, or wider"
