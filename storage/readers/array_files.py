"""Cubes out of files of named arrays: NetCDF, HDF5 and products of EMIT, PRISMA and NEON; .npy, .npz and .mat.

h5py opens NetCDF and HDF5, which are read a few lines at a time. EMIT's files follow CF but for their wavelengths,
which lie in a group of their own, and a list of good ones. NEON says scale, no-data value and place in its own words.
PRISMA keeps a cube for each of its two spectrometers, with scale, wavelengths and place as attributes of the file. The
layouts are those that the providers publish; no such file was at hand.

Packs and .mat files are listed by their headers, and only the array wanted is read: plain numbers, no Python objects,
cells or structures.
"""

from __future__ import annotations

import importlib
import math
import mmap
import struct
import warnings
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from affine import Affine
from numpy.typing import NDArray

from pipeline.errors import SceneError
from pipeline.lazy import deferred
from storage.readers.array_cubes import UNNAMED, ArrayCube, FileArray, cube_source, find_cube, names_beside, place_said
from storage.readers.cube_sources import (
    BLOCK_LINES,
    DEFLATE_RATIO,
    Bands,
    CubeSource,
    check_claim,
    check_memory,
    read_by_chunks,
    reading,
    unpacked,
)
from storage.readers.pixel_tables import find_tables

if TYPE_CHECKING:
    import h5py
    import odc.geo.geobox as odc_geobox
    import xarray as xr
    from odc.geo.geobox import GeoBox
else:
    h5py = deferred("h5py")
    odc_geobox = deferred("odc.geo.geobox")
    xr = deferred("xarray")

KIND = "NetCDF or HDF5"
HDF_ENDINGS = (".nc", ".nc4", ".h5", ".hdf5", ".he5")
GOOD_BANDS = ("good_wavelengths", "good_bands", "bbl")  # 0 marks a bad band
NO_UNIT = ("", "1", "unitless", "none", "dimensionless")
_ONLY_A_DIMENSION = "This is a netCDF dimension but not a netCDF variable"
_PRISMA = "HDFEOS/SWATHS/PRS_L2{}_HCO/Data Fields/{}_Cube"
_PRISMA_TOP = 65535  # the number that stands for the greatest value
ARRAY_ENDINGS = (".npy", ".npz", ".mat")
_MATLAB = {"double": "f8", "single": "f4", "logical": "?"} | {
    f"{u}int{8 * n}": f"{u or 'i'}{n}" for n in (1, 2, 4, 8) for u in ("", "u")
}


def open_hdf_cube(path: Path, variable: str | None = None, *, labels: bool = False) -> CubeSource:
    """Open one array of a NetCDF or HDF5 file as a cube; nothing but attributes and coordinates is read yet.

    ``variable`` names the array, by its name alone or with its groups (``SERC/Reflectance/Reflectance_Data``), and may
    end in a step of time. Raises SceneError: the file is damaged, has no such array or several, or axes that are not
    y, x and band.
    """
    with reading(path, KIND):
        arrays, attributes = _hdf_arrays(path) if h5py.is_hdf5(path) else _classic_arrays(path)
        level = next((one for one in "DCB" if _PRISMA.format(one, "VNIR") in arrays), None)
        if level is not None and variable is None:
            return _prisma_cube(path, level, arrays, attributes)
        if any(name.startswith("HDFEOS/SWATHS/PRS_") for name in arrays):
            what = "is a PRISMA product of level 1" if level is None else f"has {variable} as a part of one cube"
            raise SceneError(
                f"{path} {what}, which is not read; give a product of level 2B, 2C or 2D by its name alone, and --bands"
                " for some of its bands"
            )
        cube = find_cube(arrays, variable, path, labels=labels)
        near = _in_scope(arrays, cube.name)
        for name in names_beside(arrays) | {dim for dim in cube.dims if dim in near}:
            _check_array(path, name, (arrays | near)[name], lines=None)
        chunk = 1 if cube.array.chunks is None else cube.array.chunks[cube.order[0]]
        _check_array(path, cube.name, cube.array, lines=(cube.order[0], max(chunk, BLOCK_LINES)))
        about = {**attributes, **cube.array.attrs}
        source = cube_source(path, cube, near, about, lambda: reading(path, KIND))
        unit, (lines, _, count) = str(about.get("units", "")).strip(), source.shape
        notes = (*cube.notes, *([] if unit.lower() in NO_UNIT else [f"values are in {unit}"]))
        geobox, where = (source.geobox, ()) if source.geobox is not None else _other_place(near, cube, source.shape)
        return replace(
            source,
            read=read_by_chunks(source.read, lines, chunk),
            bad_bands=_bad_bands(near, count),
            geobox=geobox,
            notes=(*notes, *source.notes[len(cube.notes) :], *where),
        )


