"""Selection: counts, ties, numbers that are not, nesting and border seats."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.errors import BudgetError
from pipeline.planning.selection import frame_seats, seat_count, select_seats

scores = st.lists(st.sampled_from([0.0, 1.0, 2.0, -1.0, np.nan, np.inf, -np.inf]), min_size=1, max_size=30)


@given(scores, st.data())
def test_a_smaller_choice_is_the_beginning_of_a_larger_one(values: list[float], data: st.DataObject):
    """Top K lies in top K + 1, whatever the scores, and no seat comes twice."""
    large = data.draw(st.integers(0, len(values)))
    small = data.draw(st.integers(0, large))
    chosen = select_seats(np.array(values), large).seats
    assert select_seats(np.array(values), small).seats.tolist() == chosen[:small].tolist()
    assert len(set(chosen.tolist())) == large


def test_ties_go_to_the_lowest_number():
    """Equal scores are ranked by seat number."""
    assert select_seats(np.array([3.0, 2, 3, 2, 1, 3]), 2).seats.tolist() == [0, 2]
    assert select_seats(np.ones(256), 3).seats.tolist() == [0, 1, 2]


def test_infinity_is_first_and_what_is_no_number_last():
    """+inf leads; NaN and -inf follow the least finite score, in order of number."""
    values = np.array([np.nan, -5.0, np.inf, -np.inf, 2.0])
    assert select_seats(values, 5).seats.tolist() == [2, 4, 1, 0, 3]


@pytest.mark.parametrize("value", [np.nan, -np.inf])
def test_scores_without_a_rank_are_spread_evenly(value: float):
    """With nothing to rank the choice covers the seats evenly, and says that it did."""
    chosen = select_seats(np.full(400, value), 40)
    assert chosen.spread
    quarters = np.histogram(chosen.seats, bins=4, range=(0, 400))[0]
    columns = np.histogram(chosen.seats % 20, bins=4, range=(0, 20))[0]
    assert quarters.tolist() == pytest.approx([10] * 4, abs=1)
    assert columns.tolist() == pytest.approx([10] * 4, abs=3)


def test_only_valid_seats_are_chosen():
    """Masked seats are neither chosen nor counted, however good."""
    valid = np.array([False, True, True, False])
    assert select_seats(np.array([9.0, 1, 2, 9]), 2, valid).seats.tolist() == [2, 1]
    assert not select_seats(np.array([9.0, 1, 2, 9]), 2, valid).spread
    with pytest.raises(BudgetError, match="from 0 to 2, got 3"):
        select_seats(np.array([9.0, 1, 2, 9]), 3, valid)


@pytest.mark.parametrize("count", [-1, 7, 2.5, 3.0, "3", None, True, float("nan")])
def test_counts_that_cannot_be_are_refused(count: object):
    """The message names what came and how many seats there are."""
    with pytest.raises(BudgetError, match=r"from 0 to 6, got "):
        select_seats(np.zeros(6), count)  # type: ignore[arg-type]


def test_clipping_takes_all_seats_where_more_are_asked():
    """``clip=True`` opts in to the smaller of the two; below 0 is refused all the same."""
    assert len(select_seats(np.zeros(6), np.int64(9), clip=True).seats) == 6
    with pytest.raises(BudgetError, match="got -1"):
        select_seats(np.zeros(6), -1, clip=True)


def test_none_of_no_seats():
    """Zero seats out of none is an empty choice, not an error."""
    chosen = select_seats(np.zeros(0), 0)
    assert chosen.seats.shape == (0,)
    assert not chosen.spread


@given(st.floats(0, 1), st.integers(0, 5000))
def test_counts_follow_shares(share: float, valid: int):
    """The count is within half a seat of the share and within the seats."""
    count = seat_count(share, valid)
    assert abs(count - share * valid) <= 0.5 + 1e-9
    assert 0 <= count <= valid


def test_halves_are_rounded_up():
    """Half of five seats are three, whatever is even."""
    assert (seat_count(0.5, 5), seat_count(0.5, 3), seat_count(0.5, 1)) == (3, 2, 1)


@pytest.mark.parametrize("share", [-0.1, 1.01, float("nan"), float("inf")])
def test_shares_out_of_range_are_refused(share: float):
    """A share is a number from 0 to 1."""
    with pytest.raises(BudgetError, match="from 0 to 1"):
        seat_count(share, 10)


def test_frame_mode_counts_valid_seats_only():
    """35 % of 20 valid seats are 7, whatever the padded grid holds."""
    valid = np.arange(64) < 20
    assert len(frame_seats(np.arange(64.0), 0.35, valid).seats) == 7
