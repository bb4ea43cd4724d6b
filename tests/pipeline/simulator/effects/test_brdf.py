"""Reflectance by the angle of view: slope and hot spot by hand, its bound, crossing sweeps and blocks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.geometry.scan import Sweep
from pipeline.simulator.effects.lighting import BRDF, HOT_SPOT_RAD
from tests.pipeline.simulator.outdoors import SWEEP, block_of, measured, probe_of, rig_with

FAR = replace(SWEEP, strip_px=900.0, start_px=500.0)
ACROSS = replace(SWEEP, along="y", strip_px=-700.0)


def test_slope_along_a_line_by_hand() -> None:
    """640 px are 3.9 deg, so that 0.1/rad is a slope of 0.68 % from end to end."""
    gain = BRDF.gain(block_of(rig_with(brdf_per_rad=0.1), range(30, 31)), "angles")[0, :, 0]
    assert gain[-1] - gain[0] == pytest.approx(0.1 * np.deg2rad(3.87), rel=2e-3)
    assert gain[319:321].mean() == pytest.approx(1, abs=1e-6)


def test_hot_spot_is_a_cusp() -> None:
    """Its peak is its height; 2 deg away it is down to 1/e; its slope breaks at the peak."""
    rig = rig_with(brdf_per_rad=0.0, hot_spot=0.05)
    extra = BRDF.gain(block_of(rig, range(30, 31)), "angles")[0, :, 0].astype(np.float64) - 1
    assert extra.max() == pytest.approx(0.05, rel=2e-3)
    px = HOT_SPOT_RAD / rig.camera.ifov_rad
    assert np.interp(319.5 - 300, np.arange(640), extra) == pytest.approx(0.05 * np.exp(-300 / px), rel=1e-3)
    bend = np.abs(np.diff(extra, 2))
    assert bend.argmax() in (317, 318, 319)
    assert bend.max() > 20 * np.median(bend)


def test_no_parameters_no_change() -> None:
    """A scene that reflects alike in all directions."""
    rig = rig_with(brdf_per_rad=0.0)
    assert BRDF.bound(probe_of(rig), rig).value == 0
    assert (BRDF.gain(block_of(rig), "angles") == 1).all()


def test_reflectance_is_never_negative() -> None:
    """The steepest slope ends at 0."""
    rig = rig_with(brdf_per_rad=5.0)
    gain = BRDF.gain(block_of(rig, sweep=replace(SWEEP, strip_px=-3000.0)), "angles")
    assert gain.min() == 0


@pytest.mark.parametrize("sweep", [SWEEP, FAR, ACROSS])
@pytest.mark.parametrize(("slope", "hot"), [(0.1, 0.0), (0.0, 0.05), (0.3, 0.02), (5.0, 2.0)])
def test_bound_holds_and_is_near(sweep: Sweep, slope: float, hot: float) -> None:
    """The change at any sample is within the bound, and the bound within 6 times of it."""
    rig = rig_with(brdf_per_rad=slope, hot_spot=hot)
    bound = BRDF.bound(probe_of(rig, sweep), rig).value
    seen = measured(BRDF, rig, sweep=sweep)
    assert seen <= 1.2 * bound
    assert seen > bound / 6
    assert BRDF.bound(probe_of(rig, sweep), rig, "angles").value == 0


def test_crossing_sweeps_agree() -> None:
    """Reflectance belongs to the scene: two sweeps that cross see the same at the same place."""
    rig = rig_with(brdf_per_rad=0.4, hot_spot=0.1)
    along_x = replace(SWEEP, strip_px=0.0, start_px=100.0)
    along_y = replace(SWEEP, along="y", strip_px=100.0, start_px=0.0)
    seen = [
        BRDF.gain(block_of(rig, range(1), sweep=sweep), "angles")[0, 319:321].mean() for sweep in (along_x, along_y)
    ]
    assert seen[0] == pytest.approx(seen[1], abs=1e-5)


@pytest.mark.parametrize("size", [1, 7])
def test_blocks_do_not_matter(size: int) -> None:
    """Lines and samples have the same light in blocks of any size."""
    rig = rig_with(brdf_per_rad=0.4, hot_spot=0.1)
    whole = BRDF.gain(block_of(rig, sweep=FAR), "angles")
    parts = [
        BRDF.gain(block_of(rig, range(start, min(start + size, 60)), sweep=FAR), "angles")
        for start in range(0, 60, size)
    ]
    np.testing.assert_array_equal(np.concatenate(parts), whole)
    some = BRDF.gain(block_of(rig, sweep=FAR, samples=range(100, 107)), "angles")
    np.testing.assert_array_equal(some, whole[:, 100:107])
