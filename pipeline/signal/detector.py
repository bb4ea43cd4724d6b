"""Judgement of the detector by its frames: elements that are not to be believed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from pipeline.errors import RigError, ShapeError
from pipeline.readings import SIGMA_OF_MEDIAN

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

LEAST_NOISE_DN = 1.0  # dark frames are whole numbers: below one step a spread means nothing
BANDS_FOR_COLUMN = 8  # fewer cannot tell an odd element from an odd column


@dataclass(frozen=True)
class BadElementCriteria:
    """When an element is bad; the fields are the thresholds of :func:`find_bad_elements`."""

    hot_sigmas: float = 8.0  # dark above the band's median
    lit_sigmas: float = 10.0  # least response that can be judged, in spreads of the dark frame ...
    lit_fraction: float = 0.1  # ... and of the band's median: beyond the slit's ends there is stray light alone
    least_response: float = 0.1  # of the neighbours'
    odd_sigmas: float = 8.0  # response off that of the window, in spreads of the band ...
    odd_fraction: float = 0.2  # ... and beyond its nearest neighbours by this fraction of theirs
    window: int = 15  # neighbouring samples compared
    near: int = 7  # nearest neighbours, the element among them
    most: float = 0.05  # of all elements, or one column; more mean that the frames are wrong, not the detector


def find_bad_elements(
    dark: NDArray[np.floating],
    white: NDArray[np.floating],
    *,
    criteria: BadElementCriteria | None = None,
    saturated_dn: float | None = None,
) -> Bools:
    """Find elements (sample, band) of the detector that are not to be believed, from mean dark and white frames [DN].

    One is bad if a frame is not finite there, the white frame is saturated (at ``saturated_dn`` or more), its dark
    level stands out of its band's (hot), it hardly responds although its neighbours do (dead), or its response stands
    out of its neighbours' in the band by more than its column does in most bands (odd). Dust on the slit darkens a
    column in all bands and is no fault, the white frame takes it off; nor is a slope, as at the slit's ends. Where the
    neighbours see no light nothing is said of the response.

    Spreads are medians of absolute deviations. Fewer samples than ``criteria.near`` cannot tell what is odd, and one
    sample can be compared with nothing: there only what is not finite or saturated is bad.

    Raises ShapeError: the frames are not (sample, band), or not of one size.
    Raises RigError: more elements than ``criteria.most``, and than one column, would be bad.
    """
    limits = BadElementCriteria() if criteria is None else criteria
    if dark.ndim != 2 or dark.shape != white.shape:
        raise ShapeError(
            f"expected dark and white frames (sample, band) of one size, got {dark.shape} and {white.shape}"
        )
    low, high = np.asarray(dark, np.float64), np.asarray(white, np.float64)
    bad = ~(np.isfinite(low) & np.isfinite(high))
    if saturated_dn is not None:
        bad |= high >= saturated_dn
    low = np.where(bad, np.nan, low)
    above = low - _median(low, axis=0)
    noise = np.maximum(SIGMA_OF_MEDIAN * _median(np.abs(above), axis=0), LEAST_NOISE_DN)
    bad |= above > limits.hot_sigmas * noise
    bad |= _off_neighbours(np.where(bad, np.nan, high - low), noise, limits)
    if np.count_nonzero(bad) > max(limits.most * bad.size, bad.shape[1]):
        raise RigError(
            f"{100 * bad.mean():.1f} % of the elements look bad, at most {100 * limits.most:g} % can be; is the white "
            "frame lit evenly along the slit and the dark one taken with the same exposure? Take both again"
        )
    return bad


def _off_neighbours(response: Floats, noise: Floats, limits: BadElementCriteria) -> Bools:
    """Elements whose response is missing or odd beside their neighbours'."""
    size = min(limits.window, len(response))
    around = (max(size - 1 + size % 2, 1), 1)  # an odd number of samples
    local: Floats = ndimage.median_filter(_without_gaps(response), around, mode="reflect")
    least = np.maximum(limits.lit_sigmas * noise, limits.lit_fraction * _median(response, axis=0))
    judged = np.isfinite(response) & (local > least)
    relative = np.full(response.shape, np.nan)
    np.divide(response, local, out=relative, where=judged)
    dead = judged & (relative < limits.least_response)
    off = np.where(dead, np.nan, relative - 1)
    if response.shape[1] >= BANDS_FOR_COLUMN:
        off -= _median(off, axis=1)
    spread = SIGMA_OF_MEDIAN * _median(np.abs(off), axis=0)
    if len(response) < limits.near:
        return dead
    # Beyond the nearest neighbours as well; two that stand out side by side do not hide each other.
    filled = _without_gaps(response)
    low, high = (ndimage.rank_filter(filled, rank, (limits.near, 1), mode="reflect") for rank in (2, -3))
    beyond = (response < low * (1 - limits.odd_fraction)) | (response > high * (1 + limits.odd_fraction))
    odd: Bools = (np.abs(off) > limits.odd_sigmas * spread) & beyond
    return dead | odd


def _without_gaps(columns: Floats) -> Floats:
    """Gaps take the median of their band, a band that is one gap takes 0."""
    return np.where(np.isfinite(columns), columns, np.nan_to_num(_median(columns, axis=0)))


def _median(values: Floats, axis: int) -> Floats:
    """Median of what is not NaN, the axis kept; NaN where there is nothing."""
    ordered = np.sort(values, axis=axis)  # NaN last
    count = np.count_nonzero(~np.isnan(values), axis=axis, keepdims=True)
    if not values.shape[axis]:
        return np.full(count.shape, np.nan)
    low = np.take_along_axis(ordered, np.maximum(count - 1, 0) // 2, axis)
    middle: Floats = (low + np.take_along_axis(ordered, np.minimum(count // 2, values.shape[axis] - 1), axis)) / 2
    return np.where(count > 0, middle, np.nan)
