"""Intervals of a difference of two rows over frames drawn again."""

from __future__ import annotations

import numpy as np
import pytest

from models.evaluation.metrics import mean_iou, paired_interval


def _frames(runs: int, frames: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 50, (runs, frames, 3, 3))


def test_a_worked_case():
    """Two frames: 3/4 of draws by count hold the first, so that the bounds are those of either frame alone."""
    first, second = np.zeros((1, 2, 2, 2), np.int64), np.zeros((1, 2, 2, 2), np.int64)
    first[0, 0], first[0, 1] = [[4, 0], [0, 4]], [[4, 0], [0, 4]]  # perfect
    second[0, 0], second[0, 1] = [[4, 0], [0, 4]], [[2, 2], [2, 2]]  # the second frame is wrong by half: IoU 1/3
    found = paired_interval(first, second, draws=500)
    both = 6 / 10  # hits 6 of 8 in each class, union 10
    assert found.difference == pytest.approx(1 - both)
    assert found.low == pytest.approx(0)
    assert found.high == pytest.approx(1 - 1 / 3)


def test_names_turn_the_interval_round():
    """The second less the first is the first less the second with its sign and bounds turned."""
    first, second = _frames(1, 7, 1), _frames(1, 7, 2)
    there, back = paired_interval(first, second, draws=101), paired_interval(second, first, draws=101)
    assert there.difference == pytest.approx(-back.difference)
    assert there.low == pytest.approx(-back.high)
    assert there.high == pytest.approx(-back.low)


def test_a_row_is_the_mean_over_its_runs():
    """Two runs that are alike give what one gives; rows may differ in runs."""
    first, second = _frames(1, 5, 1), _frames(1, 5, 2)
    assert paired_interval(first.repeat(3, axis=0), second, draws=40) == pytest.approx(
        paired_interval(first, second, draws=40), abs=1e-12
    )


def test_a_run_is_judged_on_its_own_frames_alone():
    """Frames left out in turn: zeros of a frame that a run did not judge change nothing of its figure."""
    counts = _frames(2, 2)
    counts[0, 1], counts[1, 0] = 0, 0
    none = np.zeros((1, 2, 3, 3), np.int64) + np.eye(3, dtype=np.int64)
    expected = (mean_iou(counts[0, 0]) + mean_iou(counts[1, 1])) / 2 - 1
    assert paired_interval(counts, none, draws=20).difference == pytest.approx(expected)


def test_seeds_that_differ_widen_the_interval():
    """Frames that are all alike leave no doubt; seeds that are not alike do, and both rows share their draw."""
    good, bad = np.eye(3, dtype=np.int64) * 9, np.eye(3, dtype=np.int64) + 2
    first = np.stack([np.stack([good] * 4), np.stack([bad] * 4)])
    second, two = np.stack([np.stack([good] * 4)] * 2), np.arange(2)
    assert paired_interval(first, second, draws=50).low == pytest.approx(paired_interval(first, second).high)
    wide = paired_interval(first, second, seeds=(two, two), draws=50)
    assert wide.low == pytest.approx(mean_iou(4 * bad) - 1)
    assert wide.high == pytest.approx(0)
    same = paired_interval(first, first, seeds=(two, two), draws=50)
    assert (same.low, same.high) == (0, 0)


def test_one_frame_has_no_interval():
    """A difference, and no bounds that would feign certainty."""
    found = paired_interval(_frames(1, 1, 1), _frames(1, 1, 2))
    assert found.low is found.high is None
    assert np.isfinite(found.difference)


def test_the_same_seed_draws_the_same():
    """And another seed draws otherwise."""
    first, second = _frames(1, 9, 1), _frames(1, 9, 2)
    same = [paired_interval(first, second, draws=60, seed=seed) for seed in (3, 3, 4)]
    assert same[0] == same[1] != same[2]


def test_bounds_are_those_of_95_percent_of_the_draws():
    """One of three frames is better: all draws take it in 1 of 27, which is more than 2.5 % and less than 5 %."""
    poor, good = [[10, 0], [10, 0]], [[10, 0], [0, 10]]
    found = paired_interval(np.array([[good, poor, poor]]), np.array([[poor, poor, poor]]))
    assert (found.low, found.high) == (0.0, pytest.approx(1 - 0.25))
