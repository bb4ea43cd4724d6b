"""Which weights make up one seed of a training, and differences over the frames that two rows share."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from flows.evaluate.series import Row, by_seed, collect_row, difference, seeds_of

TRIAL = {"draws": 30, "seed": 0}


def _record(name: str, right: int, policy: str = "none") -> dict[str, Any]:
    row = {"policy": policy, "share": 0.0, "draw": 0, "counts": [[right, 10 - right], [0, 10]]}
    return {"frame": name, "rows": [row]}


def test_frames_left_out_in_turn_are_one_seed():
    """Weights without a frame in common belong together; those that share one are another seed."""
    folds = [[_record("a", 5)], [_record("b", 6)], [_record("a", 7)], [], [_record("b", 8)]]
    assert seeds_of(folds) == [[0, 1], [2, 4]]
    assert [[record["frame"] for record in records] for records in by_seed(folds)] == [["a", "b"], ["a", "b"]]


def _row(folds: list[list[dict[str, Any]]], names: list[str], policy: str = "none") -> Row:
    row = collect_row(by_seed(folds), policy, 0.0, names)
    assert row is not None
    return row


def test_a_row_of_folds_is_one_run():
    """The figure is that of all frames together, as if one training had judged them."""
    row = _row([[_record("a", 5)], [_record("b", 10)]], ["a", "b"])
    assert row.counts.shape == (1, 2, 2, 2)
    assert row.counts.sum(axis=(0, 1)).tolist() == [[15, 5], [0, 20]]
    assert row.of_seed.tolist() == [0]


def test_a_difference_is_taken_where_both_rows_have_a_frame():
    """A control that lacks a frame is compared on the others, whose number is told."""
    ours = _row([[_record("a", 10), _record("b", 0)]], ["a", "b"])
    control = _row([[_record("a", 10)]], ["a", "b"])
    found = difference(ours, control, TRIAL)
    assert (found["difference"], found["frames"]) == (pytest.approx(0), 1)
    nowhere = difference(_row([[_record("b", 1)]], ["a", "b"]), control, TRIAL)
    assert (nowhere["difference"], nowhere["frames"]) == (None, 0)


def test_a_row_that_nobody_has_is_none():
    """And a row without counts inside seats or near borders has zeros for them."""
    folds = [[_record("a", 5)]]
    assert collect_row(folds, "entropy", 0.0) is None
    assert not np.any(_row(folds, ["a"]).inside)
