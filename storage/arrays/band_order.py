"""Order bands by wavelength, where files list those of several detectors one after another."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray


class SortedBands(NamedTuple):
    """Bands by rising wavelength, (band,) each."""

    order: NDArray[np.intp]  # their numbers in the file
    wavelength_nm: NDArray[np.float64]  # unique: of equal centres each is the next float64 after the one before
    detector: NDArray[np.int64]  # number from 0 in the order of the file; all 0 where no two detectors overlap


def sort_bands(wavelength_nm: ArrayLike) -> SortedBands:
    """Return the bands by rising wavelength [nm], with their detectors.

    The bands of a detector follow each other in the file, with rising wavelengths, or falling ones if most fall. Bands
    whose order says nothing, such as red, green, blue and near infrared, count as one detector. Equal centres keep the
    order of the file.
    """
    centres = np.array(wavelength_nm, np.float64)
    steps = np.diff(centres)
    falls = bool(len(steps)) and np.median(steps) < 0
    detector = np.cumsum(np.append([False], steps >= 0 if falls else steps <= 0))
    parts = sorted((centres[detector == one].min(), centres[detector == one].max()) for one in np.unique(detector))
    overlap = any(low <= high for (_, high), (low, _) in pairwise(parts))
    if not overlap or np.bincount(detector).min() < 2:
        detector = np.zeros(len(centres), np.int64)
    order = np.argsort(centres, kind="stable")
    found = centres[order]
    for band in np.flatnonzero(np.diff(found) <= 0) + 1:
        found[band] = np.nextafter(found[band - 1], np.inf)
    return SortedBands(order, found, detector[order])
