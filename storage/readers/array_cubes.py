"""Build cubes from named arrays: Zarr stores, NetCDF and HDF5 files, .npy and .mat.

Axes are found by their names; without names they are y, x and band.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.errors import SceneError
from spectralzoom.pipeline.exposures import taken_with
from spectralzoom.storage.readers.acquired import acquired_of
from spectralzoom.storage.readers.array_files import ARRAY_ENDINGS, HDF_ENDINGS, Arrays, FileArray, list_arrays
from spectralzoom.storage.readers.band_facts import (
    CENTRES,
    GOOD_BANDS,
    WIDTHS,
    Bands,
    axis_hint,
    bad_bands,
    bands_of_fields,
    is_spectral,
    letters,
    unit_of,
)
from spectralzoom.storage.readers.cube_sources import (
    BLOCK_LINES,
    DIMS,
    CubeSource,
    LineFacts,
    ReadLines,
    read_by_chunks,
    reading,
)
from spectralzoom.storage.readers.packing import CODED, ENDS, FILLS, Turn, packing_of, shown, unpacking, values_of
from spectralzoom.storage.readers.places import Place, place_of_dataset
from spectralzoom.storage.readers.user_files import files_below

if TYPE_CHECKING:
    import xarray as xr

_ALONG = ("downtrack", "along_track", "number_of_lines")
_ACROSS = ("crosstrack", "across_track", "pixels_per_line")
ROWS = ("y", "line", "lines", "row", "rows", "lat", "latitude", "northing", *_ALONG)
COLUMNS = ("x", "sample", "samples", "column", "columns", "col", "lon", "longitude", "easting", *_ACROSS)
BANDS = ("band", "bands", "wavelength", "wavelengths", "wavelength_3d", "channel", "channels", "spectral")

NO_UNIT = ("", "1", "unitless", "none", "dimensionless")
MOST_UNEVEN = 16  # times that a picture is longer than wide
_FILL_WORDS = "fillvalue|(data)?ignorevalue|nodata(value)?"
_SHOWN = 5  # arrays in a note


def open_arrays(path: Path, variable: str | None, *, labels: bool) -> CubeSource:
    """Open an array of a file or Zarr store as a cube: the one that is named, or the only one with three axes.

    Only attributes and coordinates are read. ``variable`` is its name, alone or with its groups
    (``SERC/Reflectance/Reflectance_Data``); of ``labels`` an array with two axes is preferred. Packed lines are
    float32, NaN where there is no value. Raises SceneError: the file is damaged, or claims far more than it can hold;
    it has no such array or several; or the axes are not y, x and band.
    """
    ending = path.suffix.lower()
    guard = partial(reading, path, "Zarr" if path.is_dir() else "NetCDF or HDF5" if ending in HDF_ENDINGS else ending)
    with guard():
        files = tuple(files_below(path)) if path.is_dir() else (path,)
        arrays, about = list_arrays(path)
        name, notes = _chosen(arrays, variable, path, (2, 3) if labels else (3, 2))
        array = arrays[name]
        order, named = _axes(arrays, name, path)
        height, width, count = (*(int(array.shape[axis]) for axis in order), 1)[:3]
        if ending in ARRAY_ENDINGS and count == 1 and not labels and min(height, width):
            _check_picture((height, width), path)
        array.check([BLOCK_LINES if axis == order[0] else size for axis, size in enumerate(array.shape)])
        dims = [dim or f"axis {at}" for at, dim in enumerate((array.dims or DIMS)[: array.ndim])]
        near = _in_scope(arrays, name)
        stated = {**about, **array.attrs}
        axis = dims[order[2]] if len(order) == 3 else ""
        bands, bad, doubts = _bands_of(name, stated, axis, near, () if named else array.shape, count)
        geobox, of_place = _place_of(name, dims, order, near, stated)
        time, of_time = _time_of(near)
        acquired = acquired_of({**stated, **time})
        packing = packing_of(array.attrs, array.where, count)
        unpack, nodata = unpacking(packing, array.dtype.newbyteorder("="))
        fills = [float(one) for name in FILLS for one in np.ravel(packing.get(name, ()))]
        taken = taken_with(path.name, about, array.attrs)
    unnamed = [] if named or ending in ARRAY_ENDINGS else ["dims have no names, read as y, x, band"]
    said = [*of_time, *acquired.notes, *array.notes, *notes, *_value_notes(array), *unnamed]
    dtype, read = _reader_of(array, order, unpack, guard)
    return CubeSource(
        name=path.name,
        shape=(height, width, count),
        dtype=dtype,
        read=read_by_chunks(read, height, array.chunks[order[0]]),
        files=files,
        lines=LineFacts(exposure_ms=None if taken.exposure_ms is None else np.full(height, taken.exposure_ms)),
        taken=taken,
        bands=bands,
        nodata=nodata,
        packed_nodata=fills[0] if fills and unpack is not None else None,
        geobox=geobox,
        bad_bands=bad,
        acquired=acquired.text,
        scaling="" if unpack is None else json.dumps({key: np.ravel(packing[key]).tolist() for key in sorted(packing)}),
        notes=(*said, *of_place, *bands.notes, *doubts),
    )


def _reader_of(
    array: FileArray, order: Sequence[int], unpack: Turn | None, guard: Callable[[], AbstractContextManager[None]]
) -> tuple[np.dtype[Any], ReadLines]:
    """Return type and reader of lines (line, sample, band) of an array whose axes have this ``order``."""
    native = array.dtype.newbyteorder("=")

    def read(start: int, stop: int) -> NDArray[Any]:
        """Return some lines (line, sample, band)."""
        selection = [slice(None)] * array.ndim
        selection[order[0]] = slice(start, stop)
        with guard():
            block = np.ascontiguousarray(np.transpose(np.asarray(array[tuple(selection)]), order), native)
            block = block if len(order) == 3 else block[..., None]
            return block if unpack is None else unpack(block).astype(np.float32)

    return native if unpack is None else np.dtype(np.float32), read


def _value_notes(array: FileArray) -> list[str]:
    """Return notes on the unit of the values, and on scales and fill values by names that are not CF's."""
    unit = unit_of(array.attrs)
    scales = {key: "scale_factor and add_offset" for key in array.attrs if re.search("scale|offset", key.lower())}
    fills = {key: "numbers in _FillValue" for key in array.attrs if re.fullmatch(_FILL_WORDS, letters(key))}
    ends = {key: "numbers" for key in ENDS if np.asarray(array.attrs.get(key, 0)).dtype.kind not in "iuf"}
    return ([] if unit.lower() in NO_UNIT else [f"values are in {unit}"]) + [
        f"its {key} = {shown(array.attrs[key])} is not applied: only {allowed} are"
        for key, allowed in (scales | fills | ends).items()
        if key not in (*CODED, *FILLS)
    ]


