"""What a Zarr store says of itself, judged before it is opened.

Codecs that only carry numbers, and sizes that fit what lies on the disk. A codec of another name (``pickle`` is one) is
refused, so that reading data never runs what it brings.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import zarr

from pipeline.errors import SceneError

METADATA = ("zarr.json", ".zarray", ".zgroup")
LARGEST_METADATA = 1 << 24  # bytes
MOST_RATIO = 10_000  # numbers may take this many times the bytes of their store
CODECS = {
    "blosc", "zstd", "gzip", "zlib", "bz2", "lzma", "lz4", "bytes", "transpose", "sharding_indexed", "crc32", "crc32c",
    "adler32", "fletcher32", "jenkins_lookup3", "shuffle", "delta", "fixedscaleoffset", "quantize", "bitround",
    "packbits", "astype", "pcodec", "zfpy", "cast_value", "scale_offset",
}  # fmt: skip


def check_metadata(path: Path) -> None:
    """Refuse codecs that do not just carry numbers, in the store and its members (SceneError)."""
    for folder in (path, *(entry for entry in sorted(path.iterdir()) if entry.is_dir())):
        for file in (folder / "zarr.json", folder / ".zarray"):
            if file.is_file():
                _check_codecs(file)


def _check_codecs(file: Path) -> None:
    for codec in _codecs(_read_json(file)):
        if codec.lower().removeprefix("numcodecs.") not in CODECS:
            raise SceneError(
                f"{file} asks for the codec {codec!r}, which is not read; store plain numbers with blosc, zstd or gzip"
            )


def _read_json(path: Path) -> dict[str, Any]:
    if path.stat().st_size > LARGEST_METADATA:
        raise SceneError(f"{path} has {path.stat().st_size} bytes, too many for metadata")
    content = json.loads(path.read_bytes())
    if not isinstance(content, dict):
        raise SceneError(f"{path} holds no table")
    return content


def _codecs(content: object) -> Iterator[str]:
    """Names of all codecs in an array's metadata, those within others too."""
    if isinstance(content, dict):
        for key in ("codecs", "index_codecs", "filters", "compressor", "compressors"):
            listed = content.get(key) or []
            for codec in listed if isinstance(listed, list) else [listed]:
                yield str(codec.get("name", codec.get("id"))) if isinstance(codec, dict) else str(codec)
                yield from _codecs(codec.get("configuration") if isinstance(codec, dict) else None)


def check_size(array: zarr.Array[Any], path: Path, name: str) -> None:
    """Refuse an array that claims more than its bytes can mean, before any of it is asked for (SceneError)."""
    folder = path / name
    stored = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    claimed = array.dtype.itemsize * int(np.prod(array.shape, dtype=object))
    chunk = array.dtype.itemsize * int(np.prod(array.chunks, dtype=object))
    if max(claimed, chunk) > max(stored, 1) * MOST_RATIO:
        raise SceneError(
            f"{folder} claims {array.shape} of {array.dtype} in chunks of {array.chunks}, and {stored} bytes lie on "
            "the disk; copy it again"
        )


def open_options(path: Path) -> dict[str, Any]:
    """Options to open a store with: groups are read from their members, whose metadata alone were judged."""
    is_group = (path / ".zgroup").is_file() or (
        (path / "zarr.json").is_file() and _read_json(path / "zarr.json").get("node_type") == "group"
    )
    return {"use_consolidated": False} if is_group else {}
