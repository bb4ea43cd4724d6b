"""Arrays out of .npy, .npz and .mat files: looked at by their headers, and only the one wanted is read.

Nothing but plain numbers is read: no Python objects, no cells, structures or functions of MATLAB, however nested. What
is packed is unpacked as far as its header says and no further.
"""

from __future__ import annotations

import importlib
import io
import math
import struct
import zipfile
import zlib
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SceneError
from storage.readers.cube_sources import DEFLATE_RATIO, check_claim, check_memory
from storage.readers.scene_toml import MICROMETRES, BandWavelengths, check_wavelengths

_HEADER = 128  # bytes before the first variable
_MATRIX, _PACKED, _INT32 = 14, 15, 5  # types of elements
_LOOK = 1 << 14  # bytes in which a variable says its class, axes and name
_MOST_AXES = 32
_OF_WAVELENGTHS = ("wavelength", "wavelengths", "wavelength_nm", "wavelengths_nm", "wl", "lambda", "nm")
_CLASSES = {6: 8, 7: 4, 8: 1, 9: 1, 10: 2, 11: 2, 12: 4, 13: 4, 14: 8, 15: 8}  # of numbers -> bytes of each
_OLD_TYPES = {0: 8, 1: 4, 2: 4, 3: 2, 4: 2, 5: 1}  # of version 4


@dataclass(frozen=True)
class MatVariable:
    """One variable by its header. ``width`` is 0 where it is no array of numbers."""

    name: str
    shape: tuple[int, ...]
    width: int  # bytes a number
    start: int  # in the file
    size: int  # bytes in the file
    packed: bool = False
    old: bool = False  # of version 4


def list_mat_variables(path: Path) -> list[MatVariable]:
    """Variables of a file, whatever they hold (SceneError: a variable is cut off, or says what cannot be)."""
    with path.open("rb") as file:
        head = file.read(_HEADER)
        if len(head) < 20 or (0 not in head[:4] and head[126:128] not in (b"IM", b"MI")):
            raise SceneError(
                f"{path} cannot be read as .mat: it does not begin like one; write it again as plain numbers"
            )
        end = path.stat().st_size
        try:
            return list(_old_variables(file, end) if 0 in head[:4] else _variables(file, end, _order(head)))
        except (struct.error, zlib.error, ValueError, IndexError) as error:
            raise SceneError(f"{path} cannot be read as .mat: {error}; write it again as plain numbers") from error


def load_mat_variable(path: Path, variable: MatVariable) -> NDArray[Any]:
    """Read one array of numbers (SceneError: it claims more than its bytes or the machine can hold)."""
    where = f"{path}:{variable.name}"
    claimed = math.prod(variable.shape) * variable.width
    with path.open("rb") as file:
        head = file.read(0 if variable.old else _HEADER)
        file.seek(variable.start)
        if not variable.packed:
            body_bytes = variable.size
        else:
            body_bytes = 8 + struct.unpack(_order(head) + "II", _unpacked(file.read(min(variable.size, _LOOK)), 8))[1]
            check_claim(where, body_bytes, variable.size, DEFLATE_RATIO)
            file.seek(variable.start)
        check_claim(where, claimed, body_bytes, 8)  # a double may be kept in one byte
        check_memory(where, 2 * body_bytes + 2 * claimed)
        body = file.read(variable.size)
    content = io.BytesIO(head + (_unpacked(body, body_bytes) if variable.packed else body))
    found = importlib.import_module("scipy.io").loadmat(content).get(variable.name)
    if not isinstance(found, np.ndarray):
        raise SceneError(f"{where} is no array of numbers")
    return np.asarray(found)


def _order(head: bytes) -> str:
    return "<" if head[126:128] == b"IM" else ">"


def _unpacked(packed: bytes, most: int) -> bytes:
    return zlib.decompressobj().decompress(packed, most)


def _variables(file: BinaryIO, end: int, order: str) -> Iterator[MatVariable]:
    place = _HEADER
    while place + 8 <= end:
        file.seek(place)
        kind, size = struct.unpack(order + "II", file.read(8))
        if place + 8 + size > end:
            raise ValueError(f"the variable at byte {place} is cut off")
        packed = kind == _PACKED
        look = file.read(min(size, _LOOK))
        look = _unpacked(look, _LOOK) if packed else struct.pack(order + "II", kind, size) + look
        if look:
            start, length = (place + 8, size) if packed else (place, size + 8)
            name, shape, width = _described(look, order)
            yield MatVariable(name, shape, width, start, length, packed)
        place += 8 + size


def _described(look: bytes, order: str) -> tuple[str, tuple[int, ...], int]:
    """Name, axes and bytes a number of a matrix, from its first bytes."""
    if struct.unpack_from(order + "I", look)[0] != _MATRIX:
        return "", (), 0
    _, flags, place = _element(look, 8, order)
    kind = struct.unpack_from(order + "I", flags)[0] & 0xFF
    dims_type, dims, place = _element(look, place, order)
    _, name, _ = _element(look, place, order)
    if kind not in _CLASSES or dims_type != _INT32 or not 0 < len(dims) <= 4 * _MOST_AXES:
        return name.decode("latin-1"), (), 0
    shape = struct.unpack(f"{order}{len(dims) // 4}i", dims[: len(dims) // 4 * 4])
    if min(shape) < 0:
        raise ValueError(f"an axis has {min(shape)} numbers")
    return name.decode("latin-1"), shape, _CLASSES[kind]


def _element(look: bytes, place: int, order: str) -> tuple[int, bytes, int]:
    """Type and bytes of the element at a place, and where the next one is."""
    kind, size = struct.unpack_from(order + "II", look, place)
    if kind >> 16:  # a small one: its bytes stand in the place of their number
        return kind & 0xFFFF, look[place + 4 : place + 4 + min(kind >> 16, 4)], place + 8
    if place + 8 + size > len(look):
        raise ValueError("a header is cut off")
    return kind, look[place + 8 : place + 8 + size], place + 8 + size + -size % 8


def _old_variables(file: BinaryIO, end: int) -> Iterator[MatVariable]:
    place = 0
    while place + 20 <= end:
        file.seek(place)
        head = file.read(20)
        order = "<" if 0 <= struct.unpack("<i", head[:4])[0] < 5000 else ">"
        kind, rows, columns, imaginary, letters = struct.unpack(order + "5i", head)
        width = _OLD_TYPES.get(kind // 10 % 10)
        if width is None or min(rows, columns, letters) < 0:
            raise ValueError(f"the variable at byte {place} says what cannot be")
        size = 20 + letters + rows * columns * width * (2 if imaginary else 1)
        if place + size > end:
            raise ValueError(f"the variable at byte {place} is cut off")
        name = file.read(letters).rstrip(b"\0").decode("latin-1")
        yield MatVariable(name, (rows, columns), width if kind % 10 == 0 else 0, place, size, old=True)
        place += size


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
