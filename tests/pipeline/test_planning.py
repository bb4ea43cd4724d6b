"""The fine plan: seats and their lines, budgets, laws over budgets, and the scores that are none."""

from __future__ import annotations

import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.camera import LineCamera
from pipeline.coverage import cheapest_full, coarse_sweeps, full_sweeps
from pipeline.errors import BudgetError, SettingsError, ShapeError
from pipeline.grid import SceneGrid
from pipeline.planning import check_budget, covered_seats, least_budget, plan_fine, price_seats, seat_lines
from pipeline.scan import CostModel, Sweep, scene_to_sweep

CAMERA, COST = LineCamera(), CostModel()
GRID = SceneGrid(200, 900, 32, 4)


def drawn(grid: SceneGrid, seed: int = 0) -> np.ndarray:
    """Scores with a few strong seats."""
    return np.random.default_rng(seed).exponential(size=int(np.prod(grid.seat_shape))) ** 3


@pytest.mark.parametrize("along", ["x", "y"])
def test_seat_lines_hold_every_pixel_with_its_taps(along: str):
    """The interval is the least that holds the kernel's lines of every pixel on the scene."""
    grid = SceneGrid(100, 150, 32, 2)
    path = Sweep("a", "fine", along, 1500.0, -900.0, 1800)
    seats = grid.valid_seats()
    lines, reached = seat_lines(grid, CAMERA, path, seats)
    assert not reached.any()
    for (y, x), (first, stop) in zip(grid.seat_origin(seats), lines, strict=True):
        rows, columns = np.mgrid[y : min(y + 32, 100), x : min(x + 32, 150)]
        points = (columns - 149 / 2, rows - 99 / 2) if along == "x" else (rows - 99 / 2, columns - 149 / 2)
        at = np.floor(scene_to_sweep(path, CAMERA, *points)[..., 0] + 1e-6)
        assert (first, stop) == (at.min() - 1, at.max() + 3)


def test_seats_beyond_the_samples_are_not_reached():
    """Of a 900 px scene one strip reaches the seats whose pixels all fall on its samples."""
    (low, high) = full_sweeps(GRID, CAMERA, "x")
    seats = GRID.valid_seats()
    reached = np.stack([seat_lines(GRID, CAMERA, path, seats)[1] for path in (low, high)])
    assert reached.any(axis=0).all()
    assert 0 < reached[0].sum() < len(seats)
    padding = np.setdiff1d(np.arange(np.prod(GRID.seat_shape)), seats)
    assert not seat_lines(GRID, CAMERA, low, padding)[1].any()


def test_seats_are_cut_from_fine_sweeps_only():
    """A coarse sweep has no lines of seats."""
    with pytest.raises(ShapeError, match="step 4"):
        seat_lines(GRID, CAMERA, Sweep("c", "coarse", "x", 0.0, 0.0, 9, 4, 4), GRID.valid_seats())


def test_a_full_scan_covers_all_seats():
    """Sweeps of the full scan hold every valid seat when no seat straddles two strips."""
    grid = SceneGrid(256, 1280, 16, 4)
    seats = covered_seats(grid, CAMERA, full_sweeps(grid, CAMERA, "x"))
    assert seats.tolist() == grid.valid_seats().tolist()


@settings(max_examples=25, deadline=None)
@given(st.floats(0, 60), st.floats(0, 60), st.integers(0, 99), st.sampled_from(["x", "y"]))
def test_price_within_budget_and_worth_grows_with_it(one: float, other: float, seed: int, along: str):
    """The plan never costs more than the budget, and a bigger budget never buys less score."""
    scores = drawn(GRID, seed)
    small, large = (plan_fine(GRID, CAMERA, COST, along, scores, budget_s=b) for b in sorted((one, other)))
    assert small.seconds <= min(one, other)
    assert large.seconds <= max(one, other)
    assert large.worth >= small.worth * (1 - 1e-12)


