"""Spectra of condensed stores as xarray arrays: what is asked for is restored, scores * step @ axes + mean."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import xarray
from numpy.typing import NDArray
from xarray.backends import BackendArray
from xarray.core import indexing

from storage.arrays.georeference import GRID_MAPPING
from storage.arrays.layout import open_group
from storage.arrays.mosaics import Mosaic, open_mosaic
from storage.arrays.signal_cubes import SignalCube, check_condensed, open_signal_cube, read_coordinates, score_layout

Restore = Callable[[slice, slice, Sequence[int]], NDArray[np.float32]]  # rows, columns, bands: (row, column, band)
OF_BANDS = ("band", "wavelength", "fwhm")
OF_LINES = ("line", "sample", "time", "mirror_x", "mirror_y", "exposure_ms", "valid_line")
OF_PLACES = ("y", "x", GRID_MAPPING)
VALUE = {"long_name": "scene value", "units": "1"}


class RestoredArray(BackendArray):
    """Spectra (row, column, band) float32 that are restored when they are indexed, and only those."""

    def __init__(self, shape: tuple[int, ...], restore: Restore) -> None:
        self.shape, self.dtype, self._restore = shape, np.dtype(np.float32), restore

    def __getitem__(self, key: indexing.ExplicitIndexer) -> Any:
        return indexing.explicit_indexing_adapter(key, self.shape, indexing.IndexingSupport.OUTER, self._outer)

    def _outer(self, key: tuple[Any, ...]) -> NDArray[np.float32]:
        """Values at numbers, slices or (n,) places along each axis; a number takes its axis away."""
        chosen = [np.arange(size)[one] for size, one in zip(self.shape, key, strict=True)]
        kept = [one.size for one in chosen if one.ndim]
        if 0 in kept:
            return np.empty(kept, np.float32)
        (rows, row), (columns, column) = (_span(np.atleast_1d(one)) for one in chosen[:2])
        found = self._restore(rows, columns, np.atleast_1d(chosen[2]).tolist())
        return found[row][:, column].reshape(kept)


def _span(places: NDArray[np.intp]) -> tuple[slice, slice | NDArray[np.intp]]:
    """Return the slice that holds some places, and where in it they are."""
    first, last = int(places.min()), int(places.max())
    whole = len(places) == last - first + 1 and bool((np.diff(places) == 1).all())
    return slice(first, last + 1), slice(None) if whole else places - first


@dataclass(frozen=True)
class _MosaicSpectra:
    """Restores pixels of a mosaic, which is opened when the first are asked for."""

    path: Path

    @cached_property
    def mosaic(self) -> Mosaic:
        return open_mosaic(self.path)

    def __call__(self, rows: slice, columns: slice, bands: Sequence[int]) -> NDArray[np.float32]:
        return self.mosaic.values(rows, columns, bands)


@dataclass(frozen=True)
class _LineSpectra:
    """Restores lines of a condensed sweep, which is opened when the first are asked for."""

    path: Path

    @cached_property
    def cube(self) -> SignalCube:
        return open_signal_cube(self.path)

    def __call__(self, lines: slice, samples: slice, bands: Sequence[int]) -> NDArray[np.float32]:
        return self.cube.spectra(lines.start, lines.stop, samples, bands)


def open_lazy_mosaic(path: Path) -> xarray.DataArray:
    """Open a mosaic as (y, x, band) scene values, with a coordinate on every axis.

    Raises IncompleteStoreError: it is missing, damaged or of an earlier version.
    """
    return _open(path, ("y", "x", "band"), OF_PLACES, _MosaicSpectra(path))


def open_lazy_lines(path: Path) -> xarray.DataArray:
    """Open a condensed sweep as (line, sample, band) scene values, rare spectra too; otherwise `open_lazy_mosaic`."""
    return _open(path, ("line", "sample", "band"), OF_LINES, _LineSpectra(path))


def _open(path: Path, dims: tuple[str, str, str], places: Sequence[str], restore: Restore) -> xarray.DataArray:
    """Return spectra with the coordinates of their store, in dask's blocks of whole shards of scores."""
    group = open_group(path)
    check_condensed(group, path)
    size, block = score_layout(group)
    coords = {name: xarray.Variable(*one) for name, one in read_coordinates(group, (*places, *OF_BANDS)).items()}
    shape = (*size, coords["wavelength"].sizes["band"])
    bare = {name: np.arange(length) for name, length in zip(dims, shape, strict=True) if name not in coords}
    mapped = {"grid_mapping": GRID_MAPPING} if GRID_MAPPING in coords else {}
    spectra = xarray.Variable(dims, indexing.LazilyIndexedArray(RestoredArray(shape, restore)), VALUE | mapped)
    found = xarray.Dataset({"spectra": spectra.chunk(dict(zip(dims, (*block, -1), strict=True)))}, coords | bare)
    return by_wavelength(xarray.decode_cf(found, mask_and_scale=False))["spectra"]


def by_wavelength(opened: xarray.Dataset) -> xarray.Dataset:
    """Make ``wavelength`` an index of its bands, so that ``.sel(wavelength=660, method="nearest")`` finds one.

    Where wavelengths rise or fall without a break, slices work as well; else (two spectrometers that overlap) only the
    nearest can be asked for.
    """
    if "wavelength" not in opened.coords or opened["wavelength"].ndim != 1:
        return opened
    steps = np.diff(opened["wavelength"].values)
    if (steps > 0).all() or (steps < 0).all():
        return opened.set_xindex("wavelength")
    return opened.set_xindex("wavelength", xarray.indexes.NDPointIndex)
