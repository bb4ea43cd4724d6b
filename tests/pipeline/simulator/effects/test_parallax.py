"""Parallax: rays of a pinhole behind the pivot, depth steps and planes, and distances out to infinity."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from pipeline.geometry.mirror import scene_to_direction
from pipeline.geometry.scan import Sweep, sweep_to_scene
from pipeline.simulator.effects.effect import SweepBlock
from pipeline.simulator.effects.probe import Probe
from pipeline.simulator.effects.air import PARALLAX, closeness
from pipeline.simulator.rig_model import Air, Rig
from tests.pipeline.geometry.test_second_order import relief_error

SWEEP = Sweep("strip", "fine", "x", 0.0, -100.0, 201)
STEP = Air(distance_m=30.0, relief="step", nearest_m=3.0)


def shown(air: Air, sweep: Sweep = SWEEP, lines: range = range(201)) -> tuple[np.ndarray, np.ndarray]:
    """Displacement of the points of some lines."""
    rig = Rig(air=air)
    along, scan = sweep_to_scene(sweep, rig.camera)
    taken = slice(lines.start, lines.stop)
    return PARALLAX.displaced(SweepBlock(rig, sweep, lines, np.ones(1), (201, 640)), along[taken], scan[taken], "exact")


def probe(slope: tuple[float, float], sweeps: tuple[Sweep, ...] = (SWEEP,), span: float = 1e9) -> Probe:
    """A scene of one band, known by its slope along the line and along the scan."""
    one, none, both = np.ones(1), np.zeros(1), np.array(slope)[:, None]
    return Probe(
        "sigma", sweeps, 500 * one, None, one, one, span * one, both, both, none, none, 1e4, 0.0, 1.0, 201, 20.0
    )


def test_line_ends_move_by_half_a_line_times_the_lever():
    """At a line's ends parts at 3 and 30 m lie 320 L (1/3 - 1/30) px apart, 9.6 px for 0.1 m; centres stay."""
    along, scan = shown(STEP)
    near = along[150]
    middle = relief_error(Rig().camera, 3.0, 30.0)
    assert middle == pytest.approx(9.6)
    assert np.abs(near[[0, -1]]) == pytest.approx(middle * 319.5 / 320, rel=2e-3)
    assert np.abs(near[319:321]).max() < 0.02
    np.testing.assert_allclose(along[:100], 0, atol=1e-12)  # as far as the scene's distance
    assert np.abs(scan).max() < 0.1


@pytest.mark.parametrize("strip_px", [0.0, 1500.0, -3000.0])
def test_rays_of_a_pinhole_behind_the_pivot(strip_px: float):
    """Points seen from the lever behind the pivot, on a plane across the chief ray's distance, are met exactly."""
    sweep = replace(SWEEP, strip_px=strip_px, start_px=900.0)
    air = Air(distance_m=math.inf, relief="step", nearest_m=4.0, farthest_m=4.0, lever_m=0.1)
    camera = Rig().camera
    along, scan = sweep_to_scene(sweep, camera)
    found = np.stack([along, scan], axis=-1) + np.stack(shown(air, sweep), axis=-1)
    centre = np.stack([np.full(201, strip_px), sweep.line_px()], axis=-1) * camera.ifov_rad
    chief = scene_to_direction(centre)[:, None]
    ray = scene_to_direction(np.stack([along, scan], axis=-1) * camera.ifov_rad)
    depth = 4.0 * chief[..., 0]  # of the plane that the chief ray meets 4 m from the pivot
    point = -0.1 * chief + ray * ((depth + 0.1 * chief[..., 0]) / ray[..., 0])[..., None]
    np.testing.assert_allclose(found * camera.ifov_rad, point[..., 1:] / point[..., :1], atol=1e-12)


def test_reliefs():
    """A step is far above the middle row and near from there on; along a plane 1/d runs evenly; flat is d0."""
    row = np.array([-2.0, -1.0, -0.5, 0.0, 1.0, 3.0])
    np.testing.assert_allclose(closeness(STEP, row), [1 / 30, 1 / 30, 1 / 30, 1 / 3, 1 / 3, 1 / 3])
    plane = closeness(replace(STEP, relief="plane", farthest_m=math.inf), row)
    np.testing.assert_allclose(plane, [0, 0, 1 / 12, 1 / 6, 1 / 3, 1 / 3])
    np.testing.assert_allclose(closeness(replace(STEP, relief="flat"), row), 1 / 30)


def test_a_line_across_the_step_has_both_depths():
    """Where the line crosses the rows it meets both parts of the scene."""
    along = shown(STEP, replace(SWEEP, along="y"))[0]
    np.testing.assert_allclose(along[100, :320], 0, atol=1e-12)
    assert along[100, -1] == pytest.approx(9.6, rel=0.01)


@pytest.mark.parametrize("size", [1, 7])
def test_blocks_do_not_change_lines(size: int):
    """Lines are bit for bit the same in blocks of any size."""
    whole = shown(STEP)[0]
    parts = [shown(STEP, lines=range(a, min(a + size, 201)))[0] for a in range(0, 201, size)]
    np.testing.assert_array_equal(np.concatenate(parts), whole)


@pytest.mark.parametrize("relief", ["step", "plane"])
@pytest.mark.parametrize(("near", "far"), [(3.0, 30.0), (25.0, 30.0), (30.0, math.inf)])
def test_bound_holds_and_is_tight(relief: str, near: float, far: float):
    """The change of a wave along the line is below the bound and at least a sixth of it."""
    air = Air(distance_m=30.0, relief=relief, nearest_m=near, farthest_m=far)  # type: ignore[arg-type]
    along, scan = shown(air)
    x, y = sweep_to_scene(SWEEP, Rig().camera)
    change = np.abs(np.sin((x + along) / 5 + (y + scan) / 20) - np.sin(x / 5 + y / 20)).max()
    bound = PARALLAX.bound(probe((0.2, 0.05), span=2.0), Rig(air=air)).value
    assert change <= bound <= 6 * change


def test_a_depth_step_at_3_m_is_on_and_one_at_300_m_is_off():
    """On detail of 5 sigma/px a step from 3 m matters at 0.1 sigma, one of a metre at 300 m does not."""
    near = Rig(air=Air(distance_m=3.0, relief="step", farthest_m=4.0))
    far = Rig(air=Air(distance_m=300.0, relief="step", nearest_m=299.0))
    assert PARALLAX.bound(probe((5.0, 5.0)), near).value > 1
    assert "between 3 and 4 m" in PARALLAX.bound(probe((5.0, 5.0)), near).why
    assert 0 < PARALLAX.bound(probe((5.0, 5.0)), far).value < 0.1 / 1.2


@pytest.mark.parametrize(
    "air", [Air(), Air(distance_m=3.0), Air(distance_m=math.inf, relief="step"), replace(STEP, lever_m=0)]
)
def test_nothing_at_one_distance(air: Air):
    """No distance, one distance, all infinitely far, no lever: no displacement and no bound."""
    assert PARALLAX.bound(probe((5.0, 5.0)), Rig(air=air)).value == 0
    assert not np.any(shown(air))


def test_flat_scene_has_no_parallax():
    """Without a slope nothing changes; nor without sweeps."""
    assert PARALLAX.bound(probe((0.0, 0.0)), Rig(air=STEP)).value == 0
    assert PARALLAX.bound(probe((5.0, 5.0), ()), Rig(air=STEP)).value == 0
