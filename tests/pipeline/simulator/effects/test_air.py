"""Air and depth: turbulence by three laws, rays of a pinhole behind the pivot, sway by wind, and their bounds."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.special import j0

from spectralzoom.pipeline.geometry.mirror import scene_to_direction
from spectralzoom.pipeline.geometry.scan import Sweep, sweep_to_scene
from spectralzoom.pipeline.simulator.effects.air import PARALLAX, TURBULENCE, WIND, closeness, sway_px, turbulence_px
from spectralzoom.pipeline.simulator.effects.effect import SweepBlock, survey_stream
from spectralzoom.pipeline.simulator.rig_model import Air, Rig
from tests.pipeline.simulator.made_up_effects import steep_probe


def rig_at(distance_m: float | None, **air: float) -> Rig:
    """Return a rig at this distance from the scene."""
    return Rig(air=Air(distance_m, **air))


@pytest.mark.parametrize(("distance", "px"), [(30.0, 0.0365), (300.0, 0.1154)])
def test_turbulence_matches_hand_calculation(distance: float, px: float):
    """The jitter is sqrt(1.09 1e-13 d 4.551) / 105.7 urad, with (10.6 mm)^(-1/3) = 4.551: 3.86 urad at 30 m."""
    assert turbulence_px(rig_at(distance)) == pytest.approx(px, abs=1e-4)


def test_turbulence_matches_the_structure_function():
    """The variance is the phase's structure function at D over (k D)^2, integrated over path and spectrum.

    `8 pi^2 k^2 dz Phi (1 - J0(kappa D z / d)) kappa dkappa`, `Phi = 0.033 Cn2 kappa^(-11/3)`: waves from z = 0.
    """
    kappa = np.geomspace(1e-4, 1e7, 40_000)  # 1/m
    place = (np.arange(64) + 0.5) / 64
    d = 120.0
    cn2 = 1e-14
    aperture = 0.015 * np.sqrt(0.5)
    spectrum = 0.033 * cn2 * kappa ** (-8 / 3) * (1 - j0(kappa * aperture * place[:, None]))
    variance = 8 * np.pi**2 * d * np.trapezoid(spectrum, kappa, axis=1).mean() / aperture**2
    rig = rig_at(d, turbulence_cn2=cn2)
    assert (turbulence_px(rig) * rig.camera.ifov_rad) ** 2 == pytest.approx(variance, rel=5e-3)


def test_turbulence_jitter_is_unbiased_and_uncorrelated():
    """The jitter has the stated deviation in both directions, without correlation between them or between lines."""
    sweep = Sweep("long", "fine", "x", 0.0, -1500.0, 3000)
    block = SweepBlock(rig_at(300.0), sweep, range(3000), np.array([700.0]), (10, 10), seed=0)
    tilt = TURBULENCE.aim(block, "jitter")
    assert tilt.shape == (3000, 1, 2)
    jitter = tilt[:, 0] / turbulence_px(rig_at(300.0))
    assert jitter.mean(axis=0) == pytest.approx([0, 0], abs=0.06)
    assert jitter.std(axis=0) == pytest.approx([1, 1], abs=0.05)
    assert np.abs(np.corrcoef(np.column_stack([jitter[:-1], jitter[1:]]).T) - np.eye(4)).max() < 0.06


def test_one_survey_in_1000_exceeds_the_bound_of_turbulence():
    """Among 20,000 surveys of 50 lines, about 20 have a line beyond the displacement that the bound allows."""
    ways = np.hypot(*np.random.default_rng(3).standard_normal((2, 20_000, 50))).max(axis=1)
    ramp = steep_probe((0.0, 1.0), span=np.inf, lines=50)
    allowed = TURBULENCE.bound(ramp, rig_at(300.0)).value / turbulence_px(rig_at(300.0))
    assert 8 <= np.count_nonzero(ways > allowed) <= 34


SWEEP = Sweep("swath", "fine", "x", 0.0, -100.0, 201)
STEP = Air(distance_m=30.0, relief="step", nearest_m=3.0)


def shown(air: Air, sweep: Sweep = SWEEP, effect: Any = PARALLAX, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return the displacement of all points of a sweep."""
    rig = Rig(air=air)
    block = SweepBlock(rig, sweep, range(201), np.ones(1), (201, 640), seed=seed)
    return effect.displaced(block, *sweep_to_scene(sweep, rig.camera), "exact")


