"""Scan paths: formulas compared with the mirror's own chain, positions, durations and loads of the mirror's memory."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from spectralzoom.pipeline.errors import PoseError, SettingsError
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.mirror import direction_to_scene, position_to_normal, reflect
from spectralzoom.pipeline.geometry.scan import (
    CostModel,
    Load,
    Sweep,
    exposing,
    line_positions,
    memory_loads,
    points_of_scan,
    scan_of_points,
    scene_to_sweep,
    sweep_positions,
    sweep_to_scene,
)

CAMERA = LineCamera()
places = st.floats(-5000, 5000)


def sweep(**changes: object) -> Sweep:
    """Return a short fine sweep off the axis."""
    values = {"name": "a", "kind": "fine", "along": "x", "swath_px": 700.0, "start_px": -900.0, "lines": 5}
    return Sweep(**{**values, **changes})


@pytest.mark.parametrize(("swath", "start"), [(0.0, -1200.0), (2500.0, -4000.0), (-4500.0, 3500.0)])
def test_sample_points_equal_rays_reflected_by_the_mirror(swath: float, start: float):
    """The formula of a line's points agrees with position, normal and reflection to 1e-9 px."""
    path = sweep(swath_px=swath, start_px=start, lines=40)
    slopes = CAMERA.pixel_slopes()
    rays = np.stack([np.zeros_like(slopes), slopes, np.ones_like(slopes)], axis=-1)
    normals = position_to_normal(line_positions(path, CAMERA))
    seen = direction_to_scene(reflect(rays[None], normals[:, None])) / CAMERA.ifov_rad
    along, scan = sweep_to_scene(path, CAMERA)
    assert np.abs(along - seen[..., 0]).max() < 1e-9
    assert np.abs(scan - seen[..., 1]).max() < 1e-9


@given(places, places, st.floats(-0.034, 0.034))
def test_scene_points_and_line_points_are_inverse(swath: float, scan: float, slope: float):
    """The place of any point of a line gives back its line and slope."""
    along, across = points_of_scan(swath, CAMERA, scan, slope)
    centre, back = scan_of_points(swath, CAMERA, along, across)
    assert centre == pytest.approx(scan, abs=1e-8)
    assert back == pytest.approx(slope, abs=1e-12)


@pytest.mark.parametrize(("step", "binning"), [(1, 1), (4, 4), (3, 3), (4, 1)])
def test_sample_points_have_whole_line_and_sample_numbers(step: int, binning: int):
    """The geolocation of a sweep's own points gives whole numbers, for any step and binning."""
    path = sweep(step=step, binning=binning)
    found = scene_to_sweep(path, CAMERA, *sweep_to_scene(path, CAMERA))
    count = CAMERA.samples // binning
    assert found[..., 0] == pytest.approx(np.broadcast_to(np.arange(5.0)[:, None], (5, count)), abs=1e-8)
    assert found[..., 1] == pytest.approx(np.broadcast_to(np.arange(float(count)), (5, count)), abs=1e-8)


def test_lines_lie_at_the_mean_of_their_held_positions():
    """The middle of the exposure is the mean of the held positions, which are one px apart."""
    path = sweep(step=4)
    assert path.line_px() == pytest.approx(path.held_px().mean(axis=1))
    assert np.diff(path.held_px().ravel()) == pytest.approx(1.0)
    assert sweep_positions(path, CAMERA).shape == (5, 4, 2)
    assert line_positions(sweep(), CAMERA) == pytest.approx(sweep_positions(sweep(), CAMERA)[:, 0])


def test_sweeps_beyond_the_rim_are_refused():
    """A line beyond the mirror's disk raises an error; it is not clamped to the rim."""
    with pytest.raises(PoseError, match="beyond the rim"):
        line_positions(sweep(start_px=12_000.0), CAMERA)


def test_survey_seconds_count_lines_setups_and_reloads():
    """Two sweeps of 1000 coarse lines hold 8000 positions, which need six reloads."""
    cost = CostModel()
    path = sweep(lines=1000, step=4)
    assert cost.setup_seconds(LineCamera(readout_ms=5)) == pytest.approx(0.05 + 0.2 + 2 * 0.105)
    assert cost.seconds([path, path], CAMERA) == pytest.approx(200 + 2 * 0.45 + 6 * 1.6)
    assert cost.seconds([], CAMERA) == 0


def test_sweeps_of_other_exposures_cost_their_own_frames():
    """Lines and settling count by each sweep's exposure, or else by the camera's. Reloads count once for all sweeps."""
    cost = CostModel()
    slow, fast = sweep(lines=100), replace(sweep(lines=400), exposure_ms=10.0)
    assert exposing(CAMERA, slow) is CAMERA
    assert exposing(CAMERA, fast) == replace(CAMERA, exposure_ms=10.0)
    assert cost.seconds([slow, fast], CAMERA) == pytest.approx(10 + 0.45 + 4 + 0.27 + 1.6)
    parts = [cost.seconds([one], CAMERA) for one in (slow, fast)]
    assert cost.seconds([slow, fast], CAMERA) == pytest.approx(sum(parts) - 1.6)
    own = replace(slow, exposure_ms=CAMERA.exposure_ms)
    assert cost.seconds([own, fast], CAMERA) == cost.seconds([slow, fast], CAMERA)


def held(lines: int, step: int = 1, name: str = "a") -> Sweep:
    """Return a sweep of ``lines`` lines."""
    return Sweep(name, "fine" if step == 1 else "coarse", "x", 0.0, 0.0, lines, step)


def pairs_of(load: Load, given_sweeps: list[Sweep]) -> int:
    """Return the positions in a load."""
    return sum((part.lines[1] - part.lines[0]) * given_sweeps[part.sweep].step for part in load.parts)


sweeps = st.lists(st.builds(held, st.integers(0, 40), st.integers(1, 9)), max_size=6)


@given(sweeps, st.integers(9, 60))
def test_loads_hold_every_line_once_in_order(given_sweeps: list[Sweep], capacity: int):
    """The parts take the lines of all sweeps in order and without gaps. No load exceeds the capacity."""
    loads = memory_loads(given_sweeps, capacity)
    parts = [part for load in loads for part in load.parts]
    lines_held = [(part.sweep, line) for part in parts for line in range(*part.lines)]
    assert lines_held == [(number, line) for number, each in enumerate(given_sweeps) for line in range(each.lines)]
    assert all(pairs_of(load, given_sweeps) <= capacity for load in loads)


@given(sweeps, st.integers(9, 60))
def test_loads_are_full(given_sweeps: list[Sweep], capacity: int):
    """No load but the last has room for the next line."""
    for load, after in pairwise(memory_loads(given_sweeps, capacity)):
        assert pairs_of(load, given_sweeps) + given_sweeps[after.parts[0].sweep].step > capacity


def test_a_line_larger_than_the_mirror_memory_is_refused():
    """One line of 1501 positions does not fit into 1500 pairs."""
    with pytest.raises(SettingsError, match=r"sweep wide holds 1501 positions in each line.* 1500 pairs"):
        memory_loads([held(1, 1501, "wide")], 1500)
