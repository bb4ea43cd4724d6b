"""The mirror: closed forms, their inverses, the rim, grazing, and the paper's equation beside them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.errors import PoseError, ShapeError
from pipeline.mirror import (
    REST_TANGENT,
    direction_to_normal,
    direction_to_position,
    direction_to_scene,
    line_rotation,
    normal_to_position,
    paper_position,
    position_to_direction,
    position_to_normal,
    reflect,
    scene_to_direction,
)

E1, E3 = np.array([-1.0, 0.0, -1.0]) / np.sqrt(2), np.array([1.0, 0.0, -1.0]) / np.sqrt(2)


def disk(count: int, seed: int = 0) -> np.ndarray:
    """Positions spread evenly over the mirror's disk."""
    rng = np.random.default_rng(seed)
    radius, angle = np.sqrt(rng.uniform(0, 1, count)), rng.uniform(0, 2 * np.pi, count)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)


def tilted(tilt_deg: float) -> np.ndarray:
    """The normal tilted in the plane of incidence."""
    tilt = np.deg2rad(tilt_deg)
    return np.sin(tilt) * E1 + np.cos(tilt) * E3


def test_rest_position_looks_straight_at_the_scene():
    """Position (0, 0) sends the chief ray along x, and that is the scene's origin."""
    direction = position_to_direction([0.0, 0.0])
    assert direction == pytest.approx([1, 0, 0], abs=1e-15)
    assert direction_to_scene(direction) == pytest.approx([0, 0], abs=1e-15)


def test_position_and_direction_are_inverse_over_the_whole_disk():
    """The round trip errs by less than 1e-14 in position and 1e-12 rad in direction."""
    position = disk(20_000)
    direction = position_to_direction(position)
    back = direction_to_position(direction)
    assert np.abs(back - position).max() < 1e-14
    assert np.linalg.norm(position_to_direction(back) - direction, axis=-1).max() < 1e-12


def test_positions_in_single_precision_err_by_less_than_a_microradian():
    """Rounding positions to float32 moves the view by less than 1e-6 rad anywhere."""
    position = disk(20_000)
    moved = position_to_direction((position * 0.999).astype(np.float32)) - position_to_direction(position * 0.999)
    assert np.linalg.norm(moved, axis=-1).max() < 1e-6


@given(st.floats(0, 1), st.floats(0, 2 * np.pi))
def test_position_is_where_the_device_says(radius: float, angle: float):
    """A ray along the rest normal leaves at (X, Y) tan 50 deg, the device's own definition."""
    position = np.array([radius * np.cos(angle), radius * np.sin(angle)])
    out = reflect(-E3, position_to_normal(position))
    assert [out @ E1, out[1]] / (out @ E3) == pytest.approx(position * REST_TANGENT, abs=1e-13)


@pytest.mark.parametrize(
    ("tilt", "exact", "paper"),
    [(1, 0.0293, 0.0413), (5, 0.1480, 0.2062), (10, 0.3054, 0.4109), (12.56, 0.393, 0.514), (20, 0.7041, 0.8093)],
)
def test_exact_position_and_the_papers_differ_as_tabulated(tilt: float, exact: float, paper: float):
    """Equation (7) of the paper is up to 1.41 times the device's coordinate between rest and rim."""
    assert normal_to_position(tilted(tilt)) == pytest.approx([exact, 0], abs=6e-4)
    assert paper_position(tilted(tilt)) == pytest.approx([paper, 0], abs=6e-4)


def test_the_paper_agrees_at_the_rim():
    """At 25 deg both give 1."""
    assert normal_to_position(tilted(25)) == pytest.approx([1, 0], abs=1e-12)
    assert paper_position(tilted(25)) == pytest.approx([1, 0], abs=1e-12)


@pytest.mark.parametrize("radius", [1.0, np.nextafter(1.0, 0), np.nextafter(1.0, 2)])
def test_the_rim_is_reached_from_either_side(radius: float):
    """One unit in the last place about the rim neither raises nor loses digits."""
    position = np.array([0.6, 0.8]) * radius
    assert direction_to_position(position_to_direction(position)) == pytest.approx(position, abs=1e-14)


@pytest.mark.parametrize("position", [(1.0001, 0.0), (0.8, 0.8), (-1.0, 1.0), (0.0, -50.0)])
def test_positions_beyond_the_disk_are_refused(position: tuple[float, float]):
    """The range is a disk, not a square; the message holds the position."""
    with pytest.raises(PoseError, match=rf"\({position[0]:.15g}, {position[1]:.15g}\).*outside the unit disk"):
        position_to_normal(position)


