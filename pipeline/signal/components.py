"""Define components: the few numbers that hold the signal of a spectrum, and the linear law that restores it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.setting_fields import settings_table, stated

BROAD_BANDS = 16
BLOCK = 4  # spectra a side of a mean

Floats = NDArray[np.float64]
Scores = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Components:
    """Directions of whitened spectra: ``spectrum = scores @ axes * noise + mean``, with scores in noise deviations.

    A band without any value is NaN in ``mean`` and ``noise``, and 0 in ``axes``.
    """

    mean: Floats  # (band,) scene value
    axes: Floats  # (component, band) orthonormal rows
    noise: Floats  # (band,) standard deviation of one spectrum's noise [scene value]; the step of few bands
    covariance: Floats | None = None  # (band, band) of spectra of few bands, which predicts missing ones
    spread: Floats | None = None  # (component,) mean square of the field's scores, which bounds those of missing bands

    @classmethod
    def empty(cls, bands: int) -> Components:
        """Return no component, for lines without a value."""
        return cls(np.full(bands, np.nan), np.zeros((0, bands)), np.full(bands, np.nan))

    def __len__(self) -> int:
        return len(self.axes)

    @property
    def bands(self) -> int:
        """Return the bands of a spectrum."""
        return len(self.mean)

    def white(self, values: NDArray[np.floating]) -> Scores:
        """Return whitened spectra of scene values (..., band); 0 in bands without any value."""
        lit = np.isfinite(self.mean)
        found = np.asarray(values - np.nan_to_num(self.mean).astype(np.float32), np.float32)
        found *= np.where(lit, 1 / np.where(lit, self.noise, 1), 0).astype(np.float32)
        if not lit.all():
            found[..., ~lit] = 0
        return found

    def restore(self, scores: NDArray[np.floating]) -> Scores:
        """Return scene values (..., band) of scores (..., component); NaN if a score is NaN, or a band has none."""
        rows = np.asarray(self.axes * np.nan_to_num(self.noise), np.float32)
        return np.asarray(scores, np.float32) @ rows + self.mean.astype(np.float32)

    def of_bands(self, bands: Sequence[int]) -> Components:
        """Return the law of some bands; its axes are not orthonormal."""
        chosen = list(bands)
        return Components(self.mean[chosen], self.axes[:, chosen], self.noise[chosen])

    def largest(self, values: Floats) -> float:
        """Return a bound of the scores of spectra whose bands lie within (band,) ``values`` of the mean."""
        lit = np.isfinite(self.mean)
        return float(np.linalg.norm(np.where(lit, values, 0) / np.where(lit, self.noise, 1)))

    def completed(self, values: NDArray[np.floating]) -> Scores:
        """Return spectra (n, band) with the expected values, by the other bands, in those that are NaN.

        Every pattern of missing bands is solved by itself. A spectrum without any band takes the mean.
        """
        assert self.covariance is not None
        lit = np.isfinite(self.mean)
        spectra = np.asarray(values, np.float64) - self.mean
        there = np.isfinite(spectra)
        for pattern in np.unique(there, axis=0):
            rows = (there == pattern).all(axis=1)
            have = np.flatnonzero(pattern)
            lack = np.flatnonzero(lit & ~pattern)
            law = np.linalg.lstsq(self.covariance[np.ix_(have, have)], self.covariance[np.ix_(have, lack)], rcond=1e-9)
            spectra[np.ix_(rows, lack)] = spectra[np.ix_(rows, have)] @ law[0]
        return np.asarray(spectra + self.mean, np.float32)

    def onto(self, matrix: NDArray[np.floating]) -> tuple[Scores, Scores]:
        """Return weights (component, n) and offset (n,) that give ``spectrum @ matrix`` of scores, matrix (band, n).

        Bands without a value count nothing.
        """
        exact = np.asarray(matrix, np.float64)
        weights = (self.axes * np.nan_to_num(self.noise)) @ exact
        return weights.astype(np.float32), (np.nan_to_num(self.mean) @ exact).astype(np.float32)

    def scaled(self, gain: NDArray[np.floating]) -> tuple[Scores, Scores]:
        """Return matrix (component, component) and offset (component,) that apply a (band,) gain to scores."""
        lit = np.isfinite(self.mean)
        factor = np.where(lit, gain, 0).astype(np.float64)
        matrix = (self.axes * factor) @ self.axes.T
        shift = np.where(lit, (factor - 1) * np.nan_to_num(self.mean) / np.where(lit, self.noise, 1), 0) @ self.axes.T
        return matrix.astype(np.float32), shift.astype(np.float32)


def broad_weights(components: Components, bands: int = BROAD_BANDS) -> tuple[NDArray[np.float32], np.float32]:
    """Return weights (component,) and offset by which scores give the mean of some bands, spread evenly."""
    known = np.flatnonzero(np.isfinite(components.mean))
    matrix = np.zeros((components.bands, 1))
    if len(known):
        chosen = known[np.unique(np.linspace(0, len(known) - 1, max(bands, 1)).round().astype(np.intp))]
        matrix[chosen] = 1 / len(chosen)
    weights, offset = components.onto(matrix)
    return weights[:, 0], offset[0]


@settings_table
class SignalChoice:
    """Limits of the spectral compression into components that exceed the noise."""

    step: float = stated(1.0, "Quantisation step of the scores, in standard deviations of the noise", "", 0.01, 10)
    false_alarm: float = stated(0.01, "Probability that noise alone yields a component in a field", "", 1e-6, 0.2)
    rare_spectra: float = 1.0  # per sweep, that noise alone may mark as rare; rare spectra keep their residuals
    least: int = 4  # components
