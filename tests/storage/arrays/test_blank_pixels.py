"""Pixels that are taken out of stored images."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from storage.arrays.layout import blank_pixels
from storage.arrays.mosaics import nothing_seen, open_mosaic
from tests.storage.plain_mosaic import write_values


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