def test_the_first_bad_of_many_is_named():
    """The index and the value of the first position out of reach stand in the message."""
    many = np.zeros((3, 4, 2))
    many[1, 2] = 0.9
    with pytest.raises(PoseError, match=r"\(0.9, 0.9\) \(index 1, 2\)"):
        position_to_normal(many)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_numbers_that_are_not_finite_are_refused(value: float):
    """NaN and infinities raise in every direction of the mapping."""
    for function, vector in [
        (position_to_normal, (0.0, value)),
        (normal_to_position, (value, 0.0, -1.0)),
        (direction_to_normal, (1.0, value, 0.0)),
        (scene_to_direction, (value, 0.0)),
        (line_rotation, (1.0, 0.0, value)),
    ]:
        with pytest.raises(PoseError, match="is not finite"):
            function(vector)


@pytest.mark.parametrize("tilt", [25.001, 44.9999999, 45.0, 60.0, 90.0, 180.0])
def test_normals_beyond_the_rim_are_refused_before_dividing(tilt: float):
    """Tilts at and beyond 45 deg, where X overflows, raise instead of giving a number."""
    with pytest.raises(PoseError, match="beyond the rim"):
        normal_to_position(tilted(tilt))


@pytest.mark.parametrize("angle", [1e-2, 1e-4, 1e-8, 1e-15, 1e-150])
def test_the_normal_keeps_its_digits_at_grazing(angle: float):
    """A view almost along the chief ray has the normal of the plane between them, to the last digits."""
    direction = np.array([np.sin(angle) * 0.6, np.sin(angle) * 0.8, np.cos(angle)])
    expected = [np.cos(angle / 2) * 0.6, np.cos(angle / 2) * 0.8, -np.sin(angle / 2)]
    assert direction_to_normal(direction) == pytest.approx(expected, rel=1e-14, abs=0)
    assert line_rotation(direction) == pytest.approx(np.arctan2(0.8, np.tan(angle / 2)), rel=1e-14)


def test_the_normal_at_the_far_end_is_the_chief_ray_reversed():
    """Looking straight back (o_z = -1) needs the mirror square to the ray; o_z = 1 has no mirror at all."""
    assert direction_to_normal([0.0, 0.0, -1.0]) == pytest.approx([0, 0, -1])
    with pytest.raises(PoseError, match="no mirror makes"):
        direction_to_normal([0.0, 0.0, 1.0])


def test_views_out_of_the_rigs_range_are_refused():
    """Grazing views have a normal, but no position."""
    with pytest.raises(PoseError, match="beyond the rim"):
        direction_to_position([np.sin(1e-3), 0.0, np.cos(1e-3)])


def test_line_rotation_matches_finite_differences():
    """The image of the slit in the scene plane turns by psi, to 1e-8 rad, over the disk."""
    position = disk(500)
    normal, step = position_to_normal(position), 1e-5
    slit = np.array([[0.0, -step, 1.0], [0.0, step, 1.0]])
    ends = reflect(slit[:, None], normal[None])
    moved = np.diff(ends[..., 1:] / ends[..., :1], axis=0)[0]
    psi = line_rotation(position_to_direction(position))
    assert np.abs(np.arctan2(moved[:, 1], moved[:, 0]) - psi).max() < 1e-8


@pytest.mark.parametrize(
    ("position", "psi_deg"),
    [
        ((0, 0.3), 13.8),
        ((0.4, 0.3), 10.8),
        ((-0.4, 0.3), 16.7),
        ((0.8, 0.3), 8.5),
        ((0, 0.7), 27.1),
        ((-0.4, 0.8), 34.2),
    ],
)
def test_line_rotation_has_the_known_values(position: tuple[float, float], psi_deg: float):
    """Angles worked out independently for six positions."""
    assert np.rad2deg(line_rotation(position_to_direction(position))) == pytest.approx(psi_deg, abs=0.06)


@given(st.floats(-0.7, 0.7), st.floats(-0.7, 0.7))
def test_scene_tangents_and_directions_are_inverse(xi: float, eta: float):
    """Tangents survive the way to a direction and back."""
    assert direction_to_scene(scene_to_direction([xi, eta])) == pytest.approx([xi, eta], abs=1e-15)


def test_wrong_shapes_and_lengths_are_refused():
    """A vector of the wrong size or length says so."""
    with pytest.raises(ShapeError, match="needs 2 numbers"):
        position_to_normal([0.0, 0.0, 1.0])
    with pytest.raises(PoseError, match="not of length 1"):
        direction_to_normal([2.0, 0.0, 0.0])
    with pytest.raises(PoseError, match="looks away"):
        direction_to_scene([-1.0, 0.0, 0.0])


def test_no_positions_give_no_directions():
    """Empty in, empty out, with the shape kept."""
    assert position_to_direction(np.zeros((0, 4, 2))).shape == (0, 4, 3)
