"""Footprints of few kernels for all bands, the foreshortened pupil along sweeps, and the disc of defocus."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.integrate import quad

from spectralzoom.pipeline.geometry.mirror import direction_to_normal, scene_to_direction
from spectralzoom.pipeline.geometry.scan import Sweep
from spectralzoom.pipeline.simulator.optics.kernel_fit import Moments, box_weight, disc_contrast, disc_points, fold
from spectralzoom.pipeline.simulator.optics.rays import (
    REST_NORMAL,
    extreme_normals,
    middle_normal,
    spread_of_rays,
    spread_of_waves,
)
from spectralzoom.pipeline.simulator.optics.scene_radiance import kernels_of
from spectralzoom.pipeline.simulator.rig_model import Rig

NONE = np.zeros(1)


def test_equal_bands_need_one_kernel() -> None:
    """The kernel has exactly the moments of the bands."""
    found = fold((2.7, 1.0), (1, 1), 1, Moments(np.full((2, 9), 0.1), np.full((2, 9), 0.3)))
    assert found.kernels == 1
    np.testing.assert_allclose(np.concatenate([found.shift, found.variance])[:, 0], [0.1, 0.1, 0.3, 0.3])
    np.testing.assert_array_equal(found.fractions @ found.between, 1.0)


@pytest.mark.parametrize("parts", [(1, 1), (3, 1)])
def test_windows_group_kernels_of_similar_width(parts: tuple[int, int]) -> None:
    """Each kernel has one window, with others of its level whose standard deviations differ by at most 0.2 px."""
    waves = np.array([[0.63], [0.89]]) * np.linspace(0.4, 1.0, 9)
    shift = np.outer([0.075, 0.0], np.linspace(-1, 1, 9))
    found = fold((2.7, 1.0), parts, 1, Moments(shift, np.full((2, 9), 0.04), waves))
    windows = found.windows()
    assert sorted(np.concatenate([some for _, some in windows]).tolist()) == list(range(found.kernels))
    assert len(windows) > len(set(found.level.tolist()))
    for level, some in windows:
        assert set(found.level[some].tolist()) == {level}
        assert np.ptp(np.sqrt(found.variance[:, some]).max(axis=0)) <= 0.2


def test_footprint_without_width_is_linear_interpolation() -> None:
    """A zero-width slit without blur is a point between two pixels."""
    found = fold((0.0, 0.0), (1, 1), 1, Moments(np.zeros((2, 5)), np.zeros((2, 5))))
    assert (found.kernels, found.variance.max()) == (1, 0)
    np.testing.assert_allclose(box_weight(np.array([0.0, 0.25, 0.5, 1.0, 1.5]), 0.0), [1, 0.75, 0.5, 0, 0])


RIG = Rig()
SWEEP = Sweep("fine", "fine", "x", swath_px=0.0, start_px=-11.5, lines=24)
TANGENTS = arrays(np.float64, 2, elements=st.floats(-0.5, 0.5))


@given(TANGENTS)
def test_spread_of_rays_is_that_of_the_tilted_disc(tangents: np.ndarray):
    """The spread is the variance of points of the tilted disc along the camera's axes, over that of a round one."""
    normal = direction_to_normal(scene_to_direction(tangents))
    first = np.cross(normal, (0, 1, 0)) / np.linalg.norm(np.cross(normal, (0, 1, 0)))
    turn = np.arange(8) * np.pi / 4
    rim = np.cos(turn)[:, None] * first + np.sin(turn)[:, None] * np.cross(normal, first)
    assert spread_of_rays(normal) == pytest.approx(2 * np.mean(rim[:, [1, 0]] ** 2, axis=0))


@given(TANGENTS)
def test_spread_of_waves_is_the_inverse_of_the_pupil(tangents: np.ndarray):
    """An ellipse of shape S spreads waves by the inverse of S, of which the diagonal is kept."""
    normal = direction_to_normal(scene_to_direction(tangents))
    shape = np.eye(2) - np.outer(normal[:2], normal[:2])
    assert spread_of_waves(normal) == pytest.approx(np.diag(np.linalg.inv(shape))[::-1])


