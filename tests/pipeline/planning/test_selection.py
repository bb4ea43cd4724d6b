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


def test_only_valid_seats_are_chosen():
    """Masked seats are neither chosen nor counted, however good."""
    valid = np.array([False, True, True, False])
    assert select_seats(np.array([9.0, 1, 2, 9]), 2, valid).seats.tolist() == [2, 1]
    assert not select_seats(np.array([9.0, 1, 2, 9]), 2, valid).spread
    with pytest.raises(BudgetError, match="from 0 to 2, got 3"):
        select_seats(np.array([9.0, 1, 2, 9]), 3, valid)


@given(st.floats(0, 1), st.integers(0, 5000))
def test_counts_follow_shares(share: float, valid: int):
    """The count is within half a seat of the share and within the seats."""
    count = seat_count(share, valid)
    assert abs(count - share * valid) <= 0.5 + 1e-9
    assert 0 <= count <= valid


def test_frame_mode_counts_valid_seats_only():
    """35 % of 20 valid seats are 7, whatever the padded grid holds."""
    valid = np.arange(64) < 20
    assert len(frame_seats(np.arange(64.0), 0.35, valid).seats) == 7
