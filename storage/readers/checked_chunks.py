"""Decode chunks of Zarr stores and HDF5 files to at most the bytes that their headers declare.

Decoders of zarr and HDF5 write as many bytes as a chunk says: 1.5 MB can become gigabytes. Here sizes in headers are
checked first, and streams without one are decoded up to the limit.
"""

from __future__ import annotations

import asyncio
import bz2
import gzip
import io
import json
import math
import zlib
from dataclasses import dataclass
from typing import Any, Self

import h5py
import numcodecs
import numpy as np
from numpy.typing import NDArray
from zarr.abc.codec import BytesBytesCodec
from zarr.abc.store import ByteRequest, Store
from zarr.core.array_spec import ArraySpec
from zarr.core.buffer import Buffer, BufferPrototype
from zarr.registry import register_codec
from zarr.storage import WrapperStore

from spectralzoom.pipeline.errors import SceneError

_ZSTD = 0xFD2FB528  # with which frames begin
_NAME = "spectralzoom.checked"  # of the codec that stands for a packer in metadata
SPARE_BYTES = 1024  # of checksums within a chunk
HARMLESS_BYTES = 128 << 10  # of a deflated chunk, which makes 135 MB of them at most
WIDEST = 8  # bytes of a number: filters may store it in another type
PACKERS = ("blosc", "zstd", "gzip", "zlib", "bz2", "lz4")
PLAIN_CODECS = {
    *("crc32", "crc32c", "adler32", "fletcher32", "jenkins_lookup3"),  # checksums
    *("bytes", "transpose", "sharding_indexed", "shuffle"),  # orders
    *("delta", "fixedscaleoffset", "quantize", "bitround", "astype", "cast_value", "scale_offset"),  # of numbers
}


def unpack(packer: str, data: Any, size: int) -> bytes:
    """Return the decoded bytes of a chunk of ``size`` bytes (ValueError: there are more, or the chunk is damaged)."""
    most = size + SPARE_BYTES
    view: Any = data.view(np.uint8) if isinstance(data, np.ndarray) else data
    packed = memoryview(view)
    plain: Any = None
    if packer == "zlib":
        stream = zlib.decompressobj()
        plain = stream.decompress(packed, most + 1)
        if not stream.eof and len(plain) <= most:
            raise ValueError("a chunk packed by zlib is cut off")
    elif packer in ("gzip", "bz2"):
        with gzip.open(io.BytesIO(packed)) if packer == "gzip" else bz2.open(io.BytesIO(packed)) as file:
            plain = file.read(most + 1)
    else:
        stated = _zstd_size(packed) if packer == "zstd" else _number(packed[4:8] if packer == "blosc" else packed[:4])
        if stated is None or stated <= most:  # numcodecs fills all of an array, and refuses frames beyond it
            whole = np.empty(size if stated is None else stated, np.uint8)
            return bytes(numcodecs.get_codec({"id": packer}).decode(packed, whole))
    if plain is None or len(plain) > most:
        raise ValueError(f"a chunk packed by {packer} unpacks to more than the {size} bytes that its header declares")
    return bytes(plain)


def _zstd_size(data: memoryview) -> int | None:
    """Return how many bytes the first frame of a chunk holds by its header; None if that does not say it."""
    if len(data) < 5 or _number(data[:4]) != _ZSTD:
        raise ValueError("a chunk packed by zstd is damaged")
    single = data[4] >> 5 & 1
    width = (single, 2, 4, 8)[data[4] >> 6]
    at = 6 - single + (0, 1, 2, 4)[data[4] & 3]
    return _number(data[at : at + width]) + 256 * (width == 2) if width else None


def _number(data: memoryview) -> int:
    return int.from_bytes(data, "little")


@dataclass(frozen=True)
class CheckedCodec(BytesBytesCodec):
    """Stand for a packer in metadata of Zarr v3; zarr says the size of each chunk."""

    packer: str
    is_fixed_size = False

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Self:
        return cls(data["configuration"]["packer"])

    def to_dict(self) -> dict[str, Any]:
        return {"name": _NAME, "configuration": {"packer": self.packer}}

    def compute_encoded_size(self, input_byte_length: int, chunk_spec: ArraySpec) -> int:
        """Raise NotImplementedError, as zarr asks of codecs whose output has no fixed size."""
        raise NotImplementedError

    async def _decode_single(self, chunk_data: Buffer, chunk_spec: ArraySpec) -> Buffer:
        size = math.prod(chunk_spec.shape) * chunk_spec.dtype.to_native_dtype().itemsize
        plain = await asyncio.to_thread(unpack, self.packer, chunk_data.as_numpy_array(), size)
        return chunk_spec.prototype.buffer.from_bytes(plain)


class CheckedPacker(numcodecs.abc.Codec):  # type: ignore[misc]
    """Stand for a packer in metadata of Zarr v2, with the size of a chunk."""

    codec_id = _NAME

    def __init__(self, packer: str, size: int) -> None:
        self.packer, self.size = packer, size

    def encode(self, buf: Any) -> Any:
        """Raise NotImplementedError: numcodecs requires this method, and readers write nothing."""
        raise NotImplementedError

    def decode(self, buf: Any, out: Any = None) -> Any:
        return numcodecs.compat.ndarray_copy(unpack(self.packer, buf, self.size), out)


