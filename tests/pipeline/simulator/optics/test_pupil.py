"""The foreshortened pupil: against the outline of a tilted disc, and its extremes along sweeps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from pipeline.geometry.mirror import direction_to_normal, position_to_normal, scene_to_direction
from pipeline.geometry.scan import Sweep
from pipeline.simulator.optics.rays import REST_NORMAL, middle_normal, normals_met, spread_of_rays, spread_of_waves
from pipeline.simulator.rig_model import Rig
from tests.pipeline.simulator.fine_image import FLAT, SWEEP, probe_of

RIG = Rig()
PROBE = probe_of(FLAT)
TANGENTS = arrays(np.float64, 2, elements=st.floats(-0.5, 0.5))


def test_rest():
    """At rest the pupil is 0.71 as wide along the scan and whole along the line."""
    assert spread_of_rays() == pytest.approx([1, 0.5])
    assert spread_of_waves() == pytest.approx([1, 2])
    assert position_to_normal((0, 0)) == pytest.approx(REST_NORMAL)


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
def test_ends_of_a_sweep_hold_the_extremes(strip: float, start: float, lines: int, step: int):
    """No held position between has a wider or narrower pupil than the ends."""
    sweep = Sweep("s", "fine", "x", strip, start, max(lines // step, 1), step)
    probe = replace(PROBE, sweeps=(sweep,))
    held = sweep.held_px().ravel()
    tangents = np.stack([np.full_like(held, strip), held], axis=-1) * RIG.camera.ifov_rad
    normals = direction_to_normal(scene_to_direction(tangents))
    ends = normals_met(probe.sweeps, RIG.camera)[1:]
    for spread in (spread_of_rays, spread_of_waves):
        assert (spread(normals) <= spread(ends).max(axis=0) * (1 + 1e-12)).all()
        assert (spread(normals) >= spread(ends).min(axis=0) * (1 - 1e-12)).all()


def test_no_sweep_leaves_the_rest_position():
    """A probe without lines is judged at rest; the middle of a sweep round the axis is the rest position."""
    for sweeps in ((), (replace(SWEEP, lines=0),)):
        assert normals_met(sweeps, RIG.camera) == pytest.approx(REST_NORMAL[None])
    assert middle_normal(replace(SWEEP, start_px=-11.5), RIG.camera) == pytest.approx(REST_NORMAL)
