"""Stored mosaics: tiles, spectra in row blocks, captures and downsampled brightness."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from spectralzoom.storage.arrays.georeference import AngularGrid
from spectralzoom.storage.arrays.mosaics import MosaicWriter, open_mosaic
from tests.storage.plain_mosaic import plain_writer, write_values

Stored = tuple[Path, NDArray[np.float32]]
SHAPE = (100, 1300)
NM = np.linspace(400, 1000, 17)


def writer(path: Path) -> MosaicWriter:
    """Return an empty mosaic of two bands, two shards down and three across."""
    return plain_writer(path, SHAPE, np.array([500.0, 600.0]))


def test_tiles_and_rows_store_the_same(tmp_path: Path) -> None:
    """Tiles in reverse order read the same as rows; tiles that were never written are NaN."""
    rng = np.random.default_rng(3)
    values = rng.normal(size=(*SHAPE, 2)).astype(np.float32)
    coverage = rng.integers(0, 3, SHAPE)
    rows, tiles = writer(tmp_path / "rows.zarr"), writer(tmp_path / "tiles.zarr")
    rows.write_rows(0, values, coverage)
    assert tiles.tile_shape == (64, 640)
    assert np.isnan(open_mosaic(tmp_path / "tiles.zarr").values()).all()
    for y, x in [(64, 1280), (64, 640), (64, 0), (0, 1280), (0, 640), (0, 0)]:
        part = slice(y, y + 64), slice(x, x + 640)
        tiles.write_tile(y, x, values[part], coverage[part])
    one, other = (open_mosaic(tmp_path / name) for name in ("rows.zarr", "tiles.zarr"))
    np.testing.assert_array_equal(one.values(), other.values())
    np.testing.assert_array_equal(other.coverage(), coverage)
    np.testing.assert_allclose(other.values()[coverage > 0], values[coverage > 0], atol=2**-13)
    assert np.isnan(other.values()[coverage == 0]).all()


def test_pixels_keep_their_capture_among_hundreds_of_sweeps(tmp_path: Path) -> None:
    """Sweeps of equal exposure and line spacing are one kind; 300 kinds, more than a byte holds, are kept."""
    first, later = (0.1, 4.0), (0.5, 1.0)
    number = np.tile(np.arange(SHAPE[1]) % 300, (SHAPE[0], 1))
    writer(tmp_path / "mosaic.zarr").write_captures([first] * 16 + [later] * 284, number)
    found = open_mosaic(tmp_path / "mosaic.zarr").captures()
    assert found[0] == [first, later]
    np.testing.assert_array_equal(found[1], number >= 16)
    writer(tmp_path / "many.zarr").write_captures([(1 + sweep, 1.0) for sweep in range(300)], number)
    np.testing.assert_array_equal(open_mosaic(tmp_path / "many.zarr").captures()[1], number)


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Stored:
    """Return the path and values of a stored mosaic of 150 x 90 px, a part of it not captured."""
    path = tmp_path_factory.mktemp("mosaic") / "mosaic.zarr"
    values = np.random.default_rng(0).random((150, 90, len(NM)), np.float32)
    values[:19, :29] = np.nan
    return path, write_values(path, values, NM, AngularGrid(1e-4, (150, 90)))


@pytest.mark.parametrize(
    ("rows", "columns", "heights"),
    [(*np.s_[:, :], [64, 64, 22]), (*np.s_[10:130, 5:60], [54, 64, 2]), (*np.s_[70:71, :1], [1])],
)
def test_row_blocks_cover_the_window(stored: Stored, rows: slice, columns: slice, heights: list[int]) -> None:
    """Blocks end at shard boundaries; together they equal the stored values of the window."""
    mosaic = open_mosaic(stored[0])
    strips = [mosaic.spectra(strip) for strip in mosaic.row_blocks(rows, columns)]
    assert [len(strip) for strip in strips] == heights
    np.testing.assert_array_equal(np.concatenate(strips), stored[1][rows, columns])


def test_brightness_is_the_mean_over_bands(stored: Stored) -> None:
    """It is NaN where a pixel was not captured."""
    np.testing.assert_allclose(open_mosaic(stored[0]).brightness(), stored[1].mean(axis=-1), atol=1e-5)


def test_an_opened_mosaic_is_cached_until_it_is_replaced(tmp_path: Path) -> None:
    """A store that was removed and made again is another one at the same path."""
    path = tmp_path / "mosaic.zarr"
    writer(path)
    first = open_mosaic(path)
    assert open_mosaic(path) is first
    path.rename(tmp_path / "old.zarr")
    plain_writer(path, SHAPE, np.array([500.0, 700.0]))
    assert open_mosaic(path).wavelength_nm.tolist() == [500.0, 700.0]
