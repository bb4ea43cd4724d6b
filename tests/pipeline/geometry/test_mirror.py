"""The mirror: formulas and inverses in both precisions, rim, grazing views, line rotation, throughput and mounting."""

from __future__ import annotations

from typing import get_args

import mpmath
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from spectralzoom.pipeline.errors import PoseError, SettingsError
from spectralzoom.pipeline.geometry.mirror import (
    Axes,
    Mounting,
    camera_slope,
    check_reach,
    direction_to_normal,
    direction_to_position,
    direction_to_scene,
    line_centre,
    mirror_throughput,
    normal_to_position,
    position_to_direction,
    position_to_normal,
    reflect,
    scene_to_direction,
)
from tests.pipeline.geometry.paper_equations import line_rotation

E1, E3 = np.array([-1.0, 0.0, -1.0]) / np.sqrt(2), np.array([1.0, 0.0, -1.0]) / np.sqrt(2)


def disk(count: int, seed: int = 0) -> np.ndarray:
    """Return positions spread evenly over the mirror's disk."""
    rng = np.random.default_rng(seed)
    radius, angle = np.sqrt(rng.uniform(0, 1, count)), rng.uniform(0, 2 * np.pi, count)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)


def tilted(tilt_deg: float) -> np.ndarray:
    """Return the normal tilted in the plane of incidence."""
    tilt = np.deg2rad(tilt_deg)
    return np.sin(tilt) * E1 + np.cos(tilt) * E3


@pytest.mark.parametrize(("precision", "most_rad"), [(np.float64, 1e-12), (np.float32, 1e-6)])
def test_position_and_direction_are_inverse_over_the_disk(precision: type, most_rad: float):
    """Position to direction and back errs by less than 1e-12 rad of view in float64 and 1e-6 in float32."""
    position = disk(50_000).astype(precision)
    direction = position_to_direction(position)
    back = direction_to_position(direction)
    assert direction.dtype == back.dtype == precision
    there, here = (position_to_direction(one.astype(np.float64) * 0.999) for one in (back, position))
    assert np.linalg.norm(there - here, axis=-1).max() < most_rad


def exact_direction(position: np.ndarray) -> list[mpmath.mpf]:
    """Return one reflected ray, computed with 50 digits from the definition of the device's coordinates."""
    half = mpmath.sqrt(mpmath.mpf(1) / 2)
    tangent = mpmath.tan(50 * mpmath.pi / 180)
    axes = mpmath.matrix([[-half, 0, -half], [0, 1, 0], [half, 0, -half]])
    ray = mpmath.matrix([[float(position[0]) * tangent, float(position[1]) * tangent, mpmath.mpf(1)]])
    normal = (ray / mpmath.norm(ray) + mpmath.matrix([[0, 0, 1]])) * axes
    normal /= mpmath.norm(normal)
    return [-2 * normal[2] * normal[0], -2 * normal[2] * normal[1], 1 - 2 * normal[2] ** 2]


@pytest.mark.parametrize(("precision", "most"), [(np.float64, 1e-15), (np.float32, 6e-7)])
def test_directions_agree_with_fifty_digits(precision: type, most: float):
    """Directions and line rotations of 100 random positions equal those of 50-digit arithmetic, to rounding."""
    with mpmath.workdps(50):
        for position in disk(100, seed=4).astype(precision):
            exact, direction = exact_direction(position), position_to_direction(position)
            assert max(abs(float(e - mpmath.mpf(float(d)))) for e, d in zip(exact, direction, strict=True)) < most
            psi = mpmath.atan2(exact[1], 1 - exact[2])
            assert abs(float(psi - mpmath.mpf(float(line_rotation(direction))))) < 3 * most


def test_single_precision_is_kept_and_mixed_precision_becomes_double():
    """Functions return float32 for float32 arrays and Python numbers, and float64 if any array is float64."""
    f = np.float32
    position = disk(5).astype(f) / 2
    tangent = np.array([0.1, 0.2], f)
    direction = position_to_direction(position)
    ones = [position_to_normal(position), direction, direction_to_position(direction), line_rotation(direction)]
    ones += [scene_to_direction(tangent), direction_to_scene(direction), mirror_throughput(position)]
    ones += [line_centre(tangent, tangent, 0.25), camera_slope(tangent, tangent, 0.25, tangent)]
    assert {array.dtype for array in ones} == {np.dtype(f)}
    assert line_centre(tangent, tangent, np.array([0.25, 0.25])).dtype == np.float64
    assert position_to_direction(position.astype(np.float16)).dtype == np.float64


@pytest.mark.parametrize("position", [(1.0001, 0.0), (0.8, 0.8), (-1.0, 1.0), (0.0, -50.0)])
def test_positions_beyond_the_disk_are_refused(position: tuple[float, float]):
    """The range of positions is a disk, not a square. The message contains the position."""
    with pytest.raises(PoseError, match=rf"\({position[0]:.15g}, {position[1]:.15g}\).*outside the unit disk"):
        position_to_normal(position)
    with pytest.raises(PoseError, match="outside the unit disk"):
        check_reach(position)


