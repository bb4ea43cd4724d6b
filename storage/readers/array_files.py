"""Read cubes from files of named arrays: .npy, .npz and .mat.

Files are listed by their headers, and only the array wanted is read. Python objects, cells and structures are not read.
A table of spectra is read as a cube if the file has the rows and columns of its picture.
"""

from __future__ import annotations

import importlib
import math
import mmap
import re
import warnings
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SceneError
from pipeline.lazy import deferred
from storage.readers.array_cubes import UNNAMED, FileArray, cube_source, find_cube
from storage.readers.cube_sources import DEFLATE_RATIO, CubeSource, check_claim, check_memory, reading
from storage.readers.hdf_files import check_array, hdf_arrays

if TYPE_CHECKING:
    import h5py
else:
    h5py = deferred("h5py")

ARRAY_ENDINGS = (".npy", ".npz", ".mat")
_MATLAB = {"double": "f8", "single": "f4", "logical": "?"} | {
    f"{u}int{8 * n}": f"{u or 'i'}{n}" for n in (1, 2, 4, 8) for u in ("", "u")
}
MOST_UNEVEN = 16  # times that a picture is longer than wide
SIZES = (("nrow", "ncol"), ("nrows", "ncols"), ("rows", "cols"), ("height", "width"), ("lines", "samples"), ("h", "w"))


def open_array_file(path: Path, variable: str | None = None, *, labels: bool = False) -> CubeSource:
    """Open the array named, or the only one with three axes (for ``labels``: with two); a .npy file is read lazily.

    Raises SceneError: there is no such array, or several; it is no table of numbers; or it claims more than the file or
    the machine can hold.
    """
    guard = partial(reading_array, path)
    with guard():
        order: Literal["C", "F"] = "F"  # of pixels in tables, as MATLAB counts them
        if path.suffix.lower() == ".npy":
            values = load_npy(path)
            arrays = {"": FileArray(values.shape, values.dtype, {}, values.__getitem__)}
        elif path.suffix.lower() == ".npz":
            arrays, order = _npz_arrays(path), "C"
        else:
            arrays = _mat73_arrays(path) if h5py.is_hdf5(path) else _mat_arrays(path)
        pictures, note = _pictures_of_tables(arrays, order)
        cube = find_cube(arrays | pictures, variable, path, labels=labels)
        notes = tuple(one for one in cube.notes if one != UNNAMED)  # these formats never name axes
        values = cube.array[...]
        whole = FileArray(values.shape, values.dtype, {}, values.__getitem__)
        notes = (*notes, note) if cube.name in pictures else notes
        return cube_source(path, replace(cube, array=whole, notes=notes), arrays, {}, guard)


def reading_array(path: Path) -> AbstractContextManager[None]:
    """Return a context that turns a decoder's errors into a SceneError with the file's name."""
    return reading(path, path.suffix, "write it again as plain numbers")


def load_npy(path: Path) -> NDArray[Any]:
    """Return the array of a .npy file as a read-only view of it."""
    return np.asarray(np.load(path, mmap_mode="r", allow_pickle=False))


def _lazy(shape: tuple[int, ...], kind: np.dtype[Any], load: Callable[[], NDArray[Any]]) -> FileArray:
    """Return an array that is always read whole."""
    return FileArray(shape, kind, {}, lambda part: load()[part])


def _npz_arrays(path: Path) -> dict[str, FileArray]:
    """List the arrays of numbers in a pack."""
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
    """Read an array of a pack, once its claimed size was checked."""
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
        """Read one array, once its claimed size was checked."""
        check_claim(f"{path}:{name}", claimed, path.stat().st_size, 8 * DEFLATE_RATIO)  # a double may be one byte
        check_memory(path, 2 * claimed)
        with _mapped(path) as content:
            return np.asarray(scipy_io.loadmat(content, variable_names=[name])[name])

    with warnings.catch_warnings(), _mapped(path) as content:
        warnings.simplefilter("ignore")  # of repeated names
        kinds = {
            name: (shape, np.dtype(_MATLAB[kind])) for name, shape, kind in scipy_io.whosmat(content) if kind in _MATLAB
        }
    return {
        name: _lazy(shape, kind, partial(load, name, math.prod(shape) * kind.itemsize))
        for name, (shape, kind) in kinds.items()
    }


@contextmanager
def _mapped(path: Path) -> Iterator[mmap.mmap]:
    """Open a file as a map of memory, which never gives more bytes than the file has."""
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        yield content


def _mat73_arrays(path: Path) -> dict[str, FileArray]:
    """List the arrays of numbers of a .mat file of version 7.3, with the axes in MATLAB's order."""

    def load(name: str, array: FileArray) -> NDArray[Any]:
        """Read one array, once its claimed size was checked."""
        check_array(path, name, array)
        return array[...].T

    return {
        name: _lazy(one.shape[::-1], one.dtype, partial(load, name, one))
        for name, one in hdf_arrays(path)[0].items()
        if "/" not in name and one.dtype.kind in "buif" and one.attrs.get("MATLAB_class") != "char"
    }


# --- tables of spectra ------------------------------------------------------------------------------------------------


def _pictures_of_tables(arrays: Mapping[str, FileArray], order: Literal["C", "F"]) -> tuple[dict[str, FileArray], str]:
    """Return the tables of pixels as (y, x, band), if the file has the size of its picture, and a note of their order.

    ``order`` is that of the pixels: F down the columns of the picture, C along its rows.
    """
    single = {name: one for name, one in arrays.items() if math.prod(one.shape) == 1 and one.dtype.kind in "uif"}
    known = {re.sub("[^a-z]", "", name.lower()): name for name in reversed(single)}
    names = next(((known[one], known[two]) for one, two in SIZES if one in known and two in known), None)
    if names is None:
        return {}, ""
    rows, columns = (int(single[name][...].item()) for name in names)

    def fold(one: FileArray, axis: int) -> NDArray[Any]:
        """Return (y, x, band), or (y, x) for one band."""
        spectra = np.moveaxis(one[...], axis, 0).reshape(rows * columns, -1)
        cube = spectra.reshape((rows, columns, -1), order=order)
        return cube[..., 0] if cube.shape[2] == 1 else cube

    found = {}
    for name, one in arrays.items():
        axes = [axis for axis, size in enumerate(one.shape) if size == rows * columns]
        if one.ndim in (1, 2) and len(axes) == 1 and name not in single and one.dtype.kind in "buif":
            bands = [size for axis, size in enumerate(one.shape) if axis != axes[0] and size > 1]
            found[name] = _lazy((rows, columns, *bands), one.dtype, partial(fold, one, axes[0]))
    way = "down the columns" if order == "F" else "along the rows"
    note = f"a table of {rows * columns} pixels is read as {rows} x {columns} px (y x x), {way} of the picture"
    return found, f"{note}; if the map is scrambled or mirrored, store a cube (y, x, band)"


def check_picture(shape: tuple[int, ...], where: object) -> None:
    """Refuse a scene of one band that is a table of spectra (SceneError)."""
    if max(shape) < max(MOST_UNEVEN * min(shape), 1000):
        return
    bands, turned = min(shape), ".T" if shape[0] < shape[1] else ""
    raise SceneError(
        f"{where} is a table of {shape[0]} x {shape[1]} numbers, expected a picture (y, x) or a cube (y, x, band)."
        f" If its {'columns' if turned else 'rows'} are spectra, store variables nRow and nCol beside it, or a cube: "
        f"numpy.reshape(values{turned}, (height, width, {bands}), order='F'), or order='C' if pixels go along the rows"
    )
