"""Decode packed chunks to exactly the bytes that their array declares.

Decoders of zarr write as many bytes as a chunk says: 1 kB can become gigabytes.
"""

from __future__ import annotations

import asyncio
import bz2
import gzip
import io
import math
import zlib
from dataclasses import dataclass
from typing import Any, Self

import numcodecs
import numpy as np
from numpy.typing import NDArray
from zarr.abc.codec import BytesBytesCodec
from zarr.core.array_spec import ArraySpec
from zarr.core.buffer import Buffer
from zarr.registry import register_codec

LIMITED = "spectralzoom.limited"  # the codec that stands for a packer in metadata
PACKERS = ("blosc", "zstd", "gzip", "zlib", "bz2", "lz4")
_ZSTD = 0xFD2FB528  # with which frames begin


def unpack(packer: str, packed: Any, size: int) -> NDArray[np.uint8]:
    """Return the ``size`` decoded bytes of a chunk (ValueError: it has another size, or is damaged)."""
    data = memoryview(packed).cast("B")
    if packer == "zlib":
        stream = zlib.decompressobj()
        plain = stream.decompress(data, size + 1)
        there = len(plain) if stream.eof or len(plain) > size else -1
    elif packer in ("gzip", "bz2"):
        with gzip.open(io.BytesIO(data)) if packer == "gzip" else bz2.open(io.BytesIO(data)) as file:
            plain = file.read(size + 1)
        there = len(plain)
    else:
        stated = _zstd_size(data) if packer == "zstd" else _number(data[4:8] if packer == "blosc" else data[:4])
        there = size if stated is None else stated  # numcodecs fills an array exactly where no size is stated
        plain = b""
        if packer == "blosc" and _number(data[12:16]) > len(data):  # its decoder would read beyond them
            there = -1
        if there == size:
            return np.asarray(numcodecs.get_codec({"id": packer}).decode(data, np.empty(size, np.uint8)))
    if there != size:
        many = "cut off" if there < 0 else f"more than {size}" if there > size else f"{there}"
        raise ValueError(f"a chunk packed by {packer} has {many} bytes, and its array declares {size}")
    return np.frombuffer(plain, np.uint8)


def _zstd_size(data: memoryview) -> int | None:
    """Return the bytes that the first frame of a chunk states; None if it states none."""
    if len(data) < 5 or _number(data[:4]) != _ZSTD:
        raise ValueError("a chunk packed by zstd is damaged")
    single = data[4] >> 5 & 1
    width = (single, 2, 4, 8)[data[4] >> 6]
    at = 6 - single + (0, 1, 2, 4)[data[4] & 3]
    return _number(data[at : at + width]) + 256 * (width == 2) if width else None


def _number(data: memoryview) -> int:
    return int.from_bytes(data, "little")


@dataclass(frozen=True)
class LimitedCodec(BytesBytesCodec):
    """Stand for a packer in metadata of Zarr v3; zarr says shape and type of each chunk."""

    packer: str
    spare: int  # bytes of checksums within the packed ones
    is_fixed_size = False

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Self:
        return cls(**data["configuration"])

    def compute_encoded_size(self, input_byte_length: int, chunk_spec: ArraySpec) -> int:
        """Raise NotImplementedError, as zarr asks of codecs whose output has no fixed size."""
        raise NotImplementedError

    async def _decode_single(self, chunk_data: Buffer, chunk_spec: ArraySpec) -> Buffer:
        size = math.prod(chunk_spec.shape) * chunk_spec.dtype.to_native_dtype().itemsize + self.spare
        plain = await asyncio.to_thread(unpack, self.packer, chunk_data.as_numpy_array(), size)
        return chunk_spec.prototype.buffer.from_array_like(plain)


class LimitedPacker(numcodecs.abc.Codec):  # type: ignore[misc]
    """Stand for a packer in metadata of Zarr v2, with the size of a chunk."""

    codec_id = LIMITED

    def __init__(self, packer: str, size: int) -> None:
        self.packer, self.size = packer, size

    def encode(self, buf: Any) -> Any:
        """Raise NotImplementedError: numcodecs requires this method, and readers write nothing."""
        raise NotImplementedError

    def decode(self, buf: Any, out: Any = None) -> Any:
        return numcodecs.compat.ndarray_copy(unpack(self.packer, buf, self.size), out)


register_codec(LIMITED, LimitedCodec)
numcodecs.register_codec(LimitedPacker)
