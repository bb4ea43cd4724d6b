"""Line numbers: what time stamps say of lines, and where the mirror was at their times."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.errors import SettingsError, ShapeError
from pipeline.rectify.line_numbers import number_lines


@given(st.lists(st.integers(0, 400), min_size=2, max_size=60, unique=True), st.floats(0.97, 1.03), st.integers(0, 99))
@settings(max_examples=80, deadline=None)
def test_numbers_are_those_of_the_lines_that_came(lines: list[int], pace: float, seed: int) -> None:
    """Whatever frames are lost, with a clock off by 3 % and jitter of a tenth, short gaps are counted exactly."""
    came = np.sort(lines)
    came = came[np.concatenate([[True], np.cumprod(np.diff(came) < 9).astype(bool)])]  # a longer gap may miscount
    time = 5.0 + 0.1 * (pace * came + np.random.default_rng(seed).uniform(-0.1, 0.1, len(came)))
    found = number_lines(time, 0.1)
    np.testing.assert_array_equal(found.number, came - came[0])
    assert found.usable.all()
    assert (found.lost, found.repeated, found.backward) == (came[-1] - came[0] + 1 - len(came), 0, 0)


@given(st.integers(0, 99), st.integers(3, 40))
@settings(max_examples=40, deadline=None)
def test_copies_and_wild_stamps_change_no_other_line(seed: int, lines: int) -> None:
    """A frame sent again and a single wild stamp are marked; the others keep the numbers that they had."""
    rng = np.random.default_rng(seed)
    time = np.arange(float(lines))
    again = rng.integers(0, lines)
    sent = np.insert(time, again + 1, time[again])
    sent = np.insert(sent, rng.integers(1, lines - 1), rng.choice([-50.0, 1e6]))
    found = number_lines(sent, 1.0)
    np.testing.assert_array_equal(found.number[found.usable], np.arange(lines))
    assert (found.repeated, found.backward, found.lost, found.late) == (1, 1, 0, 0)


@pytest.mark.parametrize("ends", [[1e6], [1e300], [-1e6], [-1e300, 1e300]])
def test_wild_stamps_at_the_ends_are_not_believed(ends: list[float]) -> None:
    """A first or last stamp far off all others goes neither back nor loses a million lines: it costs its own line."""
    found = number_lines(np.sort([*ends, *np.arange(20.0)]), 1.0)
    assert found.usable.sum() == 20
    assert (found.backward, found.lost, found.late) == (len(ends), 0, 0)
    assert number_lines(np.array([0.0, 1, 900]), 1.0).lost == 898


@pytest.mark.parametrize(
    ("stamps", "number", "unusable", "late"),
    [
        ([0, 1, 2, 3, 2.5, 4], [0, 1, 2, 3, 3, 4], [4], 0),  # of two that contradict each other the later one goes
        ([0, 1, 2, 1, 3], [0, 1, 2, 1, 3], [3], 0),  # a copy is the line that its stamp says
        ([0, 1, 2.6, 3, 4, 5], [0, 1, 2, 3, 4, 5], [], 1),  # late by 0.6 periods, and none was lost
        ([0, 1, 2, 3.8, 4], [0, 1, 2, 3, 4], [], 1),  # tilts the clock fitted to all, but not the one without it
    ],
)
def test_stamps_by_hand(stamps: list[float], number: list[int], unusable: list[int], late: int) -> None:
    """Numbers, what is believed and what is late, frame by frame."""
    found = number_lines(np.array(stamps, float), 1.0)
    assert (found.number.tolist(), np.flatnonzero(~found.usable).tolist()) == (number, unusable)
    assert (found.late, found.lost) == (late, 0)


@pytest.mark.parametrize(("gap", "lost"), [(1.45, 0), (1.5, 0), (1.55, 1), (2.45, 1), (2.55, 2)])
def test_a_gap_of_more_than_one_and_a_half_periods_loses_a_line(gap: float, lost: int) -> None:
    """Gaps are counted to the nearest line, halves to fewer."""
    assert number_lines(np.concatenate([np.arange(4.0), 3 + gap + np.arange(4)]), 1.0).lost == lost


def test_slow_clock_makes_no_frame_late() -> None:
    """At a period 0.1 % longer than planned 3000 frames drift by three periods, and none is late or lost."""
    found = number_lines(np.arange(3000) * 0.1001, 0.1)
    np.testing.assert_array_equal(found.number, np.arange(3000))
    assert (found.late, found.lost) == (0, 0)


def test_unusable_input_is_refused() -> None:
    """A period of 0 and stamps that are no row raise."""
    with pytest.raises(SettingsError, match="above 0 s, got 0"):
        number_lines(np.arange(3.0), 0.0)
    with pytest.raises(ShapeError, match=r"\(frame,\)"):
        number_lines(np.zeros((3, 2)), 1.0)
