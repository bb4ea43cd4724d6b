"""Pixels that are taken out of stored images."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from storage.arrays.layout import blank_coarse, blank_pixels
from storage.arrays.mosaics import nothing_seen, open_mosaic
from tests.storage.plain_mosaic import write_values


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
    where = rng.random(shape) < 0.1
    path = tmp_path / "m.zarr"
    before = write_values(path, rng.random((*shape, 2)), np.array([500.0, 600.0]))
    blank_pixels(path, where, nothing_seen(path))
    after = open_mosaic(path)
    np.testing.assert_array_equal(after.values(), np.where(where[..., None], np.float32(np.nan), before))
    np.testing.assert_array_equal(after.coverage(), np.where(where, 0, 1))
