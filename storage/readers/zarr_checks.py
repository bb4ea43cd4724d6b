"""What a Zarr store says of itself, judged before it is opened, and before any of it is unpacked.

Codecs only carry numbers, and sizes fit what lies on the disk. A codec of another name (``pickle`` is one) is refused,
so that reading data never runs what it brings.

Codecs take the memory that a chunk says it unpacks to: that is judged before one is unpacked. Chunks of blosc and zstd
say it at their beginning, and are looked at in files and in shards whose index is plain. gzip and zlib are bounded by
their own ratio. bz2 and lzma say nothing and are bounded by nothing.
"""

from __future__ import annotations

import json
import math
import os
import struct
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import zarr

from pipeline.errors import SceneError
from storage.readers.cube_sources import DEFLATE_RATIO, MOST_RATIO, check_memory

LARGEST_METADATA = 1 << 24  # bytes
LOOK = 18  # bytes: the longest beginning of a chunk
SLACK = 64  # bytes that filters and checksums add to a chunk
CHECKSUMS = {"crc32", "crc32c", "adler32", "fletcher32", "jenkins_lookup3"}
_PACKERS = {"blosc", "zstd", "gzip", "zlib", "bz2", "lzma", "lz4", "pcodec", "zfpy", "packbits"}
_ORDERS = {"bytes", "transpose", "sharding_indexed", "shuffle"}
_NUMBERS = {"delta", "fixedscaleoffset", "quantize", "bitround", "astype", "cast_value", "scale_offset"}
CODECS = CHECKSUMS | _PACKERS | _ORDERS | _NUMBERS
_ZSTD = b"\x28\xb5\x2f\xfd"
_NOWHERE = (1 << 64) - 1  # in a shard's index: there is no such chunk


def check_store(path: Path) -> None:
    """Refuse a store before it is opened (SceneError).

    Where a link leads out of it, one of its entries is neither file nor folder, its metadata are too large or no table,
    or a codec does not just carry numbers.
    """
    _check_links(path)
    _check_metadata(path)


def open_options(path: Path) -> dict[str, Any]:
    """Options to open a store with: groups are read from their members, whose metadata alone were judged."""
    is_group = (path / ".zgroup").is_file() or (
        (path / "zarr.json").is_file() and _read_json(path / "zarr.json").get("node_type") == "group"
    )
    return {"use_consolidated": False} if is_group else {}


def check_array(array: zarr.Array[Any], path: Path, name: str) -> None:
    """Refuse an array before any of it is unpacked (SceneError).

    Where it claims more than its bytes can mean, or a chunk says that it unpacks to more than a chunk's numbers, or, of
    gzip and zlib, may unpack to more than the memory.
    """
    _check_size(array, path, name)
    _check_packing(array, path, name)


