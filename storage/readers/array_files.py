"""Arrays out of .npy, .npz and .mat files: listed by their headers, and only the one wanted is read.

Nothing but plain numbers is read: no Python objects, cells or structures. A step of a time series may be named.
"""

from __future__ import annotations

import importlib
import math
import mmap
import struct
import warnings
import zipfile
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SceneError
from storage.readers.cube_sources import DEFLATE_RATIO, Bands, check_claim, check_memory
from storage.readers.scene_toml import MICROMETRES, check_wavelengths

ARRAY_ENDINGS = (".npy", ".npz", ".mat")
_OF_WAVELENGTHS = ("wavelength", "wavelengths", "wavelength_nm", "wavelengths_nm", "wl", "lambda", "nm")
_MATLAB = {"double": 8, "single": 4, "logical": 1} | {f"{u}int{8 * n}": n for n in (1, 2, 4, 8) for u in ("", "u")}
MOST_UNEVEN = 16  # times that a picture is longer than wide


@dataclass(frozen=True)
class HeldArray:
    """One array that a file holds; ``load`` reads it."""

    shape: tuple[int, ...]
    load: Callable[[], NDArray[Any]]


@dataclass(frozen=True)
class NamedArray:
    """One array of a file, and what the others say of it."""

    values: NDArray[Any]
    bands: Bands
    notes: tuple[str, ...] = ()


def load_array(path: Path, variable: str | None, dims: int) -> NamedArray:
    """Read the array named, or the only one with ``dims`` axes; that of a .npy file is a read-only view.

    Of a cube the wavelengths, where another array is called so and has one a band. ``variable`` may be a step of time,
    or end in one: see :func:`take_step`. Raises SceneError: there is no such array, or several; it is no table of
    numbers; or it claims more than the file or the machine can hold.
    """
    try:
        return _load_array(path, variable, dims)
    except SceneError:
        raise
    except Exception as error:  # decoders raise anything at all on damaged bytes
        objects = "pickle" in str(error) or "Python objects" in str(error)
        why = "it holds Python objects or is damaged" if objects else str(error)
        raise SceneError(f"{path} cannot be read as {path.suffix}: {why}; write it again as plain numbers") from error


def _load_array(path: Path, variable: str | None, dims: int) -> NamedArray:
    if path.suffix.lower() == ".npy":
        named, step = split_step(variable, ())
        if named is not None:
            raise SceneError(f"{path} holds one array, which has no name; only a step of time can be named: {path}:0")
        return NamedArray(take_step(np.load(path, mmap_mode="r", allow_pickle=False), step, dims, str(path)), Bands())
    if path.suffix.lower() == ".npz":
        found = _npz_arrays(path)
    else:
        found = _hdf_arrays(path) if _is_hdf(path) else _mat_arrays(path)
    listing = ", ".join(f"{name} {held.shape}" for name, held in found.items()) or "none"
    named, step = split_step(variable, found)
    if named is not None and named not in found:
        raise SceneError(f"{path} has no array {named}; it has {listing}; name one: {path.name}:VARIABLE")
    name = named if named is not None else _only_one(path, found, _AXES[dims, step is not None], listing)
    others = [f"{other} {held.shape}" for other, held in found.items() if other != name]
    notes = (f"array {name} of the file, which also has {', '.join(others)}",) if others and named is None else ()
    values = take_step(found[name].load(), step, dims, f"{path}:{name}")
    return NamedArray(values, _wavelengths(path, found, values.shape[2]) if values.ndim == 3 else Bands(), notes)


def _wavelengths(path: Path, found: Mapping[str, HeldArray], bands: int) -> Bands:
    """Return wavelengths that stand beside a cube, in nm or micrometres by their size."""
    for name, held in found.items():
        if name.lower() not in _OF_WAVELENGTHS or math.prod(held.shape) != bands or max(held.shape) != bands:
            continue
        with suppress(SceneError, ValueError, TypeError):
            centres = np.asarray(held.load(), np.float64).ravel()
            unit = "micrometres by their size" if centres.max() <= MICROMETRES[1] else "nm"
            nm = check_wavelengths(centres * (1000 if unit != "nm" else 1), str(path))
            return Bands(nm, None, unit, f"wavelengths from {path}:{name}, read as {unit}")
    return Bands()


_AXES = {(3, False): (3, 4, 2), (2, False): (2, 3), (3, True): (4,), (2, True): (3, 4)}  # in the order in which tried


def _only_one(path: Path, found: Mapping[str, HeldArray], axes: Sequence[int], listing: str) -> str:
    """Return the name of the only array with the first of these numbers of axes that any has; vectors stand back."""
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
    """Return name and step of ``cube``, ``cube:3`` or, where no array is called so, of the step ``3`` alone."""
    if variable is None or variable in names:
        return variable, None
    name, colon, step = variable.rpartition(":")
    if not step.isdecimal():
        return variable, None
    return name if colon else None, int(step)


