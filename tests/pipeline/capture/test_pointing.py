"""Viewing angles and played vectors to mirror positions, against numbers worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.capture.straight_scans import PlayedVector, angles_to_positions, split_vector
from pipeline.errors import SceneError
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


def test_a_played_vector_holds_each_cell_for_its_time() -> None:
    """At 10 cells a second and a start 0.05 s before: 0.04 s is still cell 0, 0.06 s cell 1; outside the ends stand."""
    vector = PlayedVector(np.array([[0.0, 0.1], [0.2, 0.3], [0.4, 0.5]]), 10.0, 0.05)
    position, played = vector.at(np.array([-0.06, 0.04, 0.06, 0.24, 0.26]))
    assert played.tolist() == [False, True, True, True, False]
    np.testing.assert_array_equal(position[:, 0], [0.0, 0.0, 0.2, 0.4, 0.4])


def test_a_vector_in_one_memory_has_x_before_y() -> None:
    """1450 cells of X, then 1450 of Y; two columns are X and Y; a row is read as a column."""
    x, y = np.linspace(-0.2, 0.2, 1450), np.linspace(0, 0.1, 1450)
    expected = np.stack([x, y], axis=-1)
    one = np.concatenate([x, y])
    for values in (one, one[None], one[:, None], expected):
        np.testing.assert_array_equal(split_vector(values, "file"), expected)


@pytest.mark.parametrize("values", [np.zeros(3), np.zeros((4, 3)), np.zeros(0)])
def test_numbers_that_are_no_vector_are_refused(values: np.ndarray) -> None:
    """An odd number of cells, three columns, and nothing at all."""
    with pytest.raises(SceneError, match="expected two columns X and Y, or one column with all X before all Y"):
        split_vector(values, "file")
