"""Hard cases of values that no sensor gives: from the limit to the largest float32, infinite and NaN."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from spectralzoom.models.network.spectral import MOST_COLUMN
from spectralzoom.models.policies.policies import score_patches
from spectralzoom.models.reading.inference import CoarsePrediction, DrawnMap, coarse_prediction_of_columns, segment
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.pipeline.readings import MOST_VALUE, beyond_range, find_beyond, readings_alone
from tests.models.conftest import coarse_prediction, make_weights

WEIGHTS = make_weights(0)
GRID = SceneGrid(48, 64, 8)
NM = np.linspace(420, 980, 7)
MOST = WEIGHTS.normalisation.most_value
VALUES = np.random.default_rng(0).uniform(0.1, 0.5, (*GRID.padded_shape, 7)).astype(np.float32)
PATCHES = np.array([3, 9, 20, 21])
FINE = np.random.default_rng(1).uniform(0.1, 0.5, (len(PATCHES), 8, 8, 7)).astype(np.float32)
FAR = np.float32(np.finfo(np.float32).max)

sizes = st.floats(float(np.log10(MOST * 1.001)), 38.5).map(lambda power: np.float32(min(10.0**power, float(FAR))))
OUT_OF_RANGE = sizes | sizes.map(lambda size: -size) | st.sampled_from([np.inf, -np.inf, np.nan, 1e9, 1e18, 1e30, FAR])


def _drawn(coarse: NDArray[np.float32], fine: NDArray[np.float32]) -> tuple[CoarsePrediction, DrawnMap]:
    seen = coarse_prediction(WEIGHTS, coarse, NM, GRID)
    return seen, segment(WEIGHTS, seen, WEIGHTS.columns(fine, NM), PATCHES)


def _alike(one: tuple[CoarsePrediction, DrawnMap], other: tuple[CoarsePrediction, DrawnMap]) -> bool:
    parts = [(a.columns, a.probability, score_patches("gain", a), b.classes, b.confidence) for a, b in (one, other)]
    return all(np.asarray(a).tobytes() == np.asarray(b).tobytes() for a, b in zip(*parts, strict=True))


@settings(max_examples=20, deadline=None)
@given(
    value=OUT_OF_RANGE,
    y=st.integers(0, 47),
    x=st.integers(0, 63),
    bands=st.sets(st.integers(0, 6), min_size=1),
    at=st.booleans(),
)
@example(value=np.float32(1e30), y=3, x=3, bands=set(range(7)), at=True)
@example(value=np.float32(1e18), y=3, x=3, bands=set(range(7)), at=True)
@example(value=np.float32(1e30), y=3, x=3, bands=set(range(7)), at=False)
def test_out_of_range_value_counts_as_nan(value: float, y: int, x: int, bands: set[int], at: bool) -> None:
    """In some or all bands of a pixel, of the overview's input or of a patch, it gives the bits of NaN."""
    out_of_range, hole = (VALUES if at else FINE).copy(), (VALUES if at else FINE).copy()
    place = (y, x, sorted(bands)) if at else (y % len(PATCHES), y % 8, x % 8, sorted(bands))
    out_of_range[place], hole[place] = value, np.nan
    with np.errstate(all="raise", under="ignore"):
        one, other = (_drawn(*((cube, FINE) if at else (VALUES, cube))) for cube in (out_of_range, hole))
    assert _alike(one, other)
    assert np.isfinite(one[0].probability).all()
    assert (one[1].classes < len(WEIGHTS.class_names)).all()


@pytest.mark.parametrize("value", [10 * MOST_COLUMN, 1e18, 1e30, FAR, np.inf, -np.inf])
def test_out_of_range_columns_count_as_nan(value: float) -> None:
    """Columns that arrive already normalised, for the overview or for the map, are checked too."""
    columns = np.random.default_rng(3).normal(0, 1, (*GRID.padded_shape, 4)).astype(np.float32)
    patches = np.random.default_rng(4).normal(0, 1, (2, 8, 8, 4)).astype(np.float32)
    found = []
    for one in (value, np.nan):
        coarse, fine = columns.copy(), patches.copy()
        coarse[4, 6, 2], fine[1, 3, 5, 0] = one, one
        seen = coarse_prediction_of_columns(WEIGHTS, coarse, GRID)
        found.append((seen, segment(WEIGHTS, seen, fine, np.array([4, 30]))))
    assert _alike(*found)
    assert np.isfinite(found[0][0].probability).all()


# --- the range check itself -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [np.float32, np.float64, np.int64, np.uint32, np.uint16, np.uint8, bool])
def test_range_limit_is_inclusive_for_every_type(kind: Any) -> None:
    """Values up to 1e9 are in range in any type; integers of at most 16 bits cannot exceed it."""
    values = np.ones((2, 3, 4), kind)
    assert beyond_range(values) is None
    if np.dtype(kind).itemsize > 2:
        values[1, 2, 3] = MOST_VALUE
        assert find_beyond(values) is None
        values[1, 2, 3] = 2 * MOST_VALUE
        found = find_beyond(values)
        assert (found.count, found.place, float(found.value)) == (1, (1, 2, 3), 2 * MOST_VALUE)


def test_float16_is_out_of_range_only_if_infinite() -> None:
    """The largest float16 is 65 504: comparison raises no warning, and only infinite values are marked."""
    values = np.array([[[65504.0, -65504.0, np.inf, np.nan]]], np.float16)
    assert beyond_range(values).tolist() == [[[False, False, True, False]]]
    assert beyond_range(values[..., :2]) is None
    assert np.isnan(readings_alone(values, MOST_VALUE)).tolist() == [[[False, False, True, True]]]


def test_values_in_range_are_returned_without_a_copy() -> None:
    """An out-of-range value becomes NaN in the result, and NaN stays NaN."""
    values = np.array([[1.0, np.nan, -5.0]], np.float32)
    assert readings_alone(values, 10.0) is values
    np.testing.assert_array_equal(readings_alone(values, 2.0), [[1.0, np.nan, np.nan]])
