"""Build cubes from named arrays: Zarr stores, NetCDF and HDF5 files, .npy, .npz and .mat.

Axes are found by their names, else by the number of wavelengths. Values follow from scale, offset and fill value, the
place on the earth from a grid mapping.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SceneError, SeriesError
from pipeline.lazy import GeoBox
from pipeline.rig.camera.camera_texts import MICROMETRES, NANOMETRES, UNSAID
from storage.arrays.georeference import find_geobox
from storage.readers.cube_sources import (
    BLOCK_LINES,
    MOST_RATIO,
    Bands,
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
TIMES = ("time", "t", "date", "dates", "step", "visit")
WAVELENGTHS = (
    *("wavelength", "wavelengths", "radiation_wavelength", "wavelength_nm", "wavelengths_nm"),
    *("wl", "lambda", "nm"),
)
METRES = {"m", "meter", "meters", "metre", "metres"}

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
    moment: tuple[int, int] | None  # axis of time, and the step on it
    notes: tuple[str, ...] = ()

    @property
    def dims(self) -> list[str]:
        """Return names of all axes, or those of their order if they have none."""
        return self.array.dims or (["y", "x", "band"] if self.moment is None else ["time", "y", "x", "band"])


def find_cube(arrays: Arrays, variable: str | None, path: Path, *, labels: bool = False) -> ArrayCube:
    """Return the array that is named, or the only one with three axes, or the only one with wavelengths.

    For ``labels`` the only one with two axes comes first. ``variable`` may end in a step of time (``values:3``), or be
    one. Only names, shapes and attributes are read. Raises SceneError: there is no such array, there are several, or
    the axes are not y, x and band.
    """
    named, step = _split_step(variable, arrays)
    name, notes = _chosen(arrays, named, path, _AXES[labels, step is not None])
    series = arrays[name].ndim == 4 or (labels and step is not None and arrays[name].ndim == 3)
    moment = _moment(arrays[name], step, f"{path}:{name}" if name else str(path), unnamed=series)
    order, more = _axes(arrays, name, path, moment)
    return ArrayCube(name, arrays[name], order, moment, (*notes, *more))


def cube_source(path: Path, cube: ArrayCube, arrays: Arrays, attributes: Mapping[str, Any], guard: Guard) -> CubeSource:
    """Return the cube with its lines, bands and place; ``guard`` turns errors of reading into SceneError.

    Lines of an array with scale or offset are float32, NaN where there is no value. So are whole numbers with a valid
    range but no fill value. Raises SceneError: the cube claims more than its file or the memory can hold.
    """
    array, order, moment = cube.array, cube.order, cube.moment
    part = [BLOCK_LINES if axis == order[0] else size for axis, size in enumerate(array.shape)]
    if moment is not None:
        part[moment[0]] = 1
    array.check(part)
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
        selection: list[slice | int] = [slice(None)] * array.ndim
        selection[order[0]] = slice(start, stop)
        left = order
        if moment is not None:
            selection[moment[0]] = moment[1]
            left = tuple(axis - (axis > moment[0]) for axis in order)
        with guard():
            block = np.transpose(np.asarray(array[tuple(selection)]), left)
        native = np.ascontiguousarray(block, block.dtype.newbyteorder("="))
        native = (native[..., None] if native.ndim == 2 else native).view(stored)
        out = (native < low) | (native > high) | np.isin(native, missing[1:]) if checked else np.False_
        if not plain:
            values = unpacked(native, 1.0 if scale is None else scale, offset or 0.0, fill)
            return np.where(out, np.float32(np.nan), values) if checked else values
        return np.where(out, stored.type(np.nan if fill is None else fill), native) if out.any() else native

    dims = cube.dims[order[0]], cube.dims[order[1]]
    geobox, notes = place_or_note(lambda: find_geobox(attributes, arrays, (sizes[0], sizes[1]), dims))
    return CubeSource(
        name=path.name,
        shape=(sizes[0], sizes[1], sizes[2] if len(sizes) == 3 else 1),
        dtype=stored if plain else np.dtype(np.float32),
        read=read_by_chunks(read, sizes[0], array.chunks[order[0]]),
        files=(path,),
        bands=_bands_of(cube, arrays, sizes[2] if len(sizes) == 3 else 1),
        nodata=fill if plain else None,
        geobox=geobox,
        scaling=f"{stored} without {missing}, {low} to {high}" if unsigned or checked else "",
        notes=(*cube.notes, *notes),
    )


def place_or_note(find: Callable[[], GeoBox | None]) -> tuple[GeoBox | None, tuple[str, ...]]:
    """Return a place, or a note on why it cannot be read."""
    try:
        return find(), ()
    except Exception as error:  # of PROJ, too
        return None, (f"its place on the earth cannot be read: {type(error).__name__}: {error}",)


def _bands_of(cube: ArrayCube, arrays: Arrays, count: int) -> Bands:
    """Return wavelengths and widths in nm; none if their unit is no length."""
    axis = cube.dims[cube.order[2]] if len(cube.order) == 3 and len(cube.dims) == cube.array.ndim else ""
    found = _vector(arrays, WAVELENGTHS, count)
    if found is None and _is_line(arrays, axis, count) and _is_spectral(arrays[axis]):
        found = axis
    if found is None:
        return Bands()
    centres = np.asarray(arrays[found][...], np.float64).ravel()
    unit = _unit(arrays[found].attrs)
    known = {**dict.fromkeys(NANOMETRES, 1.0), **dict.fromkeys(MICROMETRES, 1000.0), **dict.fromkeys(METRES, 1e9)}
    scale = (1000.0 if centres.max() <= 20 else 1.0) if unit in UNSAID else known.get(unit)  # [nm]
    if scale is None or not (np.isfinite(centres) & (centres > 0)).all():
        return Bands()
    source = f"in {unit}" if unit not in UNSAID else "without a unit, read by their size"
    beside = _vector(arrays, ("fwhm",), count)
    widths = None if beside is None else np.asarray(arrays[beside][...], np.float64).ravel() * scale
    widths = None if widths is None or not (widths > 0).all() else widths
    return Bands(centres * scale, widths, f"wavelengths from the array {found}, {source}")


_AXES = {(False, False): (3, 4, 2), (True, False): (2, 3), (False, True): (4,), (True, True): (3, 4)}


def _split_step(variable: str | None, names: Container[str]) -> tuple[str | None, int | None]:
    """Return name and step of ``cube``, ``cube:3`` or the step ``3`` alone."""
    if variable is None or variable in names:
        return variable, None
    name, colon, step = variable.rpartition(":")
    return (name if colon else None, int(step)) if step.isdecimal() else (variable, None)


def _chosen(arrays: Arrays, variable: str | None, path: Path, axes: Sequence[int]) -> tuple[str, tuple[str, ...]]:
    """Return the name of the array to read, and notes; numbers of ``axes`` are tried in their order."""
    if list(arrays) == [""]:
        if variable is not None:
            raise SceneError(f"{path} holds one array, which has no name; only a step of time can be named: {path}:0")
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
        fitting = [name for name in fitting if min(arrays[name].shape) > 1] or fitting  # vectors come last
        fitting = [name for name in fitting if math.prod(arrays[name].shape) > 1]
        own = [name for name in fitting if name == "values"]
        spectra = [name for name in fitting if _spectral_axes(arrays, arrays[name])]
        for chosen, why in ((own, ""), (fitting, ""), (spectra, ", the only one with wavelengths")):
            if len(chosen) == 1:
                others = [text for name, text in tables.items() if name != chosen[0]]
                note = f"array {chosen[0]} of the file{why}, which also has {', '.join(others[:_SHOWN])}"
                return chosen[0], (note,) if others else ()
        if fitting:
            raise SceneError(f"{path} has several arrays with {count} axes; {listing}; name one: {path.name}:ARRAY")
    raise SceneError(f"{path} has no array of numbers with the axes y, x and band; {listing}")


def _moment(array: FileArray, step: int | None, address: str, *, unnamed: bool) -> tuple[int, int] | None:
    """Return axis and step of an array with an axis of time; the first of ``unnamed`` axes is time.

    Raises SceneError: the array has several steps and none is named, or it lacks the step or the axis.
    """
    words = [_word(dim) for dim in array.dims]
    known = set(words) & set(ROWS) and set(words) & set(COLUMNS)
    first = 0 if unnamed and not any(words) else None
    axis = next((at for at, word in enumerate(words) if known and word in TIMES), first)
    if axis is None:
        if step is not None:
            raise SceneError(f"{address} has the shape {array.shape} and no axis of time; leave :{step} out")
        return None
    steps = array.shape[axis]
    if step is None and steps > 1:
        raise SeriesError(
            f"{address} has the shape {array.shape} and {steps} steps of time; name one, {address}:0 to "
            f"{address}:{steps - 1}",
            steps,
        )
    if step is not None and step >= steps:
        raise SceneError(f"{address} has {steps} steps of time, counted from 0; got :{step}")
    return axis, step or 0


def _axes(
    arrays: Arrays, name: str, path: Path, moment: tuple[int, int] | None
) -> tuple[tuple[int, ...], tuple[str, ...]]:
    """Return the axes of rows, columns and (if there are some) bands; and notes."""
    array = arrays[name]
    named = array.dims
    own = [axis for axis in range(array.ndim) if moment is None or axis != moment[0]]
    if len(own) not in (2, 3):
        raise SceneError(
            f"{path} holds shape {array.shape}; expected (y, x, band), or (y, x) for one band; store one time or level"
        )
    if not any(_word(dim) in (*ROWS, *COLUMNS, *BANDS, *TIMES) or dim in arrays for dim in named):
        spectral = [axis for axis in _spectral_axes(arrays, array) if axis in own]
        if len(own) == 2 or len(spectral) != 1 or spectral == own[-1:]:
            return tuple(own), (UNNAMED,)
        rest = [axis for axis in own if axis not in spectral]
        return (*rest, *spectral), (f"dims have no names, read as y, x and band: axis {spectral[0]} (from 0) is band",)
    words = {axis: _word(named[axis]) for axis in own}
    found = [[at for at, word in words.items() if word in known] for known in (ROWS, COLUMNS, BANDS)]
    found[2] = found[2] or [at for at in words if _is_spectral(arrays.get(named[at]))]
    if any(len(places) != 1 for places in found[: len(own)]) or (len(own) == 2 and found[2]):
        raise SceneError(f"{path} has dims {', '.join(named)}; expected y, x, band (or band, y, x); rename them")
    return tuple(places[0] for places in found[: len(own)]), ()


def _spectral_axes(arrays: Arrays, array: FileArray) -> list[int]:
    """Return the axes that are named by a spectral coordinate, else those as long as the wavelengths."""
    known = [arrays[name].shape for name in arrays if _word(name) in WAVELENGTHS]
    lengths = {max(shape) for shape in known if shape and max(shape) == math.prod(shape)}
    by_name = [axis for axis, dim in enumerate(array.dims) if _is_spectral(arrays.get(dim))]
    return by_name or [axis for axis, size in enumerate(array.shape) if size in lengths]


def _is_spectral(coordinate: FileArray | None) -> bool:
    """Return whether a coordinate has wavelengths, by its standard name or unit."""
    if coordinate is None or coordinate.ndim != 1:
        return False
    return coordinate.attrs.get("standard_name") in WAVELENGTHS or _unit(coordinate.attrs) in NANOMETRES | MICROMETRES


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
