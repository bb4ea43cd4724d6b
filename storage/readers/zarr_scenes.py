"""Cubes out of Zarr stores: those of this project, and arrays of anyone with dims y x and band, or band y x.

What a store says of itself is judged before it is opened: see :mod:`storage.readers.zarr_checks`.
"""

from __future__ import annotations

import base64
import struct
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numcodecs.errors import UnknownCodecError  # type: ignore[import-untyped]
from numpy.typing import NDArray

from pipeline.errors import SceneError
from pipeline.rig.camera.camera_texts import MICROMETRES, NANOMETRES, UNSAID
from storage.arrays.georeference import find_geobox
from storage.arrays.layout import missing_codec
from storage.readers.array_files import split_step
from storage.readers.cube_sources import BLOCK_LINES, Bands, CubeSource, LineFacts, ReadLines
from storage.readers.zarr_checks import check_array, check_blocks, check_store, open_options

ROWS = ("y", "line", "lines", "row", "rows", "lat", "latitude", "northing")
COLUMNS = ("x", "sample", "samples", "column", "columns", "col", "lon", "longitude", "easting")
BANDS = ("band", "bands", "wavelength", "wavelengths", "channel", "channels", "spectral")
TIMES = ("time", "t", "date", "dates", "step", "visit")
WAVELENGTHS = ("wavelength", "wavelengths", "radiation_wavelength")
METRES = {"m", "meter", "meters", "metre", "metres"}
FRAMES = ("dark", "white", "panel", "bad", "flat")
OF_LINES = ("mirror_x", "mirror_y", "valid_line", "time", "exposure_ms", "frame")
METADATA = ("zarr.json", ".zarray", ".zgroup")


def find_zarr_store(path: Path) -> Path | None:
    """The Zarr store at a path, or the ``cube.zarr`` in it; None where there is neither."""
    for folder in (path, path / "cube.zarr"):
        if any((folder / name).is_file() for name in METADATA):
            return folder
    return None


def open_zarr_cube(path: Path, variable: str | None = None) -> CubeSource:
    """Open one array of a store, or of the ``cube.zarr`` in a folder, as a cube.

    Of this project: raw cubes (with their references), ingested cubes, mosaics. Of anyone's: the only array with three
    axes of numbers, or the one named, at the step of time named (``values:3`` or ``3``); wavelengths come from a
    coordinate of that name, or of the band axis with a unit.
    Raises SceneError: the store is damaged, holds no such array, has dims that are not known, a codec that is not
    allowed, or claims to hold far more than lies on the disk.
    """
    path = find_zarr_store(path) or path
    with _named(path):
        check_store(path)
        node = zarr.open(path, mode="r", **open_options(path))
        group = node if isinstance(node, zarr.Group) else None
        arrays: dict[str, Any] = dict(node.arrays()) if isinstance(node, zarr.Group) else {"": node}
        named, step = split_step(variable, arrays)
        name = _chosen(arrays, named, path, series=step is not None)
        array = arrays[name]
        for used in [name, *sorted({"fwhm", *FRAMES, *OF_LINES, *WAVELENGTHS, *_dims(array)} & set(arrays) - {name})]:
            check_array(arrays[used], path, used)
        moment = _moment(array, step, path, name)
        order, notes = _axes(array, path, moment)
        parts = [BLOCK_LINES if axis == order[0] else size for axis, size in enumerate(array.shape)]
        if moment is not None:
            parts[moment.axis] = 1
        check_blocks(array, path, parts)
        attributes = {} if group is None else dict(group.attrs)
        source = _source(path, array, order, arrays, attributes, notes, moment)
    dims = _dims(array) or (["y", "x", "band"] if moment is None else ["time", "y", "x", "band"])
    return _placed(source, {**attributes, **dict(array.attrs)}, arrays, dims, order)


def _placed(
    source: CubeSource,
    attributes: Mapping[str, Any],
    arrays: Mapping[str, Any],
    dims: Sequence[str],
    order: tuple[int, ...],
) -> CubeSource:
    """The same cube with its place on the earth, where its store says that; a note where it cannot be read."""
    try:
        geobox = find_geobox(attributes, arrays, source.shape[:2], (dims[order[0]], dims[order[1]]))
    except Exception as error:  # attributes of anyone's may hold anything
        return replace(source, notes=(*source.notes, f"its place on the earth cannot be read: {error}"))
    return replace(source, geobox=geobox)


@contextmanager
def _named(path: Path) -> Iterator[None]:
    try:
        yield
    except SceneError:
        raise
    except UnknownCodecError as error:
        raise SceneError(missing_codec(str(path), error.codec_id)) from error
    except Exception as error:  # codecs and parsers raise anything at all on damaged bytes
        raise SceneError(f"{path} cannot be read as Zarr: {type(error).__name__}: {error}; is it damaged?") from error


@dataclass(frozen=True)
class _Moment:
    """One step of an axis of time."""

    axis: int
    step: int


