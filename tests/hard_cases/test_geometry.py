"""Hard cases of the mirror: grazing incidence, the rim to the last bit, zero, NaN, float32 and float64."""

from __future__ import annotations

import numpy as np
import pytest

from spectralzoom.pipeline.errors import PoseError
from spectralzoom.pipeline.geometry import mirror
from tests.pipeline.geometry.paper_equations import line_rotation

PRECISIONS = [np.float64, np.float32]


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("angle", [1e-3, 1e-6, 1e-12, 1e-18])
def test_grazing_view_keeps_its_precision(precision: type, angle: float):
    """For o -> +z the normal and the line rotation match their limits, in the precision of the input."""
    o = np.array([0.6 * np.sin(angle), 0.8 * np.sin(angle), np.cos(angle)]).astype(precision)
    normal = mirror.direction_to_normal(o)
    eps = 4 * float(np.finfo(precision).eps)
    exact = [0.6 * np.cos(angle / 2), 0.8 * np.cos(angle / 2), -np.sin(angle / 2)]
    assert normal.dtype == precision
    assert normal == pytest.approx(exact, rel=2 * eps, abs=0)
    assert line_rotation(o) == pytest.approx(np.arctan2(0.8, np.tan(angle / 2)), rel=eps)


def test_view_along_the_chief_ray_is_refused():
    """No mirror reflects the chief ray to o = +z: all three functions raise, and the message names the direction."""
    for function in (mirror.direction_to_normal, mirror.direction_to_position, line_rotation):
        with pytest.raises(PoseError, match=r"\(0, 0, 1\).*no mirror makes"):
            function([0.0, 0.0, 1.0])


def test_view_into_the_camera_has_a_normal_but_no_position():
    """For o = -z the mirror faces the camera and the line rotation is 0; that position lies beyond the rim."""
    assert mirror.direction_to_normal([0.0, 0.0, -1.0]) == pytest.approx([0, 0, -1])
    assert line_rotation([[0.0, 0.0, -1.0], [0.0, 1e-9, -1.0]]) == pytest.approx([0, 5e-10], abs=1e-24)
    with pytest.raises(PoseError, match=r"\(-?0, 0, -1\).*beyond the rim"):
        mirror.direction_to_position([0.0, 0.0, -1.0])


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("towards", [0.0, 2.0])
def test_positions_one_ulp_from_the_rim_are_accepted(precision: type, towards: float):
    """Positions at radius 1 plus or minus 1 ulp convert to a direction and back without loss of precision."""
    turn = np.linspace(0, 2 * np.pi, 720)
    around = np.stack([np.cos(turn), np.sin(turn)], axis=-1).astype(precision)
    rim = np.nextafter(around, towards * around, dtype=precision)
    for position in (rim, np.array([[np.nextafter(precision(1), precision(towards)), 0]], precision)):
        back = mirror.direction_to_position(mirror.position_to_direction(position))
        assert np.abs(back - position).max() < 16 * np.finfo(precision).eps


@pytest.mark.parametrize(("precision", "beyond"), [(np.float64, 1e-11), (np.float32, 3e-6)])
def test_position_beyond_the_rim_is_refused(precision: type, beyond: float):
    """A radius that exceeds 1 by more than rounding raises, and the message has all digits of the value."""
    position = np.array([1 + beyond, 0], precision)
    with pytest.raises(PoseError, match=rf"\({float(position[0]):.15g}, 0\).*outside the unit disk"):
        mirror.position_to_normal(position)


@pytest.mark.parametrize("zero", [0.0, -0.0])
def test_rest_position_is_exact(zero: float):
    """XY = 0, of either sign, looks along x, has no line rotation and a throughput of 1, and converts back to 0."""
    rest = np.array([zero, zero])
    direction = mirror.position_to_direction(rest)
    assert mirror.direction_to_scene(direction) == pytest.approx([0, 0], abs=3e-16)
    assert line_rotation(direction) == 0
    assert mirror.mirror_throughput(rest) == 1
    assert np.abs(mirror.direction_to_position([1.0, 0.0, 0.0])).max() < 1e-15


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_nan_and_infinity_are_refused_with_their_index(precision: type, value: float):
    """All four functions raise and name the index among several positions, in both precisions."""
    many = np.zeros((4, 2), precision)
    many[2, 1] = value
    for function in (
        mirror.position_to_normal,
        mirror.position_to_direction,
        mirror.mirror_throughput,
        mirror.scene_to_direction,
    ):
        with pytest.raises(PoseError, match=rf"\(0, {value}\) \(index 2\) is not finite"):
            function(many)