@given(st.floats(-4000, 4000), st.floats(-5000, 3000), st.integers(1, 2000), st.integers(1, 8))
def test_extreme_pupils_lie_at_the_ends_of_a_sweep(swath: float, start: float, lines: int, step: int):
    """No held position in between has a wider or narrower pupil than the ends."""
    sweep = Sweep("s", "fine", "x", swath, start, max(lines // step, 1), step)
    held = sweep.held_px().ravel()
    tangents = np.stack([np.full_like(held, swath), held], axis=-1) * RIG.camera.ifov_rad
    normals = direction_to_normal(scene_to_direction(tangents))
    ends = extreme_normals((sweep,), RIG.camera)[1:]
    for spread in (spread_of_rays, spread_of_waves):
        assert (spread(normals) <= spread(ends).max(axis=0) * (1 + 1e-12)).all()
        assert (spread(normals) >= spread(ends).min(axis=0) * (1 - 1e-12)).all()


def test_survey_without_lines_uses_the_rest_position():
    """The middle of a sweep around the axis is the rest position as well."""
    for sweeps in ((), (replace(SWEEP, lines=0),)):
        assert extreme_normals(sweeps, RIG.camera) == pytest.approx(REST_NORMAL[None])
    assert middle_normal(SWEEP, RIG.camera) == pytest.approx(REST_NORMAL)


@pytest.mark.parametrize("diameter", [0.0, 0.5, 3.3, 12.0])
@pytest.mark.parametrize("wave", [0.0, 0.03, 0.2, 0.7])
def test_contrast_is_the_transform_of_an_even_disc(diameter: float, wave: float) -> None:
    """The reference sums chords of the disc with the wave's phase, along either axis of an ellipse."""
    wanted = quad(lambda x: 4 / np.pi * np.sqrt(1 - x * x) * np.cos(np.pi * wave * diameter * x), 0, 1)[0]
    assert disc_contrast(np.array([wave]), NONE, (diameter, 1.0)) == pytest.approx(wanted, abs=1e-8)
    assert disc_contrast(NONE, np.array([wave]), (1.0, diameter)) == pytest.approx(wanted, abs=1e-8)


@given(st.floats(0.0, 200.0), st.floats(0.2, 1.0))
def test_points_have_the_moments_of_the_disc(diameter: float, flat: float) -> None:
    """The points' mean is the middle; with their Gaussians the variance is 1/16 of the squared diameters."""
    points, about = disc_points((diameter, flat * diameter))
    axes = np.array([diameter, flat * diameter])
    assert points.mean(axis=1) == pytest.approx([0, 0], abs=1e-9 * (1 + diameter))
    assert about.min() >= 0
    assert (points**2).mean(axis=1) + about == pytest.approx(axes**2 / 16, rel=1e-6, abs=1e-12)
    assert np.hypot(*(points / np.maximum(axes[:, None], 1e-300))).max(initial=0.0) <= 0.5


@pytest.mark.parametrize("diameter", [0.3, 0.6, 1.2, 1.7, 2.7, 3.3, 4.73, 5.0, 7.0, 10.0, 14.0])
@pytest.mark.parametrize("flat", [0.34, 0.71, 1.0])
def test_points_have_the_contrast_of_the_disc(diameter: float, flat: float) -> None:
    """Behind slit, pixel and linear interpolation no wave is off by more than 2e-3 of its amplitude."""
    axes = (diameter, flat * diameter)
    radius, turn = np.geomspace(0.003, 1.3, 60), np.linspace(0, np.pi, 25)
    along, scan = (np.outer(radius, way(turn)).ravel() for way in (np.cos, np.sin))
    points, about = disc_points(axes)
    phases = np.exp(2j * np.pi * (np.outer(along, points[0]) + np.outer(scan, points[1]))).mean(axis=1)
    passed = phases * np.exp(-2 * np.pi**2 * (along**2 * about[0] + scan**2 * about[1]))
    own = np.sinc(along) ** 3 * np.sinc(scan) ** 2 * np.sinc(2.7 * scan)
    assert np.abs(own * (passed - disc_contrast(along, scan, axes))).max() < 2e-3


def test_footprint_has_its_boxes_at_every_point_of_the_disc() -> None:
    """Three boxes at 19 points make 57 parts; their places have the variance of boxes and disc together."""
    none = np.zeros((2, 1))
    kernels = kernels_of(fold((2.7, 1.0), (3, 1), 1, Moments(none, none, disc=(3.2, 2.5))))
    assert kernels.place.shape == (2, 57)
    assert kernels.between == pytest.approx(kernels.place[0].astype(np.float64).var(), rel=1e-5)
    whole = kernels.variance[:, 0] + kernels.place[::-1].astype(np.float64).var(axis=1)
    assert whole == pytest.approx([1 / 12 + 3.2**2 / 16, 2.7**2 / 12 + 2.5**2 / 16], rel=1e-5)
