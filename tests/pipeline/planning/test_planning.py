"""The fine plan: budgets, laws over budgets, the full scan instead, and the scores that are none."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.errors import SettingsError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import CostModel
from pipeline.planning.coverage import cheapest_full, full_sweeps
from pipeline.planning.fine_pass import plan_fine
from pipeline.planning.partial_scans import every_nth
from pipeline.planning.prices import check_budget
from pipeline.planning.swaths import covered_patches
from tests.pipeline.planning.fields import planned

CAMERA, COST = LineCamera(), CostModel()
GRID = SceneGrid(200, 900, 32, 4)


def drawn(grid: SceneGrid, seed: int = 0) -> np.ndarray:
    """Scores with a few strong patches."""
    return np.random.default_rng(seed).exponential(size=int(np.prod(grid.patch_shape))) ** 3


@settings(max_examples=4, deadline=None)
@given(st.floats(0, 60), st.floats(0, 60), st.integers(0, 99), st.sampled_from(["x", "y"]))
def test_price_within_budget_and_worth_grows_with_it(one: float, other: float, seed: int, along: str):
    """The plan never costs more than the budget, and a bigger budget never buys less score."""
    plan = partial(planned, GRID, CAMERA, COST, along, drawn(GRID, seed))
    small, large = (plan(budget_s=budget_s) for budget_s in sorted((one, other)))
    assert small.seconds <= min(one, other)
    assert large.seconds <= max(one, other)
    assert large.expected_gain >= small.expected_gain * (1 - 1e-12)


@settings(max_examples=3, deadline=None)
@given(st.integers(40, 700), st.integers(40, 1500), st.floats(0, 80), st.integers(0, 99))
def test_plans_hold_together(height: int, width: int, budget_s: float, seed: int):
    """Sweeps lie apart, the price is the cost model's, and the patches shown are worth at least what was bought."""
    grid = SceneGrid(height, width, 32, 2)
    scores = drawn(grid, seed)
    plan = planned(grid, CAMERA, COST, "x", scores, budget_s=budget_s)
    assert plan.seconds == COST.seconds(plan.sweeps, CAMERA) <= budget_s
    assert plan.patch_index.tolist() == covered_patches(grid, CAMERA, plan.sweeps).tolist()
    assert scores[plan.patch_index].sum() >= plan.expected_gain * (1 - 1e-12)
    assert len({sweep.name for sweep in plan.sweeps}) == len(plan.sweeps)


@pytest.mark.parametrize("width", [600, 900, 1270, 1280, 1296])
def test_enough_seconds_buy_every_patch(width: int):
    """A large budget shows all patches, for widths that divide and not."""
    grid = SceneGrid(150, width, 32, 2)
    scores = drawn(grid)
    plan = planned(grid, CAMERA, COST, "x", scores, budget_s=1e4)
    assert plan.patch_index.tolist() == grid.valid_patches().tolist()
    assert plan.expected_gain == pytest.approx(scores[grid.valid_patches()].sum())


def test_one_strong_patch_is_bought_alone():
    """A single patch of worth gets one run of just its lines, in either orientation."""
    scores = np.zeros(np.prod(GRID.patch_shape))
    scores[GRID.valid_patches()[40]] = 3.0
    for along, budget_s in (("x", 20.0), ("y", 1e4)):  # though the second pays for the full scan
        plan = planned(GRID, CAMERA, COST, along, scores, budget_s=budget_s)
        (sweep,) = plan.sweeps
        assert GRID.valid_patches()[40] in plan.patch_index
        assert 35 <= sweep.lines < 60
        assert plan.expected_gain == 3.0


def test_a_patch_wider_than_a_line_is_refused():
    """The message names both."""
    with pytest.raises(SettingsError, match="patch of 700 px is wider than a line of 640"):
        planned(SceneGrid(700, 700, 700, 1), CAMERA, COST, "x", np.zeros(1), budget_s=1.0)


def test_planning_a_farm_pays():
    """On 1280 x 1024 px with 16 px patches blobs give twice the worth of their fraction of lines."""
    grid = SceneGrid(1024, 1280, 16, 4)
    rows, columns = np.divmod(np.arange(np.prod(grid.patch_shape)), grid.patch_shape[1])
    scores = sum(np.exp(-((rows - r) ** 2 + (columns - c) ** 2) / 60) for r, c in ((8, 12), (30, 60), (55, 20)))
    _, _, full = cheapest_full(grid, CAMERA, COST)
    left = check_budget(0.5, COST.seconds(every_nth(full_sweeps(grid, CAMERA, "x")), CAMERA), full)
    plan = planned(grid, CAMERA, COST, "x", scores, budget_s=left)
    assert plan.seconds > left - 3
    assert plan.expected_gain > 2 * plan.seconds / full * scores.sum()


