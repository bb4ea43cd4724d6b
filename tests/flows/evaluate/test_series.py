"""Which weights make up one seed of a training, differences over shared frames, and one number for a curve."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from flows.evaluate.series import Row, by_seed, collect_row, curve_figures, difference, seeds_of

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


def test_every_draw_of_every_seed_is_a_run_of_its_own():
    """Seeds first, draws within them; counts of no two are added or lost."""
    seeds = [[_record("a", right), _record("a", right + 1)] for right in (2, 6)]
    for one, other in seeds:
        other["rows"][0]["draw"] = 1
        one["rows"] += other["rows"]
    row = collect_row([[one] for one, _ in seeds], "none", 0.0)
    assert row is not None
    assert row.counts[:, 0, 0, 0].tolist() == [2, 3, 6, 7]
    assert row.of_seed.tolist() == [0, 0, 1, 1]


def test_a_row_that_nobody_has_is_none():
    """And a row without counts inside seats or near borders has zeros for them."""
    folds = [[_record("a", 5)]]
    assert collect_row(folds, "entropy", 0.0) is None
    assert not np.any(_row(folds, ["a"]).inside)


def test_a_straight_line_in_the_logarithm_closes_half():
    """Without a point between, the area is that of the straight way from none to all."""
    found = curve_figures((1.0, 0.5), [], (100.0, 0.7))
    assert found.auc_gap == pytest.approx(0.5)
    assert found.hypervolume == pytest.approx(0)
    assert found.cost_to_enough == pytest.approx(1)


def test_a_curve_by_hand():
    """A tenth of the cost has all that there is: half of the logarithm at full, half rising to it."""
    found = curve_figures((1.0, 0.5), [(10.0, 0.7)], (100.0, 0.7))
    assert found.auc_gap == pytest.approx(0.75)
    assert found.hypervolume == pytest.approx(0.2 * 0.9)
    assert found.cost_to_enough == pytest.approx(0.1)


def test_more_seats_that_hurt_take_nothing_from_what_is_dominated():
    """The hypervolume holds the best so far; a point dearer than all adds nothing."""
    good = [(10.0, 0.8)]
    assert curve_figures((1.0, 0.5), [*good, (50.0, 0.6)], (100.0, 0.7)).hypervolume == pytest.approx(
        curve_figures((1.0, 0.5), [*good, (200.0, 0.9)], (100.0, 0.7)).hypervolume or 0
    )


def test_a_gap_under_a_point_has_no_area():
    """Nor has a scene where none costs as much as all."""
    assert curve_figures((1.0, 0.5), [(2.0, 0.6)], (9.0, 0.505)).auc_gap is None
    assert curve_figures((9.0, 0.5), [], (9.0, 0.7)).hypervolume is None
