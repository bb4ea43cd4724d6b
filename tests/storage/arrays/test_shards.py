"""Shards that are packed here are those that zarr would have written."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from pipeline.errors import ChunkError
from storage.arrays.layout import RAW_LEVEL, ArraySpec, create_array, create_group, image_spec
from storage.arrays.shards import ShardWriter

Kept = dict[str, bytes]


def _array(path: Path, spec: ArraySpec) -> zarr.Array[Any]:
    return create_array(create_group(path, "test", {}), "dn", spec, {}, level=RAW_LEVEL)


def _written(path: Path, spec: ArraySpec, values: NDArray[np.uint16]) -> zarr.Array[Any]:
    """An array whose shards are written here, from the last to the first."""
    array = _array(path, spec)
    assert array.shards is not None
    writer = ShardWriter(array, RAW_LEVEL)
    for first in reversed(range(0, spec.shape[0], array.shards[0])):
        writer.write(first, values[first : first + array.shards[0]])
    writer.close()
    return array


def _files(path: Path) -> Kept:
    return {f"{one.relative_to(path)}": one.read_bytes() for one in sorted(path.glob("dn/c/**/*")) if one.is_file()}


def _chunks(shard: bytes, count: int) -> list[bytes]:
    """What the index of a shard says that its chunks are, in order."""
    index = np.frombuffer(shard[-(16 * count + 4) : -4], "<u8").reshape(count, 2).tolist()
    return [shard[begin : begin + size] if begin != 2**64 - 1 else b"" for begin, size in index]


@given(rows=st.integers(1, 150), columns=st.integers(1, 90), bands=st.integers(1, 9), seed=st.integers(0, 99))
def test_chunks_are_zarrs(
    tmp_path_factory: pytest.TempPathFactory, rows: int, columns: int, bands: int, seed: int
) -> None:
    """Zarr reads the same numbers; there are the same files, and every chunk in them has the same bytes."""
    folder, rng = tmp_path_factory.mktemp("shards"), np.random.default_rng(seed)
    values = rng.integers(0, 4096, (rows, columns, bands), np.uint16)
    values[rng.integers(rows) :, rng.integers(columns) :] = 0  # chunks of nothing, where they are whole ones
    spec = image_spec(("line", "sample", "band"), values.shape, "<u2")
    ours = _written(folder / "ours.zarr", spec, values)
    _array(folder / "zarr.zarr", spec)[...] = values
    np.testing.assert_array_equal(ours[...], values)
    found, wanted = _files(folder / "ours.zarr"), _files(folder / "zarr.zarr")
    assert found.keys() == wanted.keys()
    assert ours.shards is not None
    count = int(np.prod(np.array(ours.shards) // np.array(ours.chunks)))
    for name, content in found.items():
        assert _chunks(content, count) == _chunks(wanted[name], count), name
        assert len(content) == len(wanted[name])


def test_several_shards_beside_each_other(tmp_path: Path) -> None:
    """An array that is wider and deeper than a shard comes back."""
    values = np.random.default_rng(0).integers(0, 9, (10, 11, 7), np.uint16)
    spec = ArraySpec(("line", "sample", "band"), values.shape, "<u2", (2, 3, 2), (4, 6, 4))
    np.testing.assert_array_equal(_written(tmp_path / "a.zarr", spec, values)[...], values)


@pytest.mark.parametrize("place", [0, 40, -2, -10])
def test_a_flipped_bit_is_an_error(tmp_path: Path, place: int) -> None:
    """In a chunk, its checksum or the index: zarr refuses to read."""
    values = np.random.default_rng(1).integers(0, 9, (8, 8, 3), np.uint16)
    array = _written(tmp_path / "a.zarr", image_spec(("line", "sample", "band"), values.shape, "<u2"), values)
    (file,) = (one for one in tmp_path.glob("a.zarr/dn/c/**/*") if one.is_file())
    content = bytearray(file.read_bytes())
    content[place] ^= 1
    file.write_bytes(content)
    with pytest.raises((ValueError, RuntimeError)):
        array[...]


def test_rows_that_split_a_shard_are_refused(tmp_path: Path) -> None:
    """A shard is written once: neither from its middle on nor in part."""
    array = _array(tmp_path / "a.zarr", image_spec(("line", "sample", "band"), (130, 4, 2), "<u2"))
    writer = ShardWriter(array, RAW_LEVEL)
    for first, count in ((32, 64), (0, 32), (128, 3)):
        with pytest.raises(ChunkError, match="shards of 64 rows"):
            writer.write(first, np.ones((count, 4, 2), np.uint16))
    writer.close()
