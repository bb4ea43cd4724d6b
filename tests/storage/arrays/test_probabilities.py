"""Class probabilities of a field: packed in bytes, and read back by this project and by xarray."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st

from spectralzoom.models.reading.prior_map import FAINTEST as FAINTEST_BELIEVED
from spectralzoom.pipeline.errors import IncompleteStoreError
from spectralzoom.storage.arrays import class_maps

LEGEND = class_maps.ClassNames(("soil", "maize", "weed"), np.arange(9, dtype=np.uint8).reshape(3, 3))
SHAPE = (70, 50)


def drawn(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return log probabilities of three classes, ages and light: some are unknown, and some light is 0."""
    rng = np.random.default_rng(seed)
    logits = rng.normal(0, 2, (*SHAPE, 3))
    values = (logits - np.log(np.exp(logits).sum(axis=-1, keepdims=True))).astype(np.float32)
    ages = rng.uniform(0, 400, SHAPE).astype(np.float32)
    values[:3], ages[:3] = np.nan, np.nan
    return values, ages, np.where(rng.random(SHAPE) < 0.1, 0, 2 ** rng.uniform(-8, 4, SHAPE)).astype(np.float32)


def stored(path: Path, seed: int = 0) -> Path:
    """Store class probabilities of two tiles, and return their path."""
    values, ages, light = drawn(seed)
    class_maps.create_probabilities(path, SHAPE, LEGEND)
    packed = class_maps.packed_probabilities(values)
    for top, end in ((0, 64), (64, 70)):
        class_maps.write_probabilities_tile(path, (top, 0), packed[top:end], ages[top:end], light[top:end])
    return path


def test_hourly_visits_add_up_in_age_and_light(tmp_path: Path) -> None:
    """After 72 hourly visits a pixel is three days older, and its light has faded by 0.998 per visit."""
    values, age, light = drawn(0)
    age, light = np.zeros_like(age), np.ones_like(light)
    path = tmp_path / "visits.zarr"
    class_maps.create_probabilities(path, SHAPE, LEGEND)
    packed = class_maps.packed_probabilities(values)
    for _ in range(72):
        class_maps.write_probabilities_tile(path, (0, 0), packed, age + 1 / 24, light * np.float32(0.998))
        _, age, light = class_maps.ProbabilityStore(path).read()
    np.testing.assert_allclose(age, 3, atol=1e-3)
    np.testing.assert_allclose(light, 0.998**72, rtol=0.01)


