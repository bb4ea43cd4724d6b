"""Project any number of bands, in any order, onto a fixed number of spectral features (columns) by wavelength.

Invalid pixels are filled from the rest of their patch; a patch with more than half of its pixels invalid is not read.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.errors import WavelengthError
from spectralzoom.pipeline.readings import MOST_STEPS, SIGMA_OF_MEDIAN

REACH = 1.5  # a column is reached by a band within this many column spacings of its centre
LONGEST_NM, SHORTEST_NM = 3000.0, 200.0
SPREAD_FLOOR = 1e-3  # least spread of a column, as a fraction of the median spread
VARIANCE_FLOOR = 1e-5  # least variance of a direction that whitening brings to 1, as a fraction of the largest
Kind = TypeVar("Kind", bound=np.generic)
PLANE_SCALES = np.array([4.0, 2.0, 2.0])  # of the logarithms of exposure, line spacing, binned samples
MOST_INVALID = 0.5  # largest fraction of invalid pixels in a token or patch
MOST_COLUMN = 1e12  # of valid normalised columns; squares of larger values would overflow float32


@dataclass(frozen=True)
class SpectralBasis:
    """Gaussian bumps evenly spaced over ``low_nm``..``high_nm``, the wavelength range of the weights."""

    low_nm: float
    high_nm: float
    columns: int = 24

    @staticmethod
    def spanning(wavelength_nm: NDArray[np.floating], most_columns: int = 24) -> SpectralBasis:
        """Return a basis for these bands, with at most one column a band."""
        wavelength = checked_wavelengths(wavelength_nm)
        distinct = len(np.unique(wavelength))
        return SpectralBasis(float(wavelength.min()), float(wavelength.max()), min(most_columns, distinct))

    def matrix(self, wavelength_nm: NDArray[np.floating]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Return weights from bands to columns, (band, column), and which columns a band reaches, (column,).

        Weights of a reached column sum to 1, others are 0. A band is weighted by its width (trapezoid rule on the
        sorted wavelengths). So 15 or 270 bands give columns of the same scale, and repeated bands share a weight.

        Raises WavelengthError for a wavelength that is not finite, or outside 200-3000 nm (micrometres?).
        """
        wavelength = checked_wavelengths(wavelength_nm)
        span_nm = self.high_nm - self.low_nm
        apart_nm = span_nm / (self.columns - 1) if self.columns > 1 else max(span_nm, LONGEST_NM)  # one covers all
        distance = (wavelength[:, None] - np.linspace(self.low_nm, self.high_nm, self.columns)) / apart_nm
        bump = np.where(np.abs(distance) <= REACH, np.exp(-0.5 * (distance / 0.5) ** 2), 0.0)
        weight = bump * band_widths(wavelength)[:, None]
        total = weight.sum(axis=0)
        reached = total > 0
        return (weight / np.where(reached, total, 1.0)).astype(np.float32), reached


def project(values: NDArray[np.floating], matrix: NDArray[np.float32]) -> NDArray[np.float32]:
    """Project (..., band) values onto columns, (..., column), by the weights of `SpectralBasis.matrix`.

    Bands that are not finite are left out, and the other bands of the column take their weight. A column without a
    finite band is NaN. A pixel with more than half of its bands invalid is NaN in all columns.
    """
    exact = np.asarray(values, np.float32)
    with np.errstate(invalid="ignore", over="ignore"):  # corrected below
        seen = np.asarray(exact @ matrix, np.float32)
    broken = ~np.isfinite(exact).all(axis=-1)
    if broken.any():
        finite = np.isfinite(exact[broken])
        weight = finite.astype(np.float32) @ matrix
        total = np.where(finite, exact[broken], np.float32(0)) @ matrix
        mean = np.divide(total, weight, out=np.zeros_like(weight), where=weight > 0)
        mean[(weight <= 0) & (matrix.sum(axis=0) > 0)] = np.nan
        mean[2 * finite.sum(axis=1) < len(matrix)] = np.nan
        seen[broken] = mean
    return seen


