"""Build cubes from named arrays: Zarr stores, NetCDF and HDF5 files, .npy and .mat.

Axes are found by their names; without names they are y, x and band. Values follow from scale, offset and fill value,
the place on the earth from a grid mapping.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox

from spectralzoom.pipeline.errors import SceneError
from spectralzoom.storage.arrays.georeference import find_geobox
from spectralzoom.storage.readers.band_facts import Bands, bands_of_numbers, is_spectral
from spectralzoom.storage.readers.cube_sources import (
    BLOCK_LINES,
    MOST_RATIO,
    CubeSource,
    Guard,
    check_claim,
    check_memory,
    read_by_chunks,
    unpacked,
)

ROWS = ("y", "line", "lines", "row", "rows", "lat", "latitude", "northing", "downtrack", "along_track")
_ACROSS = ("crosstrack", "across_track")
COLUMNS = ("x", "sample", "samples", "column", "columns", "col", "lon", "longitude", "easting", *_ACROSS)
BANDS = ("band", "bands", "wavelength", "wavelengths", "channel", "channels", "spectral")
WAVELENGTHS = (
    *("wavelength", "wavelengths", "radiation_wavelength", "wavelength_nm", "wavelengths_nm"),
    *("wl", "lambda", "nm"),
)

UNNAMED = "dims have no names, read as y, x, band"
_SHOWN = 5  # arrays in a note


@dataclass(frozen=True)
class FileArray:
    """One array of a file: its axes, attributes, and the function that reads a part of it.

    ``_ARRAY_DIMENSIONS`` in its attributes are the names of its axes, if they have names.
    """

    where: str  # address, for messages
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    attrs: Mapping[str, Any]
    get: Callable[[Any], NDArray[Any]] = field(repr=False)
    chunks: tuple[int, ...]  # numbers along each axis that are read at a time
    stored: int  # bytes on the disk that it may take
    ratio: int = MOST_RATIO  # bytes of numbers that one of them can be
    lost: str = ""  # note on parts without a file

    @property
    def ndim(self) -> int:
        return len(self.shape)

    @property
    def dims(self) -> list[str]:
        """Return the names of the axes; empty if there are none."""
        named = self.attrs.get("_ARRAY_DIMENSIONS")
        return ["" if name is None else str(name) for name in named] if isinstance(named, list | tuple) else []

    def __getitem__(self, part: Any) -> NDArray[Any]:
        if part is ...:
            self.check(self.shape)
        return self.get(part)

    def check(self, part: Sequence[int]) -> None:
        """Refuse an array that its file, or a ``part`` of it that the memory, cannot hold (SceneError)."""
        claimed = max(math.prod(self.shape), math.prod(self.chunks)) * self.dtype.itemsize
        check_claim(self.where, claimed, self.stored, self.ratio)
        needed = self.dtype.itemsize
        for size, chunk, wanted in zip(self.shape, self.chunks, part, strict=True):
            needed *= min(-(-wanted // chunk) + 1, -(-size // chunk)) * chunk
        check_memory(self.where, needed)


Arrays = Mapping[str, FileArray]  # by name, or by path within a file


@dataclass(frozen=True)
class ArrayCube:
    """An array that is a cube, with its axes of rows, columns and (if there are some) bands."""

    name: str
    array: FileArray
    order: tuple[int, ...]
    notes: tuple[str, ...] = ()

    @property
    def dims(self) -> list[str]:
        """Return names of all axes, or those of their order if they have none."""
        return self.array.dims or ["y", "x", "band"]


def find_cube(arrays: Arrays, variable: str | None, path: Path, *, labels: bool = False) -> ArrayCube:
    """Return the array that is named, or the only one with three axes (of ``labels``: with two), else with two.

    Only names, shapes and attributes are read. Raises SceneError: there is no such array, there are several, or the
    axes are not y, x and band.
    """
    name, notes = _chosen(arrays, variable, path, (2, 3) if labels else (3, 2))
    order, more = _axes(arrays, name, path)
    return ArrayCube(name, arrays[name], order, (*notes, *more))


def cube_source(path: Path, cube: ArrayCube, arrays: Arrays, attributes: Mapping[str, Any], guard: Guard) -> CubeSource:
    """Return the cube with its lines, bands and place; ``guard`` turns errors of reading into SceneError.

    Lines of an array with scale or offset are float32, NaN where there is no value. So are whole numbers with a valid
    range but no fill value. Raises SceneError: the cube claims more than its file or the memory can hold.
    """
    array, order = cube.array, cube.order
    array.check([BLOCK_LINES if axis == order[0] else size for axis, size in enumerate(array.shape)])
    scale, offset = (_number(array.attrs.get(name)) for name in ("scale_factor", "add_offset"))
    unsigned = array.dtype.kind == "i" and str(array.attrs.get("_Unsigned", "")).lower() == "true"
    stored = np.dtype(f"u{array.dtype.itemsize}") if unsigned else array.dtype.newbyteorder("=")
    given = [np.ravel(array.attrs[name]) for name in ("_FillValue", "missing_value") if name in array.attrs]
    given = [one for one in given if one.dtype.kind in "iuf"]
    missing = list(dict.fromkeys(float(number) for one in given for number in _as_stored(one, stored)))
    fill = missing[0] if missing else None
    low, high = _valid_range(array.attrs, stored)
    checked = len(missing) > 1 or (low, high) != (-np.inf, np.inf)
    plain = scale in (None, 1.0) and offset in (None, 0.0)
    plain = plain and (stored.kind == "f" or fill is not None or not checked)  # whole numbers have no NaN
    sizes = [int(array.shape[axis]) for axis in order]

    def read(start: int, stop: int) -> NDArray[Any]:
        """Return some lines (line, sample, band)."""
        selection = [slice(None)] * array.ndim
        selection[order[0]] = slice(start, stop)
        with guard():
            block = np.transpose(np.asarray(array[tuple(selection)]), order)
        native = np.ascontiguousarray(block, block.dtype.newbyteorder("="))
        native = (native[..., None] if native.ndim == 2 else native).view(stored)
        out = (native < low) | (native > high) | np.isin(native, missing[1:]) if checked else np.False_
        if not plain:
            values = unpacked(native, 1.0 if scale is None else scale, offset or 0.0, fill)
            return np.where(out, np.float32(np.nan), values) if checked else values
        return np.where(out, stored.type(np.nan if fill is None else fill), native) if out.any() else native

    bands = _bands_of(cube, arrays, sizes[2] if len(sizes) == 3 else 1)
    dims = cube.dims[order[0]], cube.dims[order[1]]
    geobox, notes = place_or_note(lambda: find_geobox(attributes, arrays, (sizes[0], sizes[1]), dims))
    return CubeSource(
        name=path.name,
        shape=(sizes[0], sizes[1], sizes[2] if len(sizes) == 3 else 1),
        dtype=stored if plain else np.dtype(np.float32),
        read=read_by_chunks(read, sizes[0], array.chunks[order[0]]),
        files=(path,),
        bands=bands,
        nodata=fill if plain else None,
        geobox=geobox,
        scaling=f"{stored} without {missing}, {low} to {high}" if unsigned or checked else "",
        notes=(*cube.notes, *notes, *bands.notes),
    )


def place_or_note(find: Callable[[], GeoBox | None]) -> tuple[GeoBox | None, tuple[str, ...]]:
    """Return a place, or a note on why it cannot be read."""
    try:
        return find(), ()
    except Exception as error:  # of PROJ, too
        return None, (f"its place on the earth cannot be read: {type(error).__name__}: {error}",)


def _bands_of(cube: ArrayCube, arrays: Arrays, count: int) -> Bands:
    """Return wavelengths and widths by the array of their name, or of the bands' axis."""
    axis = cube.dims[cube.order[2]] if len(cube.order) == 3 and len(cube.dims) == cube.array.ndim else ""
    found = _vector(arrays, WAVELENGTHS, count)
    if found is None and _is_line(arrays, axis, count) and is_spectral(arrays[axis].attrs):
        found = axis
    if found is None:
        return Bands()
    beside = _vector(arrays, ("fwhm",), count)
    widths = () if beside is None else (arrays[beside][...], _unit(arrays[beside].attrs))
    origin = f"wavelengths from the array {found}"
    return bands_of_numbers(arrays[found][...], _unit(arrays[found].attrs), origin, *widths)


