"""The spectral stem: any number of bands, in any order, onto a fixed number of columns by wavelength.

Pixels without a reading are filled from the rest of their patch; of which more than half is dead is not read.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import WavelengthError
from pipeline.readings import MOST_STEPS, SIGMA_OF_MEDIAN

REACH = 1.5  # a column is reached by a band within this many column spacings of its centre
LONGEST_NM, SHORTEST_NM = 3000.0, 200.0
SPREAD_FLOOR = 1e-3  # least spread of a column, as a fraction of the median spread
VARIANCE_FLOOR = 1e-5  # least variance of a direction that whitening brings to 1, as a fraction of the largest
Kind = TypeVar("Kind", bound=np.generic)
PLANE_SCALES = np.array([4.0, 2.0, 2.0])  # of the logarithms of exposure, line spacing, binned samples
MOST_DEAD = 0.5  # a token with more dead pixels than this fraction is not read
MOST_COLUMN = 1e12  # of normalised columns: no reading gives more, and squares of more would end the range of float32


@dataclass(frozen=True)
class SpectralBasis:
    """Bumps evenly spread over ``low_nm``..``high_nm``, the wavelengths that the weights are for."""

    low_nm: float
    high_nm: float
    columns: int = 24

    @staticmethod
    def spanning(wavelength_nm: NDArray[np.floating], most_columns: int = 24) -> SpectralBasis:
        """Give the basis for data of these bands: no more columns than bands."""
        wavelength = checked_wavelengths(wavelength_nm, len(wavelength_nm))
        distinct = len(np.unique(wavelength))
        return SpectralBasis(float(wavelength.min()), float(wavelength.max()), min(most_columns, distinct))

    @property
    def spacing_nm(self) -> float:
        """Distance of neighbouring column centres [nm]; one column alone takes everything."""
        span = self.high_nm - self.low_nm
        return span / (self.columns - 1) if self.columns > 1 else max(span, LONGEST_NM)

    def matrix(self, wavelength_nm: NDArray[np.floating]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Weights from bands to columns, each reached column summing to 1, and which columns are reached.

        A band counts by the stretch of spectrum that it stands for (trapezoid on the sorted wavelengths), so that
        15 or 270 bands give numbers of one scale, and repeated bands share their weight.

        Returns (band, column) float32 and (column,) bool. Columns that no band reaches are all zero.

        Raises WavelengthError for a wavelength that is not finite, or outside 200-3000 nm (micrometres?).
        """
        wavelength = checked_wavelengths(wavelength_nm, len(wavelength_nm))
        centres = np.linspace(self.low_nm, self.high_nm, self.columns)
        distance = (wavelength[:, None] - centres[None, :]) / self.spacing_nm
        bump = np.where(np.abs(distance) <= REACH, np.exp(-0.5 * (distance / 0.5) ** 2), 0.0)
        weight = bump * band_widths(wavelength)[:, None]
        total = weight.sum(axis=0)
        reached = total > 0
        return (weight / np.where(reached, total, 1.0)).astype(np.float32), reached


def project(values: NDArray[np.floating], matrix: NDArray[np.float32]) -> NDArray[np.float32]:
    """Bring (..., band) values onto columns, (..., column), by the weights of `SpectralBasis.matrix`.

    Bands of a pixel that are not finite are left out and the rest of a column's bands weigh for them; a column of which
    no band is left is NaN, and so is every column of a pixel with more than half of its bands dead.
    """
    exact = np.asarray(values, np.float32)
    with np.errstate(invalid="ignore", over="ignore"):  # what is not finite is mended afterwards
        seen = np.asarray(exact @ matrix, np.float32)
    broken = ~np.isfinite(exact).all(axis=-1)
    if broken.any():
        seen[broken] = _of_living_bands(exact[broken], matrix)
    return seen


def _of_living_bands(values: NDArray[np.float32], matrix: NDArray[np.float32]) -> NDArray[np.float32]:
    """(pixel, band) -> (pixel, column) by the finite bands alone."""
    living = np.isfinite(values)
    weight = living.astype(np.float32) @ matrix
    whole = matrix.sum(axis=0) > 0
    total = np.where(living, values, np.float32(0)) @ matrix
    mean: NDArray[np.float32] = np.divide(total, weight, out=np.zeros_like(weight), where=weight > 0)
    mean[(weight <= 0) & whole] = np.nan
    mean[2 * living.sum(axis=1) < values.shape[1]] = np.nan
    return mean


