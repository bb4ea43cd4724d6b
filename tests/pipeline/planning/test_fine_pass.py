"""The second pass: its duration, no line captured twice, and the choice of line spacing and exposure."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.pipeline.geometry.scan import CostModel
from spectralzoom.pipeline.planning.coverage import full_sweeps, patches_shown
from spectralzoom.pipeline.planning.fine_pass import (
    FIRST_STEPS,
    LEAST_GAIN,
    MOST_AGAIN,
    SecondPass,
    every_nth,
    lines_between,
)
from spectralzoom.pipeline.planning.uniform_scans import MIOU, ScanPerformance

CAMERA = LineCamera(samples=320)
COST = CostModel()
GRID = SceneGrid(256, 600, 16)
FULL = full_sweeps(GRID, CAMERA, "x")
FULL_S = COST.seconds(FULL, CAMERA)
RECORD = ScanPerformance((1, 2, 4), (5.0, 100.0), {MIOU: np.array([[0.9, 0.95], [0.85, 0.92], [0.7, 0.8]])})


def second_pass(seconds: float, *, step: int = 4, margin_px: float = 0.0) -> SecondPass:
    """Return a planner after a first pass of every ``step``-th line."""
    return SecondPass(GRID, CAMERA, COST, every_nth(FULL, step), FULL, seconds, margin_px)


def drawn(seed: int) -> np.ndarray:
    """Return random gains with a few strong patches; a quarter of the patches have none."""
    rng = np.random.default_rng(seed)
    gain = rng.exponential(size=int(np.prod(GRID.patch_shape))) ** 3
    return np.where(rng.random(gain.size) > 0.25, gain, 0.0)


@settings(max_examples=15, deadline=None)
@given(
    st.floats(0, 1.1),
    st.integers(0, 99),
    st.sampled_from([1, 2]),
    st.sampled_from([0.0, 6.0]),
    st.sampled_from([5.0, None]),
)
def test_a_plan_ends_in_time_and_captures_its_patches(
    fraction: float, seed: int, step: int, margin_px: float, exposure_ms: float | None
) -> None:
    """Its seconds are those of the cost model, its gain is that of the captured patches, and names are unique."""
    gain = drawn(seed)
    planner = second_pass(fraction * FULL_S, margin_px=margin_px)
    plan = planner.plan(gain, step=step, exposure_ms=exposure_ms)
    assert plan.seconds == COST.seconds(plan.sweeps, CAMERA) <= fraction * FULL_S
    assert plan.expected_gain == pytest.approx(gain[plan.patch_index].sum())
    assert {sweep.exposure_ms for sweep in plan.sweeps} <= {exposure_ms}
    assert patches_shown([*planner.first_pass, *plan.sweeps], GRID, CAMERA)[plan.patch_index].all()
    names = [sweep.name for sweep in plan.sweeps]
    assert len(set(names)) == len(names)


@settings(max_examples=10, deadline=None)
@given(st.floats(0.05, 1), st.integers(0, 99))
def test_no_line_is_captured_twice(fraction: float, seed: int) -> None:
    """New lines lie between those of the first pass and complete its runs to every line."""
    planner = second_pass(fraction * FULL_S)
    plan = planner.plan(drawn(seed))
    sweeps = [*planner.first_pass, *plan.sweeps]
    lines = [(sweep.swath_px, float(place)) for sweep in sweeps for place in sweep.line_px()]
    assert len(set(lines)) == len(lines)
    rows = planner.rows
    for number, place in np.argwhere(rows.there)[::5]:
        patches = np.flatnonzero(rows.row == number * rows.first.shape[1] + place)
        if np.isin(patches, plan.patch_index).all():
            swath = planner.swaths[number]
            wanted = swath.start_px + np.arange(rows.first[number, place], rows.stop[number, place])
            assert set(wanted.tolist()) <= {at for swath_px, at in lines if swath_px == swath.swath_px}


def test_distant_rows_of_a_swath_become_separate_runs() -> None:
    """Two distant rows of one swath become two runs, because the lines between them take longer than a set-up."""
    planner = second_pass(0.5 * FULL_S)
    gain = np.zeros(int(np.prod(GRID.patch_shape)))
    gain[np.isin(planner.rows.row, [1, planner.rows.first.shape[1] - 2])] = 1.0
    plan = planner.plan(gain)
    assert np.flatnonzero(gain).tolist() == plan.patch_index.tolist()
    assert len({sweep.name.rpartition("-")[0] for sweep in plan.sweeps}) == 2
    assert plan.lines < 0.3 * FULL[0].lines


def test_the_seconds_of_a_full_scan_gain_everything() -> None:
    """The plan's reason says that it captures the whole field."""
    assert second_pass(FULL_S).plan(drawn(0)).expected_gain == pytest.approx(drawn(0).sum())
    whole = second_pass(FULL_S).plan(np.ones(int(np.prod(GRID.patch_shape))))
    assert (whole.kind, whole.patch_index.tolist()) == ("full", GRID.every_patch().tolist())
    assert "the whole field, every line, 100 ms" in whole.reason


