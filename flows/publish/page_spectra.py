"""Spectra as a page holds them: a byte for each band and coarse pixel, and the mean of each class.

Where all values would be too many, first neighbouring bands are taken together, then neighbouring pixels.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
MOST_VALUES = 2_600_000  # of a page: two megabytes of it, as measured on the farm
LEAST_BANDS = 30  # before pixels are taken together
NOTHING = 255  # where no line reached
LEVELS = 254
HALF = 0.5  # of a pixel of the spectra, from which it counts for a class


@dataclass(frozen=True)
class PageSpectra:
    """Spectra of a field: byte b of band k is the value ``low[k] + b * step[k]``, `NOTHING` where there is none."""

    levels: NDArray[np.uint8]  # (y, x, band)
    low: Floats  # (band,)
    step: Floats  # (band,)
    wavelength_nm: NDArray[np.float64]  # (band,) ascending
    bands_each: int  # of the mosaic in one band
    pixel_px: int  # scene px a side of a pixel

    def values(self) -> Floats:
        """The values that it stands for, (y, x, band); NaN where there is none."""
        found: Floats = np.where(self.levels == NOTHING, np.nan, self.low + self.levels * self.step).astype(np.float32)
        return found


def page_spectra(
    rows: Iterable[Floats], shape: tuple[int, int, int], wavelength_nm: NDArray[np.floating], factor: int
) -> PageSpectra:
    """Take spectra of a mosaic, which comes as blocks of (row, x, band) from the top down.

    ``shape`` is the mosaic's (y, x, band), ``factor`` the scene px a side of its pixels. Means of bands are means over
    neighbours by wavelength, of those that have a value.
    """
    height, width, count = shape
    each = _bands_together(height * width, count)
    kept = -(-count // each)
    thin = _pixels_together(height, width, kept)
    order, starts = np.argsort(wavelength_nm, kind="stable"), np.arange(0, count, each)
    ascending = bool((order == np.arange(count)).all())
    blocks = [_band_means(block if ascending else block[..., order], starts) for block in rows]
    values = np.concatenate(blocks)
    if thin > 1:
        values = _pixel_means(values, thin)
    with np.errstate(invalid="ignore"):
        known = np.isfinite(values)
        low = np.where(known, values, np.inf).min(axis=(0, 1))
        high = np.where(known, values, -np.inf).max(axis=(0, 1))
    low, high = np.where(np.isfinite(low), low, 0), np.where(np.isfinite(high), high, 0)
    step = np.where(high > low, (high - low) / LEVELS, 1).astype(np.float32)
    levels = np.where(known, np.rint((np.where(known, values, low) - low) / step), NOTHING).astype(np.uint8)
    sizes = np.diff(np.append(starts, count))
    waves = np.add.reduceat(np.asarray(wavelength_nm, np.float64)[order], starts) / sizes
    return PageSpectra(levels, low.astype(np.float32), step, waves, each, factor * thin)


def class_means(spectra: PageSpectra, classes: NDArray[np.uint8], count: int) -> tuple[Floats, NDArray[np.intp]]:
    """Mean spectrum of each class over the pixels of which it covers half or more, and how many these are.

    ``classes`` is the (y, x) class map on scene px. Gives (class, band), NaN without such a pixel, and (class,).
    """
    side, (height, width, bands) = spectra.pixel_px, spectra.levels.shape
    down = np.minimum(np.arange(classes.shape[0]) // side, height - 1)
    across = np.minimum(np.arange(classes.shape[1]) // side, width - 1)
    place = (down[:, None] * width + across[None, :]) * (count + 1) + np.minimum(classes, count)
    share = np.bincount(place.ravel(), minlength=height * width * (count + 1)).reshape(-1, count + 1)
    covered = share[:, :count] >= HALF * np.maximum(share.sum(axis=1, keepdims=True), 1)
    values = spectra.values().reshape(-1, bands)
    means = np.full((count, bands), np.nan, np.float32)
    sizes = np.zeros(count, np.intp)
    for number in range(count):
        mine = values[covered[:, number]]
        mine = mine[np.isfinite(mine).any(axis=1)]
        sizes[number] = len(mine)
        known = np.isfinite(mine)
        total = np.where(known, mine, 0).sum(axis=0, dtype=np.float64)
        means[number] = np.divide(total, known.sum(axis=0), out=np.full(bands, np.nan), where=known.any(axis=0))
    return means, sizes


def _bands_together(pixels: int, bands: int) -> int:
    each = -(-pixels * bands // MOST_VALUES)
    return max(1, min(each, bands // LEAST_BANDS))


def _pixels_together(height: int, width: int, bands: int) -> int:
    thin = 1
    while -(-height // thin) * -(-width // thin) * bands > MOST_VALUES and thin < max(height, width):
        thin += 1
    return thin


def _band_means(block: Floats, starts: NDArray[np.intp]) -> Floats:
    """Means over runs of bands that begin at ``starts``, of the values that are there."""
    if len(starts) == block.shape[-1]:
        return block
    known = np.isfinite(block)
    total = np.add.reduceat(block if known.all() else np.where(known, block, 0), starts, axis=-1)
    there = np.add.reduceat(known, starts, axis=-1, dtype=np.int32)
    means: Floats = np.divide(total, there, out=np.full(total.shape, np.nan, np.float32), where=there > 0)
    return means


def _pixel_means(values: Floats, thin: int) -> Floats:
    """Means over squares of ``thin`` pixels a side, cut off at the right and below, of the values that are there."""
    known = np.isfinite(values)
    total = np.where(known, values, 0)
    there = known.astype(np.int32)
    for axis in (0, 1):
        starts = np.arange(0, values.shape[axis], thin)
        total, there = np.add.reduceat(total, starts, axis=axis), np.add.reduceat(there, starts, axis=axis)
    means: Floats = np.divide(total, there, out=np.full(total.shape, np.nan, np.float32), where=there > 0)
    return means
