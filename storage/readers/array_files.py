"""Arrays out of .npy, .npz and .mat files: looked at by their headers, and only the one wanted is read.

Nothing but plain numbers is read: no Python objects. What is packed is unpacked as far as its header says and no
further. A step of a time series may be named.
"""

from __future__ import annotations

import importlib
import math
import zipfile
from collections.abc import Callable, Container, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SceneError
from storage.readers.cube_sources import DEFLATE_RATIO, check_claim, check_memory
from storage.readers.mat_variables import list_mat_variables, load_mat_variable
from storage.readers.scene_toml import MICROMETRES, BandWavelengths, check_wavelengths

_OF_WAVELENGTHS = ("wavelength", "wavelengths", "wavelength_nm", "wavelengths_nm", "wl", "lambda", "nm")
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


@dataclass(frozen=True)
class NamedArray:
    """One array of a file with several, and what the others say of it."""

    values: NDArray[Any]
    notes: tuple[str, ...] = ()
    wavelengths: BandWavelengths | None = None


def load_named(path: Path, variable: str | None, dims: int) -> NamedArray:
    """Read one array of a .npz or .mat file: the one named, or the only one with ``dims`` axes.

    Of a cube the wavelengths, where another array is called so and has one a band. ``variable`` may be a step of time,
    or end in one: see :func:`take_step`. Raises SceneError: there is no such array, or several; or it claims more than
    the file or the machine can hold.
    """
    if path.suffix.lower() == ".npz":
        found = _npz_arrays(path)
    elif is_hdf_mat(path):
        found = _hdf_arrays(path)
    else:
        listed = list_mat_variables(path)
        found = {one.name: _Held(one.shape, partial(load_mat_variable, path, one)) for one in listed if one.width}
    listing = ", ".join(f"{name} {held.shape}" for name, held in found.items()) or "none"
    named, step = split_step(variable, found)
    if named is not None and named not in found:
        raise SceneError(f"{path} has no array {named}; it has {listing}; name one: {path.name}:VARIABLE")
    name = named if named is not None else _only_one(path, found, _AXES[dims, step is not None], listing)
    others = [f"{other} {held.shape}" for other, held in found.items() if other != name]
    notes = (f"array {name} of the file, which also has {', '.join(others)}",) if others and named is None else ()
    values = take_step(found[name].load(), step, dims, f"{path}:{name}")
    return NamedArray(values, notes, _wavelengths(path, found, values.shape[2]) if values.ndim == 3 else None)


def _wavelengths(path: Path, found: Mapping[str, _Held], bands: int) -> BandWavelengths | None:
    """Wavelengths that stand beside a cube, in nm or micrometres by their size; None where no array can be those."""
    for name, held in found.items():
        if name.lower() not in _OF_WAVELENGTHS or math.prod(held.shape) != bands or max(held.shape) != bands:
            continue
        with suppress(SceneError, ValueError, TypeError):
            centres = np.asarray(held.load(), np.float64).ravel()
            unit = "micrometres by their size" if centres.max() <= MICROMETRES[1] else "nm"
            nm = check_wavelengths(centres * (1000 if unit != "nm" else 1), str(path))
            return BandWavelengths(nm, None, f"wavelengths from {path}:{name}, read as {unit}")
    return None


_AXES = {(3, False): (3, 4, 2), (2, False): (2, 3), (3, True): (4,), (2, True): (3, 4)}  # in the order in which tried


def _only_one(path: Path, found: Mapping[str, _Held], axes: Sequence[int], listing: str) -> str:
    """Name of the only array with the first of these numbers of axes that any has; vectors stand back."""
    for wanted in axes:
        fitting = [name for name, held in found.items() if len(held.shape) == wanted and math.prod(held.shape) > 1]
        planes = [name for name in fitting if min(found[name].shape) > 1] or fitting
        if len(planes) == 1:
            return planes[0]
        if planes:
            break
    raise SceneError(
        f"{path} has no single array with {axes[0]} axes; it has {listing}; name one: {path.name}:VARIABLE"
    )


def split_step(variable: str | None, names: Container[str]) -> tuple[str | None, int | None]:
    """What an address names: ``cube``, ``cube:3`` or, where no array is called so, the step ``3`` of the only one."""
    if variable is None or variable in names:
        return variable, None
    name, colon, step = variable.rpartition(":")
    if not step.isdecimal():
        return variable, None
    return name if colon else None, int(step)


def take_step(values: NDArray[Any], step: int | None, dims: int, where: str) -> NDArray[Any]:
    """One step of a time series, (time, y, x, band), counted from 0; what is none is given as it is.

    Of labels (``dims`` is 2), (time, y, x). Raises SceneError: a series without a step, or one that it lacks; a step of
    what is no series.
    """
    shape = values.shape
    series = values.ndim in ((4,) if dims == 3 else (3, 4))
    if step is None:
        if dims == 3 and series:
            raise SceneError(
                f"{where} has the shape {shape}, read as (time, y, x, band); name one of its {shape[0]} steps, "
                f"{where}:0 to {where}:{shape[0] - 1}"
            )
        return values
    if not series:
        raise SceneError(f"{where} has the shape {shape}, no axis of time (time, y, x, band); leave :{step} out")
    if step >= shape[0]:
        raise SceneError(f"{where} has {shape[0]} steps of time, counted from 0; got :{step}")
    return np.asarray(values[step])


MOST_UNEVEN = 16  # times that a picture is longer than wide


def check_picture(shape: tuple[int, ...], where: object) -> None:
    """Question a table of numbers that is given for a scene of one band (SceneError)."""
    if len(shape) == 2 and max(shape) >= MOST_UNEVEN * min(shape) and max(shape) >= 1000:
        rows, columns = shape
        raise SceneError(
            f"{where} is a table of {rows} x {columns} numbers, expected a picture (y, x) or a cube (y, x, band); are"
            f" its columns or rows spectra? Then store them as a cube: values.reshape(height, width, bands)"
        )


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
        """Read the array, axes as MATLAB counts them; SceneError: it claims more than the file can hold."""
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
