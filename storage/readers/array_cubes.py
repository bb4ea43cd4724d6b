"""Build cubes from named arrays: Zarr stores, NetCDF and HDF5 files, .npy and .mat.

Axes are found by their names; without names they are y, x and band. xarray decodes scale, offset, fill value and
unsigned numbers; the valid range, which it leaves out, is applied here.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from spectralzoom.pipeline.errors import SceneError
from spectralzoom.storage.readers.array_files import Arrays, FileArray
from spectralzoom.storage.readers.band_facts import (
    CENTRES,
    GOOD_BANDS,
    WIDTHS,
    Bands,
    are_wavelengths,
    bad_bands,
    bands_of_fields,
    is_spectral,
    letters,
)
from spectralzoom.storage.readers.cube_sources import BLOCK_LINES, CubeSource, Guard, read_by_chunks
from spectralzoom.storage.readers.places import Place, place_of_dataset

_ALONG = ("downtrack", "along_track", "number_of_lines")
_ACROSS = ("crosstrack", "across_track", "pixels_per_line")
ROWS = ("y", "line", "lines", "row", "rows", "lat", "latitude", "northing", *_ALONG)
COLUMNS = ("x", "sample", "samples", "column", "columns", "col", "lon", "longitude", "easting", *_ACROSS)
BANDS = ("band", "bands", "wavelength", "wavelengths", "wavelength_3d", "channel", "channels", "spectral")

UNNAMED = "dims have no names, read as y, x, band"
MOST_UNEVEN = 16  # times that a picture is longer than wide
_SHOWN = 5  # arrays in a note


@dataclass(frozen=True)
class ArrayCube:
    """An array that is a cube, with its axes of rows, columns and (if there are some) bands."""

    name: str
    array: FileArray
    order: tuple[int, ...]
    notes: tuple[str, ...] = ()

    @property
    def dims(self) -> Sequence[str]:
        """Return names of all axes, or those of their order if they have none."""
        return self.array.dims or ("y", "x", "band")


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

    Packed lines are float32, NaN where there is no value. Whole numbers with one fill value and no valid range stay
    whole. Raises SceneError: the cube claims more than its file or the memory can hold.
    """
    array, order = cube.array, cube.order
    array.check([BLOCK_LINES if axis == order[0] else size for axis, size in enumerate(array.shape)])
    about = _packing_of(array.attrs)
    values = _Values.of(about, array.dtype.newbyteorder("="))
    sizes = [int(array.shape[axis]) for axis in order]

    def read(start: int, stop: int) -> NDArray[Any]:
        """Return some lines (line, sample, band)."""
        selection = [slice(None)] * array.ndim
        selection[order[0]] = slice(start, stop)
        with guard():
            block = np.transpose(np.asarray(array[tuple(selection)]), order)
            native = np.ascontiguousarray(block, block.dtype.newbyteorder("="))
            native = native[..., None] if native.ndim == 2 else native
            return values.of_numbers(native)

    bands, bad, doubts = _bands_of(cube, arrays, sizes[2] if len(sizes) == 3 else 1)
    with guard():
        geobox, notes = _place_of(cube, arrays, attributes)
    return CubeSource(
        name=path.name,
        shape=(sizes[0], sizes[1], sizes[2] if len(sizes) == 3 else 1),
        dtype=values.dtype,
        read=read_by_chunks(read, sizes[0], array.chunks[order[0]]),
        files=(path,),
        bands=bands,
        nodata=values.nodata,
        geobox=geobox,
        bad_bands=bad,
        scaling="" if values.plain else json.dumps({key: np.ravel(one).tolist() for key, one in sorted(about.items())}),
        notes=(*array.notes, *cube.notes, *notes, *bands.notes, *doubts),
    )


_CODED = ("scale_factor", "add_offset", "_Unsigned")  # which xarray decodes
_FILLS = ("_FillValue", "missing_value")
_ENDS = ("valid_range", "valid_min", "valid_max")