@pytest.mark.parametrize("tilt", [25.001, 44.9999999, 45.0, 60.0, 90.0, 180.0])
def test_normals_beyond_the_rim_are_refused_before_dividing(tilt: float):
    """Tilts from 25.001 deg raise an error, also at 45 deg and beyond, where X overflows."""
    with pytest.raises(PoseError, match="beyond the rim"):
        normal_to_position(tilted(tilt))


def test_line_rotation_matches_finite_differences():
    """The slit's image in the scene plane turns by psi, to 1e-8 rad, over the disk and on its rim."""
    turn = np.linspace(0, 2 * np.pi, 73)
    position = np.concatenate([disk(500), np.stack([np.cos(turn), np.sin(turn)], axis=-1)])
    step = np.array([0.0, 1e-5, 0.0])
    rays = np.array([0.0, 0.0, 1.0]) + np.stack([-step, step])
    ends = reflect(rays[:, None], position_to_normal(position)[None])
    run, rise = np.moveaxis(np.diff(ends[..., 1:] / ends[..., :1], axis=0)[0], -1, 0)
    off = np.arctan2(rise, run) - line_rotation(position_to_direction(position))
    assert np.abs(np.arctan2(np.sin(off), np.cos(off))).max() < 1e-8


def test_throughput_depends_on_the_tilt():
    """The throughput is 0.72 to 1.21 over 10240 x 10240 px, 0.48 to 1.33 over the disk, and exactly 1 at rest."""
    side = np.linspace(-5120, 5120, 201) * 105.714e-6
    normals = direction_to_normal(scene_to_direction(np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)))
    field = -normals[:, 2] * np.sqrt(2)
    turn = np.linspace(0, 2 * np.pi, 721)
    rim = mirror_throughput(np.stack([np.cos(turn), np.sin(turn)], axis=-1))
    assert (field.min(), field.max()) == pytest.approx((0.72, 1.21), abs=0.006)
    assert (rim.min(), rim.max()) == pytest.approx((0.48, 1.33), abs=0.005)
    assert mirror_throughput([0.0, 0.0]) == 1.0
    inside = mirror_throughput(disk(2000))
    assert rim.min() <= inside.min()
    assert inside.max() <= rim.max()


@given(st.floats(-0.7, 0.7), st.floats(-0.7, 0.7))
def test_scene_tangents_and_directions_are_inverse(xi: float, eta: float):
    """Tangents converted to a direction and back are equal to 1e-15."""
    assert direction_to_scene(scene_to_direction([xi, eta])) == pytest.approx([xi, eta], abs=1e-15)


@given(st.sampled_from(get_args(Axes)), st.floats(-5, 5), st.floats(-0.05, 0.05), st.floats(0, 0.9), st.floats(0, 7))
def test_to_model_inverts_to_device(axes: str, clocking: float, offset: float, radius: float, angle: float):
    """Any mounting is undone to rounding, for positions inside of both disks."""
    mounting = Mounting(axes, clocking, offset, -offset)
    position = radius * np.array([np.cos(angle), np.sin(angle)])
    assert mounting.to_model(mounting.to_device(position)) == pytest.approx(position, abs=1e-15)


def test_mounting_swaps_axes_as_set():
    """With "y,-x" X is Y and Y is -X, as in published code. The default changes no bit, not even the sign of 0."""
    many = np.array([[0.3, 0.1], [-0.2, 0.5], [-0.0, 0.0]])
    assert Mounting(axes="y,-x").to_device(many) == pytest.approx(np.array([[0.1, -0.3], [0.5, 0.2], [0.0, 0.0]]))
    assert Mounting().to_device(many).tobytes() == Mounting().to_model(many).tobytes() == many.tobytes()


def test_clocking_turns_anticlockwise_from_x_to_y():
    """The device's axes are named after the rotation, so with "y,-x" its X is the Y of the turned position."""
    cos, sin = np.cos(np.deg2rad(10)), np.sin(np.deg2rad(10))
    assert Mounting(clocking_deg=10).to_device([[0.5, 0], [0, 0.5]]) == pytest.approx(
        0.5 * np.array([[cos, sin], [-sin, cos]])
    )
    assert Mounting("y,-x", 10).to_device([0.5, 0]) == pytest.approx(0.5 * np.array([sin, -cos]))


def test_positions_that_the_device_would_clamp_are_refused():
    """An offset that moves a position beyond the device's rim raises an error with offset and position."""
    with pytest.raises(
        PoseError, match=r"as mounted \(offset 0.1; 0\).*1.05.*outside the unit disk.*less of the field"
    ):
        Mounting(offset_x=0.1).to_device([0.95, 0.0])


def test_invalid_mountings_are_refused():
    """Axes that repeat one axis, and numbers that are not finite, are refused."""
    with pytest.raises(SettingsError, match=r"axes must be one of .*got 'x,x'"):
        Mounting(axes="x,x")
    with pytest.raises(SettingsError, match="must be finite"):
        Mounting(clocking_deg=float("nan"))
