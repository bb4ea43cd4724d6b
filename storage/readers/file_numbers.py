"""Read an array in a file part by part: where another program cuts the file off, a memory map would end the process."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.errors import SceneError

AT_ONCE = 1 << 24  # bytes that are read as one piece, even if few of them are wanted


@dataclass(frozen=True)
class FileNumbers:
    """An array in a file. ``strides`` are the bytes from a number to the next one on each axis."""

    path: Path
    offset: int  # of its first number
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    strides: tuple[int, ...]

    def __getitem__(self, part: Any) -> NDArray[Any]:
        """Read the rows of a part, and cut its other axes (SceneError: the file ends before)."""
        rows, *rest = part if isinstance(part, tuple) else (part,)
        shape, offset = self.shape, self.offset
        if isinstance(rows, slice) and rows.step in (None, 1):
            first, stop, _ = rows.indices(shape[0])
            shape, offset = (max(stop - first, 0), *shape[1:]), offset + first * self.strides[0]
            part = slice(None), *rest
        with self.path.open("rb") as file:
            return np.asarray(self._block(file, offset, shape, self.strides)[part])

    def _block(self, file: BinaryIO, offset: int, shape: tuple[int, ...], strides: tuple[int, ...]) -> NDArray[Any]:
        """Read a block at once if most bytes of its span are wanted, else piece by piece along its widest axis."""
        wanted = math.prod(shape) * self.dtype.itemsize
        span = self.dtype.itemsize + sum((size - 1) * step for size, step in zip(shape, strides, strict=True))
        if not wanted or span <= max(2 * wanted, AT_ONCE):
            file.seek(offset)
            content = file.read(span if wanted else 0)
            if len(content) < wanted:
                raise SceneError(f"{self.path} ends before its last number; copy it again")
            return np.ndarray(shape, self.dtype, content, 0, strides)
        axis = max((axis for axis, size in enumerate(shape) if size > 1), key=strides.__getitem__)
        rest, steps = shape[:axis] + shape[axis + 1 :], strides[:axis] + strides[axis + 1 :]
        pieces = [self._block(file, offset + at * strides[axis], rest, steps) for at in range(shape[axis])]
        return np.moveaxis(np.stack(pieces), 0, axis)
