"""The summary of a scene and a rig from which effects are decided: how bright, steep and curved the image is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.scan import Sweep

Floats = NDArray[np.float64]
Unit = Literal["sigma", "dn"]
UNITS = {"sigma": "sigma", "dn": "DN"}


@dataclass(frozen=True)
class Probe:
    """Maxima over the samples of a few lines, band by band, as the footprint of slit and pixel alone shows the scene.

    All but the electrons are over the unit of the tolerance: one standard deviation of the noise of the number that is
    stored, or one DN of it. Where that sums ``binning`` samples, a maximum is of the mean of their sizes over the noise
    of their mean: a change of whatever sign at each of them is bounded, and no more than needed where they differ.
    Axis 0 of ``slope`` and ``curvature`` is (along the line, along the scan).
    """

    unit: Unit
    sweeps: tuple[Sweep, ...]  # that the rig is going to take
    wavelength_nm: Floats  # (band,)
    fwhm_nm: Floats | None  # (band,) of the scene's own bands; None where not known
    level: Floats  # (band,) greatest signal
    spread: Floats  # (band,) greatest difference of a signal from the mean of its line, all bands
    span: Floats  # (band,) greatest difference of two signals
    slope: Floats  # (2, band) greatest first derivative [1/px]
    curvature: Floats  # (2, band) greatest second derivative [1/px^2]
    spectral_slope: Floats  # (band,) greatest divided difference to a neighbouring band [1/nm]
    spectral_curvature: Floats  # (band,) greatest second one, twice, 0 at either end [1/nm^2]
    brightest_e: float  # expected electrons of the brightest sample
    darkest_e: float
    unit_least_dn: float  # the smallest unit met, in DN of a sample: turns electrons into the unit, on the safe side
    lines: int  # of all sweeps
    seconds: float  # from the first line to the last
    white_e: Floats | None = None  # (band,) electrons of the white panel in one exposure; None where not known
    slit_errors: Mapping[str, float] = field(default_factory=dict)  # measured change by variant of the slit, or off
    usual_e: Floats | None = None  # evenly spaced quantiles of the light along the lines; None where not known
    places: Floats = field(default_factory=lambda: np.zeros((0, 2)))  # the telling ones, rows and columns, worst first
    binning: int = 1  # samples that a stored number sums, the same in all of the sweeps

    def moved(self, along_px: float, scan_px: float) -> float:
        """Bound what a shift of the image by at most so much changes: slope times way, never more than the span."""
        steep = _times(self.slope[0], abs(along_px)) + _times(self.slope[1], abs(scan_px))
        return float(np.minimum(steep, self.span).max(initial=0.0))

    def blurred(self, variance_px2: Floats) -> float:
        """Bound what a kernel of mean 0 and (2, band) variance changes in any band."""
        return float(self.change_blurred(variance_px2).max(initial=0.0))

    def change_blurred(self, variance_px2: Floats) -> Floats:
        """Bound what it changes in each band, (band,): C s^2 / 2, or G E|x| where that is less, or the span.

        E|x| is at most s; the smaller bound takes over where the image is a step or a point.
        """
        by_curvature = _times(self.curvature, variance_px2 / 2)
        by_slope = _times(self.slope, np.sqrt(variance_px2))
        change: Floats = np.minimum(np.minimum(by_curvature, by_slope).sum(axis=0), self.span)
        return change

    def scaled(self, share: float | Floats) -> float:
        """Bound what multiplying by 1 + ``share`` (or (band,) shares) changes."""
        return float((self.level * np.abs(share)).max(initial=0.0))

    def added(self, electrons: float, electrons_per_dn: float) -> float:
        """Bound what adding so many electrons to every sample changes."""
        return abs(electrons) / electrons_per_dn / self.unit_least_dn


def _times(steep: Floats, way: Floats | float) -> Floats:
    """Their product; 0 where there is no way, however steep it is."""
    return np.multiply(steep, way, out=np.zeros(np.shape(steep)), where=np.not_equal(way, 0))