def test_line_ends_move_by_half_a_line_times_the_lever():
    """Parts at 3 and 30 m lie `320 L (1/3 - 1/30)` px apart at a line's ends, 9.6 px for 0.1 m; centres stay."""
    along, scan = shown(STEP)
    near = along[150]
    assert np.abs(near[[0, -1]]) == pytest.approx(9.6 * 319.5 / 320, rel=2e-3)
    assert np.abs(near[319:321]).max() < 0.02
    np.testing.assert_allclose(along[:100], 0, atol=1e-12)  # as far as the scene's distance
    assert np.abs(scan).max() < 0.1


@pytest.mark.parametrize("swath_px", [0.0, 1500.0, -3000.0])
def test_parallax_matches_a_pinhole_behind_the_pivot(swath_px: float):
    """Points on a plane across the chief ray's distance, seen from the lever behind the pivot, are met exactly."""
    sweep = replace(SWEEP, swath_px=swath_px, start_px=900.0)
    air = Air(distance_m=math.inf, relief="step", nearest_m=4.0, farthest_m=4.0, lever_m=0.1)
    camera = Rig().camera
    along, scan = sweep_to_scene(sweep, camera)
    found = np.stack([along, scan], axis=-1) + np.stack(shown(air, sweep), axis=-1)
    centre = np.stack([np.full(201, swath_px), sweep.line_px()], axis=-1) * camera.ifov_rad
    chief = scene_to_direction(centre)[:, None]
    ray = scene_to_direction(np.stack([along, scan], axis=-1) * camera.ifov_rad)
    depth = 4.0 * chief[..., 0]  # of the plane that the chief ray meets 4 m from the pivot
    point = -0.1 * chief + ray * ((depth + 0.1 * chief[..., 0]) / ray[..., 0])[..., None]
    np.testing.assert_allclose(found * camera.ifov_rad, point[..., 1:] / point[..., :1], atol=1e-12)


def test_relief_sets_the_distance_of_each_row():
    """A step is far above the middle row and near from it down; on a plane 1/d is linear; flat has one distance."""
    row = np.array([-2.0, -1.0, -0.5, 0.0, 1.0, 3.0])
    np.testing.assert_allclose(closeness(STEP, row), [1 / 30, 1 / 30, 1 / 30, 1 / 3, 1 / 3, 1 / 3])
    plane = closeness(replace(STEP, relief="plane", farthest_m=math.inf), row)
    np.testing.assert_allclose(plane, [0, 0, 1 / 12, 1 / 6, 1 / 3, 1 / 3])
    np.testing.assert_allclose(closeness(replace(STEP, relief="flat"), row), 1 / 30)


BREEZE = Air(distance_m=30.0, wind_amplitude_m=0.02, wind_hz=1.0)


def test_wind_sway_matches_hand_calculation():
    """2 cm at 30 m are 6.3 px. At 1 Hz a line of 100 ms is a tenth of a period, up to 3.9 px per line."""
    assert sway_px(Rig(air=BREEZE)) == pytest.approx(6.3, abs=0.01)
    along, scan = shown(BREEZE, SWEEP, WIND)
    assert np.hypot(along, scan).max() == pytest.approx(6.306, rel=0.01)
    moved = np.hypot(np.diff(along[:, 320]), np.diff(scan[:, 320])).max()
    assert 0.9 < moved / (2 * 6.306 * math.sin(0.1 * math.pi)) < 1.01


@pytest.mark.parametrize("along", ["x", "y"])
def test_crop_sways_along_the_wind(along: str):
    """The motion follows the heading that is drawn for the survey, on the scene's own axes."""
    heading = survey_stream(0, WIND.name).uniform(0, 2 * math.pi, 2)[1]
    first, second = shown(BREEZE, replace(SWEEP, along=along), WIND)
    right, down = (first, second) if along == "x" else (second, first)
    np.testing.assert_allclose(right * math.sin(heading), down * math.cos(heading), atol=1e-9)
    assert np.abs(right).max() == pytest.approx(6.306 * abs(math.cos(heading)), rel=0.02)


def test_all_sweeps_see_the_same_sway():
    """Sweeps of other names and either axis see the same crop at the same place and time; another seed does not."""
    point = np.array([[40.0]]), np.array([[-25.0]])
    line = replace(SWEEP, lines=1)
    block = SweepBlock(Rig(air=BREEZE), line, range(1), np.ones(1), (201, 640))
    seen = WIND.displaced(block, *point, "exact")
    across = replace(block, sweep=replace(line, name="other", along="y"))
    turned = WIND.displaced(across, *point[::-1], "exact")
    np.testing.assert_allclose(turned[::-1], seen)
    assert not np.allclose(shown(BREEZE, SWEEP, WIND, 3), shown(BREEZE, SWEEP, WIND))