def check_blocks(array: zarr.Array[Any], path: Path, parts: Sequence[int]) -> None:
    """Refuse an array of which ``parts`` of each axis, in whole chunks, do not fit the memory (SceneError)."""
    numbers = 1
    for size, chunk, part in zip(array.shape, array.chunks, parts, strict=True):
        numbers *= min(-(-part // chunk) + 1, -(-size // chunk)) * chunk
    check_memory(path, numbers * array.dtype.itemsize)


def _check_links(path: Path) -> None:
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


def _check_metadata(path: Path) -> None:
    """Refuse codecs that do not just carry numbers, in the store and its members (SceneError)."""
    for folder in (path, *(entry for entry in sorted(path.iterdir()) if entry.is_dir())):
        for file in (folder / "zarr.json", folder / ".zarray"):
            for codec in _codecs(_read_json(file)) if file.is_file() else ():
                if codec.lower().removeprefix("numcodecs.") not in CODECS:
                    raise SceneError(
                        f"{file} asks for the codec {codec!r}, which is not read; store plain numbers with blosc, zstd "
                        "or gzip"
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


def _check_size(array: zarr.Array[Any], path: Path, name: str) -> None:
    """Refuse an array that claims more than its bytes can mean, before any of it is asked for (SceneError)."""
    folder = path / name
    stored = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    claimed, chunk = (array.dtype.itemsize * math.prod(sizes) for sizes in (array.shape, array.chunks))
    if max(claimed, chunk) > max(stored, 1) * MOST_RATIO:
        raise SceneError(
            f"{folder} claims {array.shape} of {array.dtype} in chunks of {array.chunks}, and {stored} bytes lie on "
            "the disk; copy it again"
        )


def _check_packing(array: zarr.Array[Any], path: Path, name: str) -> None:
    """Refuse an array with a chunk that would unpack to more than a chunk's numbers (SceneError)."""
    folder, shape = path / name, array.chunks
    about = _read_json(next(file for file in (folder / "zarr.json", folder / ".zarray") if file.is_file()))
    allowed = math.prod(shape) * array.dtype.itemsize + SLACK
    of_v2 = [codec for codec in (*(about.get("filters") or []), about.get("compressor")) if codec]
    codecs = about["codecs"] or [] if "codecs" in about else of_v2
    sharding = next((codec for codec in codecs if _codec_name(codec) == "sharding_indexed"), None)
    inner = codecs if sharding is None else sharding.get("configuration", {}).get("codecs", [])
    packer = next((_codec_name(codec) for codec in reversed(inner) if _codec_name(codec) not in CHECKSUMS), "")
    for file in sorted(folder.rglob("*")):
        if file.name in ("zarr.json", ".zarray", ".zattrs", ".zgroup", ".zmetadata") or not file.is_file():
            continue
        if packer in ("gzip", "zlib") and sharding is None:
            check_memory(file, file.stat().st_size * DEFLATE_RATIO)
        elif packer in ("blosc", "zstd"):
            with file.open("rb") as stream:
                for place in [0] if sharding is None else _places(stream, sharding, about, shape):
                    stream.seek(place)
                    said = _unpacked_size(stream.read(LOOK), packer)
                    if said is not None and said > allowed:
                        raise SceneError(
                            f"{file} would unpack to {said} bytes, a chunk has {allowed - SLACK}; it is damaged"
                        )


def _codec_name(codec: object) -> str:
    found = codec.get("name", codec.get("id", "")) if isinstance(codec, Mapping) else codec
    return str(found).lower().removeprefix("numcodecs.")


def _unpacked_size(head: bytes, packer: str) -> int | None:
    """Bytes that a chunk says it unpacks to; None where it says nothing."""
    if packer == "blosc":
        return int(struct.unpack("<I", head[4:8])[0]) if len(head) >= 8 else None
    if len(head) < 6 or head[:4] != _ZSTD:
        return None
    flags = head[4]
    single = bool(flags & 0x20)
    width = (1 if single else 0, 2, 4, 8)[flags >> 6]
    start = 5 + (not single) + (0, 1, 2, 4)[flags & 3]
    if width == 0 or len(head) < start + width:
        return None
    return int.from_bytes(head[start : start + width], "little") + (256 if width == 2 else 0)


def _places(
    stream: BinaryIO, sharding: Mapping[str, Any], about: Mapping[str, Any], shape: Sequence[int]
) -> Iterator[int]:
    """Where the chunks of a shard begin, by its index; none where that is packed itself."""
    setting = sharding.get("configuration", {})
    names = [_codec_name(codec) for codec in setting.get("index_codecs", [])]
    if names not in (["bytes"], ["bytes", "crc32c"]) or setting.get("index_location", "end") != "end":
        return
    outer = about["chunk_grid"]["configuration"]["chunk_shape"]
    count = math.prod(large // small for large, small in zip(outer, shape, strict=True))
    end = stream.seek(0, 2)
    begin = end - 16 * count - (4 if "crc32c" in names else 0)
    if begin < 0:
        raise SceneError(f"{stream.name} is shorter than its index; it is cut off")
    stream.seek(begin)
    index = stream.read(16 * count)
    for offset, _ in struct.iter_unpack("<QQ", index):
        if offset != _NOWHERE and offset < end:
            yield offset