@settings(max_examples=15, deadline=None)
@given(st.integers(40, 700), st.integers(40, 1500), st.floats(0, 80), st.integers(0, 99))
def test_plans_hold_together(height: int, width: int, budget_s: float, seed: int):
    """Sweeps lie apart, the price is the cost model's, and the seats shown are worth at least what was bought."""
    grid = SceneGrid(height, width, 32, 2)
    scores = drawn(grid, seed)
    plan = plan_fine(grid, CAMERA, COST, "x", scores, budget_s=budget_s)
    assert plan.seconds == COST.seconds(plan.sweeps, CAMERA) <= budget_s
    assert plan.seats.tolist() == covered_seats(grid, CAMERA, plan.sweeps).tolist()
    assert scores[plan.seats].sum() >= plan.worth * (1 - 1e-12)
    assert len({sweep.name for sweep in plan.sweeps}) == len(plan.sweeps)


@pytest.mark.parametrize("width", [600, 900, 1270, 1280, 1296])
def test_enough_seconds_buy_every_seat(width: int):
    """No seat straddles two strips, so a large budget shows all of them, for widths that divide and not."""
    grid = SceneGrid(150, width, 32, 2)
    scores = drawn(grid)
    plan = plan_fine(grid, CAMERA, COST, "x", scores, budget_s=1e4)
    assert plan.seats.tolist() == grid.valid_seats().tolist()
    assert plan.worth == pytest.approx(scores[grid.valid_seats()].sum())


def test_one_strong_seat_is_bought_alone():
    """A single seat of worth gets one run of just its lines, in either orientation."""
    scores = np.zeros(np.prod(GRID.seat_shape))
    scores[GRID.valid_seats()[40]] = 3.0
    for along in ("x", "y"):
        plan = plan_fine(GRID, CAMERA, COST, along, scores, budget_s=20.0)
        (sweep,) = plan.sweeps
        assert GRID.valid_seats()[40] in plan.seats
        assert 35 <= sweep.lines < 60
        assert plan.worth == 3.0


@pytest.mark.parametrize("value", [np.nan, -np.inf, -1.0, 0.0])
def test_scores_of_no_worth_buy_nothing(value: float):
    """NaN, -inf, negative and zero scores are never paid for."""
    plan = plan_fine(GRID, CAMERA, COST, "x", np.full(np.prod(GRID.seat_shape), value), budget_s=50.0)
    assert (plan.sweeps, plan.seconds, plan.worth, len(plan.seats)) == ([], 0.0, 0.0, 0)


def test_infinite_scores_come_first():
    """A seat of score +inf outweighs all others together."""
    scores = drawn(GRID)
    weak = int(np.argmin(np.where(np.isin(np.arange(len(scores)), GRID.valid_seats()), scores, np.inf)))
    scores[weak] = np.inf
    plan = plan_fine(GRID, CAMERA, COST, "x", scores, budget_s=6.5)
    assert weak in plan.seats
    assert np.isfinite(plan.worth)


def test_wrong_scores_budgets_and_patches_are_refused():
    """The message names what was expected and what came."""
    with pytest.raises(ShapeError, match="expected 256 scores"):
        plan_fine(GRID, CAMERA, COST, "x", np.zeros(3), budget_s=1.0)
    for bad in (-1.0, np.nan, np.inf):
        with pytest.raises(BudgetError, match="finite number of seconds, 0 or more, got"):
            plan_fine(GRID, CAMERA, COST, "x", drawn(GRID), budget_s=bad)
    wide = SceneGrid(700, 700, 700, 1)
    with pytest.raises(SettingsError, match="patch of 700 px is wider than a line of 640"):
        plan_fine(wide, CAMERA, COST, "x", np.zeros(1), budget_s=1.0)


