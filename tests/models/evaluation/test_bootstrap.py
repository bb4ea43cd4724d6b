"""Bootstrap intervals of the difference of two rows of a table, over frames drawn again."""

from __future__ import annotations

import numpy as np
import pytest

from models.evaluation.metrics import mean_iou, paired_interval


def _frames(runs: int, frames: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 50, (runs, frames, 3, 3))


def test_interval_of_two_frames_is_that_worked_out_by_hand():
    """One draw in four holds only the first frame, one only the second: the bounds are those of either frame alone."""
    first, second = np.zeros((1, 2, 2, 2), np.int64), np.zeros((1, 2, 2, 2), np.int64)
    first[0, 0], first[0, 1] = [[4, 0], [0, 4]], [[4, 0], [0, 4]]  # perfect
    second[0, 0], second[0, 1] = [[4, 0], [0, 4]], [[2, 2], [2, 2]]  # the second frame is wrong by half: IoU 1/3
    found = paired_interval(first, second, draws=500)
    both = 6 / 10  # hits 6 of 8 in each class, union 10
    assert found.difference == pytest.approx(1 - both)
    assert found.low == pytest.approx(0)
    assert found.high == pytest.approx(1 - 1 / 3)


def test_swapping_the_rows_mirrors_the_interval():
    """Difference and bounds change their sign, and the bounds change places."""
    first, second = _frames(1, 7, 1), _frames(1, 7, 2)
    there, back = paired_interval(first, second, draws=101), paired_interval(second, first, draws=101)
    assert there.difference == pytest.approx(-back.difference)
    assert there.low == pytest.approx(-back.high)
    assert there.high == pytest.approx(-back.low)


def test_a_row_is_the_mean_over_its_runs():
    """Three equal runs give the same as one; two rows may have different numbers of runs."""
    first, second = _frames(1, 5, 1), _frames(1, 5, 2)
    assert paired_interval(first.repeat(3, axis=0), second, draws=40) == pytest.approx(
        paired_interval(first, second, draws=40), abs=1e-12
    )


def test_a_run_is_scored_on_its_own_frames_only():
    """Each run leaves another frame out, as zeros; these do not change its score."""
    counts = _frames(2, 2)
    counts[0, 1], counts[1, 0] = 0, 0
    none = np.zeros((1, 2, 3, 3), np.int64) + np.eye(3, dtype=np.int64)
    expected = (mean_iou(counts[0, 0]) + mean_iou(counts[1, 1])) / 2 - 1
    assert paired_interval(counts, none, draws=20).difference == pytest.approx(expected)


def test_differing_seeds_widen_the_interval():
    """Equal frames alone give no width; unequal seeds do, and both rows share their draw of seeds."""
    good, bad = np.eye(3, dtype=np.int64) * 9, np.eye(3, dtype=np.int64) + 2
    first = np.stack([np.stack([good] * 4), np.stack([bad] * 4)])
    second = np.stack([np.stack([good] * 4)] * 2)
    two = np.arange(2)
    assert paired_interval(first, second, draws=50).low == pytest.approx(paired_interval(first, second).high)
    wide = paired_interval(first, second, seeds=(two, two), draws=50)
    assert wide.low == pytest.approx(mean_iou(4 * bad) - 1)
    assert wide.high == pytest.approx(0)
    same = paired_interval(first, first, seeds=(two, two), draws=50)
    assert (same.low, same.high) == (0, 0)


def test_one_frame_has_no_interval():
    """There is a difference, but no bounds, which would feign certainty."""
    found = paired_interval(_frames(1, 1, 1), _frames(1, 1, 2))
    assert found.low is found.high is None
    assert np.isfinite(found.difference)


def test_equal_random_seeds_give_equal_intervals():
    """Another random seed gives another interval."""
    first, second = _frames(1, 9, 1), _frames(1, 9, 2)
    same = [paired_interval(first, second, draws=60, seed=seed) for seed in (3, 3, 4)]
    assert same[0] == same[1] != same[2]


def test_bounds_are_those_of_95_percent_of_the_draws():
    """One of three frames is better: 1 of 27 draws holds it alone, which is more than 2.5 % and less than 5 %."""
    poor, good = [[10, 0], [10, 0]], [[10, 0], [0, 10]]
    found = paired_interval(np.array([[good, poor, poor]]), np.array([[poor, poor, poor]]))
    assert (found.low, found.high) == (0.0, pytest.approx(1 - 0.25))
