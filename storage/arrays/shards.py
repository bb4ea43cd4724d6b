"""Shards of whole rows, packed here and written in one go: the bytes that zarr would write, for a fraction of its time.

::

    <array>/c/<row>/<column>/<band>    packed chunks one after the other, each with its crc32c, then their index:
                                       where each begins and how long it is, little-endian uint64, and its crc32c

That is the codec ``sharding_indexed`` of Zarr v3 with its index at the end; a chunk of zeros is left out, as zarr does.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import product
from pathlib import Path
from typing import Any

import google_crc32c
import numpy as np
import zarr
from numcodecs import blosc  # type: ignore[import-untyped]
from numpy.typing import NDArray
from zarr.storage import LocalStore

from storage.arrays.layout import whole_shards

_ABSENT = 2**64 - 1
_MOST_PACKERS = 8


class ShardWriter:
    """Writes rows of an array (row, column, band) of whole numbers whose fill value is 0, a row of shards at a time.

    The array is one that `layout.create_array` made, in a folder, packed with blosc's zstd at ``level``. Use as a
    context manager: chunks are packed by threads.
    """

    def __init__(self, array: zarr.Array[Any], level: int) -> None:
        assert array.shards is not None
        assert isinstance(array.store, LocalStore)
        self._shape, self._chunk, self._shard = array.shape, array.chunks, array.shards
        self._kind, self._level = array.dtype, level
        self._folder = Path(array.store.root) / array.path / "c"
        self._packers = ThreadPoolExecutor(min(os.cpu_count() or 1, _MOST_PACKERS))

    def close(self) -> None:
        """Let the threads go."""
        self._packers.shutdown()

    def write(self, first: int, rows: NDArray[Any]) -> None:
        """Write rows (row, column, band) from ``first`` on: all of a shard's, or those up to the array's end.

        Nothing else may have been written there. Raises ChunkError: they split a shard.
        """
        high, wide, deep = self._shard
        whole_shards("raw numbers", [slice(first, first + len(rows))], self._shape[:1], self._shard[:1])
        for column, band in product(range(0, self._shape[1], wide), range(0, self._shape[2], deep)):
            shard = rows[:, column : column + wide, band : band + deep]
            packed = list(self._packers.map(self._packed, self._chunks(shard)))
            if any(packed):
                place = self._folder / f"{first // high}" / f"{column // wide}" / f"{band // deep}"
                place.parent.mkdir(parents=True, exist_ok=True)
                with place.open("wb") as file:
                    file.writelines([*packed, _index(packed)])

    def _chunks(self, shard: NDArray[Any]) -> Iterator[NDArray[Any]]:
        """The chunks of a shard, in the order of its index; an array's last ones may be smaller."""
        steps = [range(0, size, step) for size, step in zip(self._shard, self._chunk, strict=True)]
        for starts in product(*steps):
            ends = (start + step for start, step in zip(starts, self._chunk, strict=True))
            yield shard[tuple(map(slice, starts, ends))]

    def _packed(self, part: NDArray[Any]) -> bytes:
        """A chunk's bytes with their checksum; none of zeros."""
        if not part.any():
            return b""
        if part.shape == self._chunk:
            chunk = np.ascontiguousarray(part)
        else:
            chunk = np.zeros(self._chunk, self._kind)
            chunk[tuple(map(slice, part.shape))] = part
        packed: bytes = blosc.compress(chunk, b"zstd", self._level, blosc.BITSHUFFLE)
        return packed + _checksum(packed)


def _index(packed: list[bytes]) -> bytes:
    sizes = np.array([len(one) for one in packed], "<u8")
    begins = np.concatenate([np.zeros(1, "<u8"), sizes.cumsum()[:-1]])
    index = np.where(sizes[:, None] > 0, np.stack([begins, sizes], axis=1), np.uint64(_ABSENT)).astype("<u8").tobytes()
    return index + _checksum(index)


def _checksum(content: bytes) -> bytes:
    return int(google_crc32c.value(content)).to_bytes(4, "little")
