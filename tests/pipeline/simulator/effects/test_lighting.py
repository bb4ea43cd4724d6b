"""Light of sun and sky: reflectance by angle and cloud shadows, by hand, over time and for crossing sweeps."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from spectralzoom.pipeline.simulator.effects.lighting import BRDF, CLOUD, EDGE_FRACTION, HOT_SPOT_RAD, shadow
from spectralzoom.pipeline.simulator.rig_model import Rig
from tests.pipeline.simulator.outdoors import SWEEP, block_of, rig_with


def test_reflectance_slope_along_a_line_matches_hand_calculation() -> None:
    """640 px are 3.9 deg, so that 0.1/rad is a slope of 0.68 % from end to end."""
    gain = BRDF.gain(block_of(rig_with(brdf_per_rad=0.1), range(30, 31)), "angles")[0, :, 0]
    assert gain[-1] - gain[0] == pytest.approx(0.1 * np.deg2rad(3.87), rel=2e-3)
    assert gain[319:321].mean() == pytest.approx(1, abs=1e-6)


def test_hot_spot_is_a_cusp() -> None:
    """The peak has the stated height, falls to 1/e at 2 deg, and breaks the slope."""
    rig = rig_with(brdf_per_rad=0.0, hot_spot=0.05)
    extra = BRDF.gain(block_of(rig, range(30, 31)), "angles")[0, :, 0].astype(np.float64) - 1
    assert extra.max() == pytest.approx(0.05, rel=2e-3)
    px = HOT_SPOT_RAD / rig.camera.ifov_rad
    assert np.interp(319.5 - 300, np.arange(640), extra) == pytest.approx(0.05 * np.exp(-300 / px), rel=1e-3)
    bend = np.abs(np.diff(extra, 2))
    assert bend.argmax() in (317, 318, 319)
    assert bend.max() > 20 * np.median(bend)


def test_reflectance_is_never_negative() -> None:
    """The gain of the steepest slope ends at 0."""
    rig = rig_with(brdf_per_rad=5.0)
    assert BRDF.gain(block_of(rig, sweep=replace(SWEEP, swath_px=-3000.0)), "angles").min() == 0


SIZE = 300.0
RIG = rig_with(cloud_fraction=0.6, cloud_size_px=SIZE)


def test_cloud_shadow_matches_hand_calculation() -> None:
    """The shadow is full in the middle, absent between two shadows, and a half in the middle of an edge."""
    np.testing.assert_allclose(shadow(np.array([0, 150, 300, 450, 600.0]), SIZE), [1, 0.5, 0, 0.5, 1], atol=1e-12)


@given(way=st.floats(-1e6, 1e6), size=st.floats(1, 1e5))
def test_cloud_shadows_are_smooth_and_periodic(way: float, size: float) -> None:
    """Shadows lie between 0 and 1 and are even; their period is two sizes, their slope at most 1.5 over the edge."""
    here, there = shadow(np.array([way, way + 1e-3 * size]), size)
    assert 0 <= here <= 1
    assert abs(there - here) <= 1.5 / EDGE_FRACTION * 1e-3 + 1e-6
    assert shadow(np.array([-way]), size)[0] == pytest.approx(here, abs=1e-6)
    assert shadow(np.array([way + 2 * size]), size)[0] == pytest.approx(here, abs=1e-6)


def test_cloud_shadow_moves_at_its_speed() -> None:
    """The light changes with time and repeats after one period; without speed it is constant."""
    still, quick = (rig_with(cloud_fraction=0.6, cloud_size_px=SIZE, cloud_px_per_s=speed) for speed in (0.0, 50.0))
    now, later = (CLOUD.gain(block_of(quick, range(1), started_s=start), "shadow") for start in (0.0, 12.0))
    np.testing.assert_allclose(now, later, atol=1e-5)  # 12 s at 50 px/s are one period
    assert np.abs(now - CLOUD.gain(block_of(quick, range(1), started_s=3.0), "shadow")).max() > 0.1
    first, last = (CLOUD.gain(block_of(still, range(1), started_s=start), "shadow") for start in (0.0, 12.3))
    np.testing.assert_array_equal(first, last)


@pytest.mark.parametrize(
    ("effect", "rig", "place_px", "apart"),
    [(BRDF, rig_with(brdf_per_rad=0.4, hot_spot=0.1), 100.0, 1e-5), (CLOUD, RIG, 0.0, 1e-6)],
    ids=["reflectance", "shadow"],
)
def test_crossing_sweeps_have_the_same_gain(effect: Any, rig: Rig, place_px: float, apart: float) -> None:
    """Light belongs to the scene: two sweeps of any name have the same gain at the same place and time."""
    along_x = replace(SWEEP, name="a", swath_px=0.0, start_px=place_px)
    along_y = replace(SWEEP, name="b", along="y", swath_px=place_px, start_px=0.0)
    blocks = (block_of(rig, range(1), sweep=sweep) for sweep in (along_x, along_y))
    seen = [effect.gain(block, effect.variants[0])[0, 319:321].mean() for block in blocks]
    assert seen[0] == pytest.approx(seen[1], abs=apart)
