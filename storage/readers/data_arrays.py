"""Give a cube as a lazy xarray.DataArray; apart from the readers, since xarray takes a second to import."""

from __future__ import annotations

from typing import Any

import numpy as np
import odc.geo.xr as odc_xr
import xarray as xr
from numpy.typing import NDArray
from xarray.backends import BackendArray
from xarray.core import indexing

from spectralzoom.storage.arrays.band_order import by_wavelength
from spectralzoom.storage.readers.cube_sources import DIMS, CubeSource


def data_array(cube: CubeSource) -> xr.DataArray:
    """Return the cube for xarray, bands sorted as `by_wavelength`; values are read when they are needed.

    ``file_band`` is the place of each band in the file, from 0.
    """
    marked = np.isin(np.arange(cube.shape[2]), cube.bad_bands)
    facts: dict[str, tuple[str | tuple[str, ...], Any, dict[str, str]]] = {
        "file_band": ("band", np.arange(cube.shape[2]), {"long_name": "band of the file, from 0"}),
        "wavelength": ("band", cube.bands.wavelength_nm, {"units": "nm"}),
        "fwhm": ("band", cube.bands.fwhm_nm, {"units": "nm"}),
        "bad_band": ("band", marked if marked.any() else None, {}),
        "valid": ("y", cube.lines.valid, {}),
        "time_s": ("y", cube.lines.time_s, {"units": "s"}),
        "exposure_ms": ("y", cube.lines.exposure_ms, {"units": "ms"}),
        "dark": (("x", "band"), cube.dark, {}),
        "white": (("x", "band"), cube.white, {}),
        "void": (("y", "x"), cube.void, {}),
    }
    known = {name: fact for name, fact in facts.items() if fact[1] is not None}
    places = {} if cube.geobox is None else odc_xr.xr_coords(cube.geobox, dims=("y", "x"))
    about: dict[str, Any] = {
        "notes": cube.notes,
        "files": tuple(map(str, cube.files)),
        "wavelengths_from": cube.bands.origin,
    }
    about |= {} if cube.nodata is None else {"_FillValue": cube.nodata}
    about |= {} if cube.acquired is None else {"acquired": cube.acquired}
    lines = indexing.LazilyIndexedArray(_Lines(cube))
    return by_wavelength(xr.DataArray(xr.Variable(DIMS, lines), {**known, **places}, name=cube.name, attrs=about))


class _Lines(BackendArray):
    """Lines of a cube as xarray asks for them."""

    def __init__(self, source: CubeSource) -> None:
        self.source, self.shape, self.dtype = source, source.shape, source.dtype

    def __getitem__(self, key: indexing.ExplicitIndexer) -> NDArray[Any]:
        basic = indexing.IndexingSupport.BASIC
        return indexing.explicit_indexing_adapter(key, self.shape, basic, self._part)  # type: ignore[no-any-return]

    def _part(self, key: tuple[int | slice, ...]) -> NDArray[Any]:
        """Return a part by whole numbers and slices."""
        numbers = np.arange(self.shape[0])[key[0]]
        if not numbers.size:
            return np.empty((0, *self.shape[1:]), self.dtype)[(slice(None), *key[1:])]
        first = int(numbers.min())
        block: NDArray[Any] = self.source.read(first, int(numbers.max()) + 1)
        part: NDArray[Any] = block[numbers - first]
        return part[(..., *key[1:])]
