"""How doubtful what is remembered is: hand-worked numbers, strips, and pixels of which nothing is known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from models.reading.doubts import SeatDoubts, doubt_of
from pipeline.geometry.grid import SceneGrid

GRID = SceneGrid(8, 12, 4, 1)


def believed(sure: float, classes: int = 3, shape: tuple[int, int] = (8, 12), kind: int = 0) -> np.ndarray:
    """Log-probabilities of a field that is believed to be of one class, so surely."""
    belief = np.full((*shape, classes), np.log((1 - sure) / (classes - 1)), np.float32)
    belief[..., kind] = np.log(sure)
    return belief


def test_a_doubt_is_what_certainty_leaves() -> None:
    """Sure by 0.9, it is 0.1; of what is not known any class is as likely, two in three wrong of three classes."""
    belief = believed(0.9)
    belief[0, 0] = np.nan
    doubt = doubt_of(belief)
    assert doubt[3, 3] == pytest.approx(0.1, rel=1e-5)
    assert doubt[0, 0] == pytest.approx(2 / 3)


def test_a_look_is_worth_what_it_mends_of_each_class() -> None:
    """Half of a class of 48 px is wrong by 0.4 and a look by 0.1: 0.5 x 0.3 of one class of two, over two seats."""
    belief = believed(0.999)
    belief[:4, :6], belief[4:] = believed(0.6, shape=(4, 6)), believed(0.999, shape=(4, 12), kind=1)
    doubts = SeatDoubts.of([(belief, np.zeros((8, 12)))], GRID, 3)
    worth = doubts.worth(np.array([0.1, 0.1, 0.1]))
    step = doubts.doubt[np.searchsorted(doubts.doubt, 0.4)]  # doubts are kept in steps, no less than they are
    assert worth.sum() == pytest.approx(0.5 * (step - 0.1) / 2)
    assert np.flatnonzero(worth).tolist() == [0, 1]
    assert worth[0] == pytest.approx(2 * worth[1])


def test_a_look_that_sees_worse_than_is_remembered_is_worth_nothing() -> None:
    """However much of the field it shows."""
    doubts = SeatDoubts.of([(believed(0.95), np.zeros((8, 12)))], GRID, 3)
    assert not doubts.worth(np.full(3, 0.2)).any()


@given(st.integers(1, 2), st.integers(0, 2**32 - 1))
def test_strips_say_what_the_whole_says(high: int, seed: int) -> None:
    """Read some rows of seats at a time, counts, ages and doubts are those of the field at once."""
    rng = np.random.default_rng(seed)
    belief = np.log(rng.dirichlet(np.ones(3), (8, 12))).astype(np.float32)
    age = np.where(rng.random((8, 12)) < 0.1, np.nan, rng.random((8, 12)) * 30)
    rows = 4 * high
    strips = [(belief[top : top + rows], age[top : top + rows]) for top in range(0, 8, rows)]
    whole, parts = (SeatDoubts.of(one, GRID, 3) for one in ([(belief, age)], strips))
    assert np.array_equal(whole.pixels, parts.pixels)
    assert np.array_equal(whole.age_days, parts.age_days)
    assert whole.pixels.sum() == 8 * 12
    assert 0 < whole.expected_wrong() <= 2 / 3 * whole.doubt[1] / whole.doubt[0]
