"""Footprints of few kernels that stand for all bands, and the foreshortened pupil along sweeps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from pipeline.geometry.mirror import direction_to_normal, scene_to_direction
from pipeline.geometry.scan import Sweep
from pipeline.simulator.optics.kernel_fit import Moments, box_weight, fold
from pipeline.simulator.optics.rays import REST_NORMAL, extreme_normals, middle_normal, spread_of_rays, spread_of_waves
from pipeline.simulator.rig_model import Rig


def test_bands_alike_have_one_kernel() -> None:
    """Equal moments need one kernel, and it has exactly those."""
    found = fold((2.7, 1.0), (1, 1), 1, Moments(np.full((2, 9), 0.1), np.full((2, 9), 0.3)))
    assert found.kernels == 1
    np.testing.assert_allclose(np.concatenate([found.shift, found.variance])[:, 0], [0.1, 0.1, 0.3, 0.3])
    np.testing.assert_array_equal(found.mixing, 1.0)


@pytest.mark.parametrize("parts", [(1, 1), (3, 1)])
def test_a_window_is_as_wide_as_all_of_its_kernels_need(parts: tuple[int, int]) -> None:
    """Each kernel looks through one window, with others of its level that are nearly as wide."""
    waves, shift = np.array([[0.63], [0.89]]) * np.linspace(0.4, 1.0, 9), np.outer([0.075, 0.0], np.linspace(-1, 1, 9))
    found = fold((2.7, 1.0), parts, 1, Moments(shift, np.full((2, 9), 0.04), waves))
    windows = found.windows()
    assert sorted(np.concatenate([some for _, some in windows]).tolist()) == list(range(found.kernels))
    assert len(windows) > len(set(found.level.tolist()))
    for level, some in windows:
        assert set(found.level[some].tolist()) == {level}
        assert np.ptp(np.sqrt(found.variance[:, some]).max(axis=0)) <= 0.2


def test_no_box_and_no_blur_is_linear() -> None:
    """A zero-width slit without blur is a point between two pixels."""
    found = fold((0.0, 0.0), (1, 1), 1, Moments(np.zeros((2, 5)), np.zeros((2, 5))))
    assert (found.kernels, found.variance.max()) == (1, 0)
    np.testing.assert_allclose(box_weight(np.array([0.0, 0.25, 0.5, 1.0, 1.5]), 0.0), [1, 0.75, 0.5, 0, 0])


RIG = Rig()
SWEEP = Sweep("fine", "fine", "x", swath_px=0.0, start_px=-11.5, lines=24)
TANGENTS = arrays(np.float64, 2, elements=st.floats(-0.5, 0.5))


@given(TANGENTS)
def test_rays_spread_as_the_disc_that_the_camera_sees(tangents: np.ndarray):
    """The variance of points of the tilted disc along the camera's axes, over that of a round one."""
    normal = direction_to_normal(scene_to_direction(tangents))
    first = np.cross(normal, (0, 1, 0)) / np.linalg.norm(np.cross(normal, (0, 1, 0)))
    turn = np.arange(8) * np.pi / 4
    rim = np.cos(turn)[:, None] * first + np.sin(turn)[:, None] * np.cross(normal, first)
    assert spread_of_rays(normal) == pytest.approx(2 * np.mean(rim[:, [1, 0]] ** 2, axis=0))


@given(TANGENTS)
def test_waves_spread_as_the_inverse_of_the_pupil(tangents: np.ndarray):
    """An ellipse of shape S spreads waves by the inverse of S, of which the diagonal is kept."""
    normal = direction_to_normal(scene_to_direction(tangents))
    shape = np.eye(2) - np.outer(normal[:2], normal[:2])
    assert spread_of_waves(normal) == pytest.approx(np.diag(np.linalg.inv(shape))[::-1])


@given(st.floats(-4000, 4000), st.floats(-5000, 3000), st.integers(1, 2000), st.integers(1, 8))
def test_ends_of_a_sweep_hold_the_extremes(swath: float, start: float, lines: int, step: int):
    """No held position between has a wider or narrower pupil than the ends."""
    sweep = Sweep("s", "fine", "x", swath, start, max(lines // step, 1), step)
    held = sweep.held_px().ravel()
    tangents = np.stack([np.full_like(held, swath), held], axis=-1) * RIG.camera.ifov_rad
    normals = direction_to_normal(scene_to_direction(tangents))
    ends = extreme_normals((sweep,), RIG.camera)[1:]
    for spread in (spread_of_rays, spread_of_waves):
        assert (spread(normals) <= spread(ends).max(axis=0) * (1 + 1e-12)).all()
        assert (spread(normals) >= spread(ends).min(axis=0) * (1 - 1e-12)).all()


def test_no_sweep_leaves_the_rest_position():
    """A probe without lines is judged at rest; the middle of a sweep round the axis is the rest position."""
    for sweeps in ((), (replace(SWEEP, lines=0),)):
        assert extreme_normals(sweeps, RIG.camera) == pytest.approx(REST_NORMAL[None])
    assert middle_normal(SWEEP, RIG.camera) == pytest.approx(REST_NORMAL)