def _packing_of(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Return the attributes of packing that can be used: numbers, and _Unsigned."""
    known = {name: attributes[name] for name in (*_FILLS, *_ENDS) if name in attributes}
    known = {name: value for name, value in known.items() if np.asarray(value).dtype.kind in "iuf"}
    factors = {name: np.ravel(attributes[name]) for name in _CODED[:2] if name in attributes}
    known |= {name: np.float64(one[0]) for name, one in factors.items() if one.size == 1 and one.dtype.kind in "iuf"}
    if "_Unsigned" in attributes:
        known["_Unsigned"] = str(attributes["_Unsigned"]).lower()
    return known


@dataclass(frozen=True)
class _Values:
    """How the numbers of a file become values."""

    stored: np.dtype[Any]
    coded: Mapping[str, Any]
    fills: tuple[float, ...]  # as values
    low: float | None
    high: float | None

    @classmethod
    def of(cls, about: Mapping[str, Any], stored: np.dtype[Any]) -> _Values:
        """Return the rule by the attributes of an array."""
        coded = {name: about[name] for name in _CODED if name in about}
        if (coded.get("scale_factor", 1.0), coded.get("add_offset", 0.0)) == (1.0, 0.0):
            coded = {name: value for name, value in coded.items() if name == "_Unsigned"}
        listed = [number for name in _FILLS for number in np.ravel(about.get(name, ()))]
        fills = [_as_value(number, coded, stored) for number in listed]
        pair = about.get("valid_range", (about.get("valid_min"), about.get("valid_max")))
        pair = pair if np.size(pair) == 2 else (None, None)
        ends = [None if end is None else _end_as_value(end, coded, stored) for end in pair]
        low, high = ends[::-1] if coded.get("scale_factor", 1.0) < 0 else ends
        return cls(stored, coded, tuple(dict.fromkeys(one for one in fills if one is not None)), low, high)

    @property
    def plain(self) -> bool:
        """Whether the numbers are the values, with one no-data value at most."""
        return not self.coded and len(self.fills) < 2 and self.low is None and self.high is None

    @property
    def whole(self) -> bool:
        """Whether values are whole numbers; without a no-data value those out of the valid range would be lost."""
        has_nodata = bool(self.fills) or (self.low is None and self.high is None)
        return self.stored.kind in "biu" and not set(self.coded) - {"_Unsigned"} and has_nodata

    @property
    def dtype(self) -> np.dtype[Any]:
        as_stored = self.plain or self.whole
        return _decoded(np.zeros(1, self.stored), self.coded).dtype if as_stored else np.dtype(np.float32)

    @property
    def nodata(self) -> float | None:
        """Return the no-data value; None where NaN stands for it."""
        return self.fills[0] if self.fills and (self.plain or self.whole) else None

    def of_numbers(self, numbers: NDArray[Any]) -> NDArray[Any]:
        """Return values of `dtype`; the no-data value, or NaN without one, where a number is no value."""
        if self.plain:
            return numbers
        values = _decoded(numbers, self.coded)
        with np.errstate(invalid="ignore"):
            out = np.isin(values, self.fills[1:] if self.whole else self.fills)
            out |= False if self.low is None else values < self.low
            out |= False if self.high is None else values > self.high
        values = values.astype(self.dtype, copy=False)
        void = np.nan if self.nodata is None else self.nodata
        return np.where(out, values.dtype.type(void), values) if out.any() else values


def _decoded(numbers: NDArray[Any], coded: Mapping[str, Any]) -> NDArray[Any]:
    """Return numbers of a file as values, decoded by xarray."""
    packed = xr.Dataset({"values": xr.Variable([f"axis_{at}" for at in range(numbers.ndim)], numbers, dict(coded))})
    return np.asarray(xr.decode_cf(packed, decode_times=False, decode_coords=False)["values"].values)


def _as_value(number: Any, coded: Mapping[str, Any], stored: np.dtype[Any]) -> float | None:
    """Return a number of an attribute as the value that it stands for; None where the file cannot hold it."""
    if stored.kind == "f":
        return float(number)
    if not np.isfinite(number) or int(number) != number:
        return None
    held, limits = int(number), np.iinfo(stored)
    if "_Unsigned" in coded and not limits.min <= held <= limits.max:  # written with the other sign
        held = (held - int(limits.min)) % 2 ** (8 * stored.itemsize) + int(limits.min)
    if not limits.min <= held <= limits.max:
        return None
    return float(_decoded(np.array([held], stored), coded)[0])


def _end_as_value(end: Any, coded: Mapping[str, Any], stored: np.dtype[Any]) -> float | None:
    """Return an end of the valid range as a value; None if it leaves nothing out.

    Floating ends of whole numbers with a scale are values, others are packed as the numbers are (NetCDF Users Guide,
    Attribute Conventions).
    """
    if stored.kind in "biu" and np.asarray(end).dtype.kind == "f" and set(coded) - {"_Unsigned"}:
        return float(end)
    return _as_value(end, coded, stored)


def _place_of(cube: ArrayCube, arrays: Arrays, attributes: Mapping[str, Any]) -> Place:
    """Return the place of a cube by the arrays beside it, of which only coordinates along its axes are read."""
    dims = [dim or f"axis {at}" for at, dim in enumerate(cube.dims[: cube.array.ndim])]
    sizes = dict(zip(dims, cube.array.shape, strict=True))
    read: dict[str, xr.Variable] = {}
    named: dict[str, xr.Variable] = {}
    for name, one in arrays.items():
        axis = next((at for at, words in enumerate((ROWS, COLUMNS)) if name.lower() in words), None)
        by_name = name if name in dims or axis is None else dims[cube.order[axis]]
        own = one.dims or (by_name,) * one.ndim  # a scale of HDF5 is its own axis
        fits = all(sizes.get(dim) == size for dim, size in zip(own, one.shape, strict=True))
        if one.ndim < 2 and fits and one.dtype.kind in "iuf":
            plain = {key: value for key, value in one.attrs.items() if key not in (*_CODED, *_FILLS, *_ENDS)}
            read[name] = xr.Variable(own, one[...], plain | _packing_of(one.attrs))
        else:
            own = tuple(dims) if name == cube.name else tuple(f"{name} {axis}" for axis in range(one.ndim))
            named[name] = xr.Variable(own, np.broadcast_to(np.int8(0), one.shape), dict(one.attrs))
    dataset = xr.decode_cf(xr.Dataset(read, attrs=dict(attributes)), decode_times=False, decode_coords=False)
    return place_of_dataset(dataset.assign(named), cube.name, (dims[cube.order[0]], dims[cube.order[1]]))


def _bands_of(cube: ArrayCube, arrays: Arrays, count: int) -> tuple[Bands, tuple[int, ...], tuple[str, ...]]:
    """Return facts of the bands by the arrays beside a cube and its attributes; bad bands (from 0), and notes on them.

    Arrays have the names of fields of other files; wavelengths may be the coordinate of the bands' axis.
    """
    axis = cube.dims[cube.order[2]] if len(cube.order) == 3 and len(cube.dims) == cube.array.ndim else ""
    fields: dict[str, Any] = {}
    notes: list[str] = []
    for name, one in arrays.items():
        word = _word(name)
        is_centre, is_width = (kind.fullmatch(letters(word)) is not None for kind in (CENTRES, WIDTHS))
        if name == axis and not is_centre and is_spectral(one.attrs):
            word, is_centre = "wavelength", True
        if is_centre and not _is_line(arrays, name, count):
            notes.append(f"the array {name} is left out: it has shape {one.shape} for {count} bands")
        elif (is_centre or is_width or letters(word) in GOOD_BANDS) and _is_line(arrays, name, count):
            fields |= {word: one[...], f"{word} units": _unit(one.attrs)} if word not in fields else {}
    if not any(CENTRES.fullmatch(letters(word)) for word in fields) and _is_line(arrays, axis, count):
        values = np.asarray(arrays[axis][...], np.float64).ravel()
        fields |= (
            {"wavelength": values, "wavelength units": _unit(arrays[axis].attrs)} if are_wavelengths(values) else {}
        )
    about = cube.array.attrs.items()
    usable = {key: one for key, one in about if isinstance(one, str) or np.asarray(one).dtype.kind in "iuf"}
    names = _names_of(arrays, (axis, "band_names", "band_name"), count)
    found = bands_of_fields(usable | fields, names, cube.name or "the file")
    return replace(found, notes=(*notes, *found.notes)), *bad_bands(usable | fields, count)


def _names_of(arrays: Arrays, names: Sequence[str], count: int) -> list[str | None]:
    """Return the texts, one a band, of the first array of texts that has one of the names; None each without one."""
    listed = [arrays[name] for name in names if name in arrays]
    texts = next((one for one in listed if one.shape == (count,) and one.dtype.kind in "SOUT"), None)
    each = [None if texts is None else texts[(band,)] for band in range(count)]  # none is larger than the file
    return [None if one is None else np.asarray(one).astype(str).item() for one in each]


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
        counts = {
            math.prod(one.shape) for key, one in arrays.items() if one.ndim and CENTRES.fullmatch(letters(_word(key)))
        }
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


def _is_line(arrays: Arrays, name: str, count: int) -> bool:
    """Return whether an array has ``count`` numbers along one of its axes."""
    shape = arrays[name].shape if name in arrays else ()
    return bool(shape) and math.prod(shape) == max(shape) == count and arrays[name].dtype.kind in "buif"


def _word(name: str) -> str:
    return name.rpartition("/")[2].lower()


def _unit(attributes: Mapping[str, Any]) -> str:
    return str(attributes.get("units", attributes.get("unit", ""))).strip().lower()


def check_picture(shape: tuple[int, ...], where: object) -> None:
    """Refuse a scene of one band that is a table of spectra (SceneError)."""
    if max(shape) < max(MOST_UNEVEN * min(shape), 1000):
        return
    turned = ".T" if shape[0] < shape[1] else ""
    raise SceneError(
        f"{where} is a table of {shape[0]} x {shape[1]} numbers, expected a picture (y, x) or a cube (y, x, band)."
        f" If its {'columns' if turned else 'rows'} are spectra, store a cube: numpy.reshape(values{turned}, "
        f"(height, width, {min(shape)}), order='F'), or order='C' if pixels go along the rows"
    )


def in_scope(arrays: Arrays, name: str) -> dict[str, FileArray]:
    """Return all arrays by their paths; those of the array's group, and of groups above it, by their names alone."""
    groups = name.split("/")[:-1]
    heads = ["".join(f"{group}/" for group in groups[:depth]) for depth in range(len(groups) + 1)]
    return {
        path.removeprefix(head): array
        for head in heads
        for path, array in arrays.items()
        if path.startswith(head) and "/" not in path.removeprefix(head)
    } | {path: array for path, array in arrays.items() if "/" in path}
