"""The stored mosaic: rows and tiles of whole shards, rounding, refusals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipeline.errors import ChunkError, ShapeError
from storage.arrays.layout import round_bits
from storage.arrays.mosaics import MosaicWriter, load_mosaic

SHAPE = (100, 1300)


def writer(path: Path) -> MosaicWriter:
    """An empty mosaic of two bands, two shards down and three across."""
    return MosaicWriter(path, SHAPE, np.array([500.0, 600.0]))


def image() -> tuple[np.ndarray, np.ndarray]:
    """Values with some NaN, and coverage."""
    rng = np.random.default_rng(3)
    values = rng.normal(size=(*SHAPE, 2)).astype(np.float32)
    values[rng.random(SHAPE) < 0.1] = np.nan
    return values, rng.integers(0, 3, SHAPE)


def test_tiles_and_rows_store_the_same(tmp_path: Path) -> None:
    """Written in tiles, last ones first, or in rows, a mosaic reads back the same, rounded to 11 bits."""
    values, coverage = image()
    rows, tiles = writer(tmp_path / "rows.zarr"), writer(tmp_path / "tiles.zarr")
    for first in (0, 64):
        rows.write_rows(first, values[first : first + 64], coverage[first : first + 64])
    assert tiles.tile_shape == (64, 640)
    for y, x in [(64, 1280), (64, 640), (64, 0), (0, 1280), (0, 640), (0, 0)]:
        part = slice(y, y + 64), slice(x, x + 640)
        tiles.write_tile(y, x, values[part], coverage[part])
    for path in ("rows.zarr", "tiles.zarr"):
        stored = load_mosaic(tmp_path / path)
        np.testing.assert_array_equal(stored.values, round_bits(values))
        np.testing.assert_array_equal(stored.coverage, coverage)


def test_a_tile_that_was_not_written_is_empty(tmp_path: Path) -> None:
    """Shards that never came read as NaN."""
    values, coverage = image()
    writer(tmp_path / "m.zarr").write_tile(0, 640, values[:64, 640:1280], coverage[:64, 640:1280])
    stored = load_mosaic(tmp_path / "m.zarr")
    assert np.isnan(stored.values[64:]).all()
    np.testing.assert_array_equal(stored.values[:64, 640:1280], round_bits(values[:64, 640:1280]))


@pytest.mark.parametrize(
    ("at", "size", "words"),
    [
        ((32, 0), (32, 640), "rows 32:64 split the mosaic's shards of 64 rows"),
        ((0, 0), (64, 600), "columns 0:600 split the mosaic's shards of 640 columns"),
        ((0, 640), (63, 640), "rows 0:63 split"),
    ],
)
def test_a_tile_that_splits_shards_is_refused(
    tmp_path: Path, at: tuple[int, int], size: tuple[int, int], words: str
) -> None:
    """Two writers of one shard would lose each other's part, so only whole ones are taken."""
    with pytest.raises(ChunkError, match=words):
        writer(tmp_path / "m.zarr").write_tile(*at, np.zeros((*size, 2), np.float32), np.zeros(size))


def test_a_tile_that_does_not_fit_is_refused(tmp_path: Path) -> None:
    """Beyond the mosaic, with other bands, or with a coverage of another shape."""
    mosaic = writer(tmp_path / "m.zarr")
    for at, shape, coverage in (
        ((64, 0), (64, 640, 2), (64, 640)),
        ((0, 0), (64, 640, 3), (64, 640)),
        ((0, 0), (64, 640, 2), (64, 639)),
    ):
        with pytest.raises(ShapeError, match="the mosaic is"):
            mosaic.write_tile(*at, np.zeros(shape, np.float32), np.zeros(coverage))