def _bad_bands(arrays: Mapping[str, Any], count: int) -> tuple[int, ...]:
    """Return the bands, from 0, that a list of the file marks by 0, as EMIT's of good wavelengths does."""
    for name, array in arrays.items():
        if name.rpartition("/")[2].lower() in GOOD_BANDS and array.shape == (count,):
            return tuple(int(band) for band in np.flatnonzero(array[...] == 0))
    return ()


def _other_place(
    arrays: Mapping[str, Any], cube: ArrayCube, shape: tuple[int, int, int]
) -> tuple[GeoBox | None, tuple[str, ...]]:
    """Return the place by NEON's map info and EPSG code; else a note where the file has a place that is not read."""
    folder = f"{cube.name.rpartition('/')[0]}/Metadata/Coordinate_System"
    if f"{folder}/Map_Info" in arrays and f"{folder}/EPSG Code" in arrays:
        texts = [arrays[f"{folder}/{name}"][()] for name in ("Map_Info", "EPSG Code")]
        info, code = (str(np.asarray(text).astype(np.str_).reshape(-1)[0]) for text in texts)
        return place_said(lambda: _place_of_neon(info, code, shape[:2]))
    names = {name.rpartition("/")[2].lower() for name, array in arrays.items() if array.ndim == 2}
    if "glt_x" in names:
        return None, (
            "its pixels are in the sensor's own geometry and have no map grid; for a place on the earth, write it"
            " orthorectified by its geolocation grids (glt_x, glt_y) first",
        )
    if {"lat", "latitude"} & names:
        return None, ("its place is given by a latitude and longitude of each pixel, which are not read",)
    return None, ()


def _place_of_neon(info: str, code: str, shape: tuple[int, int]) -> GeoBox:
    words = [word.strip() for word in info.split(",")]
    x, y, east, north, wide, high = map(float, words[1:7])
    if any(word.lower().startswith("rotation") and float(word.partition("=")[2]) for word in words):
        raise ValueError(f"map info {info!r} is turned")
    corner = Affine(wide, 0, east - (x - 1) * wide, 0, -high, north + (y - 1) * high)
    return odc_geobox.GeoBox(shape, corner, f"EPSG:{int(code)}")


def _prisma_cube(path: Path, level: str, arrays: Mapping[str, FileArray], about: Mapping[str, Any]) -> CubeSource:
    """Return both cubes of a PRISMA product of level 2 as one, its used bands by ascending wavelength.

    Their axes are y, band and x. Pixels that are 0 in every band lie outside the swath.
    """
    parts: list[tuple[FileArray, float, float]] = []
    centres: list[float] = []
    widths: list[float] = []
    used: list[NDArray[np.bool_]] = []
    for part in ("Vnir", "Swir"):
        array = arrays[_PRISMA.format(level, part.upper())]
        _check_array(path, f"{part}_Cube", array, lines=(0, (array.chunks or (1,))[0]))
        told = [np.asarray(about[f"List_{word}_{part}"], np.float64).ravel() for word in ("Cw", "Fwhm")]
        if array.ndim != 3 or any(len(one) != array.shape[1] for one in told):
            raise SceneError(
                f"{path}: {part}_Cube has the shape {array.shape} and {len(told[0])} wavelengths, expected (y, band, x)"
                " with one for each band; copy the file again"
            )
        low, high = (float(about[f"L2Scale{part}{end}"]) for end in ("Min", "Max"))
        parts.append((array, low, (high - low) / _PRISMA_TOP))
        centres, widths = [*centres, *told[0]], [*widths, *told[1]]
        used += [told[0] > 0]
    (lines, _, samples), bands = parts[0][0].shape, np.flatnonzero(np.concatenate(used))
    if {(array.shape[0], array.shape[2]) for array, _, _ in parts} != {(lines, samples)}:
        raise SceneError(f"{path}: the cubes {[array.shape for array, _, _ in parts]} (y, band, x) are of two sizes")
    order = bands[np.argsort(np.array(centres)[bands], kind="stable")]

    def read(start: int, stop: int) -> NDArray[Any]:
        """Return some lines (line, sample, band)."""
        with reading(path, KIND):
            raw = [np.moveaxis(array[start:stop], 1, 2) for array, _, _ in parts]
        void = np.logical_and.reduce([(block == 0).all(axis=2) for block in raw])
        values = [unpacked(block, scale, low, None) for block, (_, low, scale) in zip(raw, parts, strict=True)]
        lit = np.concatenate(values, axis=2)[..., order]
        lit[void] = np.nan
        return lit

    chunk = max((array.chunks or (1,))[0] for array, _, _ in parts)
    check_memory(path, max(chunk, BLOCK_LINES) * samples * len(centres) * 8)
    geobox, notes = None, tuple[str, ...](["it has no map grid"])
    if level == "D":
        geobox, notes = place_said(lambda: _place_of_prisma(about, (lines, samples)))
    unused = len(centres) - len(order)
    return CubeSource(
        name=path.name,
        shape=(lines, samples, len(order)),
        dtype=np.dtype(np.float32),
        read=read_by_chunks(read, lines, chunk),
        files=(path,),
        bands=Bands(np.array(centres)[order], np.array(widths)[order], "wavelengths from List_Cw of the file"),
        geobox=geobox,
        notes=(f"a PRISMA product of level 2{level}; {unused} bands without a wavelength are left out", *notes),
    )


