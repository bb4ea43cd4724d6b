"""Positions at the precision of the wire, and as cells."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.errors import PoseError, ShapeError
from pipeline.rig.mirror.steering import MotionLog, as_cells, wire_positions


@given(st.floats(0, 1), st.floats(-7, 7))
def test_no_position_is_rounded_beyond_the_rim(radius: float, angle: float):
    """Positions stay in the disk, near where they were, and are not rounded twice."""
    given_ = np.array([[radius * np.cos(angle), radius * np.sin(angle)]])
    rounded = wire_positions(given_)
    assert rounded.dtype == np.float32
    assert np.hypot(*rounded[0].astype(np.float64)) <= 1
    np.testing.assert_allclose(rounded, given_, atol=2e-7)
    np.testing.assert_array_equal(wire_positions(rounded), rounded)


def test_a_rim_of_float32_is_taken():
    """A float32 position that rounding put beyond the rim comes back to it."""
    beyond = np.array([[0.6, 0.8]], np.float32) * np.float32(1 + 3e-7)
    assert np.hypot(*wire_positions(beyond)[0].astype(np.float64)) <= 1


@pytest.mark.parametrize(("x", "y"), [(1.0001, 0), (0.8, 0.8), (float("nan"), 0), (0, float("inf"))])
def test_targets_outside_the_disk_are_refused(x: float, y: float):
    """Beyond the rim, and what is no number."""
    with pytest.raises(PoseError, match=r"index 1\)"):
        wire_positions([(0, 0), (x, y)])


@pytest.mark.parametrize("shape", [(0, 2), (2,), (3, 3), (2, 2, 2)])
def test_a_path_is_a_list_of_pairs(shape: tuple[int, ...]):
    """Anything but (position, 2) is refused, and an empty path."""
    with pytest.raises(ShapeError, match=r"\(position, 2\), at least one, got shape"):
        wire_positions(np.zeros(shape))


def test_cells_are_x_of_all_then_y_of_all():
    """Both channels lie in one vector, Y behind X, big-endian."""
    cells = as_cells(np.array([[0.5, -0.25], [1, 0]], np.float32))
    assert cells == bytes.fromhex("3F000000 3F800000 BE800000 00000000")


def test_a_log_knows_its_times():
    """Samples are a period apart."""
    log = MotionLog(np.zeros((3, 2), np.float32), 10.0, 5.0, 0.01)
    np.testing.assert_allclose(log.time_s, [0, 0.1, 0.2])