def take_step(values: NDArray[Any], step: int | None, dims: int, where: str) -> NDArray[Any]:
    """Return one step of a time series, (time, y, x, band), counted from 0; what is none is returned as it is.

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


def check_picture(shape: tuple[int, ...], where: object) -> None:
    """Question a table of numbers that is given for a scene of one band (SceneError)."""
    if len(shape) == 2 and max(shape) >= MOST_UNEVEN * min(shape) and max(shape) >= 1000:
        raise SceneError(
            f"{where} is a table of {shape[0]} x {shape[1]} numbers, expected a picture (y, x) or a cube (y, x, band);"
            " are its columns or rows spectra? Then store them as a cube: values.reshape(height, width, bands)"
        )


def _npz_arrays(path: Path) -> dict[str, HeldArray]:
    """List the arrays of a pack; those of Python objects are passed over."""
    found: dict[str, HeldArray] = {}
    with zipfile.ZipFile(path) as pack:
        for member in pack.infolist():
            if member.filename.endswith(".npy"):
                with pack.open(member) as stream:
                    formats = np.lib.format
                    old = formats.read_magic(stream) == (1, 0)
                    shape, _, kind = (formats.read_array_header_1_0 if old else formats.read_array_header_2_0)(stream)
                if not kind.hasobject:
                    load = partial(_member, path, member, math.prod(shape) * kind.itemsize)
                    found[member.filename.removesuffix(".npy")] = HeldArray(shape, load)
    return found


def _member(path: Path, member: zipfile.ZipInfo, claimed: int) -> NDArray[Any]:
    """Read an array of a pack, once its claims of size are found to be possible."""
    where, packed = f"{path}:{member.filename}", member.compress_type != zipfile.ZIP_STORED
    check_claim(where, member.file_size, member.compress_size, DEFLATE_RATIO if packed else 1)
    check_claim(where, claimed, member.file_size, 1)
    check_memory(where, member.file_size)
    with zipfile.ZipFile(path) as pack, pack.open(member) as stream:
        return np.asarray(np.lib.format.read_array(stream, allow_pickle=False))


def _is_hdf(path: Path) -> bool:
    """Tell whether a .mat file is of version 7.3, which is HDF5 behind 512 bytes of MATLAB's own."""
    with path.open("rb") as file:
        head = file.read(520)
    return b"\x89HDF\r\n\x1a\n" in (head[:8], head[512:])


def _mat_arrays(path: Path) -> dict[str, HeldArray]:
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
        name: HeldArray(shape, partial(load, name, math.prod(shape) * _MATLAB[kind]))
        for name, shape, kind in listed
        if kind in _MATLAB
    }


def _check_names(content: mmap.mmap) -> None:
    """Refuse names of variables beyond the file's end (ValueError): scipy takes the memory before it reads one."""
    order, place = "<" if content[126:128] == b"IM" else ">", 128
    while content[126:128] in (b"IM", b"MI") and place + 48 <= len(content):
        kind, size, *_, axes = struct.unpack(order + "8I", content[place : place + 32])[:8]
        name = place + 32 + axes + -axes % 8  # after flags and axes
        if kind == 14 and (name + 8 > len(content) or _length(content[name : name + 8], order) > len(content) - name):
            raise ValueError(f"the variable at byte {place} is cut off")
        place += 8 + size


def _length(tag: bytes, order: str) -> int:
    """Return the bytes of an element by its tag; those of up to four bytes stand in the tag itself."""
    kind, size = struct.unpack(order + "II", tag)
    return 4 if kind >> 16 else int(size)


@contextmanager
def _mapped(path: Path) -> Iterator[mmap.mmap]:
    """Open a file so that asking for more bytes than it has takes no memory for them."""
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        yield content


def _hdf_arrays(path: Path) -> dict[str, HeldArray]:
    """List the arrays of numbers of a .mat file of version 7.3, axes as MATLAB counts them.

    Only what is kept in this very file: links may lead anywhere on the disk.
    """
    h5py = importlib.import_module("h5py")
    found: dict[str, HeldArray] = {}

    def load(name: str) -> NDArray[Any]:
        """Read one array (SceneError: it claims more than the file or the memory can hold)."""
        with h5py.File(path, "r") as file:
            item = file[name]
            stored = min(item.id.get_storage_size(), path.stat().st_size)
            chunk = math.prod(item.chunks or ()) * item.dtype.itemsize
            check_claim(f"{path}:{name}", max(int(item.nbytes), chunk), stored, DEFLATE_RATIO)
            check_memory(path, int(item.nbytes) + chunk)
            return np.asarray(item).T

    with h5py.File(path, "r") as file:
        for name in file:
            item = file[name] if isinstance(file.get(name, getlink=True), h5py.HardLink) else None
            if not isinstance(item, h5py.Dataset) or item.external or item.is_virtual or item.shape is None:
                continue
            if item.dtype.kind in "buifc" and item.attrs.get("MATLAB_class") not in (b"char", "char"):
                found[name] = HeldArray(tuple(item.shape[::-1]), partial(load, name))
    return found
