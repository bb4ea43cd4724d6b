"""Parts of stored mosaics and patches: what is read some at a time is what is stored."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipeline.errors import IncompleteStoreError
from storage.arrays.mosaics import (
    MosaicWriter,
    PatchWriter,
    load_mosaic,
    mosaic_brightness,
    mosaic_strips,
    mosaic_wavelengths,
    open_patches,
)

NM = np.linspace(400, 1000, 17)


@pytest.fixture(scope="module")
def mosaic(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A stored mosaic of 150 x 90 px, a part of it not seen."""
    path = tmp_path_factory.mktemp("mosaic") / "mosaic.zarr"
    values = np.random.default_rng(0).random((150, 90, len(NM)), np.float32)
    values[:20, :30] = np.nan
    MosaicWriter(path, (150, 90), NM).write_rows(0, values, np.ones((150, 90), np.float32))
    return path


@pytest.mark.parametrize(
    ("rows", "columns", "heights"),
    [
        (slice(None), slice(None), [64, 64, 22]),
        (slice(10, 130), slice(5, 60), [54, 64, 2]),
        (slice(70, 71), slice(0, 1), [1]),
    ],
)
def test_strips_make_the_window(mosaic: Path, rows: slice, columns: slice, heights: list[int]) -> None:
    """They end where shards do, and together are what is stored there."""
    strips = list(mosaic_strips(mosaic, rows, columns))
    assert [len(strip) for strip in strips] == heights
    np.testing.assert_array_equal(np.concatenate(strips), load_mosaic(mosaic).values[rows, columns])


def test_brightness_is_the_mean_over_bands(mosaic: Path) -> None:
    """To the last bit that of the mosaic in memory; NaN where nothing was seen."""
    np.testing.assert_array_equal(mosaic_brightness(mosaic), load_mosaic(mosaic).values.mean(axis=-1))
    assert (mosaic_wavelengths(mosaic) == NM).all()


def test_a_mosaic_that_is_not_there_is_told(tmp_path: Path) -> None:
    """Reading begins when the first strip is asked for, and says what is missing."""
    with pytest.raises(IncompleteStoreError, match="no readable Zarr store"):
        next(mosaic_strips(tmp_path / "none.zarr"))


@pytest.mark.parametrize("entries", [[], [0], [3, 4, 5], [0, 2, 3, 9], list(range(10))])
def test_patches_are_picked_by_their_numbers(tmp_path: Path, entries: list[int]) -> None:
    """Runs and single ones come in the order asked for."""
    values = np.random.default_rng(1).random((10, 4, 4, 2)).astype(np.float16).astype(np.float32)
    writer = PatchWriter(tmp_path / "p.zarr", np.arange(10), np.zeros((10, 2), int), 4, NM[:2])
    writer.write(0, values, np.ones((10, 4, 4), np.bool_))
    store = open_patches(tmp_path / "p.zarr")
    np.testing.assert_allclose(store.pick(np.array(entries, np.int64)), values[entries], rtol=3e-4)
    assert (store.wavelength_nm == NM[:2]).all()
