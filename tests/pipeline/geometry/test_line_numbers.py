"""Line numbers: what time stamps say of lines, and where the mirror was at their times."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.errors import SettingsError, ShapeError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.mirror import (
    direction_to_position,
    direction_to_scene,
    position_to_direction,
    scene_to_direction,
)
from pipeline.rectify.line_numbers import number_lines, positions_at

CAMERA = LineCamera()


def aim(along_px: np.ndarray | float, scan_px: np.ndarray) -> np.ndarray:
    """Mirror positions (line, 2) that look at points given in px along the line and the scan."""
    tangents = np.stack(np.broadcast_arrays(along_px, scan_px), axis=-1) * CAMERA.ifov_rad
    return direction_to_position(scene_to_direction(tangents))


def look(position: np.ndarray) -> np.ndarray:
    """The scene points [px] that mirror positions look at, along the line and the scan."""
    return direction_to_scene(position_to_direction(position)) / CAMERA.ifov_rad


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


def test_longest_ascent_of_equal_ones_keeps_the_earlier_frames() -> None:
    """Of two stamps that contradict each other the one that goes back is not believed."""
    found = number_lines(np.array([0, 1, 2, 3, 2.5, 4]), 1.0)
    np.testing.assert_array_equal(found.usable, [True, True, True, True, False, True])
    np.testing.assert_array_equal(found.number, [0, 1, 2, 3, 3, 4])


def test_frame_that_came_again_has_the_number_of_the_first() -> None:
    """However late the copy comes, it is the line that its stamp says."""
    found = number_lines(np.array([0.0, 1, 2, 1, 3]), 1.0)
    np.testing.assert_array_equal(found.number, [0, 1, 2, 1, 3])
    np.testing.assert_array_equal(found.usable, [True, True, True, False, True])


def test_late_frame_is_no_lost_line() -> None:
    """A frame 0.6 periods late keeps its own number; the one after shows that none was lost."""
    found = number_lines(np.array([0, 1, 2.6, 3, 4, 5]), 1.0)
    np.testing.assert_array_equal(found.number, np.arange(6))
    assert (found.late, found.lost) == (1, 0)


def test_very_late_frame_makes_no_other_late() -> None:
    """A frame 0.8 periods late tilts the clock that is fitted to all, but not the one without it."""
    assert number_lines(np.array([0, 1, 2, 3.8, 4]), 1.0).late == 1


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


def test_position_at_a_lines_own_time() -> None:
    """On a planned sweep a late line lies where its time says, to 1e-9 px."""
    command = np.arange(100.0)
    time = np.array([3.0, 4.6, 50.25, 99.0])
    found = look(positions_at(time, command, aim(2600.0, command * 4)))
    np.testing.assert_allclose(found, np.stack([np.full(4, 2600.0), time * 4], axis=-1), atol=1e-9)


@pytest.mark.parametrize(("apart_px", "error_px"), [(1, 1e-5), (10, 1e-3)])
def test_tangents_or_device_coordinates_make_no_difference(apart_px: float, error_px: float) -> None:
    """A mirror that runs straight in X and Y between commands is found this near, all over the field."""
    command = np.arange(9000 / apart_px)
    for strip in (0.0, 2600.0, 4800.0):
        position = aim(strip, -4800 + command * apart_px)
        truth = look((position[1:] + position[:-1]) / 2)
        found = look(positions_at(command[:-1] + 0.5, command, position))
        assert np.abs(found - truth).max() < error_px


def test_times_outside_the_command_have_no_position() -> None:
    """Before the first and after the last command, and at no time, the position is NaN; no lines give none."""
    found = positions_at(np.array([-0.1, 0.5, 3.1, np.nan]), np.arange(4.0), aim(0.0, np.arange(4.0)))
    np.testing.assert_array_equal(np.isnan(found).any(axis=1), [True, False, True, True])
    assert positions_at(np.zeros(0), np.arange(4.0), aim(0.0, np.arange(4.0))).shape == (0, 2)


def test_commands_must_ascend_and_fit() -> None:
    """Commands that stand still in time, or whose arrays do not fit, are refused."""
    with pytest.raises(ShapeError, match="commands 1 and 2 do not ascend"):
        positions_at(np.zeros(1), np.array([0.0, 1, 1]), aim(0.0, np.arange(3.0)))
    with pytest.raises(ShapeError, match=r"expected commands \(command, 2\)"):
        positions_at(np.zeros(1), np.arange(2.0), aim(0.0, np.arange(3.0)))