def _time_of(near: Arrays) -> tuple[dict[str, Any], list[str]]:
    """Return the value of a coordinate ``time`` with one element, by its units, if there is one; and notes."""
    found = near.get("time")
    if found is None or math.prod(found.shape) != 1 or "since" not in unit_of(found.attrs):
        return {}, []
    about = {"units": unit_of(found.attrs)}
    about |= {"calendar": found.attrs["calendar"]} if "calendar" in found.attrs else {}
    import xarray as xr  # takes a second

    time = xr.Dataset({"time": ((), found[...].reshape(()), about)})
    try:
        coder = xr.coders.CFDatetimeCoder(use_cftime=False)
        return {"time": xr.decode_cf(time, decode_times=coder)["time"].values}, []
    except Exception as error:  # of many kinds, by units and calendar
        words = " ".join(f"{one}" for one in about.values())[:80]
        return {}, [f"time in {words!r} is not used as the day of acquisition ({type(error).__name__}); use --visit"]


def _place_of(
    name: str, dims: Sequence[str], order: Sequence[int], arrays: Arrays, attributes: Mapping[str, Any]
) -> Place:
    """Return the place of a cube by the arrays beside it, of which only coordinates along its axes are read."""
    sizes = dict(zip(dims, arrays[name].shape, strict=True))
    import xarray as xr

    found: dict[str, xr.Variable] = {}
    for key, one in arrays.items():
        axis = next((at for at, words in enumerate((ROWS, COLUMNS)) if key.lower() in words), None)
        by_name = key if key in dims or axis is None else dims[order[axis]]
        own = one.dims or (by_name,) * one.ndim  # a scale of HDF5 is its own axis
        fits = all(sizes.get(dim) == size for dim, size in zip(own, one.shape, strict=True))
        if one.ndim < 2 and fits and one.dtype.kind in "iuf":
            plain = {text: value for text, value in one.attrs.items() if text not in (*CODED, *FILLS, *ENDS)}
            found[key] = xr.Variable(own, values_of(one), plain)
        else:
            own = tuple(dims) if key == name else tuple(f"{key} {axis}" for axis in range(one.ndim))
            found[key] = xr.Variable(own, np.broadcast_to(np.int8(0), one.shape), dict(one.attrs))
    return place_of_dataset(xr.Dataset(found, attrs=dict(attributes)), name, (dims[order[0]], dims[order[1]]))