def checked_wavelengths(wavelength_nm: NDArray[np.floating], bands: int) -> NDArray[np.float64]:
    """Return the wavelengths as float64 after checking number, finiteness and unit; raises WavelengthError."""
    wavelength = np.asarray(wavelength_nm, np.float64)
    if wavelength.shape != (bands,) or bands == 0:
        raise WavelengthError(f"expected one wavelength for each of {bands} bands, got {wavelength.size}")
    outside = ~((wavelength >= SHORTEST_NM) & (wavelength <= LONGEST_NM))
    if outside.any():
        raise WavelengthError(
            f"wavelength {wavelength[outside][0]:g} is outside {SHORTEST_NM:g}-{LONGEST_NM:g} nm;"
            " give nanometres (multiply micrometres by 1000)"
        )
    return wavelength


def check_basis(basis: SpectralBasis, columns: int) -> None:
    """Raise WavelengthError unless a basis has so many columns, between two wavelengths that there can be."""
    checked_wavelengths(np.array([basis.low_nm, basis.high_nm]), 2)
    if basis.columns != columns or basis.low_nm > basis.high_nm:
        raise WavelengthError(
            f"a basis of {basis.columns} columns from {basis.low_nm:g} to {basis.high_nm:g} nm, expected {columns} of"
            " them between ascending wavelengths"
        )