def _chosen(arrays: Arrays, variable: str | None, path: Path, axes: Sequence[int]) -> tuple[str, tuple[str, ...]]:
    """Return the name of the array to read, and notes; numbers of ``axes`` are tried in their order."""
    if list(arrays) == [""]:
        if variable is not None:
            raise SceneError(f"{path} holds one array, which has no name; leave :{variable} out")
        return "", ()
    tables = {name: f"{name} {array.shape}" for name, array in arrays.items() if array.ndim > 1}
    listing = f"it has {', '.join(tables.values()) or 'none'}"
    if variable is not None:
        inner = [name for name in arrays if name.rpartition("/")[2] == variable]
        fitting = [variable] if variable in arrays else inner
        if len(fitting) != 1:
            raise SceneError(f"{path} has no array {variable}; {listing}; name one: {path.name}:ARRAY")
        return fitting[0], ()
    for count in axes:
        fitting = [name for name, one in arrays.items() if one.ndim == count and one.dtype.kind in "buifc"]
        fitting = [name for name in fitting if min(arrays[name].shape) > 1] or fitting  # vectors of .mat come last
        if len(fitting) == 1:
            others = [text for name, text in tables.items() if name != fitting[0]]
            note = f"array {fitting[0]} of the file, which also has {', '.join(others[:_SHOWN])}"
            return fitting[0], (note,) if others else ()
        if fitting:
            raise SceneError(f"{path} has several arrays with {count} axes; {listing}; name one: {path.name}:ARRAY")
    raise SceneError(f"{path} has no array of numbers with the axes y, x and band; {listing}")