def test_planning_a_farm_is_quick_and_pays():
    """1280 x 1024 px with 16 px seats is planned in seconds; blobs give twice the worth of their share of lines."""
    grid = SceneGrid(1024, 1280, 16, 4)
    rows, columns = np.divmod(np.arange(np.prod(grid.seat_shape)), grid.seat_shape[1])
    scores = sum(np.exp(-((rows - r) ** 2 + (columns - c) ** 2) / 60) for r, c in ((8, 12), (30, 60), (55, 20)))
    _, _, full = cheapest_full(grid, CAMERA, COST)
    left = check_budget(0.5, COST.seconds(coarse_sweeps(grid, CAMERA, "x"), CAMERA), full)
    began = time.process_time()
    plan = plan_fine(grid, CAMERA, COST, "x", scores, budget_s=left)
    assert time.process_time() - began < 3.0
    assert plan.seconds > left - 3
    assert plan.worth > 2 * plan.seconds / full * scores.sum()


@pytest.mark.parametrize("budget", [0.0, -0.5, 1.0001, float("nan"), float("inf")])
def test_budgets_out_of_range_are_refused(budget: float):
    """A budget is above 0 and at most 1."""
    with pytest.raises(BudgetError, match="above 0 and at most 1, got"):
        check_budget(budget, 50.0, 200.0)


def test_budgets_below_the_coarse_pass_name_the_least():
    """The least that a refusal names is accepted."""
    with pytest.raises(BudgetError, match=r"least possible is 0\.2847"):
        check_budget(0.1, 56.93, 200.0)
    assert check_budget(0.2847, 56.93, 200.0) == pytest.approx(0.01)
    assert check_budget(1.0, 56.93, 200.0) == pytest.approx(143.07)


@given(st.floats(1, 500), st.floats(0.01, 1))
def test_the_least_budget_is_accepted_and_is_the_least(full: float, share: float):
    """It pays for the coarse pass, and one step of the last digit less does not."""
    least = least_budget(full * share, full)
    assert 0 <= check_budget(min(least, 1.0), full * share, full) <= full * 1.01e-4
    with pytest.raises(BudgetError, match=f"the least possible is {least}"):
        check_budget(least - 1.01e-4, full * share, full)


def test_a_coarse_pass_dearer_than_the_full_scan_is_refused():
    """Without a saving to be had the message says to scan in full."""
    with pytest.raises(BudgetError, match="scan in full"):
        check_budget(1.0, 210.0, 200.0)


def test_a_seat_alone_costs_its_own_lines():
    """On a strip through the axis lines are not turned: a seat takes its rows, three for the kernel, and one set-up."""
    grid = SceneGrid(100, 150, 16, 4)
    lines, seconds = price_seats(grid, CAMERA, COST, "x", np.array([24]))
    assert lines == 16 + 3
    assert seconds == pytest.approx(lines * 0.1 + COST.setup_seconds(CAMERA) + COST.reload_s)
    assert price_seats(grid, CAMERA, COST, "x", np.array([], np.intp)) == (0, 0.0)


@given(st.sets(st.integers(0, 55), min_size=2, max_size=20))
def test_neighbours_share_their_lines(seats: set[int]):
    """Seats bought together take at most the lines of each by itself, and no fewer than the dearest of them."""
    grid = SceneGrid(100, 250, 16, 2)  # 8 x 16 seats with the padding; those of the first rows lie on the scene
    valid = [seat for seat in seats if grid.valid_share().ravel()[seat] > 0]
    alone = [price_seats(grid, CAMERA, COST, "y", np.array([seat]))[0] for seat in valid]
    together, _ = price_seats(grid, CAMERA, COST, "y", np.array(valid, np.intp))
    assert max(alone, default=0) <= together <= sum(alone)


def test_seats_of_one_row_cost_one_run():
    """A whole row of seats on one strip takes the lines of a single seat."""
    grid = SceneGrid(100, 150, 16, 4)
    row = np.arange(12, 12 + 9)
    assert price_seats(grid, CAMERA, COST, "x", row) == price_seats(grid, CAMERA, COST, "x", row[:1])
