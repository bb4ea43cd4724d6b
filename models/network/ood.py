"""Detect out-of-distribution pixels by the distance of their spectrum from the training spectra.

Training spectra are modelled by components: a mean and a covariance of normalised spectral columns, to which the noise
of the exposure is added. The distance of a pixel is that from the component with the nearest mean. Columns contain
brightness and shape: a known shape at an unknown brightness is out of distribution, too.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import scipy
from numpy.typing import NDArray

from models.network.spectral import LineSpec

Floats = NDArray[np.float32]
Exact = NDArray[np.float64]
PIXELS_AT_ONCE = 1 << 14  # fit the processor's cache
RATE = 0.001  # default false-alarm rate
VARIANCE_FLOOR = 1e-5  # least variance of a direction, as a fraction of the largest: float32 keeps less only as noise


@dataclass(frozen=True)
class Limits:
    """Quantiles of the distances of validation pixels, by line spacing and exposure."""

    rates: Exact  # (rate,) ascending fractions
    light: Exact  # (light,) ascending, exposures as fractions of the reference
    steps: tuple[int, ...]  # ascending line spacings [px]
    fine: Exact  # (step, light, rate)

    def at(self, rate: float, light: float, step: float) -> float:
        """Return the distance for a false-alarm rate, interpolated in the logarithms of rate and light.

        Light and rates are clipped to the measured range; other steps take the next wider one.
        """
        row = min(int(np.searchsorted(self.steps, step)), len(self.steps) - 1)
        by_rate = [float(np.interp(np.log(light), np.log(self.light), column)) for column in self.fine[row].T]
        return float(np.interp(np.log(rate), np.log(self.rates), by_rate))


@dataclass(frozen=True)
class OodDetector:
    """Components of the training spectra at the reference exposure, and the noise of other exposures."""

    centres: Exact  # (component, column)
    covariance: Exact  # (component, column, column)
    shot: Exact  # (component, column, column) shot noise at the reference exposure
    read: Exact  # (column, column) read noise
    limits: Limits
    bands: int  # of the camera in training

    def lit(self, light: float, readings: float = 1.0) -> LitDetector:
        """Return the components with the noise of an exposure ``light``; a pixel is the mean of ``readings`` samples.

        Raises ValueError: a covariance has a negative variance.
        """
        noise = (self.shot / light + self.read / light**2) / readings
        spread = np.stack([_floored(one) for one in self.covariance + noise])
        base = _whitening(spread.mean(axis=0))
        back = np.linalg.inv(base)
        parts = np.stack([back @ _whitening(one) for one in spread]) / np.sqrt(len(self.read))
        return LitDetector(*(one.astype(np.float32) for one in (base, self.centres @ base, parts)))

    def unknown(
        self, columns: NDArray[np.floating], *, rate: float, capture: LineSpec, bands: int
    ) -> NDArray[np.bool_]:
        """Return which pixels (..., column) are out of distribution at a false-alarm rate, (...).

        ``bands`` are those of the camera. A pixel of NaN is not out of distribution.
        """
        limit = self.limits.at(rate, capture.light, capture.step)
        readings = min(1.0, bands / self.bands)  # fewer bands count as fewer samples
        distance = self.lit(capture.light, readings).distance(columns)
        with np.errstate(invalid="ignore"):
            return np.asarray(distance > limit, np.bool_)


def _floored(covariance: Exact) -> Exact:
    """Return a covariance with variances of at least `VARIANCE_FLOOR`; one that has them stays bit for bit.

    Columns that no band reaches, or that repeat each other, have smaller ones. Raises ValueError: a variance is
    negative beyond rounding.
    """
    power, axes = np.linalg.eigh(covariance)
    least = VARIANCE_FLOOR * power[-1]
    if power[0] >= least > 0:
        return covariance
    if not (least > 0 and power[0] > -least):
        raise ValueError(f"a covariance has variances from {power[0]:.2g} to {power[-1]:.2g}")
    return np.asarray((axes * np.maximum(power, least)) @ axes.T)


def _whitening(covariance: Exact) -> Exact:
    """Return the matrix that whitens rows of this covariance."""
    lower = np.linalg.cholesky(covariance)
    return np.asarray(scipy.linalg.solve_triangular(lower, np.eye(len(lower)), lower=True).T)


@dataclass(frozen=True)
class LitDetector:
    """Components with the noise of one exposure."""

    base: Floats  # (column, column) whitening in which the nearest mean is searched
    centres: Floats  # (component, column) there
    whitening: Floats  # (component, column, column) further whitening of each component

    def distance(self, columns: NDArray[np.floating]) -> Floats:
        """Return squared distances of pixels (..., column) from the nearest component, per column, (...)."""
        flat = columns.reshape(-1, columns.shape[-1])
        found = np.empty(len(flat), np.float32)
        for first in range(0, len(flat), PIXELS_AT_ONCE):
            part = slice(first, first + PIXELS_AT_ONCE)
            with np.errstate(invalid="ignore", over="ignore"):
                found[part] = self._squares(np.asarray(flat[part], np.float32) @ self.base)
        found[~np.isfinite(found)] = np.nan
        return found.reshape(columns.shape[:-1])

    def _squares(self, known: Floats) -> Floats:
        near = (known @ self.centres.T - 0.5 * (self.centres**2).sum(axis=1)).argmax(axis=1)
        order = np.argsort(near.astype(np.uint16), kind="stable")  # radix sort: a tenth of the time
        ends = np.searchsorted(near[order], np.arange(len(self.centres) + 1))
        found = np.empty(len(known), np.float32)
        for number, (start, stop) in enumerate(pairwise(ends)):
            own = order[start:stop]
            apart = (known[own] - self.centres[number]) @ self.whitening[number]
            found[own] = np.einsum("ij,ij->i", apart, apart)
        return found
