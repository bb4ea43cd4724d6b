"""Hard cases of the mirror: grazing, the rim to the last bit, zero, NaN, both precisions."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.errors import PoseError
from pipeline.geometry.mirror import (
    direction_to_normal,
    direction_to_position,
    direction_to_scene,
    mirror_throughput,
    position_to_direction,
    position_to_normal,
    scene_to_direction,
)
from tests.pipeline.geometry.paper_equations import line_rotation

PRECISIONS = [np.float64, np.float32]


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("angle", [1e-3, 1e-6, 1e-12, 1e-18])
def test_a_view_towards_the_camera_keeps_its_digits(precision: type, angle: float):
    """o -> +z: the normal and the rotation have the values of their limits, in the precision that came in."""
    o = np.array([0.6 * np.sin(angle), 0.8 * np.sin(angle), np.cos(angle)]).astype(precision)
    normal, eps = direction_to_normal(o), 4 * float(np.finfo(precision).eps)
    exact = [0.6 * np.cos(angle / 2), 0.8 * np.cos(angle / 2), -np.sin(angle / 2)]
    assert normal.dtype == precision
    assert normal == pytest.approx(exact, rel=2 * eps, abs=0)
    assert line_rotation(o) == pytest.approx(np.arctan2(0.8, np.tan(angle / 2)), rel=eps)


def test_the_camera_itself_cannot_be_looked_at():
    """o = +z has no mirror, whatever asks; the message holds the direction."""
    for function in (direction_to_normal, direction_to_position, line_rotation):
        with pytest.raises(PoseError, match=r"\(0, 0, 1\).*no mirror makes"):
            function([0.0, 0.0, 1.0])


def test_a_view_straight_back_has_a_normal_but_no_position():
    """o = -z: the mirror faces the camera, the line is not turned, and the rig cannot get there."""
    assert direction_to_normal([0.0, 0.0, -1.0]) == pytest.approx([0, 0, -1])
    assert line_rotation([[0.0, 0.0, -1.0], [0.0, 1e-9, -1.0]]) == pytest.approx([0, 5e-10], abs=1e-24)
    with pytest.raises(PoseError, match=r"\(-?0, 0, -1\).*beyond the rim"):
        direction_to_position([0.0, 0.0, -1.0])


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("towards", [0.0, 2.0])
def test_one_bit_either_side_of_the_rim_is_still_the_rim(precision: type, towards: float):
    """Radius 1 + and - 1 ulp goes to a ray and back without an error or a lost digit."""
    turn = np.linspace(0, 2 * np.pi, 720)
    around = np.stack([np.cos(turn), np.sin(turn)], axis=-1).astype(precision)
    rim = np.nextafter(around, towards * around, dtype=precision)
    for position in (rim, np.array([[np.nextafter(precision(1), precision(towards)), 0]], precision)):
        back = direction_to_position(position_to_direction(position))
        assert np.abs(back - position).max() < 16 * np.finfo(precision).eps


@pytest.mark.parametrize(("precision", "beyond"), [(np.float64, 1e-11), (np.float32, 3e-6)])
def test_just_beyond_the_rim_is_refused(precision: type, beyond: float):
    """More than rounding beyond the rim raises, with all digits of the value."""
    position = np.array([1 + beyond, 0], precision)
    with pytest.raises(PoseError, match=rf"\({float(position[0]):.15g}, 0\).*outside the unit disk"):
        position_to_normal(position)


@pytest.mark.parametrize("zero", [0.0, -0.0])
def test_rest_is_exact(zero: float):
    """XY = 0, of either sign, looks along x, is not turned, passes all light, and comes back as 0."""
    rest = np.array([zero, zero])
    direction = position_to_direction(rest)
    assert direction_to_scene(direction) == pytest.approx([0, 0], abs=3e-16)
    assert line_rotation(direction) == 0
    assert mirror_throughput(rest) == 1
    assert np.abs(direction_to_position([1.0, 0.0, 0.0])).max() < 1e-15


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_numbers_that_are_not_finite_are_named(precision: type, value: float):
    """NaN and infinity raise with their place among many, in both precisions."""
    many = np.zeros((4, 2), precision)
    many[2, 1] = value
    for function in (position_to_normal, position_to_direction, mirror_throughput, scene_to_direction):
        with pytest.raises(PoseError, match=rf"\(0, {value}\) \(index 2\) is not finite"):
            function(many)
