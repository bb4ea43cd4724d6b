"""Hard cases of planning: fields and times at their borders, and the last pair of the mirror's memory."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import Axis, CostModel, Sweep, memory_loads
from pipeline.planning.coverage import full_sweeps
from pipeline.planning.fine_pass import FinePlan, SecondPass, every_nth

CAMERA, COST = LineCamera(), CostModel()
GRID = SceneGrid(200, 900, 32)


def planned(grid: SceneGrid, gain: np.ndarray, seconds: float, along: Axis = "x", cost: CostModel = COST) -> FinePlan:
    """A second pass over a field after one of every 4th line, beside it as if the mirror were off."""
    full = full_sweeps(grid, CAMERA, along)
    return SecondPass(grid, CAMERA, cost, every_nth(full), full, seconds, margin_px=1e-9).plan(gain)


@pytest.mark.parametrize(("lines", "loads"), [(1500, 1), (1501, 2)])
def test_the_memorys_last_pair(lines: int, loads: int):
    """1500 positions are one load and 1501 two, in the layout and in the price."""
    sweep = Sweep("a", "fine", "x", 0.0, -750.0, lines)
    assert len(memory_loads([sweep], 1500)) == loads
    expected = lines * 0.1 + COST.setup_seconds(CAMERA) + loads * COST.reload_s
    assert COST.seconds([sweep], CAMERA) == pytest.approx(expected)


def test_set_ups_that_cost_nothing():
    """Where slews, settling and starts are free, plans keep to the time and grow with it."""
    cost = CostModel(slew_s=0.0, settle_frames=0.0, capture_start_s=0.0)
    gain = np.random.default_rng(0).exponential(size=int(np.prod(GRID.patch_shape)))
    plans = [planned(GRID, gain, seconds, cost=cost) for seconds in (6.0, 12.0, 20.0)]
    assert all(plan.seconds <= seconds for plan, seconds in zip(plans, (6.0, 12.0, 20.0), strict=True))
    assert 0 < plans[0].expected_gain < plans[1].expected_gain < plans[2].expected_gain


@pytest.mark.parametrize("along", ["x", "y"])
@pytest.mark.parametrize("shape", [(1, 1), (20, 32)])
def test_one_patch(along: Axis, shape: tuple[int, int]):
    """A field of one patch, down to one pixel, is one run that shows it."""
    grid = SceneGrid(*shape, max(shape))
    plan = planned(grid, np.ones(1), 1e3, along)
    (sweep,) = plan.sweeps
    assert sweep.lines <= (shape[0] if along == "x" else shape[1]) + 5
    assert plan.patch_index.tolist() == [0]


def test_a_time_of_exactly_the_price_and_one_just_below_it():
    """The price of the one run pays for it; a rounding step less pays for nothing at all."""
    gain = np.zeros(int(np.prod(GRID.patch_shape)))
    gain[GRID.every_patch()[40]] = 3.0
    price = planned(GRID, gain, 20.0).seconds
    assert planned(GRID, gain, price).expected_gain == 3.0
    below = planned(GRID, gain, float(np.nextafter(price, 0)))
    assert (below.sweeps, below.expected_gain) == ([], 0.0)


def test_a_field_with_an_empty_side():
    """Patches with a gain on one side alone are shown by runs there; the empty side costs nothing."""
    for side in (0, 27):
        gain = np.zeros(GRID.patch_shape)
        gain[:7, side] = 1.0
        plan = planned(GRID, gain.ravel(), 500.0)
        assert plan.expected_gain == 7.0
        assert {sweep.swath_px < 0 for sweep in plan.sweeps} == {side == 0}


def test_28_negative_gains_are_never_bought():
    """No run is bought for a negative score, nor for one that is no number; all is left unspent."""
    grid, score = SceneGrid(256, 256, 16), np.full(256, -0.3)
    score[[3, 70, 200]] = -5.0, np.nan, -np.inf
    plan = planned(grid, score, 10.0)
    assert (plan.patch_index.tolist(), plan.sweeps, plan.expected_gain) == ([], [], 0.0)
    score[100] = 5.0
    plan = planned(grid, score, 10.0)
    assert 100 in plan.patch_index
    assert plan.expected_gain == pytest.approx(5.0)
