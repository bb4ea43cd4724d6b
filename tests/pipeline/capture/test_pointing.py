"""Viewing angles and played vectors to mirror positions, against numbers worked out by hand."""

from __future__ import annotations

import numpy as np

from pipeline.capture.straight_scans import angles_to_positions
from pipeline.geometry.mirror import REST_TANGENT, direction_to_scene, position_to_direction


def test_angles_along_the_scan_are_known_by_hand() -> None:
    """On the axis X is -tan(angle) / tan 50 deg: the beam along the rest normal is turned by the same angle."""
    positions, reached = angles_to_positions(np.array([[0, 0], [0, 10], [0, -30], [0, 50]], float))
    expected = -np.tan(np.deg2rad([0, 10, -30, 50])) / REST_TANGENT
    np.testing.assert_allclose(positions, np.stack([expected, np.zeros(4)], axis=-1), atol=1e-12)
    assert reached.all()


def test_positions_of_angles_look_there() -> None:
    """The scene tangents of a position are the tangents of its two angles."""
    angles = np.array([[12.0, -20.0], [-30.0, 5.0], [33.0, 12.0]])
    positions, reached = angles_to_positions(angles)
    assert reached.all()
    seen = np.rad2deg(np.arctan(direction_to_scene(position_to_direction(positions))))
    np.testing.assert_allclose(seen, angles, atol=1e-10)


def test_angles_beyond_the_mirror_are_told() -> None:
    """50 deg is the rim along the scan and 35.6 deg across it; a view to the side or behind is never reached."""
    angles = np.array([[0, 50.01], [35.6, 0], [35.7, 0], [0, 90], [120, 0]], float)
    positions, reached = angles_to_positions(angles)
    assert reached.tolist() == [False, True, False, False, False]
    assert np.isnan(positions[~reached]).all()
