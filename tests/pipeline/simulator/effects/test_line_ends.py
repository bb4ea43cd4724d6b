"""Ends of a line that is aimed beside its plan."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import Sweep, points_of_scan
from pipeline.simulator.effects.pointing import at_line_ends, end_gains

CAMERA = LineCamera()


def test_centres_move_as_they_are_told_and_ends_turn():
    """The centre's derivatives are the identity; an end of 320 px has .034 px across for every px along."""
    gains = end_gains(Sweep("a", "fine", "x", 0.0, 0.0, 1), CAMERA)[0]
    np.testing.assert_allclose(gains[1], np.eye(2), atol=1e-9)
    np.testing.assert_allclose(np.abs(gains[[0, 2], 1, 0]), 0.0338, atol=2e-4)


@pytest.mark.parametrize("strip_px", [0.0, 2000.0, -4000.0])
def test_no_point_of_a_line_moves_farther(strip_px: float):
    """Shifts of 5 px in any direction move no point of any line by more than the bound, and some nearly so."""
    sweep = Sweep("a", "fine", "x", strip_px, -1500.0, 301, step=10)
    plan = np.stack(points_of_scan(strip_px, CAMERA, sweep.line_px()[:, None], CAMERA.pixel_slopes()))
    bound = np.array(at_line_ends([sweep], CAMERA, 3.0, 4.0))
    most = np.zeros(2)
    for along, scan in ((3, 4), (3, -4), (-3, 4), (-3, -4)):
        beside = points_of_scan(strip_px + along, CAMERA, sweep.line_px()[:, None] + scan, CAMERA.pixel_slopes())
        most = np.maximum(most, np.abs(np.stack(beside) - plan).max(axis=(1, 2)))
    assert np.all(most <= bound * (1 + 1e-4))
    assert np.all(bound <= 1.1 * most)


def test_no_lines_turn_nothing():
    """Without lines the shift is the bound."""
    assert at_line_ends([], CAMERA, 1.0, 2.0) == (1.0, 2.0)
    assert at_line_ends([Sweep("a", "fine", "x", 0.0, 0.0, 0)], CAMERA, 1.0, 2.0) == (1.0, 2.0)
