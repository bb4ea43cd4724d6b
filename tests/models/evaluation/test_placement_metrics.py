"""The gain oracle, and what placements are worth beside it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from models.evaluation.placement import (
    average_precision,
    captured_gain,
    gain_sums,
    oracle_gain,
    rank_correlation,
    top_seats,
)
from models.reading.inference import glance_of_columns, segment
from pipeline.geometry.grid import SceneGrid
from tests.models.conftest import Maker


def _scene(tiny: Maker, height: int = 24, width: int = 32):
    weights = tiny(classes=2)
    grid = SceneGrid(height, width, 8, 2)
    rng = np.random.default_rng(0)
    rows, columns = grid.seat_shape
    y, x = grid.padded_shape
    seen = glance_of_columns(weights, rng.normal(size=(y // 2, x // 2, 4)), grid)
    fine = rng.normal(size=(rows * columns, 8, 8, 4)).astype(np.float32)
    return weights, grid, seen, fine, rng.integers(0, 2, (height, width)).astype(np.uint8)


def test_the_gain_is_the_loss_that_all_seats_take_away(tiny: Maker):
    """With two classes a map's confidence gives its loss: the gain is the difference of the two maps' losses."""
    weights, grid, seen, fine, labels = _scene(tiny)
    valid = grid.valid_seats()

    def loss(seats: np.ndarray) -> np.ndarray:
        drawn = segment(weights, seen, fine[seats], seats)
        right = np.where(drawn.classes == labels, drawn.confidence, 1 - drawn.confidence)
        full = np.zeros(grid.padded_shape)
        full[: grid.height, : grid.width] = -np.log(right.astype(np.float64))
        rows, columns = grid.seat_shape
        return full.reshape(rows, 8, columns, 8).mean(axis=(1, 3)).ravel()

    expected = loss(np.empty(0, np.intp)) - loss(valid)
    assert oracle_gain(weights, seen, fine, labels)[valid] == pytest.approx(expected[valid], abs=1e-4)


def test_what_has_no_label_has_no_gain(tiny: Maker):
    """A seat without a labelled pixel gains nothing, and one half labelled half as much at most."""
    weights, grid, seen, fine, labels = _scene(tiny, 20, 30)
    labels[:8, :8] = 255
    gain = oracle_gain(weights, seen, fine, labels)
    outside = np.setdiff1d(np.arange(len(gain)), grid.valid_seats())
    assert gain[0] == 0
    assert (gain[outside] == 0).all()
    assert gain.any()
    assert (np.abs(gain) <= 5).all()


@given(st.lists(st.integers(-16, 24).map(lambda n: n / 8), min_size=1, max_size=20), st.integers(0, 20))
def test_the_oracle_captures_all_of_its_own_gain(values: list[float], count: int):
    """The seats with the most gain have a ratio of 1, where there is any to be had, and no others have more."""
    gain, valid = np.array(values), np.arange(len(values))
    chosen = np.flatnonzero(top_seats(gain, count))
    own, best = gain_sums(gain, chosen, valid)
    assert own == pytest.approx(best)
    last, _ = gain_sums(gain, np.arange(len(chosen)), valid)
    assert last <= best + 1e-9
    assert captured_gain(own, best) in (None, pytest.approx(1))


def test_precision_by_hand():
    """Positives at ranks 1 and 3: (1/1 + 2/3) / 2; NaN scores come last; nothing positive has none."""
    positive = np.array([True, False, True, False])
    assert average_precision(np.array([9.0, 5, 3, 1]), positive) == pytest.approx(5 / 6)
    assert average_precision(np.array([np.nan, 5, 3, 1]), positive) == pytest.approx((1 / 2 + 2 / 4) / 2)
    assert average_precision(positive.astype(float), positive) == 1
    assert np.isnan(average_precision(np.ones(4), ~(positive | True)))


def test_ranks_agree_whatever_the_scale():
    """1 for any rising function, -1 turned round, ties share a rank, and what is flat has none."""
    gain = np.array([0.1, 0.4, 0.2, 0.9])
    assert rank_correlation(np.exp(5 * gain), gain) == pytest.approx(1)
    assert rank_correlation(-gain, gain) == pytest.approx(-1)
    assert rank_correlation(np.array([1.0, 1, 2, 2]), np.array([1.0, 1, 2, 2])) == pytest.approx(1)
    assert np.isnan(rank_correlation(np.ones(4), gain))
