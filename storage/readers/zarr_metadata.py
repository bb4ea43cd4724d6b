"""What a Zarr store says of itself, judged before it is opened.

Codecs that only carry numbers, and sizes that fit what lies on the disk. A codec of another name (``pickle`` is one) is
refused, so that reading data never runs what it brings.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import zarr

from pipeline.errors import SceneError
from storage.readers.declared_sizes import MOST_RATIO, check_memory
from storage.readers.zarr_chunks import check_chunks

METADATA = ("zarr.json", ".zarray", ".zgroup")
LARGEST_METADATA = 1 << 24  # bytes
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


def check_links(path: Path) -> None:
    """Refuse what leads out of the store, or is neither file nor folder (SceneError): reading it may never end."""
    home = path.resolve()
    for place, folders, files in os.walk(path):
        for name in (*folders, *files):
            entry = Path(place, name)
            if entry.is_symlink() and not entry.resolve().is_relative_to(home):
                raise SceneError(f"{entry} is a link out of the store, which is not followed; copy what it leads to")
        odd = next((name for name in files if not Path(place, name).is_file()), None)
        if odd is not None:
            raise SceneError(f"{Path(place, odd)} is no file; take it out of the store")


def check_size(array: zarr.Array[Any], path: Path, name: str) -> None:
    """Refuse an array that claims more than its bytes can mean, before any of it is asked for (SceneError)."""
    folder = path / name
    stored = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    claimed, chunk = (array.dtype.itemsize * math.prod(sizes) for sizes in (array.shape, array.chunks))
    if max(claimed, chunk) > max(stored, 1) * MOST_RATIO:
        raise SceneError(
            f"{folder} claims {array.shape} of {array.dtype} in chunks of {array.chunks}, and {stored} bytes lie on "
            "the disk; copy it again"
        )


def check_packing(array: zarr.Array[Any], path: Path, name: str) -> None:
    """Refuse an array with chunks that would unpack to more than they may (SceneError)."""
    folder = path / name
    about = next(file for file in (folder / "zarr.json", folder / ".zarray") if file.is_file())
    check_chunks(folder, _read_json(about), array.chunks, array.dtype.itemsize)


def check_blocks(array: zarr.Array[Any], path: Path, parts: Sequence[int]) -> None:
    """Refuse an array of which ``parts`` of each axis, in whole chunks, do not fit the memory (SceneError)."""
    numbers = 1
    for size, chunk, part in zip(array.shape, array.chunks, parts, strict=True):
        numbers *= min(-(-part // chunk) + 1, -(-size // chunk)) * chunk
    check_memory(path, numbers * array.dtype.itemsize)


def open_options(path: Path) -> dict[str, Any]:
    """Options to open a store with: groups are read from their members, whose metadata alone were judged."""
    is_group = (path / ".zgroup").is_file() or (
        (path / "zarr.json").is_file() and _read_json(path / "zarr.json").get("node_type") == "group"
    )
    return {"use_consolidated": False} if is_group else {}