def band_widths(wavelength_nm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Stretch of spectrum that a band stands for [nm]: half the way to either neighbour; 1 for a single wavelength."""
    distinct, group, members = np.unique(wavelength_nm, return_inverse=True, return_counts=True)
    if len(distinct) == 1:
        return np.full(len(wavelength_nm), 1.0 / members[0])
    gap = np.diff(distinct)
    width = np.concatenate([gap[:1], gap[:-1] + gap[1:], gap[-1:]]) / 2
    return (width / members)[group]


@dataclass(frozen=True)
class Normalisation:
    """Brings columns to one scale and takes their correlation out, as measured on the training data.

    Neighbouring columns nearly repeat each other; what tells two crops apart is a small direction among them, which
    whitening makes as large as the rest.
    """

    centre: NDArray[np.float32]  # (column,) median
    spread: NDArray[np.float32]  # (column,) 1.4826 MAD, floored
    whitening: NDArray[np.float32]  # (column, column)

    @staticmethod
    def measured(sample: NDArray[np.floating], noise: NDArray[np.floating] | None = None) -> Normalisation:
        """Measure on (pixel, column) values. Constant columns give 0, whatever the order of columns.

        ``noise`` is the covariance (column, column) of what a shorter exposure than the sample's would add, in squares
        of its values: directions that it hides are not made as large as the rest.
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
        whitening = (axes * gain) @ axes.T  # symmetric: no column changes its sign or its place
        return Normalisation(centre.astype(np.float32), spread.astype(np.float32), whitening.astype(np.float32))

    def apply(self, columns: NDArray[np.floating], reached: NDArray[np.bool_]) -> NDArray[np.float32]:
        """(..., column) -> the same shape; columns that are unreached or not finite take what the others let expect.

        Left at the median they would stand out among neighbours that they nearly repeat, and whitening would make that
        larger than everything else. A pixel without a known column counts as the median.
        """
        normal = (np.asarray(columns, np.float32) - self.centre) / self.spread
        there = reached & np.isfinite(normal)
        known = np.where(there, normal, np.float32(0))
        alike = (there == reached).all(axis=-1)
        self._complete(known, alike, reached)
        broken = there[~alike]
        for pattern in np.unique(broken, axis=0):
            self._complete(known, np.asarray(~alike & (there == pattern).all(axis=-1), np.bool_), pattern)
        return np.asarray(known @ self.whitening, np.float32)

    def _complete(self, known: NDArray[np.float32], pixels: NDArray[np.bool_], reached: NDArray[np.bool_]) -> None:
        """Put what the reached columns let expect into the others of some pixels, in place."""
        if reached.all() or not reached.any() or not pixels.any():
            return
        rows = known[pixels]
        rest, whitening = ~reached, self.whitening.astype(np.float64)
        inverse = whitening @ whitening  # of the covariance of a normal law
        weights = -np.linalg.solve(inverse[np.ix_(rest, rest)], inverse[np.ix_(rest, reached)]).T
        rows[:, rest] = rows[:, reached] @ np.asarray(weights, np.float32)  # its conditional mean
        known[pixels] = rows

    @property
    def most_value(self) -> float:
        """Size up to which a value may be a reading: as many spreads from the centre as a camera tells steps apart."""
        reach = np.abs(self.centre.astype(np.float64)) + MOST_STEPS * self.spread.astype(np.float64)
        return float(min(reach.max(initial=0.0), np.finfo(np.float32).max))

    @property
    def gain_shift(self) -> NDArray[np.float32]:
        """Return what 100 % more light adds to normalised columns beyond doubling them, (column,)."""
        return np.asarray((self.centre / self.spread) @ self.whitening, np.float32)


class LineSpec(NamedTuple):
    """Capture of pixels: light, line spacing, binning; without arguments every line of the reference exposure."""

    light: float = 1.0  # exposure as a fraction of the reference
    step: float = 1  # line spacing [px]
    binned: float = 1  # samples to a pixel

    @property
    def planes(self) -> NDArray[np.float32]:
        """Return what the network reads beside spectral features, (3,): 0 for what is at least the reference."""
        return np.asarray(np.log2(np.maximum([1 / self.light, self.step, self.binned], 1)) / PLANE_SCALES, np.float32)

    @property
    def specs(self) -> tuple[LineSpec, ...]:
        """Return the kinds of capture that there are: this one."""
        return (self,)

    @property
    def usual(self) -> LineSpec:
        """Return the capture that stands for all pixels."""
        return self

    def of_patches(self, patch_index: NDArray[np.integer], patch: int) -> LineSpec:
        """Return the capture of some patches: that of all pixels."""
        return self

    def where(self, spec: LineSpec) -> None:
        """Return None: every pixel was captured so."""


@dataclass(frozen=True, eq=False)
class CaptureMap:
    """Capture of each pixel of an image, where that differs from pixel to pixel."""

    specs: tuple[LineSpec, ...]
    number: NDArray[np.uint8]  # (...) of each pixel's capture among them

    @property
    def planes(self) -> NDArray[np.float32]:
        """Return what the network reads beside spectral features, (..., 3)."""
        return np.stack([spec.planes for spec in self.specs])[self.number]

    @property
    def usual(self) -> LineSpec:
        """Return the capture of most pixels."""
        return self.specs[int(np.bincount(self.number.ravel(), minlength=1).argmax())]

    def padded(self, shape: tuple[int, int]) -> CaptureMap:
        """Return the map of a padded image, by its border's pixels."""
        gap = [(0, whole - size) for whole, size in zip(shape, self.number.shape, strict=True)]
        return CaptureMap(self.specs, np.pad(self.number, gap, mode="edge"))

    def of_patches(self, patch_index: NDArray[np.integer], patch: int) -> CaptureMap:
        """Return the captures of some patches of an image, (patch, p, p)."""
        return CaptureMap(self.specs, patches_of(self.number, patch)[patch_index])

    def where(self, spec: LineSpec) -> NDArray[np.bool_]:
        """Return the pixels (...) that were captured so."""
        return np.asarray(self.number == self.specs.index(spec), np.bool_)


Capture = LineSpec | CaptureMap


def with_planes(columns: NDArray[np.floating], capture: Capture) -> NDArray[np.float32]:
    """Spectral features (..., column) with how they were captured behind them, (..., column + 3)."""
    planes = np.broadcast_to(capture.planes, (*columns.shape[:-1], len(PLANE_SCALES)))
    return np.concatenate([columns, planes], axis=-1, dtype=np.float32)


def all_alive(columns: NDArray[np.floating]) -> bool:
    """Return whether no pixel is dead, without a copy of the columns."""
    return not columns.size or bool(columns.min() >= -MOST_COLUMN and columns.max() <= MOST_COLUMN)


def dead_pixels(columns: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Pixels with a column that is not finite, or larger than any reading gives, (..., column) -> (...)."""
    if all_alive(columns):
        return np.zeros(columns.shape[:-1], np.bool_)
    alive = columns <= MOST_COLUMN  # no copy of the columns: their size would be one
    alive &= columns >= -MOST_COLUMN
    return np.asarray(~alive.all(axis=-1), np.bool_)


def fill_dead(patches: NDArray[np.floating], dead: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Patches (P, y, x, column) with the mean of each one's living pixels in the dead ones; 0 where none lives."""
    filled = np.array(patches, np.float32)
    for patch, holes in zip(filled, dead, strict=True):  # one by one: together they would take several copies of all
        if holes.any():
            patch[holes] = 0 if holes.all() else patch[~holes].mean(axis=0, dtype=np.float64)
    return filled


def readable(dead: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which patches can be read, (P, y, x) dead pixels -> (P,)."""
    return np.asarray(dead.mean(axis=(1, 2)) <= MOST_DEAD, np.bool_)


def patches_of(image: NDArray[Kind], patch: int) -> NDArray[Kind]:
    """Cut an image whose sides ``patch`` divides, (y, x, ...), into patches (P, patch, patch, ...), row by row."""
    y, x = image.shape[0] // patch, image.shape[1] // patch
    cells = image.reshape(y, patch, x, patch, *image.shape[2:]).swapaxes(1, 2)
    return cells.reshape(y * x, patch, patch, *image.shape[2:])
