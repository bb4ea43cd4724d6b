"""List the arrays of .npy, .mat, NetCDF and HDF5 files.

Files are listed by their headers, and only the array wanted is read. Python objects, cells and structures are not read,
nor links and virtual arrays of HDF5, which may lead to any file. EMIT's files follow CF, except for wavelengths and
good bands, which lie in a group of their own.
"""

from __future__ import annotations

import importlib
import io
import math
import mmap
import struct
import warnings
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import IO, Any

import h5py
import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.errors import SceneError
from spectralzoom.storage.readers.array_cubes import Arrays, FileArray
from spectralzoom.storage.readers.checked_chunks import WIDEST, outside_links, read_hdf5, unpack
from spectralzoom.storage.readers.cube_sources import DEFLATE_RATIO

ARRAY_ENDINGS = (".npy", ".mat")
HDF_ENDINGS = (".nc", ".nc4", ".h5", ".hdf5", ".he5")
GOOD_BANDS = ("good_wavelengths", "good_bands", "bbl")  # 0 marks a bad band
MOST_UNEVEN = 16  # times that a picture is longer than wide
_MATLAB = {"double": "f8", "single": "f4", "logical": "?"} | {
    f"{u}int{8 * n}": f"{u or 'i'}{n}" for n in (1, 2, 4, 8) for u in ("", "u")
}
_MAT_MATRIX, _MAT_PACKED = 14, 15  # kinds of elements
_MAT_HEAD = 4096  # bytes for sizes and name of an array
_ONLY_A_DIMENSION = "This is a netCDF dimension but not a netCDF variable"


def list_arrays(path: Path) -> tuple[dict[str, FileArray], dict[str, Any]]:
    """Return the arrays of a file by their names or paths, and the attributes of the file.

    Raises SceneError: it is a NetCDF file of version 3; other errors are those of the libraries.
    """
    ending = path.suffix.lower()
    if ending == ".npy":
        values = load_npy(path)
        each = (1,) * values.ndim
        return {"": FileArray(str(path), values.shape, values.dtype, {}, values.__getitem__, each, values.nbytes)}, {}
    if not h5py.is_hdf5(path):
        if ending == ".mat":
            return _mat_arrays(path), {}
        raise SceneError(
            f"{path} cannot be read as NetCDF or HDF5: it does not begin as HDF5; copy it again, or if it is NetCDF 3, "
            "write it as NetCDF 4 (nccopy -k nc4)"
        )
    arrays, attributes = _hdf_arrays(path)
    if ending == ".mat":
        numbers = {name: one for name, one in arrays.items() if "/" not in name and one.dtype.kind in "buif"}
        return {name: _transposed(one) for name, one in numbers.items() if one.attrs.get("MATLAB_class") != "char"}, {}
    return arrays, attributes


def load_npy(path: Path) -> NDArray[Any]:
    """Return the array of a .npy file as a read-only view of it."""
    return np.asarray(np.load(path, mmap_mode="r", allow_pickle=False))


def _whole(
    where: str, shape: tuple[int, ...], kind: np.dtype[Any], load: Callable[[], NDArray[Any]], stored: int, ratio: int
) -> FileArray:
    """Return an array that is always read whole."""
    chunks = tuple(max(size, 1) for size in shape)
    return FileArray(where, shape, kind, {}, lambda part: load()[part], chunks, stored, ratio)


def _mat_arrays(path: Path) -> dict[str, FileArray]:
    """List the arrays of numbers of a .mat file of versions 4 to 7."""
    scipy_io = importlib.import_module("scipy.io")

    def load(name: str, number: int, shape: tuple[int, ...], kind: str) -> NDArray[Any]:
        most = 2 * WIDEST * math.prod(shape) + _MAT_HEAD  # complex numbers are two
        with _mapped(path) as content:
            values = np.asarray(scipy_io.loadmat(_plain_mat(content, most, number), variable_names=[name])[name])
        if np.iscomplexobj(values):
            raise SceneError(f"{path}:{name} holds complex numbers, expected real ones; write their absolute values")
        return values.astype(_MATLAB[kind], copy=False)  # whole doubles may be stored as bytes

    with warnings.catch_warnings(), _mapped(path) as content:
        warnings.simplefilter("ignore")  # of repeated names
        listed = scipy_io.whosmat(_plain_mat(content, _MAT_HEAD))
    size = path.stat().st_size
    found: dict[str, FileArray] = {}
    for number, (name, shape, kind) in enumerate(listed):
        if kind in _MATLAB:
            read = partial(load, name, number, shape, kind)
            ratio = 8 * DEFLATE_RATIO  # a double may be one byte
            found[name] = _whole(f"{path}:{name}", shape, np.dtype(_MATLAB[kind]), read, size, ratio)
    return found