@given(seed=st.integers(0, 2**16))
def test_probabilities_round_trip_within_their_step(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    """The likeliest class stays where it leads by a step; values stay within 1.5 steps; ages and light are kept."""
    path = stored(tmp_path_factory.mktemp("class_probabilities") / "class_probabilities.zarr", seed)
    values, ages, light = drawn(seed)
    found, days, shown = class_maps.ProbabilityStore(path).read()
    known = slice(3, None)
    assert np.isnan(found[:3]).all()
    assert np.isnan(days[:3]).all()
    np.testing.assert_allclose(days[known], ages[known], rtol=1e-6)
    np.testing.assert_allclose(shown, light)
    np.testing.assert_allclose(np.exp(found[known]).sum(axis=-1), 1, atol=1e-5)
    first, second = np.sort(values[known], axis=-1)[..., -1], np.sort(values[known], axis=-1)[..., -2]
    clear = first - second > class_maps.STEP
    np.testing.assert_array_equal(found[known].argmax(axis=-1)[clear], values[known].argmax(axis=-1)[clear])
    told = values[known] > class_maps.LEAST
    assert np.abs(found[known] - values[known])[told].max() < 1.5 * class_maps.STEP
    np.testing.assert_allclose(found[known][~told], class_maps.UNLIKELY, atol=class_maps.STEP)


def test_models_and_stores_have_the_same_faintest_value() -> None:
    """The two packages do not import each other, so each defines the constant."""
    assert class_maps.FAINTEST == FAINTEST_BELIEVED


def test_a_window_equals_that_part_of_the_whole(tmp_path: Path) -> None:
    """Some rows and columns are read alone; shape and class names are those of the whole store."""
    store = class_maps.ProbabilityStore(stored(tmp_path / "class_probabilities.zarr"))
    whole, part = store.read(), store.read(slice(10, 66), slice(7, 9))
    for one, other in zip(whole, part, strict=True):
        np.testing.assert_array_equal(one[10:66, 7:9], other)
    assert store.shape == SHAPE
    assert store.legend.names == LEGEND.names


def test_xarray_unpacks_probabilities(tmp_path: Path) -> None:
    """Probabilities and days are packed by CF's rules; unknown pixels are NaN."""
    opened = xr.open_zarr(stored(tmp_path / "class_probabilities.zarr"), consolidated=False)
    values, ages, light = drawn(0)
    np.testing.assert_array_equal(opened.light.values, light)
    assert opened.log_probability.dims == ("y", "x", "class")
    assert opened.age.attrs["units"] == "days"
    assert np.isnan(opened.log_probability.values[:3]).all()
    told = np.where(values[3:] < class_maps.LEAST, class_maps.UNLIKELY, values[3:])
    np.testing.assert_allclose(opened.log_probability.values[3:], told, atol=class_maps.STEP / 2 + 1e-4)
    np.testing.assert_allclose(opened.age.values[3:].astype(float), ages[3:], rtol=1e-6)


def gone_on(path: Path) -> tuple[Path, np.ndarray]:
    """Store probabilities that continue an earlier visit; return their path and the pixels' old classes."""
    old = np.random.default_rng(1).choice(np.array([0, 2, 255], np.uint8), SHAPE)
    class_maps.create_probabilities(path, SHAPE, LEGEND, goes_on=True)
    for top, bottom in ((0, 64), (64, 70)):
        packed = np.zeros((bottom - top, SHAPE[1], len(LEGEND.names)), np.uint8)
        nothing = np.zeros((2, *packed.shape[:2]), np.float32)
        class_maps.write_probabilities_tile(path, (top, 0), packed, *nothing, old[top:bottom])
    return path, old


def test_old_classes_are_stored_with_their_names(tmp_path: Path) -> None:
    """Tiles of old classes are read by plain xarray as whole numbers with CF flags, 255 where nothing changed."""
    path, old = gone_on(tmp_path / "class_probabilities.zarr")
    np.testing.assert_array_equal(class_maps.ProbabilityStore(path).old_class(), old)
    with xr.open_zarr(path, consolidated=False) as opened:
        found = opened["changed_from"]
        np.testing.assert_array_equal(found.values, old)
        assert found.dtype == np.uint8
        assert found.attrs["flag_meanings"].split() == list(LEGEND.names)
        assert found.attrs["nodata"] == 255


def test_a_first_visit_has_no_old_classes(tmp_path: Path) -> None:
    """It refuses tiles of old classes."""
    path = stored(tmp_path / "first.zarr")
    assert class_maps.ProbabilityStore(path).old_class() is None
    packed = np.zeros((64, 64, len(LEGEND.names)), np.uint8)
    nothing = np.zeros((2, 64, 64), np.float32)
    with pytest.raises(IncompleteStoreError, match="changed_from"):
        class_maps.write_probabilities_tile(path, (0, 0), packed, *nothing, packed[..., 0])


def test_a_probability_of_1_is_not_read_as_unknown(tmp_path: Path) -> None:
    """A probability of 1 is stored below 255, the byte for unknown."""
    path = tmp_path / "class_probabilities.zarr"
    class_maps.create_probabilities(path, (4, 4), LEGEND)
    sure = np.full((4, 4, 3), -50.0, np.float32)
    sure[..., 1] = 0.0
    packed = class_maps.packed_probabilities(sure)
    class_maps.write_probabilities_tile(path, (0, 0), packed, *np.full((2, 4, 4), 1e9, np.float32))
    found, days, light = class_maps.ProbabilityStore(path).read()
    assert (found.argmax(axis=-1) == 1).all()
    assert np.exp(found[..., 1]).min() > 0.99
    assert np.isfinite(days).all()
    assert light.min() > 30
    assert class_maps.NOTHING == 255
