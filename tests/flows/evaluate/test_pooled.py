"""Rows of many frames: one threshold for the scores of all, seeds of a training, and one number for a curve."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from flows.evaluate import work as benchmark_work
from flows.evaluate.command import evaluate_weights, run_evaluate
from flows.evaluate.frames import EvaluateRequest
from flows.evaluate.plots import evaluation_figure
from flows.evaluate.rows import (
    Trial,
    buy_by_seed,
    buy_together,
    judge_frame,
    judge_pooled,
    pooled_policies,
    score_frame,
)
from flows.evaluate.series import Row, by_seed, collect_row, curve_figures, difference, seeds_of
from models.policies.policies import score_seats
from pipeline.planning.selection import seat_count
from tests.flows.evaluate.conftest import Judged
from tests.flows.small_fields import FRAMES, QUICK, looked_at, scene_at, write_weights

POLICY = "entropy, pooled"
FAST: dict[str, Any] = {**QUICK, "policies": ("entropy", "random"), "timed_frames": 0}
scores = st.lists(st.lists(st.floats(-1, 1) | st.sampled_from([0.0, np.nan]), max_size=12), min_size=1, max_size=5)


def _records(each: list[list[float]]) -> list[dict[str, Any]]:
    return [{"frame": f"{at}", "scores": {"gain": own}} for at, own in enumerate(each)]


@given(scores, st.floats(0, 1))
def test_all_frames_together_buy_the_share(each: list[list[float]], share: float):
    """The seats add up to the share of all, and no seat left behind has a higher score than one that was bought."""
    bought = [own[0] for own in buy_together(_records(each), (share,))]
    assert sum(one["seats"] for one in bought) == seat_count(share, sum(map(len, each)))
    ranked = [sorted((-np.inf if np.isnan(v) else v for v in own), reverse=True) for own in each]
    taken = [value for own, one in zip(ranked, bought, strict=True) for value in own[: one["seats"]]]
    left = [value for own, one in zip(ranked, bought, strict=True) for value in own[one["seats"] :]]
    if taken and left and max(max(taken), max(left)) > -np.inf:
        assert min(taken) >= max(left)
        assert min(taken) == (-np.inf if bought[0]["threshold"] is None else bought[0]["threshold"])


def test_frames_of_one_seed_buy_together():
    """Bare frames less, ties the first; weights with no frame in common share a threshold; scores are of one unit."""
    rich = [own[0]["seats"] for own in buy_together(_records([[0.1, 0.2], [0.9, 0.8]]), (0.5,))]
    assert rich == [0, 2]
    even = buy_together(_records([[0.3], [0.3], [0.3]]), (2 / 3,))
    assert [own[0]["seats"] for own in even] == [1, 1, 0]
    assert [own[0]["threshold"] for own in even] == [0.3] * 3
    runs = [
        [{"frame": "a", "scores": {"gain": [0.1, 0.2]}}],
        [{"frame": "b", "scores": {"gain": [0.8, 0.9]}}],
        [{"frame": "a", "scores": {"gain": [5.0, 0.0]}}],
    ]
    bought = buy_by_seed(runs, (0.5,))
    assert {key: (own[0]["seats"], own[0]["threshold"]) for key, own in bought.items()} == {
        (0, "a"): (0, 0.8),
        (1, "b"): (2, 0.8),
        (2, "a"): (1, 5.0),
    }
    assert buy_by_seed([[]], (0.5,)) == {}
    assert pooled_policies(("sobel", "entropy", "random", "gain", "centre")) == ("entropy", "gain")


def test_as_many_seats_as_of_its_own_share_give_the_same_map(data: Path, tmp_path: Path):
    """A frame that buys what the share would buy there has the row of the share, costs and all."""
    look, weights = looked_at(data, tmp_path / "w.safetensors")
    own = next(row for row in judge_frame(Trial((0.25,), ("gain",)), look, weights)["rows"] if row["policy"] == "gain")
    bought = buy_together([score_frame(("gain",), look)], (0.25,))[0]
    (row,) = judge_pooled(bought, look, weights)["rows"]
    same = set(own) - {"policy", "gain", "best_gain", "ap_top"}
    assert {name: row[name] for name in same} == {name: own[name] for name in same}
    scores = score_seats("gain", look.seen)[look.seen.grid.valid_seats()]
    assert bought[0]["threshold"] == np.sort(scores)[-own["seats"]]


def _rows(content: dict[str, Any], policy: str) -> list[dict[str, Any]]:
    return [row for row in content["rows"] if row["policy"] == policy]


def test_rows_say_what_frames_bought_and_cost(judged: Judged):
    """Seats are the share of all in the mean, costs those of the policy at its own seats; lines are not told."""
    content = judged[1]
    for row, own in zip(_rows(content, POLICY), _rows(content, "entropy"), strict=True):
        seats, cost = row["seats_per_frame"], row["cost"]
        assert seats["mean"] == seat_count(row["share"], 45) / 3  # 15 seats of 8 px a frame
        assert seats["least"] <= seats["mean"] <= seats["most"]
        assert own["seats_per_frame"]["least"] == own["seats_per_frame"]["most"]
        assert len(row["thresholds"]) == 2
        assert row["against_share_per_frame"]["difference"] == pytest.approx(row["miou"] - own["miou"])
        for name in ("against_share_per_frame", "against_baseline", "against_random"):
            assert row[name]["low"] <= row[name]["difference"] <= row[name]["high"]
        assert own["thresholds"] is own["against_share_per_frame"] is None
        assert row["captured_gain"] is row["ap_gain"] is None
        assert {one["frames"] for one in (row, own)} == {3}
        assert (cost["cpu_s"], cost["frame_s"]) == (own["cost"]["cpu_s"], own["cost"]["frame_s"])
        assert cost["rig_s"]["done"] is None
        assert cost["samples"]["done"] == pytest.approx(12 * 20 + 64 * seats["mean"])


def test_pooled_rows_are_printed_and_drawn(judged: Judged, capsys: pytest.CaptureFixture[str]):
    """A table of seats and thresholds, and a line of its own in the plot."""
    request, content = judged
    run_evaluate(request, Console(stderr=True))
    shown = capsys.readouterr().out
    assert "pooled: one threshold" in shown
    assert shown.count(POLICY) == 2 * 4 + 1  # accuracy, costs, multiply-adds and seats by share, placement once
    labels = evaluation_figure(content).axes[0].get_legend_handles_labels()[1]
    assert POLICY in labels


def test_a_killed_run_goes_on_and_old_results_count(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """What was kept without pooling is used; the second pass goes on where it was killed."""
    weights = (write_weights(tmp_path / "w.safetensors"),)
    before = EvaluateRequest(str(data), weights, tmp_path / "out", pooled=False, **FAST)
    old = evaluate_weights(before)
    request = EvaluateRequest(str(data), weights, tmp_path / "out", **FAST)
    monkeypatch.setattr(benchmark_work, "judge_frame", lambda *_: pytest.fail("a frame was judged again"))
    seen: list[str] = []
    _killed_after(1, seen, monkeypatch)
    with pytest.raises(KeyboardInterrupt):
        evaluate_weights(request)
    _killed_after(9, seen, monkeypatch)
    new = evaluate_weights(request)
    assert seen == list(FRAMES)
    assert json.dumps([row for row in new["rows"] if row["policy"] != POLICY]) == json.dumps(old["rows"])
    assert len(_rows(new, POLICY)) == 2


def _killed_after(count: int, seen: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[str] = []

    def judge(bought: Any, look: Any, weights: Any, report: Callable[[float], None]) -> dict[str, Any]:
        if len(made) == count:
            raise KeyboardInterrupt
        made.append(look.name)
        seen.append(look.name)
        return judge_pooled(bought, look, weights, report)

    monkeypatch.setattr(benchmark_work, "judge_pooled", judge)


def test_maps_are_kept_by_what_every_frame_bought(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """With fewer frames the threshold is another: their maps are made anew, and found again with all."""
    weights = (write_weights(tmp_path / "w.safetensors"),)
    seen: list[str] = []
    _killed_after(99, seen, monkeypatch)
    for frames, made in ((), 3), (FRAMES[:2], 2), ((), 0):
        seen[:] = []
        evaluate_weights(EvaluateRequest(str(data), weights, tmp_path / "out", frames=frames, **FAST))
        assert len(seen) == made


def test_folds_share_a_threshold(data: Path, tmp_path: Path):
    """Frames left out in turn are one seed: one threshold, whoever scored them."""
    keys = {name: scene_at(data, name).key for name in FRAMES}
    first = write_weights(tmp_path / "a.safetensors", 0, split={"train": {"001": keys["001"]}})
    second = write_weights(tmp_path / "b.safetensors", 1, split={"train": {n: keys[n] for n in ("002", "003")}})
    content = evaluate_weights(EvaluateRequest(str(data), (first, second), **FAST))
    assert [len(row["thresholds"]) for row in _rows(content, POLICY)] == [1, 1]
    per_frame = [row["seats"] for one in content["per_frame"] for row in one["rows"] if row["policy"] == POLICY]
    assert sum(per_frame) == sum(seat_count(share, 45) for share in (0.25, 0.5))


@pytest.mark.parametrize("choice", [{"frames": ("001",)}, {"pooled": False}, {"policies": ("random",)}, {"shares": ()}])
def test_what_needs_no_second_pass_has_none(data: Path, tmp_path: Path, choice: dict[str, Any]):
    """One frame alone, policies without a unit, no share, or where it was not asked for."""
    weights = (write_weights(tmp_path / "w.safetensors"),)
    content = evaluate_weights(EvaluateRequest(str(data), weights, **{**FAST, **choice}))
    assert not any("pooled" in row["policy"] for row in content["rows"])


TRIAL = {"draws": 30, "seed": 0}


def _record(name: str, right: int, policy: str = "none") -> dict[str, Any]:
    row = {"policy": policy, "share": 0.0, "draw": 0, "counts": [[right, 10 - right], [0, 10]]}
    return {"frame": name, "rows": [row]}


def test_frames_left_out_in_turn_are_one_seed():
    """Weights without a frame in common belong together; a row that nobody has is none."""
    folds = [[_record("a", 5)], [_record("b", 6)], [_record("a", 7)], [], [_record("b", 8)]]
    assert seeds_of(folds) == [[0, 1], [2, 4]]
    assert [[record["frame"] for record in records] for records in by_seed(folds)] == [["a", "b"], ["a", "b"]]
    folds = [[_record("a", 5)]]
    assert collect_row(folds, "entropy", 0.0) is None
    assert not np.any(_row(folds, ["a"]).inside)


def _row(folds: list[list[dict[str, Any]]], names: list[str], policy: str = "none") -> Row:
    row = collect_row(by_seed(folds), policy, 0.0, names)
    assert row is not None
    return row


def test_rows_are_of_runs_and_differ_over_shared_frames():
    """Folds are one run, draws of a seed each their own; a control that lacks a frame is compared on the others."""
    row = _row([[_record("a", 5)], [_record("b", 10)]], ["a", "b"])
    assert row.counts.shape == (1, 2, 2, 2)
    assert row.counts.sum(axis=(0, 1)).tolist() == [[15, 5], [0, 20]]
    assert row.of_seed.tolist() == [0]
    ours = _row([[_record("a", 10), _record("b", 0)]], ["a", "b"])
    control = _row([[_record("a", 10)]], ["a", "b"])
    found = difference(ours, control, TRIAL)
    assert (found["difference"], found["frames"]) == (pytest.approx(0), 1)
    nowhere = difference(_row([[_record("b", 1)]], ["a", "b"]), control, TRIAL)
    assert (nowhere["difference"], nowhere["frames"]) == (None, 0)
    seeds = [[_record("a", right), _record("a", right + 1)] for right in (2, 6)]
    for one, other in seeds:
        other["rows"][0]["draw"] = 1
        one["rows"] += other["rows"]
    row = collect_row([[one] for one, _ in seeds], "none", 0.0)
    assert row is not None
    assert row.counts[:, 0, 0, 0].tolist() == [2, 3, 6, 7]
    assert row.of_seed.tolist() == [0, 0, 1, 1]


def test_a_curve_by_hand():
    """Half for the straight way from none to all; more for more; dearer points add nothing; no area without a gap."""
    found = curve_figures((1.0, 0.5), [], (100.0, 0.7))
    assert found.auc_gap == pytest.approx(0.5)
    assert found.hypervolume == pytest.approx(0)
    assert found.cost_to_enough == pytest.approx(1)
    found = curve_figures((1.0, 0.5), [(10.0, 0.7)], (100.0, 0.7))
    assert found.auc_gap == pytest.approx(0.75)
    assert found.hypervolume == pytest.approx(0.2 * 0.9)
    assert found.cost_to_enough == pytest.approx(0.1)
    good = [(10.0, 0.8)]
    assert curve_figures((1.0, 0.5), [*good, (50.0, 0.6)], (100.0, 0.7)).hypervolume == pytest.approx(
        curve_figures((1.0, 0.5), [*good, (200.0, 0.9)], (100.0, 0.7)).hypervolume or 0
    )
    assert curve_figures((1.0, 0.5), [(2.0, 0.6)], (9.0, 0.505)).auc_gap is None
    assert curve_figures((9.0, 0.5), [], (9.0, 0.7)).hypervolume is None