def test_a_pointing_margin_extends_a_run_at_both_ends() -> None:
    """With pointing errors a run has every line of its swath, and as many more at both ends as the error reaches."""
    gain = np.zeros(GRID.patch_shape)
    gain[8, 3] = 1.0
    (plain,) = second_pass(FULL_S, step=4, margin_px=1e-9).plan(gain.ravel()).sweeps
    (wide,) = second_pass(FULL_S, step=4, margin_px=6.0).plan(gain.ravel()).sweeps
    assert (wide.start_px, wide.lines) == (plain.start_px - 5, plain.lines + 10)  # 1e-9 already adds a line
    assert wide.step == 1


def test_a_recording_limits_the_sweeps_of_a_plan() -> None:
    """The plan's seconds and exposures are those of the recorded lines; without any there is no plan."""
    plan = replace(second_pass(FULL_S), recorded=lambda a: [replace(a[0], exposure_ms=5.0), a[1]]).plan(drawn(1))
    assert len(plan.sweeps) == 2
    assert plan.seconds == COST.seconds(plan.sweeps, CAMERA)
    assert plan.reason.endswith("every line, 5 ms and 100 ms")
    assert not replace(second_pass(FULL_S), recorded=lambda made: []).plan(drawn(1)).patch_index.size


@pytest.mark.parametrize(("first", "lines"), [(0, 9), (1, 6), (3, 3), (5, 4)])
def test_a_run_ends_at_lines_of_the_first_pass(first: int, lines: int) -> None:
    """A run that begins or ends between two of them is completed from the one before to the one after."""
    (full, *_) = FULL
    (coarse, *_) = every_nth(FULL)
    run = replace(full, start_px=full.start_px + first, lines=lines)
    places = [place - full.start_px for one in lines_between([run], [coarse]) for place in one.line_px()]
    ends = first // 4 * 4, -(-(first + lines - 1) // 4) * 4
    assert sorted(places) == [place for place in range(*ends) if place % 4]


def test_old_and_new_lines_share_the_exposure_by_their_numbers() -> None:
    """After every 4th line at 10 ms, three of four lines at 100 ms make every line, and one of two every second."""
    planner = replace(second_pass(FULL_S), first_pass=every_nth(FULL, 4, 10.0), recorded_ms=(100.0,))
    asked: list[tuple[int, float]] = []

    def gain_of(spacing: int, mean_ms: float) -> np.ndarray:
        asked.append((spacing, mean_ms))
        return drawn(0)

    planner.best(RECORD, gain_of)
    shares = {1: 0.25, 2: 0.5}
    assert dict(asked) == pytest.approx(
        {step: (old / 10**2 + (1 - old) / 100**2) ** -0.5 for step, old in shares.items()}
    )