def _axes(arrays: Arrays, name: str, path: Path) -> tuple[tuple[int, ...], tuple[str, ...]]:
    """Return the axes of rows, columns and (if there are some) bands, by their names or in this order; and notes."""
    array = arrays[name]
    named = array.dims
    if array.ndim not in (2, 3):
        raise SceneError(
            f"{path} holds shape {array.shape}; expected (y, x, band), or (y, x) for one band; store one time or level"
        )
    if not any(_word(dim) in (*ROWS, *COLUMNS, *BANDS) or dim in arrays for dim in named):
        counts = {math.prod(one.shape) for key, one in arrays.items() if one.ndim and _word(key) in WAVELENGTHS}
        if array.ndim == 3 and counts & set(array.shape[:2]) and array.shape[2] not in counts:
            raise SceneError(
                f"{path} holds shape {array.shape} without names of its axes and {max(counts)} wavelengths; expected"
                " (y, x, band): store it in this order, or name the axes"
            )
        return tuple(range(array.ndim)), (UNNAMED,)
    words = [_word(dim) for dim in named]
    found = [[at for at, word in enumerate(words) if word in known] for known in (ROWS, COLUMNS, BANDS)]
    found[2] = found[2] or [at for at, dim in enumerate(named) if dim in arrays and is_spectral(arrays[dim].attrs)]
    if any(len(places) != 1 for places in found[: array.ndim]) or (array.ndim == 2 and found[2]):
        raise SceneError(f"{path} has dims {', '.join(named)}; expected y, x, band (or band, y, x); rename them")
    return tuple(places[0] for places in found[: array.ndim]), ()


def _vector(arrays: Arrays, words: tuple[str, ...], count: int) -> str | None:
    """Return the first array of ``count`` numbers that has one of the names, in their order."""
    found = (name for word in words for name in arrays if _word(name) == word and _is_line(arrays, name, count))
    return next(found, None)


def _is_line(arrays: Arrays, name: str, count: int) -> bool:
    """Return whether an array has ``count`` numbers along one of its axes."""
    shape = arrays[name].shape if name in arrays else ()
    return bool(shape) and math.prod(shape) == max(shape) == count and arrays[name].dtype.kind in "uif"


def _word(name: str) -> str:
    return name.rpartition("/")[2].lower()


def _valid_range(attributes: Mapping[str, Any], stored: np.dtype[Any]) -> tuple[float, float]:
    """Return the smallest and largest valid number of an array, before scale and offset."""
    pair = attributes.get("valid_range", (attributes.get("valid_min"), attributes.get("valid_max")))
    ends = [None if one is None else np.ravel(one) for one in pair] if np.size(pair) == 2 else [None, None]
    low, high = (None if one is None or one.dtype.kind not in "iuf" else _as_stored(one, stored)[0] for one in ends)
    return -np.inf if low is None else float(low), np.inf if high is None else float(high)


def _as_stored(numbers: NDArray[Any], stored: np.dtype[Any]) -> NDArray[Any]:
    """Return numbers of an attribute as those of an unsigned array that is stored with a sign."""
    signed = stored.kind == "u" and numbers.dtype.kind == "i" and (numbers < 0).any()
    return numbers % 2 ** (8 * stored.itemsize) if signed else numbers


def _number(value: object) -> float | None:
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def _unit(attributes: Mapping[str, Any]) -> str:
    return str(attributes.get("units", attributes.get("unit", ""))).strip().lower()
