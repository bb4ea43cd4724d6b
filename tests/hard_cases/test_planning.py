"""Hard cases of planning: scores that are none, fields and budgets at their borders, the rim of the mirror's disk."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.errors import PoseError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import CostModel, Sweep, memory_loads
from pipeline.planning.coverage import check_reach, full_sweeps
from tests.pipeline.planning.fields import planned

CAMERA, COST = LineCamera(), CostModel()
GRID = SceneGrid(200, 900, 32, 4)


def even(grid: SceneGrid, value: float = 1.0) -> np.ndarray:
    """The same score for every patch."""
    return np.full(int(np.prod(grid.patch_shape)), value)


@pytest.mark.parametrize(("lines", "loads"), [(1500, 1), (1501, 2)])
def test_the_memorys_last_pair(lines: int, loads: int):
    """1500 positions are one load and 1501 two, in the layout and in the price."""
    sweep = Sweep("a", "fine", "x", 0.0, -750.0, lines)
    assert len(memory_loads([sweep], 1500)) == loads
    expected = lines * 0.1 + COST.setup_seconds(CAMERA) + loads * COST.reload_s
    assert COST.seconds([sweep], CAMERA) == pytest.approx(expected)


def test_a_plan_stops_at_the_memorys_last_pair_where_a_reload_does_not_pay():
    """With a reload dearer than all else and a budget for one, the plan has as many lines as one load holds."""
    cost = CostModel(reload_s=30.0, vector_pairs=150)
    plan = planned(GRID, CAMERA, cost, "x", even(GRID), budget_s=30.0 + 20.0)
    assert 100 < plan.lines <= 150
    assert plan.seconds <= 50.0


def test_set_ups_that_cost_nothing():
    """Where slews, settling and starts are free, plans keep to the budget and grow with it."""
    cost = CostModel(slew_s=0.0, settle_frames=0.0, capture_start_s=0.0)
    scores = np.random.default_rng(0).exponential(size=int(np.prod(GRID.patch_shape)))
    plans = [planned(GRID, CAMERA, cost, "x", scores, budget_s=budget_s) for budget_s in (5.0, 10.0, 20.0)]
    assert all(plan.seconds <= budget_s for plan, budget_s in zip(plans, (5.0, 10.0, 20.0), strict=True))
    assert 0 < plans[0].expected_gain < plans[1].expected_gain < plans[2].expected_gain


@pytest.mark.parametrize("value", [np.nan, -np.inf, -1.0, 0.0])
@pytest.mark.parametrize("budget_s", [0.0, 50.0, 1e6])
def test_no_worth_buys_nothing(value: float, budget_s: float):
    """Scores that are worth nothing give an empty plan at any budget, and no full scan either."""
    plan = planned(GRID, CAMERA, COST, "x", even(GRID, value), budget_s=budget_s)
    assert (plan.sweeps, plan.seconds, plan.expected_gain, plan.kind, len(plan.patch_index)) == (
        [],
        0.0,
        0.0,
        "lines",
        0,
    )
    assert plan.gain_per_second is None


def test_all_worth_the_same_fills_the_budget_in_one_run():
    """With nothing to tell patches apart, set-ups are not paid twice and no second line is left over."""
    grid = SceneGrid(192, 900, 32, 4)
    plan = planned(grid, CAMERA, COST, "x", even(grid), budget_s=12.0)
    assert len(plan.sweeps) == 1
    assert plan.seconds > 12.0 - 32 * 0.1


def test_ties_are_settled_the_same_way_each_time():
    """Equal scores give the same plan again, and so does the same field planned after another."""
    first = planned(GRID, CAMERA, COST, "x", even(GRID), budget_s=15.0)
    planned(SceneGrid(300, 300, 16, 2), CAMERA, COST, "y", even(SceneGrid(300, 300, 16, 2)), budget_s=9.0)
    again = planned(GRID, CAMERA, COST, "x", even(GRID), budget_s=15.0)
    assert again.sweeps == first.sweeps


@pytest.mark.parametrize("along", ["x", "y"])
def test_one_patch(along: str):
    """A field of one patch is one run of its rows and the kernel's three lines."""
    grid = SceneGrid(20, 32, 32, 1)
    plan = planned(grid, CAMERA, COST, along, np.ones(1), budget_s=1e3)
    (sweep,) = plan.sweeps
    assert sweep.lines == (20 if along == "x" else 32) + 3
    assert plan.patch_index.tolist() == [0]