def test_runs_lie_at_their_own_offsets():
    """A block of patches in the middle of a field two swaths wide takes one run, on none of the full scan's swaths."""
    grid = SceneGrid(320, 1280, 32, 2)
    scores = np.zeros(grid.patch_shape)
    scores[4:6, 11:29] = 1.0
    plan = planned(grid, CAMERA, COST, "x", scores.ravel(), budget_s=15.0)
    (sweep,) = plan.sweeps
    assert abs(sweep.swath_px) < 40
    assert plan.expected_gain == scores.sum()
    assert plan.gain_per_second == pytest.approx(plan.expected_gain / plan.seconds)
    assert plan.kind == "lines"


def scattered(grid: SceneGrid) -> np.ndarray:
    """Every third patch in every third row: nearly all lines are needed for a ninth of the patches."""
    rows, columns = np.divmod(np.arange(int(np.prod(grid.patch_shape))), grid.patch_shape[1])
    on_scene = grid.valid_fraction().ravel() > 0
    return np.where(on_scene & (rows % 2 == 0) & (columns % 3 == 0), 1.0, 0.0)


def test_the_full_scan_is_taken_where_runs_are_no_cheaper():
    """Patches of which a line shows one take four swaths, the full scan two: it is taken, and says so."""
    grid = SceneGrid(600, 1280, 400, 1)
    scores = np.ones(8)
    full = full_sweeps(grid, CAMERA, "x")
    full_s = COST.seconds(full, CAMERA)
    plan = planned(grid, CAMERA, COST, "x", scores, budget_s=full_s)
    assert (plan.kind, plan.seconds, plan.full_seconds) == ("full", full_s, full_s)
    assert plan.sweeps == full
    assert plan.patch_index.tolist() == grid.valid_patches().tolist()
    assert plan.expected_gain == plan.wanted_gain == 8.0
    assert "the full scan is taken" in plan.reason
    below = planned(grid, CAMERA, COST, "x", scores, budget_s=full_s - 1e-6)
    assert below.kind == "lines"
    assert below.expected_gain < 8.0


@pytest.mark.parametrize("budget_s", [0.0, 20.0, 40.0, 80.0, 500.0])
def test_no_plan_takes_longer_than_the_full_scan(budget_s: float):
    """Whatever the budget, the fine pass takes at most the seconds of the full scan."""
    plan = planned(GRID, CAMERA, COST, "x", scattered(GRID), budget_s=budget_s)
    assert plan.seconds <= plan.full_seconds
    assert plan.kind == "lines" or plan.seconds == plan.full_seconds
    assert f"{plan.full_seconds:.1f} s" in plan.reason


def test_a_margin_shows_the_patches_wherever_the_mirror_looks() -> None:
    """Runs planned for a mirror that may be 6 px off still show their patches whole when all of it is."""
    grid, camera = SceneGrid(300, 900, 32, 4), LineCamera()
    scores = np.random.default_rng(2).random(int(np.prod(grid.patch_shape))) ** 4
    full = full_sweeps(grid, camera, "x")
    plan = plan_fine(grid, camera, CostModel(), "x", scores, budget_s=20.0, margin_px=6.0, full=full)
    assert len(plan.patch_index) > 20
    for along, scan in ((6, 6), (-6, 6), (6, -6), (-6, -6)):
        beside = [replace(one, swath_px=one.swath_px + along, start_px=one.start_px + scan) for one in plan.sweeps]
        assert set(plan.patch_index) <= set(covered_patches(grid, camera, beside))


@settings(max_examples=3, deadline=None)
@given(st.integers(0, 99), st.floats(5, 40))
def test_negative_scores_ride_along_and_change_nothing(seed: int, budget_s: float):
    """The plan is that of scores of 0 in their place: negative patches are shown by runs made for others alone."""
    scores = drawn(GRID, seed)
    gone = np.random.default_rng(seed).random(len(scores)) < 0.5
    negative, nothing = np.where(gone, -scores, scores), np.where(gone, 0.0, scores)
    one, other = (planned(GRID, CAMERA, COST, "x", s, budget_s=budget_s) for s in (negative, nothing))
    assert (one.sweeps, one.expected_gain, one.patch_index.tolist()) == (
        other.sweeps,
        other.expected_gain,
        other.patch_index.tolist(),
    )
    for sweep in one.sweeps:
        assert nothing[covered_patches(GRID, CAMERA, [sweep])].max() > 0