def _place_of_prisma(about: Mapping[str, Any], shape: tuple[int, int]) -> GeoBox:
    """Return the grid between the centres of the upper left and the lower right pixel."""
    (west, north), (east, south) = (
        [float(about[f"Product_{corner}corner_{axis}"]) for axis in ("easting", "northing")] for corner in ("UL", "LR")
    )
    wide, high = (east - west) / (shape[1] - 1), (north - south) / (shape[0] - 1)
    corner = Affine(wide, 0, west - wide / 2, 0, -high, north + high / 2)
    return odc_geobox.GeoBox(shape, corner, f"EPSG:{int(about['Epsg_Code'])}")


def _in_scope(arrays: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Return all arrays by their paths; those of the array's group and of groups above by their names alone, too."""
    groups = name.split("/")[:-1]
    found: dict[str, Any] = {}
    for depth in range(len(groups) + 1):
        head = "".join(f"{group}/" for group in groups[:depth])
        found |= {
            other.removeprefix(head): array
            for other, array in arrays.items()
            if other.startswith(head) and "/" not in other.removeprefix(head)
        }
    return found | {other: array for other, array in arrays.items() if "/" in other}


def _check_array(path: Path, name: str, array: FileArray, *, lines: tuple[int, int] | None) -> None:
    """Refuse what the memory cannot hold: all of an array, or so many ``lines`` of an axis (SceneError)."""
    part = math.prod(array.shape) * array.dtype.itemsize
    if lines is not None and array.shape[lines[0]]:
        part = part // array.shape[lines[0]] * min(lines[1], array.shape[lines[0]])
    claimed = max(math.prod(array.shape), math.prod(array.chunks or ())) * array.dtype.itemsize
    check_claim(f"{path}:{name}", claimed, path.stat().st_size)
    check_memory(path, part + math.prod(array.chunks or ()) * array.dtype.itemsize)


def _classic_arrays(path: Path) -> tuple[dict[str, FileArray], dict[str, Any]]:
    """Return the arrays and attributes of a NetCDF file of version 3, which is no HDF5.

    The file is read whole: asked for more bytes than it has, it would take the memory for them first.
    """
    check_memory(path, 3 * path.stat().st_size)
    data = xr.open_dataset(BytesIO(path.read_bytes()), engine="scipy", decode_cf=False)
    arrays = {
        str(name): FileArray(
            one.shape,
            one.dtype,
            {**_plain(one.attrs), "_ARRAY_DIMENSIONS": [str(dim) for dim in one.dims]},
            lambda part, one=one: np.asarray(one[part].values),  # type: ignore[misc]
        )
        for name, one in data.variables.items()
        if one.dtype.kind in "buif"
    }
    return arrays, _plain(data.attrs)


def _hdf_arrays(path: Path) -> tuple[dict[str, FileArray], dict[str, Any]]:
    """Return the arrays of an HDF5 file by their paths, and the attributes of its root.

    Only what is kept in this very file: links and virtual arrays may lead anywhere on the disk.
    """
    arrays: dict[str, FileArray] = {}

    def visit(name: str, item: Any) -> None:
        """Keep an array of numbers, or a single text."""
        if not isinstance(item, h5py.Dataset) or item.external or item.is_virtual or item.shape is None:
            return
        about = _plain(item.attrs)
        if str(about.get("NAME", "")).startswith(_ONLY_A_DIMENSION) or item.dtype.kind not in "buifSO":
            return
        if item.dtype.kind in "SO" and item.ndim:
            return  # texts are read where they are one, as NEON's map info
        arrays[name] = FileArray(
            item.shape, item.dtype, {**about, **_words(about, item)}, partial(_read, path, name), item.chunks
        )

    with h5py.File(path, "r") as file:
        file.visititems(visit)  # hard links alone
        return arrays, _plain(file.attrs)


def _read(path: Path, name: str, part: Any) -> NDArray[Any]:
    with h5py.File(path, "r") as file:
        return np.asarray(file[name][part])


def _words(about: Mapping[str, Any], item: Any) -> dict[str, Any]:
    """Return what an array says in other words than CF's: names of its axes, NEON's scale, no-data value and units."""
    dims = [dim[0].name.removeprefix("/") if len(dim) else dim.label for dim in item.dims]
    words: dict[str, Any] = {"_ARRAY_DIMENSIONS": dims} if any(dims) else {}
    scale = about.get("Scale_Factor") or about.get("Scale Factor")  # divides values, where CF's scale_factor multiplies
    void = about.get("Data_Ignore_Value", about.get("data ignore value"))
    unit = about.get("units", about.get("Units"))
    words |= {} if scale is None else {"scale_factor": 1 / float(scale)}
    words |= {} if void is None else {"_FillValue": float(void)}
    return words | ({} if unit is None else {"units": unit})


def _plain(attributes: Any) -> dict[str, Any]:
    """Return the attributes as Python's own texts and numbers, lists as arrays.

    Attributes that cannot be read are left out.
    """
    found = {}
    for name in attributes:
        try:
            value = attributes[name]
        except Exception:  # of a type that h5py does not know
            continue
        if isinstance(value, np.ndarray | np.generic) and value.size == 1:
            value = np.asarray(value).reshape(-1)[0]
            value = value.item() if isinstance(value, np.generic) else value
        found[str(name)] = value.decode("utf-8", "replace") if isinstance(value, bytes) else value
    return found


# --- .npy, .npz and .mat ----------------------------------------------------------------------------------------------


def open_array_file(path: Path, variable: str | None = None, *, labels: bool = False) -> CubeSource:
    """Open the array named, or the only one with three axes; one of a .npy file is never read as a whole.

    For ``labels`` it is the only one with two axes. Raises SceneError: there is no such array, or several, or it is no
    table of numbers. So does an array that claims more than the file or the machine can hold.
    """
    guard = partial(reading_array, path)
    with guard():
        if path.suffix.lower() == ".npy":
            values = load_npy(path)
            arrays = {"": FileArray(values.shape, values.dtype, {}, values.__getitem__)}
        elif path.suffix.lower() == ".npz":
            arrays = _npz_arrays(path)
        else:
            arrays = _mat73_arrays(path) if h5py.is_hdf5(path) else _mat_arrays(path)
        tables = find_tables(arrays)
        cube = find_cube(
            arrays | {name: table.shaped(arrays[name]) for name, table in tables.items()}, variable, path, labels=labels
        )
        notes = tuple(note for note in cube.notes if note != UNNAMED)  # as everyone keeps them
        values = arrays[cube.name][...]
        if cube.name in tables:
            values, note = tables[cube.name].folded(values, "C" if path.suffix.lower() == ".npz" else "F")
            notes = (*notes, note)
        whole = FileArray(values.shape, values.dtype, {}, values.__getitem__)
        return cube_source(path, replace(cube, array=whole, notes=notes), arrays, {}, guard)


def reading_array(path: Path) -> AbstractContextManager[None]:
    """Return the guard that names what a file of arrays cannot be read for."""
    return reading(path, path.suffix, "write it again as plain numbers")


def load_npy(path: Path) -> NDArray[Any]:
    """Return the array of a .npy file as a read-only view of it."""
    return np.asarray(np.load(path, mmap_mode="r", allow_pickle=False))


def _lazy(shape: tuple[int, ...], kind: np.dtype[Any], load: Callable[[], NDArray[Any]]) -> FileArray:
    """Return an array that is read as a whole, whichever part is asked for."""
    return FileArray(shape, kind, {}, lambda part: load()[part])


def _npz_arrays(path: Path) -> dict[str, FileArray]:
    """List the arrays of a pack; those of Python objects are passed over."""
    found: dict[str, FileArray] = {}
    with zipfile.ZipFile(path) as pack:
        for member in pack.infolist():
            if member.filename.endswith(".npy"):
                with pack.open(member) as stream:
                    formats = np.lib.format
                    old = formats.read_magic(stream) == (1, 0)
                    shape, _, kind = (formats.read_array_header_1_0 if old else formats.read_array_header_2_0)(stream)
                if not kind.hasobject:
                    load = partial(_member, path, member, math.prod(shape) * kind.itemsize)
                    found[member.filename.removesuffix(".npy")] = _lazy(shape, kind, load)
    return found


def _member(path: Path, member: zipfile.ZipInfo, claimed: int) -> NDArray[Any]:
    """Read an array of a pack, once its claims of size are found to be possible."""
    where, packed = f"{path}:{member.filename}", member.compress_type != zipfile.ZIP_STORED
    check_claim(where, member.file_size, member.compress_size, DEFLATE_RATIO if packed else 1)
    check_claim(where, claimed, member.file_size, 1)
    check_memory(where, member.file_size)
    with zipfile.ZipFile(path) as pack, pack.open(member) as stream:
        return np.asarray(np.lib.format.read_array(stream, allow_pickle=False))


def _mat_arrays(path: Path) -> dict[str, FileArray]:
    """List the arrays of numbers of a .mat file of versions 4 to 7."""
    scipy_io = importlib.import_module("scipy.io")

    def load(name: str, claimed: int) -> NDArray[Any]:
        """Read one array (SceneError: it claims more than the file or the memory can hold)."""
        check_claim(f"{path}:{name}", claimed, path.stat().st_size, 8 * DEFLATE_RATIO)  # a double may be one byte
        check_memory(path, 2 * claimed)
        with _mapped(path) as content:
            return np.asarray(scipy_io.loadmat(content, variable_names=[name])[name])

    with warnings.catch_warnings(), _mapped(path) as content:
        warnings.simplefilter("ignore")  # of names that are there twice
        _check_names(content)
        listed = scipy_io.whosmat(content)
    return {
        name: _lazy(
            shape, np.dtype(_MATLAB[kind]), partial(load, name, math.prod(shape) * np.dtype(_MATLAB[kind]).itemsize)
        )
        for name, shape, kind in listed
        if kind in _MATLAB
    }


def _check_names(content: mmap.mmap) -> None:
    """Refuse names of variables beyond the file's end (ValueError): scipy takes the memory before it reads one."""
    order, place = "<" if content[126:128] == b"IM" else ">", 128
    while content[126:128] in (b"IM", b"MI") and place + 48 <= len(content):
        kind, size, *_, axes = struct.unpack(order + "8I", content[place : place + 32])[:8]
        name = place + 32 + axes + -axes % 8  # after flags and axes
        tag = content[name : name + 8]
        named, length = struct.unpack(order + "II", tag) if len(tag) == 8 else (0, len(content))
        if kind == 14 and (4 if named >> 16 else length) > len(content) - name:  # up to four bytes stand in the tag
            raise ValueError(f"the variable at byte {place} is cut off")
        place += 8 + size


@contextmanager
def _mapped(path: Path) -> Iterator[mmap.mmap]:
    """Open a file so that asking for more bytes than it has takes no memory for them."""
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        yield content


def _mat73_arrays(path: Path) -> dict[str, FileArray]:
    """List the arrays of numbers of a .mat file of version 7.3, axes as MATLAB counts them."""

    def load(name: str, array: FileArray) -> NDArray[Any]:
        """Read one array (SceneError: it claims more than the file or the memory can hold)."""
        _check_array(path, name, array, lines=None)
        return array[...].T

    return {
        name: _lazy(one.shape[::-1], one.dtype, partial(load, name, one))
        for name, one in _hdf_arrays(path)[0].items()
        if "/" not in name and one.dtype.kind in "buif" and one.attrs.get("MATLAB_class") != "char"
    }
