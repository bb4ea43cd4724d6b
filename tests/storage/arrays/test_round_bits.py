"""Rounding to 11 bits keeps its bound, is done once, and leaves what is no number alone."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from storage.arrays.layout import round_bits

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