def _moment(array: zarr.Array[Any], step: int | None, path: Path, name: str) -> _Moment | None:
    """The step that is meant, of an array with an axis of time (SceneError: none is named, or one that it lacks)."""
    words = [word.lower() for word in _dims(array)]
    unnamed = 0 if array.ndim == 4 and not any(words) else None
    known = set(words) & set(ROWS) and set(words) & set(COLUMNS)
    axis = next((at for at, word in enumerate(words) if known and word in TIMES), unnamed)
    address = f"{path}:{name}" if name else str(path)
    if axis is None:
        if step is not None:
            raise SceneError(f"{address} has the shape {array.shape} and no axis of time; leave :{step} out")
        return None
    steps = array.shape[axis]
    if step is None and steps > 1:
        raise SceneError(f"{address} has {steps} steps of time; name one, {address}:0 to {address}:{steps - 1}")
    if step is not None and step >= steps:
        raise SceneError(f"{address} has {steps} steps of time, counted from 0; got :{step}")
    return _Moment(axis, step or 0)


def _chosen(arrays: Mapping[str, zarr.Array[Any]], variable: str | None, path: Path, *, series: bool) -> str:
    listing = ", ".join(f"{name} {array.shape}" for name, array in arrays.items()) or "none"
    if variable is not None:
        if variable not in arrays:
            raise SceneError(f"{path} has no array {variable}; it has {listing}")
        return variable
    cubes = [name for name, array in arrays.items() if array.ndim == 3 + series and array.dtype.kind in "buif"]
    own = [name for name in ("dn", "values") if name in cubes]
    if own or len(cubes) == 1:
        return (own or cubes)[0]
    if cubes:
        raise SceneError(f"{path} has several arrays with three axes; it has {listing}; name one: {path.name}:ARRAY")
    if list(arrays) == [""]:
        return ""
    over_time = [name for name, array in arrays.items() if array.ndim == 4 and array.dtype.kind in "buif"]
    if len(over_time) == 1:
        return over_time[0]
    raise SceneError(f"{path} has no array of numbers with the axes y, x and band; it has {listing}")


def _axes(array: zarr.Array[Any], path: Path, moment: _Moment | None) -> tuple[tuple[int, ...], tuple[str, ...]]:
    """Which axes of the array are rows, columns and (where there are some) bands; and notes."""
    named, own = _dims(array), [axis for axis in range(array.ndim) if moment is None or axis != moment.axis]
    if len(own) not in (2, 3):
        raise SceneError(f"{path} holds shape {array.shape}; expected y, x and band; store one time or level")
    if not any(named):
        return tuple(own), ("dims have no names, read as y, x, band",)
    words = {axis: named[axis].lower() for axis in own}
    found = [[at for at, word in words.items() if word in known] for known in (ROWS, COLUMNS, BANDS)]
    if any(len(places) != 1 for places in found[: len(own)]) or (len(own) == 2 and found[2]):
        raise SceneError(f"{path} has dims {', '.join(named)}; expected y, x, band (or band, y, x); rename them")
    return tuple(places[0] for places in found[: len(own)]), ()


def _dims(array: zarr.Array[Any]) -> list[str]:
    """Names of the axes as v3 or xarray's v2 keeps them; empty where there are none."""
    named = getattr(array.metadata, "dimension_names", None) or array.attrs.get("_ARRAY_DIMENSIONS")
    return ["" if name is None else str(name) for name in named] if isinstance(named, list | tuple) else []


def _source(
    path: Path,
    array: zarr.Array[Any],
    order: tuple[int, ...],
    arrays: Mapping[str, Any],
    attributes: dict[str, Any],
    notes: tuple[str, ...],
    moment: _Moment | None,
) -> CubeSource:
    lines, samples, bands = tuple(array.shape[axis] for axis in order) + ((1,) if len(order) == 2 else ())
    own = "sweep" in attributes or attributes.get("kind") == "ingested cube"
    known = arrays if own else {}
    frame = (samples, bands)
    bad, valid = _small(known, "bad", frame), _column(known, "valid_line", lines)
    by_mirror = attributes.get("by_mirror") is True
    x, y = (_small(arrays, f"mirror_{axis}", (lines,)) if by_mirror else None for axis in "xy")
    position = None if x is None or y is None else np.stack([x, y], axis=-1).astype(np.float64)
    read, kind, fill = _reader(path, array, order, moment)
    void = attributes.get("nodata") if own else None
    return CubeSource(
        name=path.name,
        shape=(lines, samples, bands),
        dtype=kind,
        read=read,
        files=tuple(sorted(file for file in path.rglob("*") if file.is_file())),
        lines=LineFacts(
            np.ones(lines, np.bool_) if valid is None else valid.astype(np.bool_),
            _column(known, "time", lines),
            _column(known, "exposure_ms", lines),
            _column(known, "frame", lines),
        ),
        bands=_bands(arrays, array, order, bands),
        dark=_small(known, "dark", frame),
        white=_small(known, "white", frame),
        panel=_small(known, "panel", (bands,)),
        bad=None if bad is None else bad.astype(np.bool_),
        flat=_small(known, "flat", frame),
        position=position,
        nodata=void if void is not None else fill,
        bad_bands=tuple(int(band) for band in attributes.get("bad_bands", ())) if own else (),
        root=path,
        notes=notes,
    )


