"""Codecs to choose from, tried on arrays in memory in the archive's own layout of shards and chunks."""

from __future__ import annotations

from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.codecs import BloscCodec, BloscShuffle, Crc32cCodec, ZstdCodec
from zarr.storage import MemoryStore

from pipeline.errors import SettingsError
from storage.arrays.layout import image_spec

BLOSC = {"lz4-5": ("lz4", 5), "zstd-1": ("zstd", 1), "zstd-3": ("zstd", 3), "zstd-5": ("zstd", 5)}
CODECS = ("none", *BLOSC, "zstd-3 bytes in order")


def store_in_memory(values: NDArray[Any], codec: str) -> tuple[int, NDArray[Any]]:
    """Write an image (y, x, band) with one codec and read it back; gives the bytes stored and what was read.

    Raises
    ------
    SettingsError : the codec is none of ``CODECS``.
    """
    held: dict[str, Any] = {}
    spec = image_spec(("y", "x", "band"), values.shape, values.dtype.str)
    array = zarr.create_array(
        MemoryStore(store_dict=held),
        shape=spec.shape,
        dtype=values.dtype,
        chunks=spec.chunk,
        shards=spec.shard,
        compressors=(*_compressors(codec, values.dtype.itemsize), Crc32cCodec()),
    )
    array[...] = values
    size = sum(len(part) for name, part in held.items() if not name.endswith("zarr.json"))
    return size, np.asarray(array[...])


def _compressors(codec: str, size: int) -> tuple[Any, ...]:
    if codec == "none":
        return ()
    if codec == "zstd-3 bytes in order":
        return (ZstdCodec(level=3),)
    if codec not in BLOSC:
        raise SettingsError(f"the codec must be one of {', '.join(CODECS)}, got {codec!r}")
    name, level = BLOSC[codec]
    return (BloscCodec(cname=name, clevel=level, shuffle=BloscShuffle.bitshuffle, typesize=size),)  # type: ignore[arg-type]
