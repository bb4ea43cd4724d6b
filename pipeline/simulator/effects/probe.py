"""Basis of decisions on effects: a summary of scene and rig, units of stored numbers, gains over wavelength.

A change of light over its noise is the change of the stored number in its own sigmas.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.scan import Floats, Sweep
from spectralzoom.pipeline.simulator.rig_model import Rig

Unit = Literal["sigma", "dn"]
UNITS = {"sigma": "sigma", "dn": "DN"}
Radiance = NDArray[np.float32]
Real = TypeVar("Real", np.float32, np.float64)


@dataclass(frozen=True)
class Probe:
    """Maxima over a scene, band by band, as the footprint of slit and pixel alone shows it.

    All but the electrons are over the unit of the tolerance: a standard deviation of the stored number's noise, or one
    DN of it. Axis 0 of ``slope`` and ``curvature`` is (along the line, along the scan).
    """

    unit: Unit
    sweeps: tuple[Sweep, ...]  # that the rig is going to take
    wavelength_nm: Floats  # (band,)
    fwhm_nm: Floats | None  # (band,) of the scene's own bands; None where not known
    level: Floats  # (band,) greatest signal
    span: Floats  # (band,) greatest difference of two signals
    slope: Floats  # (2, band) greatest first derivative [1/px]
    curvature: Floats  # (2, band) greatest second derivative [1/px^2]
    spectral_slope: Floats  # (band,) greatest divided difference to a neighbouring band [1/nm]
    brightest_e: float  # expected electrons of the brightest sample
    darkest_e: float
    unit_least_dn: float  # the smallest unit met, in DN of a sample: turns electrons into the unit, on the safe side
    lines: int  # of all sweeps
    seconds: float  # from the first line to the last
    white_e: Floats | float = 0.0  # (band,) electrons of the white reference in one exposure
    slit_errors: Mapping[str, float] = field(default_factory=dict)  # measured change by variant of the slit, or off

    def moved(self, along_px: float, scan_px: float) -> float:
        """Bound what a shift of the image by at most so much changes: slope times way, never more than the span."""
        steep = _times(self.slope[0], abs(along_px)) + _times(self.slope[1], abs(scan_px))
        return float(np.minimum(steep, self.span).max(initial=0.0))

    def blurred(self, variance_px2: Floats) -> float:
        """Bound what a kernel of mean 0 and (2, band) variance changes in any band."""
        return float(self.change_blurred(variance_px2).max(initial=0.0))

    def change_blurred(self, variance_px2: Floats, mean_way: float = 1.0) -> Floats:
        """Bound what it changes in each band, (band,): C s^2 / 2, or G E|x| where that is less, or the span.

        E|x| is ``mean_way`` times s, at most 1; the smaller bound takes over where the image is a step or a point.
        """
        by_curvature = _times(self.curvature, variance_px2 / 2)
        by_slope = _times(self.slope, mean_way * np.sqrt(variance_px2))
        return np.asarray(np.minimum(np.minimum(by_curvature, by_slope).sum(axis=0), self.span))

    def scaled(self, fraction: float | Floats) -> float:
        """Bound what multiplying by 1 + ``fraction`` (or (band,) shares) changes."""
        return float((self.level * np.abs(fraction)).max(initial=0.0))

    def added(self, electrons: float, electrons_per_dn: float) -> float:
        """Bound what adding so many electrons to every sample changes."""
        return abs(electrons) / electrons_per_dn / self.unit_least_dn


def _times(steep: Floats, way: Floats | float) -> Floats:
    """Return the product; 0 where ``way`` is 0, however steep."""
    return np.multiply(steep, way, out=np.zeros(np.shape(steep)), where=np.not_equal(way, 0))


def noise_electrons(signal: NDArray[np.floating], rig: Rig) -> Radiance:
    """Return one standard deviation of shot noise, read noise and quantisation at each signal; never 0. [e-]"""
    if rig.detector.noiseless:
        return np.full_like(signal, np.sqrt(rig.camera.electrons_per_dn**2 / 12))
    noise: Radiance = np.sqrt(np.maximum(signal, 0) + np.float32(fixed_variance(rig.camera)))
    return noise


def unit_at(signal: NDArray[np.floating], rig: Rig, unit: Unit) -> Radiance:
    """Return what a unit of the tolerance is at each signal. [e-]"""
    return noise_electrons(signal, rig) if unit == "sigma" else np.full_like(signal, rig.camera.electrons_per_dn)


def fixed_variance(camera: LineCamera) -> float:
    """Return the variance of read noise and quantisation, which light does not change. [e-^2]"""
    return camera.read_noise_e**2 + camera.electrons_per_dn**2 / 12


@dataclass(frozen=True)
class GainRange:
    """Factors of light that a gain has anywhere in a survey, (band,) each."""

    least: Floats
    greatest: Floats
    uneven: float  # greatest difference of two factors within one line
    added_e: Floats  # light that is added

    @staticmethod
    def between(least: float, greatest: float, bands: int, *, uneven: float = 0.0) -> GainRange:
        """Return the range from ``least`` to ``greatest``, the same in all bands."""
        return GainRange(np.full(bands, least), np.full(bands, greatest), uneven, np.zeros(bands))

    @staticmethod
    def of(factors: Floats, *, uneven: float) -> GainRange:
        """Summarise (state, band) factors by their extremes."""
        return GainRange(factors.min(axis=0), factors.max(axis=0), uneven, np.zeros(factors.shape[1]))


def rising_runs(wavelength_nm: Floats) -> list[slice]:
    """Return the runs of bands whose wavelengths rise: where they fall back or stay, another detector begins."""
    breaks = np.flatnonzero(~(np.diff(wavelength_nm) > 0)) + 1
    return [slice(start, stop) for start, stop in pairwise([0, *breaks.tolist(), len(wavelength_nm)])]


def rising_gaps(wavelength_nm: Floats) -> Floats:
    """Return the distances of neighbouring bands within runs. [nm]"""
    gaps = np.diff(wavelength_nm)
    return gaps[gaps > 0]


def difference_rates(wavelength_nm: Floats) -> Floats:
    """Return the weights of the second difference D, (2, band): of the steps down and up to the neighbours. [1/nm^2]

    D I = up (I_next - I) + down (I_last - I) is the second derivative of any parabola. 0 at both ends of a run.
    """
    rates = np.zeros((2, len(wavelength_nm)))
    gaps = np.diff(wavelength_nm)
    inner = 1 + np.flatnonzero((gaps[:-1] > 0) & (gaps[1:] > 0))
    before, after = gaps[inner - 1], gaps[inner]
    rates[:, inner] = 2 / (before + after) / np.stack([before, after])
    return rates


def steepest_difference(spectra: NDArray[Real], wavelength_nm: Floats) -> NDArray[Real]:
    """Return |I'| of spectra (..., band) towards the steeper neighbour of each band; 0 for a run of one band. [1/nm]"""
    gaps = np.diff(wavelength_nm)
    rate = np.divide(1, gaps, out=np.zeros_like(gaps), where=gaps > 0).astype(spectra.dtype)
    steep = np.abs(np.diff(spectra, axis=-1)) * rate
    out = np.zeros_like(spectra)
    out[..., :-1] = steep
    np.maximum(out[..., 1:], steep, out=out[..., 1:])
    return out


@dataclass(frozen=True)
class Tolerance:
    """Greatest simulation error from omitted effects, in noise sigmas or in DN."""

    value: float = 0.1
    unit: Unit = "sigma"

    def __str__(self) -> str:
        return f"{self.value!r}" + ("" if self.unit == "sigma" else "dn")