def _plain_mat(content: mmap.mmap, most: int, wanted: int | None = None) -> IO[bytes]:
    """Return a .mat file without packing: the first ``most`` bytes of each element, or all of the ``wanted`` one.

    ValueError: the wanted element has more of them.
    """
    if 0 in content[:4]:  # version 4 packs nothing
        return io.BytesIO(content)
    parts = [content[:128]]
    order = "<II" if content[126:128] == b"IM" else ">II"
    at, number = 128, 0
    while at + 8 <= len(content):
        kind, size = struct.unpack(order, content[at : at + 8])
        if wanted in (None, number):
            body = content[at + 8 : at + 8 + (size if kind == _MAT_PACKED else min(size, most))]
            if kind == _MAT_PACKED:
                plain = zlib.decompressobj().decompress(body, most) if wanted is None else unpack("zlib", body, most)
                kind, body = _MAT_MATRIX, plain[8:]
            parts += [struct.pack(order, kind, len(body)), body]
        at += 8 + size
        number += 1
    return io.BytesIO(b"".join(parts))


@contextmanager
def _mapped(path: Path) -> Iterator[mmap.mmap]:
    """Open a file as a map of memory, which never gives more bytes than the file has."""
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        yield content


def _transposed(one: FileArray) -> FileArray:
    """Return an array of a .mat file of version 7.3 with the axes in MATLAB's order."""
    return _whole(one.where, one.shape[::-1], one.dtype, lambda: one[...].T, one.stored, one.ratio)


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


def _hdf_arrays(path: Path) -> tuple[dict[str, FileArray], dict[str, Any]]:
    """Return the arrays of an HDF5 file by their paths, and the attributes of its root."""
    arrays: dict[str, FileArray] = {}
    stored = path.stat().st_size

    def visit(name: str, item: Any) -> None:
        """Add an array of numbers, or a single text such as GDAL's grid mapping."""
        if not isinstance(item, h5py.Dataset) or item.external or item.is_virtual or item.shape is None:
            return
        about = _plain(item.attrs)
        is_text = item.dtype.kind in "SO" and not item.ndim
        if (item.dtype.kind in "buif" or is_text) and not str(about.get("NAME", "")).startswith(_ONLY_A_DIMENSION):
            dims = [dim[0].name.removeprefix("/") if len(dim) else dim.label for dim in item.dims]
            attributes = {**about, "_ARRAY_DIMENSIONS": dims} if any(dims) else about
            chunks = item.chunks or (1,) * item.ndim
            read = partial(_read, path, name)
            arrays[name] = FileArray(f"{path}:{name}", item.shape, item.dtype, attributes, read, chunks, stored)

    with h5py.File(path, "r") as file:
        file.visititems(visit)  # follows hard links alone
        if not any(one.ndim > 1 for one in arrays.values()) and (led := outside_links(file)):
            raise SceneError(f"{path}: {led[0]}, which is not followed; copy what it leads to into the file (h5copy)")
        return arrays, _plain(file.attrs)


def _read(path: Path, name: str, part: Any) -> NDArray[Any]:
    with h5py.File(path, "r") as file:
        return read_hdf5(file[name], part)


def _plain(attributes: Any) -> dict[str, Any]:
    """Return the attributes that can be read as Python's own texts and numbers, lists as arrays."""
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


def marked_bands(arrays: Arrays, count: int) -> tuple[int, ...]:
    """Return the bands (from 0) that a list of good bands marks by 0."""
    for name, array in arrays.items():
        if name.rpartition("/")[2].lower() in GOOD_BANDS and array.shape == (count,):
            return tuple(np.flatnonzero(array[...] == 0).tolist())
    return ()