register_codec(_NAME, CheckedCodec)
numcodecs.register_codec(CheckedPacker)


class CheckedStore(WrapperStore[Store]):
    """A store of any kind whose chunks give at most what their array declares.

    Raises SceneError on a codec that is not allowed. Consolidated metadata are left out: each array's own are read.
    """

    async def get(self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None) -> Buffer | None:
        """Return the bytes of a key; metadata name a checked codec for each packer."""
        name = key.rpartition("/")[2]
        found = None if name == ".zmetadata" else await super().get(key, prototype, byte_range)
        if found is None or name not in ("zarr.json", ".zarray"):
            return found
        about = json.loads(found.to_bytes())
        where = f"{str(self).partition('://')[2]}/{key}"
        if not isinstance(about, dict):
            raise SceneError(f"{where} holds no table; copy the store again")
        about.pop("consolidated_metadata", None)
        for listed in ("compressor", "filters", "codecs"):
            if about.get(listed):
                about[listed] = _checked(about[listed], where, about)
        return prototype.buffer.from_bytes(json.dumps(about).encode())


def _checked(codecs: Any, where: str, about: dict[str, Any]) -> Any:
    """Return codecs of metadata with each packer replaced (SceneError: one is not allowed)."""
    if isinstance(codecs, list):
        return [_checked(codec, where, about) for codec in codecs]
    given = codecs if isinstance(codecs, dict) else {"name": codecs}
    name = str(given.get("name", given.get("id")))
    kind = name.lower().removeprefix("numcodecs.")
    if kind in PACKERS:
        if "id" not in given:
            return {"name": _NAME, "configuration": {"packer": kind}}
        plain = isinstance(about["dtype"], str)  # structures are not read
        width = WIDEST if about.get("filters") else np.dtype(about["dtype"]).itemsize if plain else 0
        return {"id": _NAME, "packer": kind, "size": math.prod(about["chunks"]) * width}
    if kind not in PLAIN_CODECS:
        raise SceneError(
            f"{where} asks for the codec {name!r}, which is not read; store plain numbers with {', '.join(PACKERS)}"
        )
    inner = given.get("configuration")
    if kind == "sharding_indexed" and isinstance(inner, dict):
        lists = {key: _checked(inner[key], where, about) for key in ("codecs", "index_codecs") if key in inner}
        return given | {"configuration": inner | lists}
    return codecs


_DEFLATE, _SHUFFLE, _FLETCHER32, _LZF = 1, 2, 3, 32000  # filters of HDF5


def read_hdf5(dataset: h5py.Dataset, part: Any) -> NDArray[Any]:
    """Return a part of an HDF5 array: ``...``, or one slice without a step for each axis.

    Large deflated chunks are checked first; HDF5's decoder knows no limit. Raises SceneError: a filter is not allowed;
    ValueError: a chunk holds more than its array declares, or is damaged.
    """
    plist = dataset.id.get_create_plist()
    codes = [plist.get_filter(number)[0] for number in range(plist.get_nfilters())]
    allowed = [_SHUFFLE, _FLETCHER32, _DEFLATE if _DEFLATE in codes else _LZF]  # each once
    if any(code not in allowed or codes.count(code) > 1 for code in codes):
        raise SceneError(
            f"{dataset.file.filename}:{dataset.name} is packed by the HDF5 filters {codes}, of which one of deflate "
            "and lzf, shuffle and fletcher32 are read, each once; write it with deflate (h5repack -f GZIP=4)"
        )
    large: set[tuple[int, ...]] = set()
    if _DEFLATE in codes:
        dataset.id.chunk_iter(lambda one: large.add(one.chunk_offset) if one.size > HARMLESS_BYTES else None)
    for origin in large:
        parts = zip((slice(None),) * dataset.ndim if part is ... else part, origin, dataset.chunks, strict=True)
        wanted = all((one.start or 0) < at + size and (one.stop is None or one.stop > at) for one, at, size in parts)
        mask, data = dataset.id.read_direct_chunk(origin) if wanted else (-1, b"")
        if not mask >> codes.index(_DEFLATE) & 1:
            unpack("zlib", data, math.prod(dataset.chunks) * dataset.dtype.itemsize)
    return np.asarray(dataset[part])


def outside_links(file: h5py.File) -> list[str]:
    """Return a sentence for each link, external array and virtual array of a file, which may lead to any other file."""
    found: list[str] = []

    def visit(name: str, item: Any) -> None:
        if isinstance(item, h5py.ExternalLink):
            found.append(f"{name} is a link to {item.filename}:{item.path}")
        elif isinstance(item, h5py.Dataset) and (item.external or item.is_virtual):
            others = [one[0] for one in item.external or ()] or [one.file_name for one in item.virtual_sources()]
            found.append(f"{name} takes its numbers from {', '.join(others[:1]) or 'no file'}")

    file.visititems_links(visit)
    file.visititems(visit)
    return found
