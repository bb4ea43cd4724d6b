"""Pixels that are taken out of stored images."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from storage.arrays.layout import NO_VALUE, blank_coarse, blank_pixels
from storage.arrays.mosaics import MosaicWriter, load_mosaic


@given(st.integers(1, 30), st.integers(1, 30), st.sampled_from([1, 2, 4]), st.integers(0, 2**32 - 1))
def test_a_coarse_pixel_is_blank_where_most_of_it_is(height: int, width: int, factor: int, seed: int) -> None:
    """Of the pixels that it has on the scene, more than half."""
    missing = np.random.default_rng(seed).random((height, width)) < 0.5
    found = blank_coarse(missing, factor)
    assert found.shape == (-(-height // factor), -(-width // factor))
    for y, x in np.ndindex(found.shape):
        block = missing[y * factor : (y + 1) * factor, x * factor : (x + 1) * factor]
        assert found[y, x] == (block.mean() > 0.5)


def test_only_the_pixels_that_are_named_lose_their_values(tmp_path: Path) -> None:
    """Across shards; values become NaN, coverage 0, and all others stay bit for bit."""
    shape, rng = (70, 650), np.random.default_rng(0)
    values, where = rng.random((*shape, 2)).astype(np.float32), rng.random(shape) < 0.1
    writer = MosaicWriter(tmp_path / "m.zarr", shape, np.array([500.0, 600.0]))
    for rows in (slice(0, 64), slice(64, 70)):
        writer.write_tile(rows.start, 0, values[rows], np.ones((rows.stop - rows.start, shape[1])))
    before = load_mosaic(tmp_path / "m.zarr").values
    blank_pixels(tmp_path / "m.zarr", where, NO_VALUE)
    after = load_mosaic(tmp_path / "m.zarr")
    np.testing.assert_array_equal(after.values, np.where(where[..., None], np.float32(np.nan), before))
    np.testing.assert_array_equal(after.coverage, np.where(where, 0, 1))
