"""Arrays out of .npy, .npz and .mat files: looked at by their headers, and only the one wanted is read.

Nothing but plain numbers is read: no Python objects, no cells, structures or functions of MATLAB, however nested.
"""

from __future__ import annotations

import importlib
import math
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SceneError
from storage.readers.declared_sizes import DEFLATE_RATIO, check_claim, check_memory
from storage.readers.mat_files import list_mat_variables, load_mat_variable

NAMED_ENDINGS = (".mat", ".npz")  # hold several arrays: FILE:VARIABLE picks one


@dataclass(frozen=True)
class _Held:
    """One array that a file holds; ``load`` reads it."""

    shape: tuple[int, ...]
    load: Callable[[], NDArray[Any]]


def load_npy(path: Path) -> NDArray[Any]:
    """The array of a .npy file as a read-only view, its numbers left in the file."""
    values = np.load(path, mmap_mode="r", allow_pickle=False)
    if not isinstance(values, np.ndarray):
        values.close()
        raise SceneError(f"{path} is a pack of several arrays; call it .npz")
    return values


def load_named(path: Path, variable: str | None, dims: int) -> NDArray[Any]:
    """Read one array of a .npz or .mat file: the one named, or the only one with ``dims`` axes.

    Raises
    ------
    SceneError : there is none, or several; or it claims more than the file or the machine can hold.
    """
    found = _npz_arrays(path) if path.suffix.lower() == ".npz" else _mat_arrays(path)
    return _picked(found, path, variable, dims).load()


def variable_names(path: Path) -> set[str]:
    """Names in a .mat file, without reading their arrays."""
    if is_hdf_mat(path):
        with importlib.import_module("h5py").File(path, "r") as file:
            return set(file)
    return {variable.name for variable in list_mat_variables(path)}


def is_hdf_mat(path: Path) -> bool:
    """Whether a .mat file is of version 7.3, which is HDF5 behind 512 bytes of MATLAB's own."""
    with path.open("rb") as file:
        head = file.read(520)
    return b"\x89HDF\r\n\x1a\n" in (head[:8], head[512:])


def _picked(found: Mapping[str, _Held], path: Path, variable: str | None, dims: int) -> _Held:
    listing = ", ".join(f"{name} {held.shape}" for name, held in found.items()) or "none"
    if variable is not None:
        if variable not in found:
            raise SceneError(f"{path} has no array {variable}; it has {listing}")
        return found[variable]
    for wanted in (dims, 5 - dims):
        fitting = [name for name, held in found.items() if len(held.shape) == wanted and math.prod(held.shape) > 1]
        if len(fitting) == 1:
            return found[fitting[0]]
        if fitting:
            break
    raise SceneError(f"{path} has no single array with {dims} axes; it has {listing}; name one: {path.name}:VARIABLE")


# --- .npz -------------------------------------------------------------------------------------------------------------


def _npz_arrays(path: Path) -> dict[str, _Held]:
    """Arrays of a pack; those of Python objects are passed over, unless there is nothing else."""
    found: dict[str, _Held] = {}
    objects = False
    with zipfile.ZipFile(path) as pack:
        for member in pack.infolist():
            if not member.filename.endswith(".npy"):
                continue
            with pack.open(member) as stream:
                shape, kind = _npy_header(stream)
            objects = objects or kind.hasobject
            if not kind.hasobject:
                found[member.filename.removesuffix(".npy")] = _Held(shape, _npz_loader(path, member))
    if objects and not found:
        raise SceneError(f"{path} holds Python objects, which are never read; write it again as plain numbers")
    return found


def _npy_header(stream: Any) -> tuple[tuple[int, ...], np.dtype[Any]]:
    version = np.lib.format.read_magic(stream)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, kind = read(stream)
    return shape, kind


def _npz_loader(path: Path, member: zipfile.ZipInfo) -> Callable[[], NDArray[Any]]:
    def load() -> NDArray[Any]:
        """Read the array, once its claims of size are found to be possible."""
        where = f"{path}:{member.filename}"
        packed = member.compress_type != zipfile.ZIP_STORED
        check_claim(where, member.file_size, member.compress_size, DEFLATE_RATIO if packed else 1)
        with zipfile.ZipFile(path) as pack:
            with pack.open(member) as stream:
                shape, kind = _npy_header(stream)
            check_claim(where, math.prod(shape) * kind.itemsize, member.file_size, 1)
            check_memory(where, member.file_size)
            with pack.open(member) as stream:
                return np.asarray(np.lib.format.read_array(stream, allow_pickle=False))

    return load


# --- .mat -------------------------------------------------------------------------------------------------------------


def _mat_arrays(path: Path) -> dict[str, _Held]:
    if is_hdf_mat(path):
        return _hdf_arrays(path)
    listed = list_mat_variables(path)
    return {one.name: _Held(one.shape, partial(load_mat_variable, path, one)) for one in listed if one.width}


def _hdf_arrays(path: Path) -> dict[str, _Held]:
    try:
        h5py = importlib.import_module("h5py")
    except ImportError as error:
        raise SceneError(f"{path} is MATLAB 7.3, which needs h5py; pip install h5py, or save it with -v7") from error
    with h5py.File(path, "r") as file:
        # MATLAB counts axes from the other end than HDF5
        return {
            name: _Held(tuple(file[name].shape[::-1]), _hdf_loader(path, name))
            for name in file
            if _is_own(file, name, h5py)
        }


def _hdf_loader(path: Path, name: str) -> Callable[[], NDArray[Any]]:
    def load() -> NDArray[Any]:
        with importlib.import_module("h5py").File(path, "r") as file:
            item, where = file[name], f"{path}:{name}"
            stored = min(item.id.get_storage_size(), path.stat().st_size)
            chunk = math.prod(item.chunks or ()) * item.dtype.itemsize
            for claimed in (int(item.nbytes), chunk):
                check_claim(where, claimed, stored)
            check_memory(where, int(item.nbytes) + chunk)
            return np.asarray(item).T

    return load


def _is_own(file: Any, name: str, h5py: Any) -> bool:
    """Whether a name is a data set of numbers kept in this very file: others may lead anywhere on the disk."""
    if not isinstance(file.get(name, getlink=True), h5py.HardLink):
        return False
    item = file[name]
    if not isinstance(item, h5py.Dataset) or item.external or item.is_virtual or item.shape is None:
        return False
    return item.dtype.kind in "buifc" and item.attrs.get("MATLAB_class") not in (b"char", "char")
