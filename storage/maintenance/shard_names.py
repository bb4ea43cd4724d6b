"""Which part of an array a file of a store holds, in words, and which chunks of it can no longer be read."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zarr
from numcodecs.errors import UnknownCodecError  # type: ignore[import-untyped]

from storage.archive.plain_files import kind_of, read_plain

WORDS = {"y": "rows", "x": "columns", "line": "lines", "sample": "samples", "band": "bands", "patch": "patches"}
MOST_NAMED = 3
_NO_ARRAY = (OSError, ValueError, KeyError, TypeError, IndexError, RecursionError)


@dataclass(frozen=True)
class Shard:
    """One file of a Zarr v3 array: the array, and the indices that the file holds."""

    array: Path
    dims: tuple[str, ...]
    shape: tuple[int, ...]
    box: tuple[slice, ...]  # of the file
    chunk: tuple[int, ...]  # what has a checksum of its own

    def words(self, box: Sequence[slice]) -> str:
        """Index ranges of a part of the array; a dimension of which it has everything is left out."""
        ranges = [
            f"{WORDS.get(dim, dim)} {part.start} to {part.stop - 1}"
            for dim, size, part in zip(self.dims, self.shape, box, strict=True)
            if part.stop - part.start < size
        ]
        return ", ".join(ranges) or "all of it"

    def chunks(self) -> list[tuple[slice, ...]]:
        """What the file is made of, cut to the array."""
        steps = [
            [slice(start, min(start + step, part.stop)) for start in range(part.start, part.stop, step)]
            for part, step in zip(self.box, self.chunk, strict=True)
        ]
        return list(itertools.product(*steps))

    def unreadable(self) -> list[tuple[slice, ...]]:
        """Chunks that fail their checksum or cannot be decoded; all of them where the file's index is damaged."""
        array: zarr.Array[Any] = zarr.open_array(self.array, mode="r", zarr_format=3)
        return [box for box in self.chunks() if not _can_be_read(array, box)]


def name_damage(store: Path, name: str) -> str:
    """What is known of a broken file of a store, in words to follow its name; empty where it belongs to no array.

    For example ``(values: rows 0 to 63, columns 0 to 639; unreadable: rows 32 to 63, columns 0 to 31)``.
    """
    if any(path.is_symlink() for path in (store / name).parents if path.is_relative_to(store)):
        return ""
    try:
        shard = find_shard(store, name)
        if shard is None:
            return ""
        where = f"{shard.array.relative_to(store).as_posix()}: {shard.words(shard.box)}"
        return f" ({where}{_damage_words(shard) if kind_of(store / name) == 'a file' else ''})"
    except _NO_ARRAY:
        return ""


def _damage_words(shard: Shard) -> str:
    broken, count = shard.unreadable(), len(shard.chunks())
    if count == 1:
        return ""
    if not broken:
        return "; every chunk of it can still be read"
    if len(broken) == count:
        return "; none of its chunks can be read"
    named = "; ".join(shard.words(box) for box in broken[:MOST_NAMED])
    more = f" and {len(broken) - MOST_NAMED} more" if len(broken) > MOST_NAMED else ""
    return f"; unreadable: {named}{more}"


def find_shard(store: Path, name: str) -> Shard | None:
    """The part of an array that ``name``, a file of a store, holds; None where it is no array's file.

    Raises
    ------
    OSError, ValueError, KeyError, TypeError, IndexError : the array's own description is damaged.
    """
    file = store / name
    for array in file.parents:
        if array == store or not array.is_relative_to(store):
            return None
        if kind_of(array / "zarr.json") == "a file":
            break
    about = json.loads(read_plain(array / "zarr.json"))
    if about.get("node_type") != "array" or file == array / "zarr.json":
        return None
    shape = tuple(int(size) for size in about["shape"])
    sizes = [int(size) for size in about["chunk_grid"]["configuration"]["chunk_shape"]]
    numbers = _chunk_numbers(file.relative_to(array).as_posix(), len(shape))
    box = tuple(
        slice(number * size, min((number + 1) * size, whole))
        for number, size, whole in zip(numbers, sizes, shape, strict=True)
    )
    dims = tuple(about.get("dimension_names") or (f"axis {axis}" for axis in range(len(shape))))
    return Shard(array, dims, shape, box, _inner_chunk(about, sizes))


def _chunk_numbers(name: str, dims: int) -> list[int]:
    """Of ``c/0/3/0`` (or ``c.0.3.0``) the numbers."""
    words = name.replace(".", "/").split("/")
    if words[0] != "c" or len(words) != dims + 1:
        raise ValueError(f"{name} is no chunk of {dims} dimensions")
    return [int(word) for word in words[1:]]


def _inner_chunk(about: dict[str, Any], sizes: list[int]) -> tuple[int, ...]:
    for codec in about["codecs"]:
        if codec["name"] == "sharding_indexed":
            sizes = [int(size) for size in codec["configuration"]["chunk_shape"]]
    if not all(size > 0 for size in sizes):
        raise ValueError(f"chunks of {sizes}")
    return tuple(sizes)


def _can_be_read(array: zarr.Array[Any], box: tuple[slice, ...]) -> bool:
    """Whether one chunk decodes. Whatever a decoder says of damaged bytes, the answer is no (no codec: it raises)."""
    if math.prod(part.stop - part.start for part in box) <= 0:
        return True
    try:
        array[box]
    except UnknownCodecError:
        raise
    except Exception:
        return False
    return True