def _bands_of(
    cube: str, attributes: Mapping[str, Any], axis: str, arrays: Arrays, unnamed: Sequence[int], count: int
) -> tuple[Bands, tuple[int, ...], tuple[str, ...]]:
    """Return facts of the bands by the arrays beside a cube and by attributes; bad bands (from 0), and notes on them.

    Both have the names of fields of other files; wavelengths may be the coordinate of the bands' ``axis``. ``unnamed``
    is the shape of a cube whose axes have no names.
    """
    fields: dict[str, Any] = {}
    notes: list[str] = []
    for name, one in arrays.items():
        word = _word(name)
        if name == axis and is_spectral(one.attrs) and not CENTRES.fullmatch(letters(word)):
            word = "wavelength"
        is_centre = CENTRES.fullmatch(letters(word)) is not None
        of_bands = is_centre or WIDTHS.fullmatch(letters(word)) or letters(word) in GOOD_BANDS
        if of_bands and _is_line(arrays, name, count):
            fields = {word: values_of(one), f"{word} units": unit_of(one.attrs)} | fields
        elif is_centre:
            doubt = f"it has {one.dtype} of shape {one.shape} for {count} bands"
            notes.append(f"the array {name} is left out: {doubt}{axis_hint(unnamed, math.prod(one.shape))}")
    usable = {
        key: value
        for key, value in attributes.items()
        if all(isinstance(one, str | float | int | np.number) for one in np.asarray(value, object).ravel().tolist())
    }
    names = _names_of(arrays, (axis, "band_names", "band_name"), count)
    found = bands_of_fields(usable | fields, names, cube or "the file")
    if found.wavelength_nm is None and _is_line(arrays, axis, count) and (np.diff(values_of(arrays[axis])) != 1).any():
        notes.append(f"the coordinate {axis} has no unit of a length, such as nm, and is not read as wavelengths")
    return replace(found, notes=(*notes, *found.notes)), *bad_bands(usable | fields, count)


def _names_of(arrays: Arrays, names: Sequence[str], count: int) -> list[str | None]:
    """Return the texts, one a band, of the first array of texts that has one of the names; None each without one."""
    listed = [arrays[name] for name in names if name in arrays]
    texts = next((one for one in listed if one.shape == (count,) and one.dtype.kind in "SOUT"), None)
    each = [None] * count if texts is None else texts[...].tolist()
    return [one.decode("utf-8", "replace") if isinstance(one, bytes) else one for one in each]


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


def _axes(arrays: Arrays, name: str, path: Path) -> tuple[tuple[int, ...], bool]:
    """Return the axes of rows, columns and (if there are some) bands, and whether they have names or this order."""
    array = arrays[name]
    named = array.dims
    if array.ndim not in (2, 3):
        raise SceneError(
            f"{path} holds shape {array.shape}; expected (y, x, band), or (y, x) for one band; store one time or level"
        )
    if not any(_word(dim) in (*ROWS, *COLUMNS, *BANDS) or dim in arrays for dim in named):
        return tuple(range(array.ndim)), False
    words = [_word(dim) for dim in named]
    found = [[at for at, word in enumerate(words) if word in known] for known in (ROWS, COLUMNS, BANDS)]
    found[2] = found[2] or [at for at, dim in enumerate(named) if dim in arrays and is_spectral(arrays[dim].attrs)]
    if any(len(places) != 1 for places in found[: array.ndim]) or (array.ndim == 2 and found[2]):
        raise SceneError(f"{path} has dims {', '.join(named)}; expected y, x, band (or band, y, x); rename them")
    return tuple(places[0] for places in found[: array.ndim]), True


def _is_line(arrays: Arrays, name: str, count: int) -> bool:
    """Return whether an array has ``count`` numbers along one of its axes."""
    shape = arrays[name].shape if name in arrays else ()
    return bool(shape) and math.prod(shape) == max(shape) == count and arrays[name].dtype.kind in "buif"


def _word(name: str) -> str:
    return name.rpartition("/")[2].lower()


def _check_picture(shape: tuple[int, ...], where: object) -> None:
    """Refuse a scene of one band that is a table of spectra (SceneError)."""
    if max(shape) < max(MOST_UNEVEN * min(shape), 1000):
        return
    turned = ".T" if shape[0] < shape[1] else ""
    raise SceneError(
        f"{where} is a table of {shape[0]} x {shape[1]} numbers, expected a picture (y, x) or a cube (y, x, band)."
        f" If its {'columns' if turned else 'rows'} are spectra, store a cube: numpy.reshape(values{turned}, "
        f"(height, width, {min(shape)}), order='F'), or order='C' if pixels go along the rows"
    )


def _in_scope(arrays: Arrays, name: str) -> dict[str, FileArray]:
    """Return all arrays by their paths; those of the array's group, and of groups above it, by their names alone."""
    group = f"/{name}".rpartition("/")[0]
    near: dict[str, FileArray] = {}
    for path, array in sorted(arrays.items(), key=lambda one: one[0].count("/")):
        home, _, own = f"/{path}".rpartition("/")
        if f"{group}/".startswith(f"{home}/"):
            near[own] = array
    return near | {path: array for path, array in arrays.items() if "/" in path}