@pytest.mark.parametrize("step", FIRST_STEPS)
def test_spacing_and_exposure_have_the_highest_gain(step: int) -> None:
    """No other pair gains over 2 % more than the chosen one in the time. A negligible gain plans no second pass."""
    planner = second_pass(0.3 * FULL_S, step=step)
    asked: list[tuple[int, float]] = []

    def gain_of(spacing: int, mean_ms: float) -> np.ndarray:
        asked.append((spacing, mean_ms))
        return drawn(2) * RECORD.expected(spacing, mean_ms)[MIOU]

    best = planner.best(RECORD, gain_of)
    assert {spacing for spacing, _ in asked} == {one for one in RECORD.steps if one < step}
    for spacing in (1, 2):
        for exposure_ms in (5.0, 20.0, 100.0):
            gain = drawn(2) * RECORD.expected(spacing, exposure_ms)[MIOU]
            assert planner.plan(gain, step=spacing, exposure_ms=exposure_ms).expected_gain <= 1.02 * best.expected_gain
    dim = replace(planner, first_pass=every_nth(FULL, step, 100.0), margin_px=6.0)
    worse = replace(RECORD, steps=(1, step), scores={MIOU: np.array([[0.6, 0.95], [0.7, 0.8]])})
    asked.clear()
    dim.best(worse, gain_of)  # lines with a lower score than those of the first pass are not tried
    assert asked
    assert all(worse.expected(*pair)[MIOU] >= 0.8 for pair in asked)
    nothing = planner.best(RECORD, lambda spacing, mean_ms: np.full(drawn(2).size, 0.1 * LEAST_GAIN / drawn(2).size))
    assert (nothing.sweeps, nothing.kind) == ([], "lines")
    assert "no second pass" in nothing.reason


def _gains(share: float) -> np.ndarray:
    """Return gains of .1 in all, evenly on a share of the rows of patches."""
    rows, columns = GRID.patch_shape
    there = np.repeat(np.arange(rows) < share * rows, columns)
    return np.where(there, 0.1 / there.sum(), 0.0)


@pytest.mark.parametrize(("share", "kind"), [(1 / 16, "lines"), (1.0, "full")])
def test_a_second_pass_zooms_where_the_gain_is_compact(share: float, kind: str) -> None:
    """Else it completes the uniform scan; the reason has the figures of both."""
    planner = second_pass(0.25 * FULL_S)

    def gain_of(step: int, mean_ms: float) -> np.ndarray:
        return 5 * _gains(share) * RECORD.expected(step, mean_ms)[MIOU]

    plan = planner.best(RECORD, gain_of)
    assert plan.kind == kind
    assert "expected gain" in plan.reason
    assert len(plan.patch_index) == (GRID.every_patch().size if kind == "full" else pytest.approx(80, abs=64))


def test_runs_that_gain_little_more_complete_the_scan() -> None:
    """Runs are .2 points ahead of the whole field, which is below the least difference."""
    planner = second_pass(0.25 * FULL_S)
    plan = planner.best(RECORD, lambda step, mean_ms: 0.02 * _gains(1 / 16) * RECORD.expected(step, mean_ms)[MIOU])
    assert plan.kind == "full"


@pytest.mark.parametrize("fraction", [0.3, 0.62, 1.0])
def test_runs_of_most_of_the_field_give_way_to_even_lines(fraction: float) -> None:
    """Without a table of scans, either at most the limit is captured again or the whole field."""
    gain = np.random.default_rng(3).uniform(0.9, 1.1, GRID.every_patch().size)
    plan = second_pass(fraction * FULL_S).by_score(gain)
    assert len(plan.patch_index) <= MOST_AGAIN * gain.size or plan.kind == "full"
    assert (plan.kind == "full") == (fraction > 0.3)
    assert plan.seconds <= fraction * FULL_S