def test_one_pixel():
    """The smallest field there is has one patch of one pixel, seen in four lines."""
    plan = planned(SceneGrid(1, 1, 1, 1), CAMERA, COST, "x", np.ones(1), budget_s=10.0)
    assert [sweep.lines for sweep in plan.sweeps] == [4]


def test_a_patch_as_wide_as_the_line():
    """On the axis a line of 640 samples shows a patch of 640 px, and off it too."""
    grid = SceneGrid(640, 1280, 640, 1)
    plan = planned(grid, CAMERA, COST, "x", np.ones(2), budget_s=1e3)
    assert plan.patch_index.tolist() == [0, 1]


def test_a_budget_of_exactly_the_price_and_one_just_below_it():
    """The price of the one run buys it; a rounding step less buys nothing at all."""
    scores = np.zeros(int(np.prod(GRID.patch_shape)))
    scores[GRID.valid_patches()[40]] = 3.0
    price = planned(GRID, CAMERA, COST, "x", scores, budget_s=20.0).seconds
    assert planned(GRID, CAMERA, COST, "x", scores, budget_s=price).expected_gain == 3.0
    below = planned(GRID, CAMERA, COST, "x", scores, budget_s=float(np.nextafter(price, 0)))
    assert (below.sweeps, below.expected_gain) == ([], 0.0)


@pytest.mark.parametrize("side", [0, 27])
def test_a_field_with_an_empty_side(side: int):
    """Patches worth something on one side alone are shown by runs there; the empty side costs nothing."""
    scores = np.zeros(GRID.patch_shape)
    scores[:7, side] = 1.0
    plan = planned(GRID, CAMERA, COST, "x", scores.ravel(), budget_s=500.0)
    assert plan.expected_gain == 7.0
    (sweep,) = plan.sweeps
    assert (sweep.swath_px < 0) == (side == 0)


def test_more_swaths_than_are_needed():
    """A line twice as long as the field is wide gives one strip, on the axis, however many patches there are."""
    grid = SceneGrid(300, 300, 8, 2)
    plan = planned(grid, CAMERA, COST, "x", even(grid), budget_s=1e3)
    assert [sweep.swath_px for sweep in plan.sweeps] == [0.0]
    assert plan.patch_index.tolist() == grid.valid_patches().tolist()


def test_a_field_at_the_rim_of_the_disk():
    """A full scan is beyond the rim, patches near the axis are not: only lines that are needed have to be reached."""
    grid = SceneGrid(16_000, 16_000, 320, 1)
    with pytest.raises(PoseError, match="beyond the mirror's range"):
        full_sweeps(grid, CAMERA, "x")
    scores = np.zeros(grid.patch_shape)
    scores[0, 0] = scores[24, 24] = scores[30, 12] = 1.0
    plan = planned(grid, CAMERA, COST, "x", scores.ravel(), budget_s=1e4)
    assert (plan.expected_gain, plan.out_of_reach) == (2.0, 1)
    check_reach(plan.sweeps, CAMERA)


def test_patches_that_nothing_reaches_are_refused():
    """A plan for the corner alone cannot be made; the message names the patch."""
    grid = SceneGrid(16_000, 16_000, 320, 1)
    scores = np.zeros(int(np.prod(grid.patch_shape)))
    scores[0] = 1.0
    with pytest.raises(PoseError, match=r"shows any of the 1 patches with an expected gain \(the first is 0\)"):
        planned(grid, CAMERA, COST, "x", scores, budget_s=1e4)


def test_a_patch_costs_its_rotated_footprint():
    """Far off the axis a line lies across a patch: 320 (1 + tan psi) lines and the kernel's, not 320."""
    grid = SceneGrid(10_240, 10_240, 320, 1)
    scores = np.zeros(int(np.prod(grid.patch_shape)))
    scores[16 * 32 + 31] = 1.0
    lines = planned(grid, CAMERA, COST, "x", scores, budget_s=60.0).lines
    xi = 4800 * CAMERA.ifov_rad
    psi = np.arctan2(xi, np.sqrt(1 + xi * xi))  # of a line at xi on the axis, to a few lines over the patch
    assert lines == pytest.approx(320 * (1 + np.tan(psi)) + 3, abs=6)
