"""Hard cases of planning: fields and times at their limits, and the capacity of the mirror's memory."""

from __future__ import annotations

import numpy as np
import pytest

from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.pipeline.geometry.scan import Axis, CostModel, Sweep, memory_loads
from spectralzoom.pipeline.planning.coverage import full_sweeps
from spectralzoom.pipeline.planning.fine_pass import FinePlan, SecondPass, every_nth

CAMERA = LineCamera()
COST = CostModel()
GRID = SceneGrid(200, 900, 32)


def planned(grid: SceneGrid, gain: np.ndarray, seconds: float, along: Axis = "x", cost: CostModel = COST) -> FinePlan:
    """Return the second pass after a first pass of every 4th line, planned with a margin of 1e-9 px."""
    full = full_sweeps(grid, CAMERA, along)
    return SecondPass(grid, CAMERA, cost, every_nth(full), full, seconds, margin_px=1e-9).plan(gain)


@pytest.mark.parametrize(("lines", "loads"), [(1500, 1), (1501, 2)])
def test_positions_beyond_the_mirror_memory_need_a_second_load(lines: int, loads: int):
    """1500 positions take one load and 1501 take two, both in the loads and in the seconds."""
    sweep = Sweep("a", "fine", "x", 0.0, -750.0, lines)
    assert len(memory_loads([sweep], 1500)) == loads
    expected = lines * 0.1 + COST.setup_seconds(CAMERA) + loads * COST.reload_s
    assert COST.seconds([sweep], CAMERA) == pytest.approx(expected)


def test_plans_with_free_setups_keep_to_the_time():
    """With slews, settling and capture starts of 0 s, plans fit into 6, 12 and 20 s, and their expected gain grows."""
    cost = CostModel(slew_s=0.0, settle_frames=0.0, capture_start_s=0.0)
    gain = np.random.default_rng(0).exponential(size=int(np.prod(GRID.patch_shape)))
    plans = [planned(GRID, gain, seconds, cost=cost) for seconds in (6.0, 12.0, 20.0)]
    assert all(plan.seconds <= seconds for plan, seconds in zip(plans, (6.0, 12.0, 20.0), strict=True))
    assert 0 < plans[0].expected_gain < plans[1].expected_gain < plans[2].expected_gain


@pytest.mark.parametrize("along", ["x", "y"])
@pytest.mark.parametrize("shape", [(1, 1), (20, 32)])
def test_field_of_one_patch_is_one_sweep(along: Axis, shape: tuple[int, int]):
    """Fields of 1 x 1 and 20 x 32 px take one sweep with at most 5 extra lines, along either axis."""
    plan = planned(SceneGrid(*shape, max(shape)), np.ones(1), 1e3, along)
    (sweep,) = plan.sweeps
    assert sweep.lines <= (shape[0] if along == "x" else shape[1]) + 5
    assert plan.patch_index.tolist() == [0]


def test_sweep_is_planned_only_if_its_seconds_fit():
    """A time limit equal to the plan's seconds buys the sweep; a limit one rounding step lower buys nothing."""
    gain = np.zeros(int(np.prod(GRID.patch_shape)))
    gain[GRID.every_patch()[40]] = 3.0
    price = planned(GRID, gain, 20.0).seconds
    assert planned(GRID, gain, price).expected_gain == 3.0
    below = planned(GRID, gain, float(np.nextafter(price, 0)))
    assert (below.sweeps, below.expected_gain) == ([], 0.0)


def test_gain_on_one_side_takes_sweeps_on_that_side_only():
    """All 7 patches with a gain lie in column 0 or 27: sweeps of the same side capture them all."""
    for side in (0, 27):
        gain = np.zeros(GRID.patch_shape)
        gain[:7, side] = 1.0
        plan = planned(GRID, gain.ravel(), 500.0)
        assert plan.expected_gain == 7.0
        assert {sweep.swath_px < 0 for sweep in plan.sweeps} == {side == 0}


def test_28_patches_with_negative_gain_are_never_planned():
    """Patches with negative, NaN or -inf scores get no sweep and leave the time unspent; a positive one is planned."""
    grid = SceneGrid(256, 256, 16)
    score = np.full(256, -0.3)
    score[[3, 70, 200]] = -5.0, np.nan, -np.inf
    plan = planned(grid, score, 10.0)
    assert (plan.patch_index.tolist(), plan.sweeps, plan.expected_gain) == ([], [], 0.0)
    score[100] = 5.0
    plan = planned(grid, score, 10.0)
    assert 100 in plan.patch_index
    assert plan.expected_gain == pytest.approx(5.0)
