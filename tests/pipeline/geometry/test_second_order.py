"""Effects that the model leaves out: their sizes for the rig."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.paper_equations import line_points
from tests.pipeline.geometry.second_order import (
    distance_error,
    line_stretch,
    pivot_error,
    pointing_error,
    relief_error,
    staircase_jitter,
)

CAMERA = LineCamera()


def test_distance_and_relief():
    """A lever of 0.1 m errs by 1.05 px at 30.5 m and 0.11 at 300 m; a scene of one distance has no relief."""
    assert distance_error(CAMERA, 30.5) == pytest.approx(1.05, abs=0.005)
    assert distance_error(CAMERA, 300) == pytest.approx(0.11, abs=0.005)
    assert relief_error(CAMERA, 30.5, 300) == pytest.approx(distance_error(CAMERA, 30.5) - distance_error(CAMERA, 300))
    assert relief_error(CAMERA, 50, 50) == 0


def test_pivot_and_pointing():
    """1 mm off the pivot is 0.23 px at 30 m, ten times that at 3 m; 40 urad are 0.76 and 0.54 px, 0.15 deg 50 px."""
    assert pivot_error(CAMERA, 30, 1e-3) == pytest.approx(0.23, abs=0.005)
    assert pivot_error(CAMERA, 3, -1e-3) == pytest.approx(2.3, abs=0.05)
    assert pointing_error(CAMERA, 40e-6) == pytest.approx((0.76, 0.54), abs=0.005)
    assert pointing_error(CAMERA, np.deg2rad(0.15))[0] == pytest.approx(50, abs=0.5)


@pytest.mark.parametrize(("samples", "lines", "px"), [(1450, 640, 0.011), (1500, 600, 0.020), (1500, 1000, 0.056)])
def test_staircase_shakes_lines(samples: int, lines: int, px: float):
    """Positions that do not divide among the frames put lines off by hundredths of a px."""
    assert staircase_jitter(samples, lines) == pytest.approx(px, abs=5e-4)


@pytest.mark.parametrize(("samples", "lines"), [(1500, 500), (1500, 1500), (640, 640), (1, 1)])
def test_whole_numbers_of_samples_shake_nothing(samples: int, lines: int):
    """An integer number of positions per frame leaves the line centres even."""
    assert staircase_jitter(samples, lines) < 1e-12


def test_lines_stretch_as_their_points_do():
    """The stretch is the derivative of the line's own points, and nowhere below 1."""
    strips, scan = np.array([-4000.0, 0.0, 3000.0]), np.array([-4500.0, 0.0, 2500.0])
    found = line_stretch(CAMERA, strips[:, None], scan)
    for row, strip in enumerate(strips):
        along, across = line_points("L4", strip, scan, CAMERA)
        apart = np.hypot(np.diff(along[:, 319:321]), np.diff(across[:, 319:321]))[:, 0]
        psi = np.arctan2(np.diff(across[:, 319:321]), np.diff(along[:, 319:321]))[:, 0]
        assert found[row] == pytest.approx(apart * np.cos(psi), rel=1e-6)
    assert found.min() >= 1
    assert found[1, 1] == pytest.approx(1)
