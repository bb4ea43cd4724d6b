"""Selection: counts, ties, numbers that are not, nesting and border patches."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.errors import BudgetError
from pipeline.planning.selection import frame_patches, select_patches

scores = st.lists(st.sampled_from([0.0, 1.0, 2.0, -1.0, np.nan, np.inf, -np.inf]), min_size=1, max_size=30)


@given(scores, st.data())
def test_a_smaller_choice_is_the_beginning_of_a_larger_one(values: list[float], data: st.DataObject):
    """Top K lies in top K + 1, whatever the scores, and no patch comes twice."""
    large = data.draw(st.integers(0, len(values)))
    small = data.draw(st.integers(0, large))
    chosen = select_patches(np.array(values), large)
    assert select_patches(np.array(values), small).tolist() == chosen[:small].tolist()
    assert len(set(chosen.tolist())) == large


def test_only_valid_patches_are_chosen():
    """Masked patches are neither chosen nor counted, however good."""
    valid = np.array([False, True, True, False])
    assert select_patches(np.array([9.0, 1, 2, 9]), 2, valid).tolist() == [2, 1]
    with pytest.raises(BudgetError, match="from 0 to 2, got 3"):
        select_patches(np.array([9.0, 1, 2, 9]), 3, valid)


@given(st.floats(0, 1), st.integers(0, 500))
def test_counts_follow_fractions(fraction: float, valid: int):
    """The count is within half a patch of the fraction and within the patches."""
    count = len(frame_patches(np.zeros(valid), fraction))
    assert abs(count - fraction * valid) <= 0.5 + 1e-9
    assert 0 <= count <= valid


def test_frame_mode_counts_valid_patches_only():
    """35 % of 20 valid patches are 7, whatever the padded grid holds."""
    valid = np.arange(64) < 20
    assert len(frame_patches(np.arange(64.0), 0.35, valid)) == 7
