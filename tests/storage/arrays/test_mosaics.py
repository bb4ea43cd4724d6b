"""The stored mosaic: rows and tiles of whole shards, rounding, refusals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from pipeline.errors import ChunkError, IncompleteStoreError, ShapeError
from storage.arrays.layout import round_bits
from storage.arrays.mosaics import (
    MosaicWriter,
    PatchWriter,
    load_mosaic,
    mosaic_brightness,
    mosaic_rows,
    mosaic_wavelengths,
    open_patches,
)

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
        rows.write_tile(first, 0, values[first : first + 64], coverage[first : first + 64])
    assert tiles.tile_shape == (64, 640)
    assert np.isnan(load_mosaic(tmp_path / "tiles.zarr").values).all()  # shards that never came
    for y, x in [(64, 1280), (64, 640), (64, 0), (0, 1280), (0, 640), (0, 0)]:
        part = slice(y, y + 64), slice(x, x + 640)
        tiles.write_tile(y, x, values[part], coverage[part])
    for path in ("rows.zarr", "tiles.zarr"):
        stored = load_mosaic(tmp_path / path)
        np.testing.assert_array_equal(stored.values, round_bits(values))
        np.testing.assert_array_equal(stored.coverage, coverage)


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


NM = np.linspace(400, 1000, 17)


@pytest.fixture(scope="module")
def mosaic(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A stored mosaic of 150 x 90 px, a part of it not seen."""
    path = tmp_path_factory.mktemp("mosaic") / "mosaic.zarr"
    values = np.random.default_rng(0).random((150, 90, len(NM)), np.float32)
    values[:20, :30] = np.nan
    MosaicWriter(path, (150, 90), NM).write_tile(0, 0, values, np.ones((150, 90), np.float32))
    return path


@pytest.mark.parametrize(
    ("rows", "columns", "heights"),
    [
        (slice(None), slice(None), [64, 64, 22]),
        (slice(10, 130), slice(5, 60), [54, 64, 2]),
        (slice(70, 71), slice(0, 1), [1]),
    ],
)
def test_swaths_make_the_window(mosaic: Path, rows: slice, columns: slice, heights: list[int]) -> None:
    """They end where shards do, and together are what is stored there."""
    swaths = list(mosaic_rows(mosaic, rows, columns))
    assert [len(strip) for strip in swaths] == heights
    np.testing.assert_array_equal(np.concatenate(swaths), load_mosaic(mosaic).values[rows, columns])


def test_brightness_is_the_mean_over_bands(mosaic: Path) -> None:
    """To the last bit that of the mosaic in memory; NaN where nothing was seen."""
    np.testing.assert_array_equal(mosaic_brightness(mosaic), load_mosaic(mosaic).values.mean(axis=-1))
    assert (mosaic_wavelengths(mosaic) == NM).all()
    with pytest.raises(IncompleteStoreError, match="no readable Zarr store"):
        next(mosaic_rows(mosaic / "none.zarr"))


@pytest.mark.parametrize("entries", [[], [0], [3, 4, 5], [0, 2, 3, 9], list(range(10))])
def test_patches_are_picked_by_their_numbers(tmp_path: Path, entries: list[int]) -> None:
    """Runs and single ones come in the order asked for."""
    values = np.random.default_rng(1).random((10, 4, 4, 2)).astype(np.float16).astype(np.float32)
    writer = PatchWriter(tmp_path / "p.zarr", np.arange(10), np.zeros((10, 2), int), 4, NM[:2])
    writer.write(values, np.ones((10, 4, 4), np.bool_))
    store = open_patches(tmp_path / "p.zarr")
    np.testing.assert_allclose(store.pick(np.array(entries, np.int64)), values[entries], rtol=3e-4)
    assert (store.wavelength_nm == NM[:2]).all()


FLOATS = hnp.arrays(np.float32, st.integers(1, 20), elements=st.floats(width=32))


@given(FLOATS)
@settings(max_examples=100, deadline=None)
def test_rounding_again_changes_nothing(values: NDArray[np.float32]) -> None:
    """round(round(x)) is round(x), NaN and infinities and signs included."""
    once = round_bits(values)
    np.testing.assert_array_equal(round_bits(once), once)
    np.testing.assert_array_equal(np.isnan(once), np.isnan(values))
    np.testing.assert_array_equal(np.isinf(once), np.isinf(values))


@given(hnp.arrays(np.float32, 16, elements=st.floats(2.0**-100, 2.0**100, width=32)))
@settings(max_examples=100, deadline=None)
def test_error_is_below_half_a_step(values: NDArray[np.float32]) -> None:
    """The relative error is at most 2^-12, and the last 12 bits of the mantissa are zero."""
    rounded = round_bits(values)
    assert (np.abs(rounded.astype(float) - values) <= 2.0**-12 * np.abs(values.astype(float))).all()
    assert not (rounded.view(np.uint32) & 0xFFF).any()


def test_halves_are_rounded_to_even() -> None:
    """1 + 2^-12 lies in the middle between two numbers of 11 bits, as 1 + 3 * 2^-12 does."""
    halves = np.array([1 + 2.0**-12, 1 + 3 * 2.0**-12, -1 - 2.0**-12], np.float32)
    assert round_bits(halves).tolist() == [1.0, 1 + 2.0**-10, -1.0]
