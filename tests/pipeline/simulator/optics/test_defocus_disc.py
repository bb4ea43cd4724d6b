"""The disc of what is out of focus: its contrast by another way, and the points that stand for it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad

from pipeline.simulator.optics.kernel_fit import Moments, disc_contrast, disc_points, fold
from pipeline.simulator.optics.scene_radiance import kernels_of

NONE = np.zeros(1)


@pytest.mark.parametrize("diameter", [0.0, 0.5, 3.3, 12.0])
@pytest.mark.parametrize("wave", [0.0, 0.03, 0.2, 0.7])
def test_contrast_is_the_transform_of_an_even_disc(diameter: float, wave: float) -> None:
    """Chords over the disc, summed with the wave's phase; along either axis of an ellipse."""
    wanted = quad(lambda x: 4 / np.pi * np.sqrt(1 - x * x) * np.cos(np.pi * wave * diameter * x), 0, 1)[0]
    assert disc_contrast(np.array([wave]), NONE, (diameter, 1.0)) == pytest.approx(wanted, abs=1e-8)
    assert disc_contrast(NONE, np.array([wave]), (1.0, diameter)) == pytest.approx(wanted, abs=1e-8)


@given(st.floats(0.0, 200.0), st.floats(0.2, 1.0))
def test_points_have_the_moments_of_the_disc(diameter: float, flat: float) -> None:
    """Their mean is the middle; with the Gaussians about them they vary by a sixteenth of the diameters squared."""
    points, about = disc_points((diameter, flat * diameter))
    axes = np.array([diameter, flat * diameter])
    assert points.mean(axis=1) == pytest.approx([0, 0], abs=1e-9 * (1 + diameter))
    assert about.min() >= 0
    assert (points**2).mean(axis=1) + about == pytest.approx(axes**2 / 16, rel=1e-6, abs=1e-12)
    assert np.hypot(*(points / np.maximum(axes[:, None], 1e-300))).max(initial=0.0) <= 0.5


@pytest.mark.parametrize("diameter", [0.3, 0.6, 1.2, 1.7, 2.7, 3.3, 4.73, 5.0, 7.0, 10.0, 14.0])
@pytest.mark.parametrize("flat", [0.34, 0.71, 1.0])
def test_points_pass_what_the_disc_passes(diameter: float, flat: float) -> None:
    """Behind slit, pixel and linear light no wave is off by more than 2e-3 of its amplitude."""
    axes = (diameter, flat * diameter)
    radius, turn = np.geomspace(0.003, 1.3, 60), np.linspace(0, np.pi, 25)
    along, scan = (np.outer(radius, way(turn)).ravel() for way in (np.cos, np.sin))
    points, about = disc_points(axes)
    phases = np.exp(2j * np.pi * (np.outer(along, points[0]) + np.outer(scan, points[1]))).mean(axis=1)
    passed = phases * np.exp(-2 * np.pi**2 * (along**2 * about[0] + scan**2 * about[1]))
    own = np.sinc(along) ** 3 * np.sinc(scan) ** 2 * np.sinc(2.7 * scan)
    assert np.abs(own * (passed - disc_contrast(along, scan, axes))).max() < 2e-3


def test_parts_of_a_footprint_are_its_boxes_at_every_point() -> None:
    """Three boxes across at 19 points; their places vary as boxes and disc together."""
    none = np.zeros((2, 1))
    kernels = kernels_of(fold((2.7, 1.0), (3, 1), 1, Moments(none, none, disc=(3.2, 2.5))))
    assert kernels.place.shape == (2, 57)
    assert kernels.between == pytest.approx(kernels.place[0].astype(np.float64).var(), rel=1e-5)
    whole = kernels.variance[:, 0] + kernels.place[::-1].astype(np.float64).var(axis=1)
    assert whole == pytest.approx([1 / 12 + 3.2**2 / 16, 2.7**2 / 12 + 2.5**2 / 16], rel=1e-5)
