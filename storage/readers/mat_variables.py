"""Variables of MATLAB files of versions 4 to 7, listed by their headers; only the one wanted is read.

Nothing but plain numbers is read: no cells, structures or functions, however nested. What is packed is unpacked as far
as its header says and no further.
"""

from __future__ import annotations

import importlib
import io
import math
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SceneError
from storage.readers.cube_sources import DEFLATE_RATIO, check_claim, check_memory

_HEADER = 128  # bytes before the first variable
_MATRIX, _PACKED, _INT32 = 14, 15, 5  # types of elements
_LOOK = 1 << 14  # bytes in which a variable says its class, axes and name
_MOST_AXES = 32
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
