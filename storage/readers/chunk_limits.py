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
from functools import partial
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
_DECODERS = {packer: numcodecs.get_codec({"id": packer}).decode for packer in ("blosc", "zstd", "lz4")}
_ZSTD = 0xFD2FB528  # with which frames begin


def unpack(packer: str, packed: Any, size: int) -> NDArray[np.uint8]:
    """Return the ``size`` decoded bytes of a chunk (ValueError: it has another size, or is damaged)."""
    data = memoryview(packed).cast("B")
    plain: Any = b""
    if packer == "zlib":
        stream = zlib.decompressobj()
        plain = stream.decompress(data, size + 1)
        plain = plain if stream.eof else b""  # longer or cut off
    elif packer in ("gzip", "bz2"):
        with gzip.open(io.BytesIO(data)) if packer == "gzip" else bz2.open(io.BytesIO(data)) as file:
            plain = file.read(size + 1)
    elif _stated_size(packer, data) in (None, size):  # numcodecs fills an array exactly where no size is stated
        plain = _DECODERS[packer](data, np.empty(size, np.uint8))
    if len(plain) != size:
        raise ValueError(f"a chunk packed by {packer} has not the {size} bytes that its array declares")
    return np.frombuffer(plain, np.uint8)


def _stated_size(packer: str, data: memoryview) -> int | None:
    """Return the decoded bytes that the head of a chunk states: of zstd in its first frame, None if there is none."""
    number = partial(int.from_bytes, byteorder="little")
    if packer == "lz4":
        return number(data[:4])
    if packer == "blosc":  # its decoder would read beyond a chunk that is cut off
        return number(data[4:8]) if number(data[12:16]) <= len(data) else -1
    if len(data) < 5 or number(data[:4]) != _ZSTD:
        return -1
    single = data[4] >> 5 & 1
    width = (single, 2, 4, 8)[data[4] >> 6]
    at = 6 - single + (0, 1, 2, 4)[data[4] & 3]
    return number(data[at : at + width]) + 256 * (width == 2) if width else None


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