def _reader(
    path: Path, array: zarr.Array[Any], order: tuple[int, ...], moment: _Moment | None
) -> tuple[ReadLines, np.dtype[Any], float | None]:
    """What reads lines, unpacked by CF's scale and offset, its type, and the number that stands for none yet."""

    def real(value: object) -> float | None:
        return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None

    scale, offset = real(array.attrs.get("scale_factor")), real(array.attrs.get("add_offset"))
    scale, offset = 1.0 if scale is None else scale, 0.0 if offset is None else offset
    stated = array.attrs.get("_FillValue", array.attrs.get("missing_value"))  # wherever xarray has put it
    fill = real(stated)
    if isinstance(stated, str) and array.dtype.kind == "f":  # floats of v3 in base64
        (fill,) = struct.unpack("<d", base64.standard_b64decode(stated))
    elif stated is None and array.dtype.kind in "buif" and array.fill_value is not None:
        fill = float(array.fill_value) if "_ARRAY_DIMENSIONS" in array.attrs else None  # all of v2
    plain = scale == 1.0 and offset == 0.0

    def read(start: int, stop: int) -> NDArray[Any]:
        """Give some lines (line, sample, band); unpacked they are float32, NaN where there is no reading."""
        selection: list[slice | int] = [slice(None)] * array.ndim
        selection[order[0]] = slice(start, stop)
        left = order
        if moment is not None:
            selection[moment.axis] = moment.step
            left = tuple(axis - (axis > moment.axis) for axis in order)
        with _named(path):
            block = np.transpose(np.asarray(array[tuple(selection)]), left)
        native = np.ascontiguousarray(block, block.dtype.newbyteorder("="))
        if native.ndim == 2:
            native = native[..., None]
        if plain:
            return native
        values = (native * scale + offset).astype(np.float32)
        if fill is not None:
            values[native == fill] = np.nan
        return values

    return read, np.dtype(array.dtype.newbyteorder("=") if plain else np.float32), fill if plain else None


def _column(arrays: Mapping[str, Any], name: str, lines: int) -> NDArray[Any] | None:
    return np.asarray(arrays[name][...]) if name in arrays and arrays[name].shape == (lines,) else None


def _small(arrays: Mapping[str, Any], name: str, shape: tuple[int, ...]) -> NDArray[np.float32] | None:
    if name not in arrays or arrays[name].shape != shape:
        return None
    return np.asarray(arrays[name][...], np.float32)


def _bands(arrays: Mapping[str, Any], array: zarr.Array[Any], order: tuple[int, ...], count: int) -> Bands:
    """Wavelengths and widths of the coordinates that say them, in nm; none in another unit than one of length."""
    named = _dims(array)
    axis = named[order[2]] if len(order) == 3 and len(named) == array.ndim else ""
    found = next((name for name in WAVELENGTHS if _is_line(arrays, name, count)), None)
    if found is None and _is_line(arrays, axis, count):
        about = arrays[axis].attrs
        known = about.get("standard_name") in WAVELENGTHS or _unit(about) in NANOMETRES | MICROMETRES
        found = axis if known else None
    if found is None:
        return Bands()
    centres = np.asarray(arrays[found][...], np.float64)
    unit = _unit(arrays[found].attrs)
    scale = _scale(unit, float(centres.max()))
    if scale is None or not (np.isfinite(centres) & (centres > 0)).all():
        return Bands(units=unit)
    said = f"in {unit}" if unit not in UNSAID else "without a unit, read by their size"
    widths = np.asarray(arrays["fwhm"][...], np.float64) if _is_line(arrays, "fwhm", count) else None
    if widths is not None:
        own = _unit(arrays["fwhm"].attrs)
        widths = widths * (scale if own in UNSAID else _scale(own, 0.0) or np.nan)
        widths = widths if (widths > 0).all() else None
    return Bands(centres * scale, widths, unit, f"wavelengths from the array {found}, {said}")


def _scale(unit: str, largest: float) -> float | None:
    """What one of the unit is in nm; where none is said, micrometres or nm by the size; None of other units."""
    if unit in UNSAID:
        return 1000.0 if largest <= 20 else 1.0
    return 1.0 if unit in NANOMETRES else 1000.0 if unit in MICROMETRES else 1e9 if unit in METRES else None


def _is_line(arrays: Mapping[str, Any], name: str, count: int) -> bool:
    return name in arrays and arrays[name].shape == (count,) and arrays[name].dtype.kind in "uif"


def _unit(attributes: Mapping[str, Any]) -> str:
    return str(attributes.get("units", attributes.get("unit", ""))).strip().lower()
