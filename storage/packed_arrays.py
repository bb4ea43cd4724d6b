"""One raw array in the archive tier: whether it is there, how it gets there, and what its numbers are.

Attributes, chunks and shards stay; only the codec differs. Every block is read back from the disk and compared.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

from pipeline.errors import ArchiveError
from storage.archive_codec import PCODEC_NAME
from storage.arrays.layout import SHARD_ROWS, ArraySpec, create_array, damage_named, open_group, read_array

RAW_ARRAYS = ("dn", "values")  # of a captured sweep, of an ingested cube


def raw_array(cube: Path) -> zarr.Array[Any] | None:
    """The raw numbers of a stored cube, not yet read; None where it is no raw cube.

    Raises
    ------
    IncompleteStoreError : its description is damaged.
    """
    group = open_group(cube)
    with damage_named(str(cube)):
        name = next((name for name in RAW_ARRAYS if name in group), None)
        found = None if name is None else group[name]
        return found if isinstance(found, zarr.Array) else None


def is_packed(array: zarr.Array[Any]) -> bool:
    """Whether an array's numbers go through the archive tier's codec."""
    return PCODEC_NAME in json.dumps(array.metadata.to_dict(), default=str)


def pack_array(cube: Path, to: Path, report: Callable[[float], None] = lambda done: None) -> str:
    """Write the raw numbers of ``cube`` into the archive tier of the group at ``to``, 64 lines at a time.

    Returns
    -------
    `values_hash` of the numbers read and of those read back.

    Raises
    ------
    IncompleteStoreError : the cube is damaged.
    ArchiveError : what was written does not read back as it was.
    """
    old = raw_array(cube)
    assert old is not None
    name, dims = old.basename, getattr(old.metadata, "dimension_names", None) or ("line", "sample", "band")
    spec = ArraySpec(tuple(dims), old.shape, old.dtype.str, old.chunks, old.shards)
    group = zarr.open_group(to, mode="r+", zarr_format=3, use_consolidated=False)
    new = create_array(group, name, spec, old.attrs.asdict(), tier="archive")
    digest = _digest(old)
    for start, block in _blocks(cube, old):
        new[start : start + len(block)] = block
        back = np.asarray(new[start : start + len(block)])
        if not np.array_equal(back, block):
            raise ArchiveError(
                f"{to / name}: lines {start} to {start + len(block) - 1} do not read back as they were written; "
                "nothing was changed; check the disk and the installation of pcodec"
            )
        digest.update(np.ascontiguousarray(block).data)
        report((start + len(block)) / old.shape[0])
    return digest.hexdigest()


def values_hash(cube: Path) -> str:
    """SHA-256 of the type, shape and decoded numbers of a raw cube, whatever its codec and chunks.

    Raises
    ------
    IncompleteStoreError : it cannot be read.
    """
    array = raw_array(cube)
    if array is None:
        return ""
    digest = _digest(array)
    for _, block in _blocks(cube, array):
        digest.update(np.ascontiguousarray(block).data)
    return digest.hexdigest()


def _digest(array: zarr.Array[Any]) -> hashlib._Hash:
    return hashlib.sha256(f"{array.dtype.str} {array.shape}".encode())


def _blocks(cube: Path, array: zarr.Array[Any]) -> Iterator[tuple[int, NDArray[Any]]]:
    """Whole shards from side to side with the number of their first line, in order."""
    group, step = open_group(cube), (array.shards or (SHARD_ROWS,))[0]
    for start in range(0, array.shape[0], step):
        yield start, read_array(group, array.basename, slice(start, min(start + step, array.shape[0])))