def checked_wavelengths(wavelength_nm: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the wavelengths as float64. Raises WavelengthError: none, or one that is not finite or in another unit."""
    wavelength = np.asarray(wavelength_nm, np.float64)
    if not wavelength.size:
        raise WavelengthError("expected at least one band with a wavelength, got none")
    outside = ~((wavelength >= SHORTEST_NM) & (wavelength <= LONGEST_NM))
    if outside.any():
        raise WavelengthError(
            f"wavelength {wavelength[outside][0]:g} is outside {SHORTEST_NM:g}-{LONGEST_NM:g} nm;"
            " give nanometres (multiply micrometres by 1000)"
        )
    return wavelength


def band_widths(wavelength_nm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the width of each band [nm]: half the way to either neighbour; 1 for a single wavelength."""
    distinct, group, members = np.unique(wavelength_nm, return_inverse=True, return_counts=True)
    if len(distinct) == 1:
        return np.full(len(wavelength_nm), 1.0 / members[0])
    gap = np.diff(distinct)
    width = np.concatenate([gap[:1], gap[:-1] + gap[1:], gap[-1:]]) / 2
    return (width / members)[group]


@dataclass(frozen=True)
class Normalisation:
    """Scale and decorrelate columns by statistics of the training data.

    Neighbouring columns are nearly equal. Whitening enlarges the small directions that distinguish two crops.
    """

    centre: NDArray[np.float32]  # (column,) median
    spread: NDArray[np.float32]  # (column,) 1.4826 MAD, floored
    whitening: NDArray[np.float32]  # (column, column)

    @staticmethod
    def measured(sample: NDArray[np.floating], noise: NDArray[np.floating] | None = None) -> Normalisation:
        """Measure the statistics of (pixel, column) values. Constant columns are normalised to 0.

        ``noise`` is the covariance (column, column) of the noise that a shorter exposure would add, in squares of
        scene values. It keeps whitening from enlarging directions below the noise.
        """
        exact = sample.astype(np.float64)
        centre = np.median(exact, axis=0)
        spread = SIGMA_OF_MEDIAN * np.median(np.abs(exact - centre), axis=0)
        spread = np.maximum(spread, SPREAD_FLOOR * (float(np.median(spread)) or 1.0))
        scaled = np.clip((exact - centre) / spread, -10, 10)
        scaled -= scaled.mean(axis=0)
        covariance = scaled.T @ scaled / max(len(scaled), 1)
        if noise is not None:
            covariance += noise / np.outer(spread, spread)
        power, axes = np.linalg.eigh(covariance)
        gain = 1 / np.sqrt(np.maximum(power, VARIANCE_FLOOR * max(float(power[-1]), 1e-12)))
        whitening = (axes * gain) @ axes.T  # symmetric: keeps sign and order of columns
        return Normalisation(centre.astype(np.float32), spread.astype(np.float32), whitening.astype(np.float32))

    def apply(self, columns: NDArray[np.floating], reached: NDArray[np.bool_]) -> NDArray[np.float32]:
        """Normalise (..., column); columns that are unreached or not finite take their conditional mean.

        Their median would differ from neighbouring columns, and whitening would enlarge this difference. A pixel
        without a known column takes the median.
        """
        normal = (np.asarray(columns, np.float32) - self.centre) / self.spread
        there = reached & np.isfinite(normal)
        if there.all():
            return np.asarray(normal @ self.whitening, np.float32)
        known = np.where(there, normal, np.float32(0))
        alike = (there == reached).all(axis=-1)
        self._complete(known, alike, reached)
        partly = ~alike & there.any(axis=-1)  # a pixel without a column keeps the medians
        for pattern in np.unique(there[partly], axis=0):
            self._complete(known, np.asarray(partly & (there == pattern).all(axis=-1), np.bool_), pattern)
        return np.asarray(known @ self.whitening, np.float32)

    def _complete(self, known: NDArray[np.float32], pixels: NDArray[np.bool_], reached: NDArray[np.bool_]) -> None:
        """Write the conditional mean of the other columns, given the reached ones, into some pixels, in place."""
        if reached.all() or not reached.any() or not pixels.any():
            return
        rows = known[pixels]
        rest = ~reached
        whitening = self.whitening.astype(np.float64)
        inverse = whitening @ whitening  # of the covariance of a normal law
        weights = -np.linalg.solve(inverse[np.ix_(rest, rest)], inverse[np.ix_(rest, reached)]).T
        rows[:, rest] = rows[:, reached] @ np.asarray(weights, np.float32)  # conditional mean
        known[pixels] = rows

    @property
    def most_value(self) -> float:
        """Return the largest valid value: as many spreads from the centre as a camera has steps."""
        reach = np.abs(self.centre.astype(np.float64)) + MOST_STEPS * self.spread.astype(np.float64)
        return float(min(reach.max(initial=0.0), np.finfo(np.float32).max))

    @property
    def gain_shift(self) -> NDArray[np.float32]:
        """Return the shift of normalised columns, beyond doubling, by twice the light, (column,)."""
        return np.asarray((self.centre / self.spread) @ self.whitening, np.float32)


class LineSpec(NamedTuple):
    """Exposure, line spacing and binning of pixels; by default every line at the reference exposure."""

    light: float = 1.0  # exposure as a fraction of the reference
    step: float = 1  # line spacing [px]
    binned: float = 1  # samples to a pixel

    @property
    def planes(self) -> NDArray[np.float32]:
        """Return the network's inputs beside spectral features, (3,); 0 is the reference or better."""
        return np.asarray(np.log2(np.maximum([1 / self.light, self.step, self.binned], 1)) / PLANE_SCALES, np.float32)

    @property
    def specs(self) -> tuple[LineSpec, ...]:
        """Return all captures of the image: this one."""
        return (self,)

    @property
    def usual(self) -> LineSpec:
        """Return the most frequent capture: this one."""
        return self

    def of_patches(self, patch_index: NDArray[np.integer], patch: int) -> LineSpec:
        """Return the capture of some patches: this one."""
        return self

    def where(self, spec: LineSpec) -> None:
        """Return None: every pixel has this capture."""


@dataclass(frozen=True, eq=False)
class CaptureMap:
    """Captures of the pixels of an image."""

    specs: tuple[LineSpec, ...]
    number: NDArray[np.uint8]  # (...) index of each pixel's capture

    @property
    def planes(self) -> NDArray[np.float32]:
        """Return the network's inputs beside spectral features, (..., 3)."""
        return np.stack([spec.planes for spec in self.specs])[self.number]

    @property
    def usual(self) -> LineSpec:
        """Return the most frequent capture."""
        return self.specs[int(np.bincount(self.number.ravel(), minlength=1).argmax())]

    def of_patches(self, patch_index: NDArray[np.integer], patch: int) -> CaptureMap:
        """Return the captures of some patches of an image, (patch, p, p)."""
        return CaptureMap(self.specs, patches_of(self.number, patch)[patch_index])

    def where(self, spec: LineSpec) -> NDArray[np.bool_]:
        """Return which pixels (...) have this capture."""
        return np.asarray(self.number == self.specs.index(spec), np.bool_)


Capture = LineSpec | CaptureMap


def with_planes(columns: NDArray[np.floating], capture: Capture, *, fainter: float = 1.0) -> NDArray[np.float32]:
    """Append the planes of the capture to spectral features, (..., column) -> (..., column + 3).

    ``fainter`` is a factor of the octaves by which exposures are shorter than the reference.
    """
    planes = capture.planes * np.array([fainter, 1, 1], np.float32)
    planes = np.broadcast_to(planes, (*columns.shape[:-1], len(PLANE_SCALES)))
    return np.concatenate([columns, planes], axis=-1, dtype=np.float32)


def all_valid(columns: NDArray[np.floating]) -> bool:
    """Return whether all pixels are valid, without a copy of the columns."""
    return not columns.size or bool(columns.min() >= -MOST_COLUMN and columns.max() <= MOST_COLUMN)


def invalid_pixels(columns: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return the invalid pixels, (..., column) -> (...): a column is not finite, or larger than any valid value."""
    if all_valid(columns):
        return np.zeros(columns.shape[:-1], np.bool_)
    valid = columns <= MOST_COLUMN  # avoids a copy of the columns
    valid &= columns >= -MOST_COLUMN
    return np.asarray(~valid.all(axis=-1), np.bool_)


def fill_invalid(patches: NDArray[np.floating], invalid: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Fill invalid pixels of patches (P, y, x, column) by the mean of the patch's valid ones, or by 0 without one."""
    filled = np.array(patches, np.float32)
    for patch, holes in zip(filled, invalid, strict=True):  # one by one saves memory
        if holes.any():
            patch[holes] = 0 if holes.all() else patch[~holes].mean(axis=0, dtype=np.float64)
    return filled


def readable(invalid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which patches have enough valid pixels, (P, y, x) invalid pixels -> (P,)."""
    return np.asarray(invalid.mean(axis=(1, 2)) <= MOST_INVALID, np.bool_)


def patches_of(image: NDArray[Kind], patch: int) -> NDArray[Kind]:
    """Cut an image whose sides ``patch`` divides, (y, x, ...), into patches (P, patch, patch, ...), row by row."""
    y, x = image.shape[0] // patch, image.shape[1] // patch
    cells = image.reshape(y, patch, x, patch, *image.shape[2:]).swapaxes(1, 2)
    return cells.reshape(y * x, patch, patch, *image.shape[2:])
