"""Order bands by wavelength, where files list those of several detectors one after another."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple, TypeVar

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

OF_WAVELENGTHS = ("band", "wavelength")  # coordinates [nm]
Labelled = TypeVar("Labelled", xr.Dataset, xr.DataArray)


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


def by_wavelength(opened: Labelled) -> Labelled:
    """Sort bands by wavelength, for ``.sel(wavelength=660, method="nearest")``, and index them by it and by ``band``.

    ``detector`` is the number of each band's detector, as `sort_bands` finds it: overlapping ones alternate. Cubes in
    which a band has no wavelength are returned as they are.
    """
    found = opened.coords.get("wavelength")
    if found is None or found.dims != ("band",) or np.isnan(found.values).any():
        return opened
    bands = sort_bands(found.values)
    names = [name for name in OF_WAVELENGTHS if name in opened.coords]
    opened = opened.drop_indexes(names, errors="ignore")
    if (np.diff(bands.order) < 0).any():
        opened = opened.isel(band=bands.order)
    about = {"long_name": "detector, numbered from 0 in the order of the file", "units": "1"}
    coords = {name: ("band", bands.wavelength_nm, opened[name].attrs) for name in names}
    opened = opened.assign_coords({**coords, "detector": ("band", bands.detector, about)})
    for name in names:
        opened = opened.drop_indexes(name, errors="ignore").set_xindex(name)
    return opened
