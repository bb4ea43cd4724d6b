"""What packed chunks say of their unpacked size, judged before one is unpacked: codecs take the memory that they say.

Chunks of blosc and zstd say their size at their beginning, and are looked at in files and in shards whose index is
plain. gzip and zlib are bounded by their own ratio. bz2 and lzma say nothing and are bounded by nothing.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

from pipeline.errors import SceneError
from storage.readers.declared_sizes import DEFLATE_RATIO, check_memory

LOOK = 18  # bytes: the longest beginning
CHECKSUMS = {"crc32", "crc32c", "adler32", "fletcher32", "jenkins_lookup3"}
SLACK = 64  # bytes that filters and checksums add to a chunk
_ZSTD = b"\x28\xb5\x2f\xfd"
_NOWHERE = (1 << 64) - 1  # in a shard's index: there is no such chunk


def check_chunks(folder: Path, about: Mapping[str, Any], shape: Sequence[int], width: int) -> None:
    """Refuse an array with a chunk that would unpack to more than a chunk's numbers (SceneError).

    Parameters
    ----------
    about
        The array's metadata, of version 2 or 3.
    shape
        Of one chunk; within shards of one of theirs.
    width
        Bytes a number.
    """
    allowed = math.prod(shape) * width + SLACK
    codecs = _codecs(about)
    sharding = next((codec for codec in codecs if _name(codec) == "sharding_indexed"), None)
    inner = codecs if sharding is None else sharding.get("configuration", {}).get("codecs", [])
    packer = next((_name(codec) for codec in reversed(inner) if _name(codec) not in CHECKSUMS), "")
    for file in sorted(folder.rglob("*")):
        if file.name in ("zarr.json", ".zarray", ".zattrs", ".zgroup", ".zmetadata") or not file.is_file():
            continue
        if packer in ("gzip", "zlib") and sharding is None:
            check_memory(file, file.stat().st_size * DEFLATE_RATIO)
        elif packer in ("blosc", "zstd"):
            with file.open("rb") as stream:
                for place in [0] if sharding is None else _places(stream, sharding, about, shape):
                    stream.seek(place)
                    _check(file, _unpacked_size(stream.read(LOOK), packer), allowed)


def _codecs(about: Mapping[str, Any]) -> list[Any]:
    if "codecs" in about:
        return list(about["codecs"] or [])
    return [*(about.get("filters") or []), *([about["compressor"]] if about.get("compressor") else [])]


def _name(codec: object) -> str:
    found = codec.get("name", codec.get("id", "")) if isinstance(codec, Mapping) else codec
    return str(found).lower().removeprefix("numcodecs.")


def _check(file: Path, said: int | None, allowed: int) -> None:
    if said is not None and said > allowed:
        raise SceneError(f"{file} would unpack to {said} bytes, a chunk has {allowed - SLACK}; it is damaged")


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
    names = [_name(codec) for codec in setting.get("index_codecs", [])]
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
