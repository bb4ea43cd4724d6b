"""Distance of a pixel's spectrum from all training spectra, and the distance from which it is called unknown.

What training saw is a number of components, each a middle and a covariance of normalised spectral columns, and what the
light of a look adds to their spread. A pixel lies as far away as from the component whose middle is nearest. Columns
hold brightness and shape alike: a known shape in a brightness that nobody saw is as strange as a shape nobody saw.
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
PIXELS_AT_ONCE = 1 << 14  # so many lie in the processor's cache with their columns
RATE = 0.001  # of known pixels that may be called unknown, unless the settings ask for another
VARIANCE_FLOOR = 1e-5  # least variance of a direction, as a fraction of the largest: float32 keeps less only as noise


@dataclass(frozen=True)
class Limits:
    """Distances beyond which a fraction of the pixels of validation scenes lay, by the light that they were seen in."""

    rates: Exact  # (rate,) ascending shares
    light: Exact  # (light,) ascending, exposures as fractions of the reference
    steps: tuple[int, ...]  # ascending pixels from line to line
    fine: Exact  # (step, light, rate)

    def at(self, rate: float, light: float, step: float) -> float:
        """Return the distance for a rate, even in the logarithms of rate and light.

        Light and rates beyond those that were measured count as the nearest that was, other steps as the next wider.
        """
        row = min(int(np.searchsorted(self.steps, step)), len(self.steps) - 1)
        by_rate = [float(np.interp(np.log(light), np.log(self.light), column)) for column in self.fine[row].T]
        return float(np.interp(np.log(rate), np.log(self.rates), by_rate))


@dataclass(frozen=True)
class OodDetector:
    """The components of what training saw at the reference exposure, and what less light adds."""

    centres: Exact  # (component, column)
    covariance: Exact  # (component, column, column)
    shot: Exact  # (component, column, column) what light leaves in a reading of the reference exposure
    read: Exact  # (column, column) what the reading leaves in it
    limits: Limits
    bands: int  # of the camera in training; columns of fewer are noisier

    def lit(self, light: float, readings: float = 1.0) -> LitDetector:
        """The components as a look shows them whose pixels are means of so many readings of an exposure ``light``.

        Raises ValueError: a covariance has a negative variance.
        """
        noise = (self.shot / light + self.read / light**2) / readings
        spread = np.stack([_floored(one) for one in self.covariance + noise])
        base = _whitening(spread.mean(axis=0))
        back = np.linalg.inv(base)
        columns = len(self.read)
        parts = np.stack([back @ _whitening(one) for one in spread]) / np.sqrt(columns)
        return LitDetector(*(one.astype(np.float32) for one in (base, self.centres @ base, parts)))

    def unknown(
        self, columns: NDArray[np.floating], *, rate: float, capture: LineSpec, bands: int
    ) -> NDArray[np.bool_]:
        """Pixels (..., column) that lie farther away than all but a fraction ``rate`` of known ones, (...).

        ``bands``: Of the camera. A pixel without columns is not unknown.
        """
        limit = self.limits.at(rate, capture.light, capture.step)
        readings = min(1.0, bands / self.bands)  # fewer bands are as fewer readings
        distance = self.lit(capture.light, readings).distance(columns)
        with np.errstate(invalid="ignore"):
            return np.asarray(distance > limit, np.bool_)


def _floored(covariance: Exact) -> Exact:
    """Return a covariance without directions of less than `VARIANCE_FLOOR`; one that has none stays bit for bit.

    Columns that no band of the training reached, or that repeat each other, have such directions. Raises ValueError: a
    variance is more negative than rounding makes it.
    """
    power, axes = np.linalg.eigh(covariance)
    least = VARIANCE_FLOOR * power[-1]
    if power[0] >= least > 0:
        return covariance
    if not (least > 0 and power[0] > -least):
        raise ValueError(f"a covariance has variances from {power[0]:.2g} to {power[-1]:.2g}")
    return np.asarray((axes * np.maximum(power, least)) @ axes.T)


def _whitening(covariance: Exact) -> Exact:
    """Return the matrix that brings rows of this covariance to the covariance 1."""
    lower = np.linalg.cholesky(covariance)
    return np.asarray(scipy.linalg.solve_triangular(lower, np.eye(len(lower)), lower=True).T)


@dataclass(frozen=True)
class LitDetector:
    """Components in the light of one look."""

    base: Floats  # (column, column) brings columns to where the nearest middle is looked for
    centres: Floats  # (component, column) there
    whitening: Floats  # (component, column, column) from there; lengths of products with it are the distance

    def distance(self, columns: NDArray[np.floating]) -> Floats:
        """Squared distance of pixels (..., column) from the nearest component a column, (...); NaN without columns."""
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
        order = np.argsort(near.astype(np.uint16), kind="stable")  # sorted by digits, in a tenth of the time
        ends, in_order = np.searchsorted(near[order], np.arange(len(self.centres) + 1)), known[order]
        squares = np.empty(len(known), np.float32)
        for number, (start, stop) in enumerate(pairwise(ends)):
            apart = (in_order[start:stop] - self.centres[number]) @ self.whitening[number]
            squares[start:stop] = np.einsum("ij,ij->i", apart, apart)
        found = np.empty(len(known), np.float32)
        found[order] = squares
        return found
