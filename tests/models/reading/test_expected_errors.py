"""Expected errors of a prior map: values worked out by hand, row blocks, and unknown pixels."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from spectralzoom.models.reading.expected_errors import PatchExpectedErrors, expected_error_of
from spectralzoom.pipeline.geometry.grid import SceneGrid

GRID = SceneGrid(8, 12, 4)


def believed(sure: float, classes: int = 3, shape: tuple[int, int] = (8, 12), kind: int = 0) -> np.ndarray:
    """Return log-probabilities of a field of one class with this certainty."""
    probabilities = np.full((*shape, classes), np.log((1 - sure) / (classes - 1)), np.float32)
    probabilities[..., kind] = np.log(sure)
    return probabilities


def test_expected_error_is_one_minus_certainty() -> None:
    """Certainty 0.9 gives 0.1; an unknown pixel of three classes is wrong in two of three cases."""
    probabilities = believed(0.9)
    probabilities[0, 0] = np.nan
    expected_error = expected_error_of(probabilities)
    assert expected_error[3, 3] == pytest.approx(0.1, rel=1e-5)
    assert expected_error[0, 0] == pytest.approx(2 / 3)


def test_expected_gain_is_the_corrected_error_of_each_class() -> None:
    """Half of a class of 48 px is wrong by 0.4, a pass by 0.1. Two patches gain 0.5 x 0.3 of one class of two."""
    probabilities = believed(0.999)
    probabilities[:4, :6], probabilities[4:] = believed(0.6, shape=(4, 6)), believed(0.999, shape=(4, 12), kind=1)
    expected_errors = PatchExpectedErrors.of([(probabilities, np.zeros((8, 12)))], GRID, 3)
    expected_gain = expected_errors.expected_gain(np.array([0.1, 0.1, 0.1]))
    assert expected_gain.sum() == pytest.approx(0.5 * 0.3 / 2, rel=1e-5)
    assert np.flatnonzero(expected_gain).tolist() == [0, 1]
    assert expected_gain[0] == pytest.approx(2 * expected_gain[1])


def test_a_pass_no_better_than_the_prior_map_has_no_gain() -> None:
    """A pass with more or equal expected errors gains nothing, however much of the field it shows."""
    expected_errors = PatchExpectedErrors.of([(believed(0.95), np.zeros((8, 12)))], GRID, 3)
    assert not expected_errors.expected_gain(np.full(3, 0.2)).any()
    assert expected_errors.expected_gain(np.full(3, 0.05)).sum() == pytest.approx(0, abs=1e-6)


def test_unknown_pixels_belong_to_no_class() -> None:
    """Known pixels gain as parts of a class twice as large, others by the mean; `come_true` scales known errors."""
    probabilities = np.full((8, 12, 3), np.nan, np.float32)
    probabilities[:4, :8], probabilities[:4, 4:8] = believed(0.8, shape=(4, 8)), believed(0.8, shape=(4, 4), kind=1)
    never = np.where(np.isnan(probabilities[..., 0]), np.nan, 0.0)
    errors = PatchExpectedErrors.of([(probabilities, never)], GRID, 3, come_true=0.5)
    wrong = np.tensordot(errors.pixels, errors.expected_error, 2)
    assert wrong == pytest.approx([1.6, 1.6, *[16 * 2 / 3] * 4], rel=1e-5)
    gain = errors.expected_gain(np.array([0.0, 0.06, 0.5]))
    assert gain[:2] == pytest.approx([0.1 / 6, 0.04 / 6], rel=1e-4)
    assert gain[2:] == pytest.approx((2 / 3 - 0.03) / 6, rel=1e-5)


def test_a_certain_pixel_is_known() -> None:
    """The probability of another class may be too small for a float32."""
    probabilities = believed(1 - 1e-7, kind=1)
    probabilities[..., 0] = -np.inf
    assert not PatchExpectedErrors.of([(probabilities, np.zeros((8, 12)))], GRID, 3).pixels[:, 3].any()


@given(st.integers(1, 2), st.integers(0, 2**32 - 1))
def test_row_blocks_equal_the_whole_field(high: int, seed: int) -> None:
    """Read in some rows of patches at a time, counts, ages and expected errors are those of the field at once."""
    rng = np.random.default_rng(seed)
    probabilities = np.log(rng.dirichlet(np.ones(3), (8, 12))).astype(np.float32)
    age = np.where(rng.random((8, 12)) < 0.1, np.nan, rng.random((8, 12)) * 30)
    rows = 4 * high
    swaths = [(probabilities[top : top + rows], age[top : top + rows]) for top in range(0, 8, rows)]
    whole, parts = (PatchExpectedErrors.of(one, GRID, 3) for one in ([(probabilities, age)], swaths))
    assert np.array_equal(whole.pixels, parts.pixels)
    assert np.array_equal(whole.age_days, parts.age_days)
    assert whole.pixels.sum() == 8 * 12
    for one in (whole, parts):
        assert one.expected_wrong() == pytest.approx(expected_error_of(probabilities).mean())


def test_left_out_pixels_do_not_count() -> None:
    """Left-out pixels add neither errors nor ages; a patch of them alone has an infinite age."""
    probabilities = believed(0.9)
    age = np.ones((8, 12))
    left_out = np.zeros((8, 12), np.bool_)
    left_out[:4, :5] = True
    probabilities[:, :6] = np.nan
    age[0, 4] = 50.0
    asked = PatchExpectedErrors.of([(probabilities, age)], GRID, 3, left_out=left_out)
    assert asked.pixels.sum(axis=(1, 2)).tolist() == [0, 12, 16, 16, 16, 16]
    assert asked.age_days.tolist() == [np.inf, 1, 1, 1, 1, 1]
