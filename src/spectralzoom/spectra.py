"""Give the spectra of condensed stores as xarray arrays, restored on indexing: scores * step @ axes + mean."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import xarray
from numpy.typing import NDArray
from xarray.backends import BackendArray
from xarray.core import indexing

from spectralzoom.storage.arrays.band_order import OF_WAVELENGTHS, by_wavelength
from spectralzoom.storage.arrays.georeference import GRID_MAPPING
from spectralzoom.storage.arrays.layout import array_of, open_group
from spectralzoom.storage.arrays.mosaics import Mosaic, open_mosaic
from spectralzoom.storage.arrays.signal_cubes import SignalCube, open_signal_cube, read_coordinates

OpenStore = Callable[[Path], Mosaic | SignalCube]
OF_BANDS = (*OF_WAVELENGTHS, "fwhm")
OF_LINES = ("line", "sample", "time", "mirror_x", "mirror_y", "exposure_ms", "valid_line")
OF_PLACES = ("y", "x", GRID_MAPPING)
VALUE = {"long_name": "scene value", "units": "1"}


class RestoredArray(BackendArray):
    """Spectra (row, column, band) float32 of a store, which is opened when some are first selected and restored."""

    def __init__(self, shape: tuple[int, ...], path: Path, open_store: OpenStore) -> None:
        self.shape = shape
        self.dtype = np.dtype(np.float32)
        self._path = path
        self._open_store = open_store

    @cached_property
    def _store(self) -> Mosaic | SignalCube:
        return self._open_store(self._path)

    def __getitem__(self, key: indexing.ExplicitIndexer) -> Any:
        return indexing.explicit_indexing_adapter(key, self.shape, indexing.IndexingSupport.OUTER, self._outer)

    def _outer(self, key: tuple[Any, ...]) -> NDArray[np.float32]:
        """Return the values at numbers, slices or (n,) places along each axis; a number removes its axis."""
        chosen = [np.arange(size)[one] for size, one in zip(self.shape, key, strict=True)]
        kept = [one.size for one in chosen if one.ndim]
        if 0 in kept:
            return np.empty(kept, np.float32)
        (rows, row), (columns, column) = (_span(np.atleast_1d(one)) for one in chosen[:2])
        bands = np.atleast_1d(chosen[2]).tolist()
        if isinstance(self._store, Mosaic):
            values = self._store.values(rows, columns, bands)
        else:
            values = self._store.spectra(rows.start, rows.stop, columns, bands)
        return values[row][:, column].reshape(kept)


def _span(places: NDArray[np.intp]) -> tuple[slice, slice | NDArray[np.intp]]:
    """Return the slice that holds some places, and where in it they are."""
    first, last = int(places.min()), int(places.max())
    whole = len(places) == last - first + 1 and bool((np.diff(places) == 1).all())
    return slice(first, last + 1), slice(None) if whole else places - first


def open_lazy_mosaic(path: Path) -> xarray.DataArray:
    """Open a mosaic as (y, x, band) scene values, with a coordinate on every axis.

    Raises IncompleteStoreError: it is missing or damaged.
    """
    return _open(path, ("y", "x", "band"), OF_PLACES, open_mosaic)


def open_lazy_lines(path: Path) -> xarray.DataArray:
    """Open a condensed sweep as (line, sample, band) scene values, rare spectra too; otherwise `open_lazy_mosaic`."""
    return _open(path, ("line", "sample", "band"), OF_LINES, open_signal_cube)


def _open(path: Path, dims: tuple[str, str, str], places: Sequence[str], open_store: OpenStore) -> xarray.DataArray:
    """Return spectra with the coordinates of their store, in dask's blocks of whole shards of scores."""
    group = open_group(path)
    scores = array_of(group, "scores")
    block = (scores.shards or scores.chunks)[1:]
    coords = {name: xarray.Variable(*one) for name, one in read_coordinates(group, (*places, *OF_BANDS)).items()}
    shape = (*scores.shape[1:], coords["wavelength"].sizes["band"])
    bare = {name: np.arange(length) for name, length in zip(dims, shape, strict=True) if name not in coords}
    mapped = {"grid_mapping": GRID_MAPPING} if GRID_MAPPING in coords else {}
    spectra = xarray.Variable(dims, indexing.LazilyIndexedArray(RestoredArray(shape, path, open_store)), VALUE | mapped)
    found = xarray.decode_cf(xarray.Dataset({"spectra": spectra}, coords | bare), mask_and_scale=False)
    return by_wavelength(with_plain_attributes(found))["spectra"].chunk(dict(zip(dims, (*block, -1), strict=True)))


def with_plain_attributes(opened: xarray.Dataset) -> xarray.Dataset:
    """Return arrays with attributes that NetCDF can hold: text, numbers and lists of them; others become JSON text."""
    found = opened.copy()
    holders: tuple[Any, ...] = (found, *found.variables.values())
    for one in holders:
        one.attrs = {name: value if _is_plain(value) else json.dumps(value) for name, value in one.attrs.items()}
    return found


def _is_plain(value: object) -> bool:
    """Return whether NetCDF has such an attribute."""
    parts = value if isinstance(value, list | tuple) and value else [value]
    return all(isinstance(one, str) for one in parts) or all(
        isinstance(one, int | float | np.number) and not isinstance(one, bool) for one in parts
    )
