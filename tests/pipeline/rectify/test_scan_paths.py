"""Scan paths have every line at one place in ascending order, for any motion; line numbers follow from time stamps."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from spectralzoom.pipeline.errors import PoseError
from spectralzoom.pipeline.rectify.scan_paths import judge_stamps, line_centres, make_scan_paths
from tests.pipeline.rectify.aiming import CAMERA, aim

STEPS = st.lists(st.sampled_from([-3.0, -1.0, 0.0, 0.1, 1.0, 1.0, 1.2, 4.0]), min_size=0, max_size=60)


@given(STEPS, st.integers(0, 99))
def test_every_usable_line_belongs_to_one_knot(steps: list[float], seed: int) -> None:
    """On any path a knot lies at the mean of its lines, and knots ascend along the scan."""
    position = aim(30.0, np.concatenate([[0.0], np.cumsum(steps)]))
    usable = np.random.default_rng(seed).random(len(position)) < 0.8
    scan, across, _ = line_centres(position, CAMERA)
    held = []
    for scan_path in make_scan_paths(position, CAMERA, usable=usable, step_px=1.0):
        assert (np.diff(scan_path.scan) > 0).all()
        for knot, lines in enumerate(np.split(scan_path.lines, scan_path.starts[1:])):
            assert len(lines) > 0
            if scan_path.seen[knot]:
                held += lines.tolist()
                np.testing.assert_allclose(scan_path.scan[knot], scan[lines].mean(), atol=1e-15)
                np.testing.assert_allclose(scan_path.across[knot], across[lines].mean(), atol=1e-15)
    assert sorted(held) == np.flatnonzero(usable).tolist()


@given(STEPS)
@settings(max_examples=30, deadline=None)
def test_knots_leave_no_gap_above_one_and_a_half_steps(steps: list[float]) -> None:
    """Unseen knots fill gaps where lines are missing. The first and last knot are seen."""
    for scan_path in make_scan_paths(aim(0.0, np.concatenate([[0.0], np.cumsum(steps)])), CAMERA, step_px=1.0):
        assert np.diff(scan_path.scan).max(initial=0) <= 1.5 * CAMERA.ifov_rad * (1 + 1e-9)
        assert scan_path.seen[[0, -1]].all()


def test_an_even_sweep_gives_one_even_scan_path() -> None:
    """A planned sweep gives one knot for each line, straight and even, in either direction."""
    position = aim(-700.0, 12.0 + 4 * np.arange(50.0))
    (scan_path,), (back,) = make_scan_paths(position, CAMERA), make_scan_paths(position[::-1], CAMERA)
    assert scan_path.straight
    assert scan_path.uniform
    assert len(scan_path) == 50
    assert scan_path.seen.all()
    np.testing.assert_allclose(scan_path.width, 4 * CAMERA.ifov_rad, rtol=1e-12)
    np.testing.assert_array_equal(scan_path.lines, np.arange(50))
    np.testing.assert_array_equal(back.lines, np.arange(50)[::-1])
    np.testing.assert_allclose(back.scan, scan_path.scan, atol=1e-15)


def test_lost_and_unusable_lines_keep_a_scan_path_even() -> None:
    """Lost or unusable lines get unseen knots at their places."""
    usable = np.ones(8, np.bool_)
    usable[5] = False
    (scan_path,) = make_scan_paths(aim(0.0, np.array([0.0, 1, 2, 5, 6, 7, 8, 9])), CAMERA, usable=usable)
    assert scan_path.uniform
    np.testing.assert_array_equal(scan_path.seen, [True, True, True, False, False, True, True, False, True, True])
    np.testing.assert_array_equal(scan_path.lines, [0, 1, 2, 2, 3, 3, 4, 4, 6, 7])  # unseen: the nearest line


def test_corrections_move_the_line_centres() -> None:
    """A shift in scene px is added along the line and along the scan."""
    shift = np.stack([np.full(5, 7.0), 0.5 * np.arange(5)], axis=-1)
    (scan_path,) = make_scan_paths(aim(100.0, np.arange(5.0)), CAMERA, shift_px=shift)
    np.testing.assert_allclose(scan_path.across / CAMERA.ifov_rad, 107.0, atol=1e-9)
    np.testing.assert_allclose(scan_path.scan / CAMERA.ifov_rad, 1.5 * np.arange(5), atol=1e-9)


def test_position_noise_does_not_split_a_scan_path() -> None:
    """A path of 1 px steps stays one scan path under 0.8 px of noise, although lines change their order."""
    rng = np.random.default_rng(4)
    scan_paths = make_scan_paths(aim(0.0, np.arange(400.0) + rng.normal(0, 0.8, 400)), CAMERA, step_px=1.0)
    assert len(scan_paths) == 1
    assert (np.diff(scan_paths[0].lines) < 0).any()


def test_a_reversal_above_the_noise_splits_the_scan_path() -> None:
    """A path that goes back by 3.5 px under 0.3 px of noise turns twice and gives three scan paths."""
    scan = np.concatenate([np.arange(60.0), 59 - 0.5 * np.arange(1, 8), 55.5 + np.arange(1, 60)])
    noise = np.random.default_rng(2).normal(0, 0.3, len(scan))
    assert len(make_scan_paths(aim(0.0, scan + noise), CAMERA, step_px=1.0)) == 3


def test_lines_closer_than_a_quarter_step_share_a_knot() -> None:
    """Pairs of lines 0.2 steps apart share a knot, pairs 0.3 steps apart do not."""
    pairs = np.repeat(np.arange(10.0), 2)
    for apart, knots in ((0.2, 10), (0.3, 20)):
        (scan_path,) = make_scan_paths(aim(0.0, pairs + np.tile([0, apart], 10)), CAMERA, step_px=1.0)
        assert len(scan_path) == knots


@pytest.mark.parametrize(
    ("scan", "lines"),
    [
        (np.repeat(np.arange(6.0), 9) + 1e-6 * np.arange(54), np.arange(54)),  # stands for 9 lines, creeping
        (np.array([0.0, 1.0, 4.0]), np.arange(3)),  # as many gaps as steps
        (np.arange(5.0), np.arange(0, 5, 2)),  # every other line not usable
    ],
)
def test_the_step_is_estimated_from_the_path(scan: np.ndarray, lines: np.ndarray) -> None:
    """Without a planned step it is the distance that a moving mirror covers from line to line: knots are 1 px apart."""
    (scan_path,) = make_scan_paths(aim(0.0, scan), CAMERA, usable=np.isin(np.arange(len(scan)), lines))
    np.testing.assert_allclose(np.diff(scan_path.scan) / CAMERA.ifov_rad, 1, atol=1e-4)


def test_a_speed_near_the_plan_is_still_even() -> None:
    """An even path whose step is 0.1 % above the plan uses its own step."""
    (scan_path,) = make_scan_paths(aim(0.0, 1.001 * np.arange(50.0)), CAMERA, step_px=1.0)
    assert scan_path.uniform
    np.testing.assert_allclose(scan_path.width, 1.001 * CAMERA.ifov_rad, rtol=1e-9)
    (uneven,) = make_scan_paths(aim(0.0, np.array([0, 1, 2, 3.4, 4.8])), CAMERA, step_px=1.0)
    np.testing.assert_allclose(uneven.width, CAMERA.ifov_rad, rtol=1e-9)


def test_recorded_lines_far_apart_leave_no_gap() -> None:
    """Plans of recordings have whole pixels. Lines 1.45 px apart, with noise, still get no unseen knot between them."""
    scan = 1.45 * np.arange(60.0) + np.random.default_rng(0).normal(0, 0.04, 60)
    (scan_path,) = make_scan_paths(aim(0.0, scan), CAMERA, step_px=1.0)
    assert scan_path.seen.all()


def test_a_line_out_of_reach_is_named() -> None:
    """Usable lines beyond the disk or without a position raise an error with their number. Unusable ones do not."""
    position = aim(0.0, np.arange(6.0))
    position[4] = np.nan
    with pytest.raises(PoseError, match="line 4 is at mirror position"):
        make_scan_paths(position, CAMERA)
    position[5] = 0.8, 0.8
    with pytest.raises(PoseError, match=r"line 5 is at mirror position \(0.8, 0.8\)"):
        make_scan_paths(position, CAMERA, usable=np.arange(6) != 4)
    (scan_path,) = make_scan_paths(position, CAMERA, usable=np.arange(6) < 4)
    assert len(scan_path) == 4


@given(st.lists(st.integers(0, 400), min_size=2, max_size=60, unique=True), st.floats(0.97, 1.03), st.integers(0, 99))
def test_lost_frames_are_counted(lines: list[int], pace: float, seed: int) -> None:
    """With a clock that errs by 3 % and jitter of a tenth, gaps of up to 8 lines are counted exactly."""
    came = np.sort(lines)
    came = came[np.concatenate([[True], np.cumprod(np.diff(came) < 9).astype(bool)])]  # longer gaps may be miscounted
    time = 5.0 + 0.1 * (pace * came + np.random.default_rng(seed).uniform(-0.1, 0.1, len(came)))
    found = judge_stamps(time, 0.1)
    assert found.usable.all()
    assert (found.lost, found.repeated, found.backward) == (came[-1] - came[0] + 1 - len(came), 0, 0)


@given(st.integers(0, 99), st.integers(3, 40))
def test_repeated_frames_and_wild_stamps_are_marked(seed: int, lines: int) -> None:
    """A repeated frame and one wild time stamp are marked, and no line counts as lost."""
    rng = np.random.default_rng(seed)
    time = np.arange(float(lines))
    again = rng.integers(0, lines)
    sent = np.insert(time, again + 1, time[again])
    sent = np.insert(sent, rng.integers(1, lines - 1), rng.choice([-50.0, 1e6]))
    found = judge_stamps(sent, 1.0)
    assert (found.repeated, found.backward, found.lost) == (1, 1, 0)


@pytest.mark.parametrize("ends", [[1e6], [1e300], [-1e6], [-1e300, 1e300]])
def test_wild_stamps_at_the_ends_are_unusable(ends: list[float]) -> None:
    """A first or last stamp far off all others costs its own line only. It adds neither lost lines nor a step back."""
    found = judge_stamps(np.sort([*ends, *np.arange(20.0)]), 1.0)
    assert found.usable.sum() == 20
    assert (found.backward, found.lost) == (len(ends), 0)
    assert judge_stamps(np.array([0.0, 1, 900]), 1.0).lost == 898


@pytest.mark.parametrize(
    ("stamps", "unusable"),
    [
        ([0, 1, 2, 3, 2.5, 4], [4]),  # of two contradicting stamps the later one is unusable
        ([0, 1, 2, 1, 3], [3]),  # a copy
        ([0, 1, 2.6, 3, 4, 5], []),  # late by 0.6 periods, but no line is lost
        ([0, 1, 2, 3.8, 4], []),
    ],
)
def test_stamps_worked_out_by_hand(stamps: list[float], unusable: list[int]) -> None:
    """Unusable frames; no line is lost."""
    found = judge_stamps(np.array(stamps, float), 1.0)
    assert (np.flatnonzero(~found.usable).tolist(), found.lost) == (unusable, 0)


@pytest.mark.parametrize(("gap", "lost"), [(1.45, 0), (1.5, 0), (1.55, 1), (2.45, 1), (2.55, 2)])
def test_a_gap_above_one_and_a_half_periods_counts_a_lost_line(gap: float, lost: int) -> None:
    """Gaps are rounded to the nearest line, halves down."""
    assert judge_stamps(np.concatenate([np.arange(4.0), 3 + gap + np.arange(4)]), 1.0).lost == lost
