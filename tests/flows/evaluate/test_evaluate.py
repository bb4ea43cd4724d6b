"""`spectralzoom evaluate`: which frames are judged, what the figures hold, and that a killed run goes on."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from flows.cli.main import main
from flows.evaluate import work as benchmark_work
from flows.evaluate.command import ends, evaluate_weights, run_evaluate
from flows.evaluate.costs import Prices, cpu_seconds, row_seconds
from flows.evaluate.frames import EvaluateRequest, open_candidates
from flows.evaluate.rows import ORACLE, Trial, captured_px, judge_frame, placings
from flows.evaluate.series import collect_row
from flows.evaluate.summary import summarise
from flows.evaluate.table import print_evaluation
from flows.evaluate.work import KeptResults
from flows.training.data import farm_test_data, pack_mask
from flows.training.train import train_weights
from flows.training.train_scenes import TrainRequest
from models.evaluation.metrics import average_accuracy, kappa, mean_iou, overall_accuracy
from models.training.train import TrainingSettings
from models.weights.files import load_weights, save_weights
from pipeline.errors import SceneError, SettingsError, WeightsError
from pipeline.geometry.camera import LineCamera
from pipeline.simulator.effects.registry import USUAL
from pipeline.simulator.scenes.farm.farm_plan import CLASSES
from tests.flows.evaluate.conftest import Judged
from tests.flows.small_fields import FRAMES, QUICK, looked_at, scene_at, write_weights
from tests.models.conftest import make_weights


def _row(content: dict[str, Any], policy: str, share: float) -> dict[str, Any]:
    return next(row for row in content["rows"] if (row["policy"], row["share"]) == (policy, share))


def test_every_row_is_there(judged: Judged):
    """Every policy at every share, with means of the seeds and their spread; and the files of the folder."""
    request, content = judged
    folder = request.out
    assert folder is not None
    keys = [(row["policy"], row["share"]) for row in content["rows"]]
    names = ("entropy", "random", "entropy, pooled", ORACLE)
    policies = [(policy, share) for policy in names for share in (0.25, 0.5)]
    assert keys == [("none", 0.0), *policies, ("all", 1.0)]
    assert content["frames"] == list(FRAMES)
    assert [one["frames"] for one in content["weights"]] == [3, 3]
    files = {path.name for path in folder.iterdir()}
    assert files >= {"evaluation.json", "evaluation.png", "worst.png", "frames"}
    kept = json.loads((folder / "evaluation.json").read_text())
    assert kept["rows"][1]["miou"] == content["rows"][1]["miou"]
    row = _row(content, "entropy", 0.25)
    assert row["miou"] == pytest.approx(np.mean(row["by_seed"]))
    assert row["spread"] == pytest.approx(np.std(row["by_seed"], ddof=1))
    assert len(row["by_seed"]) == 2


def test_costs_stand_beside_all_and_the_oracle_has_all_the_gain(judged: Judged):
    """More seats cost more, `all` costs all; what uses labels is marked, with a ratio and a rank of 1."""
    _, content = judged
    cost = {share: _row(content, "entropy", share)["cost"] for share in (0.25, 0.5)}
    for column in ("samples", "bytes", "multiply_adds", "cpu_s", "frame_s", "rig_s"):
        assert cost[0.25][column]["done"] is not None
    for column in ("samples", "bytes", "multiply_adds"):
        assert cost[0.25][column]["done"] < cost[0.5][column]["done"]
    assert _row(content, "all", 1.0)["cost"]["samples"] == {
        "done": 24 * 40 + 12 * 20,
        "full": 24 * 40 + 12 * 20,
        "ratio": 1.0,
    }
    assert _row(content, "all", 1.0)["cost"]["rig_s"]["ratio"] == 1
    adds = cost[0.25]["multiply_adds"]
    assert sum(adds[part] for part in ("glance", "score", "encode", "decode")) == adds["done"]
    row = _row(content, ORACLE, 0.5)
    assert row["uses_labels"]
    assert row["captured_gain"] in (None, pytest.approx(1))
    assert row["spearman"] == pytest.approx(1)
    assert row["ap_gain"] in (None, pytest.approx(1))


def test_a_killed_run_goes_on(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Frames that were judged are not judged again, and the figures are those of a run that was not killed."""
    weights = (write_weights(tmp_path / "w.safetensors"),)
    whole = evaluate_weights(EvaluateRequest(str(data), weights, **QUICK))
    request = EvaluateRequest(str(data), weights, tmp_path / "out", **QUICK)
    judged: list[str] = []

    def killed(trial: Trial, look: Any, *rest: Any) -> dict[str, Any]:
        if len(judged) == 2:
            raise KeyboardInterrupt
        judged.append(look.name)
        return judge_frame(trial, look, *rest)

    monkeypatch.setattr(benchmark_work, "judge_frame", killed)
    with pytest.raises(KeyboardInterrupt):
        evaluate_weights(request)
    judged[:] = []
    again = evaluate_weights(request)
    assert judged == ["003"]
    assert _without_costs(whole) == _without_costs(again)


def _without_costs(content: dict[str, Any]) -> str:
    return json.dumps([{name: row[name] for name in row if name != "cost"} for row in content["rows"]])


def test_progress_tells_the_time_left(data: Path, tmp_path: Path):
    """From the second frame on, beside the frame's name; the share done never falls."""
    said: list[tuple[float, str]] = []
    weights = (write_weights(tmp_path / "w.safetensors"),)
    request = EvaluateRequest(str(data), weights, pooled=False, **{**QUICK, "timed_frames": 0})
    evaluate_weights(request, lambda what, done, words: said.append((done, words)) if "judging" in what else None)
    assert said[0] == (0, "001")
    assert all(words.startswith("003, about ") and words.endswith(" left") for _, words in said[-3:-1])
    assert [done for done, _ in said] == sorted(done for done, _ in said)


def test_a_damaged_result_is_made_again(tmp_path: Path):
    """What was cut short by a kill, or is of something else, is not believed."""
    kept, made = KeptResults(tmp_path / "frames"), []

    def make() -> dict[str, Any]:
        made.append(1)
        return {"value": len(made)}

    assert kept.made("frame", {"seed": 0}, make) == {"value": 1}
    assert kept.made("frame", {"seed": 0}, make) == {"value": 1}
    assert kept.made("frame", {"seed": 1}, make) == {"value": 2}
    for path in (tmp_path / "frames").iterdir():
        path.write_text(path.read_text()[:20])
    assert kept.made("frame", {"seed": 0}, make) == {"value": 3}


def test_frames_trained_on_are_left_out(data: Path, tmp_path: Path):
    """Weights that a training made are judged on what it held out or kept for validation."""
    settings = TrainingSettings(steps=1, batch=1, crop=16)
    out = tmp_path / "w.safetensors"
    train_weights(TrainRequest(str(data), out, ("003",), 1, patch=8, factor=2, width=4, settings=settings))
    split = load_weights(out).record["split"]
    content = evaluate_weights(EvaluateRequest(str(data), (out,), **{**QUICK, "timed_frames": 0}))
    assert content["weights"][0]["left_out"] == sorted(split["train"])
    assert content["frames"] == sorted({"003", *split["validation"]})
    assert content["rows"][0]["cost"]["cpu_s"]["done"] is None
    assert content["left_out"] == sorted(split["train"])
    with pytest.raises(SceneError, match=r"was trained on all 1 frames .* frames trained on are refused"):
        evaluate_weights(EvaluateRequest(str(data), (out,), frames=tuple(split["train"])))
    with pytest.raises(SceneError, match=rf"no weights are left for {next(iter(split['train']))} of --frames"):
        evaluate_weights(EvaluateRequest(str(data), (out,), frames=FRAMES))


def test_folds_are_judged_each_on_its_own_frames(data: Path, tmp_path: Path):
    """With frames left out in turn every frame is judged by the weights that did not see it."""
    scenes = {name: scene_at(data, name).key for name in FRAMES}
    first = write_weights(tmp_path / "a.safetensors", 0, split={"train": {"001": scenes["001"]}})
    second = write_weights(tmp_path / "b.safetensors", 1, split={"train": {n: scenes[n] for n in ("002", "003")}})
    content = evaluate_weights(EvaluateRequest(str(data), (first, second), **{**QUICK, "timed_frames": 0}))
    assert [(one["frames"], one["left_out"]) for one in content["weights"]] == [(2, ["001"]), (1, ["002", "003"])]
    assert content["frames"] == list(FRAMES)
    assert sum(content["support"].values()) == 3 * 24 * 40
    assert content["seeds"] == [["a.safetensors", "b.safetensors"]]
    assert content["rows"][0]["spread"] is None
    one = {**QUICK, "timed_frames": 0, "frames": ("001",)}
    alone = evaluate_weights(EvaluateRequest(str(data), (first, second), **one))
    assert [weights["covers"] for weights in alone["weights"]] == [[], ["001"]]


def test_folds_that_kept_frames_for_validation_are_one_seed(data: Path, tmp_path: Path):
    """What one of them held out another validated on: each is judged on its own; alone, on both."""
    keys = {name: scene_at(data, name).key for name in FRAMES}
    paths = []
    for number, (kept, validated, trained) in enumerate((("001", "002", "003"), ("002", "001", "003"))):
        split = {"train": {trained: keys[trained]}, "held_out": [kept], "validation": [validated]}
        paths.append(write_weights(tmp_path / f"{number}.safetensors", number, data="field", split=split))
    content = evaluate_weights(EvaluateRequest(str(data), tuple(paths), **{**QUICK, "timed_frames": 0}))
    assert [one["covers"] for one in content["weights"]] == [["001"], ["002"]]
    assert content["seeds"] == [["0.safetensors", "1.safetensors"]]
    alone = evaluate_weights(EvaluateRequest(str(data), (paths[0],), **{**QUICK, "timed_frames": 0}))
    assert alone["frames"] == ["001", "002"]


def test_files_that_leave_different_pixels_are_not_compared(data: Path, tmp_path: Path):
    """With masks of their own two files would be judged on different pixels of one frame: refused."""
    scene = scene_at(data)
    halves = [np.zeros(scene.shape, bool) for _ in range(2)]
    halves[0][:12], halves[1][12:] = True, True
    paths = [
        write_weights(
            tmp_path / f"{number}.safetensors",
            number,
            "dense" if number == 1 else "two-scale",
            split={"train": {"001": scene.key}, "pixels": {scene.key: pack_mask(half)}},
        )
        for number, half in enumerate((halves[0], halves[1], halves[0]))
    ]
    quick = {**QUICK, "timed_frames": 0, "frames": ("001",)}
    with pytest.raises(SettingsError, match=r"were trained on different pixels of 001"):
        evaluate_weights(EvaluateRequest(str(data), (paths[0],), controls=(paths[1],), **quick))
    content = evaluate_weights(EvaluateRequest(str(data), (paths[0], paths[2]), **quick))
    assert sum(content["support"].values()) == 12 * 40


def test_frames_trained_on_are_known_in_other_bands(data: Path, tmp_path: Path):
    """With bands chosen a frame's identity is another, here or in the training: its name tells."""
    split = {"train": {"001": "of other bands"}}
    quick = {**QUICK, "timed_frames": 0, "policies": (), "shares": ()}
    plain = (write_weights(tmp_path / "w.safetensors", data="field", split=split),)
    assert evaluate_weights(EvaluateRequest(str(data), plain, **quick))["left_out"] == []
    chosen = EvaluateRequest(str(data), plain, choices={"bands": [0, 1]}, **quick)
    assert evaluate_weights(chosen)["left_out"] == ["001"]
    command = "spectralzoom train field -o w.safetensors --bands 0,1"
    taught = (write_weights(tmp_path / "v.safetensors", data="field", split=split, command=command),)
    assert evaluate_weights(EvaluateRequest(str(data), taught, **quick))["left_out"] == ["001"]


def test_frames_without_a_label_are_refused(data: Path, tmp_path: Path):
    """Where the mask of the training took every label there is nothing to judge by."""
    scene = scene_at(data)
    split = {"train": {"001": scene.key}, "pixels": {scene.key: pack_mask(np.ones(scene.shape, bool))}}
    weights = (write_weights(tmp_path / "w.safetensors", split=split),)
    with pytest.raises(SceneError, match="no labelled pixel is left on the 1 frames"):
        evaluate_weights(EvaluateRequest(str(data), weights, frames=("001",), **QUICK))


def test_weights_that_cannot_be_judged_together_are_refused(tmp_path: Path):
    """A record that is none of a camera, the same file twice, and other classes."""
    (one,) = open_candidates((write_weights(tmp_path / "w.safetensors", camera={"lens": 1}),))
    with pytest.raises(WeightsError, match="its camera is damaged"):
        _ = one.camera
    first, again = write_weights(tmp_path / "a.safetensors"), write_weights(tmp_path / "b.safetensors")
    with pytest.raises(SettingsError, match="the same weights are given twice"):
        open_candidates((first, again))
    save_weights(make_weights(1, classes=3, columns=3), again)
    with pytest.raises(SettingsError, match=r"differs from .* in sizes or classes"):
        open_candidates((first, again))


def test_one_frame_has_accuracies_over_its_pixels(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """Overall and average accuracy and kappa stand in the table of one frame alone; freed memory is kept."""
    kept: list[bool] = []
    monkeypatch.setattr("flows.evaluate.command.keep_freed_memory", lambda: kept.append(True))
    weights = (write_weights(tmp_path / "w.safetensors"),)
    request = EvaluateRequest(str(data), weights, frames=("001",), **{**QUICK, "timed_frames": 0})
    row = run_evaluate(request, Console(stderr=True))["rows"][0]
    assert kept == [True]
    look, loaded = looked_at(data, tmp_path / "w.safetensors")
    record = judge_frame(Trial((), ()), look, loaded)
    counts = np.array(record["rows"][0]["counts"])
    assert row["pixel_accuracy"] == overall_accuracy(counts)
    assert row["average_accuracy"] == average_accuracy(counts)
    assert row["kappa"] == kappa(counts)
    assert "overall  average  kappa" in capsys.readouterr().out


def test_inside_and_outside_make_the_whole(data: Path, tmp_path: Path):
    """Counts of captured seats are those of their pixels; all seats are the whole, none nothing."""
    look, weights = looked_at(data, tmp_path / "w.safetensors")
    record = judge_frame(Trial((0.25,), ("random",)), look, weights)
    rows = {row["policy"]: row for row in record["rows"]}
    assert np.sum(rows["none"]["inside"]) == 0
    assert rows["all"]["inside"] == rows["all"]["counts"]
    seats = placings(Trial((0.25,), ("random",)), look, weights)[0].scores.argsort()[::-1][: rows["random"]["seats"]]
    last = next(row for row in record["rows"] if row["policy"] == "random")
    assert np.sum(last["inside"]) == captured_px(look, seats).sum() == 64 * last["seats"]


def test_a_look_does_not_depend_on_its_company(data: Path, tmp_path: Path):
    """Noise and figures of a frame follow from seed and name, whatever other frames are judged."""
    weights = (write_weights(tmp_path / "w.safetensors"),)
    quick = {**QUICK, "timed_frames": 0, "pooled": False}
    every = evaluate_weights(EvaluateRequest(str(data), weights, **quick))
    alone = evaluate_weights(EvaluateRequest(str(data), weights, frames=("002",), **quick))
    assert alone["per_frame"] == [one for one in every["per_frame"] if one["frame"] == "002"]
    assert alone["rows"][1]["against_all"]["low"] is None


def test_records_count_by_their_pixels():
    """In any order, and not by the figure that an earlier version kept of them."""
    rng = np.random.default_rng(0)
    records = [_record(f"{number:03d}", rng) for number in range(4)]
    trial = {"shares": (0.5,), "policies": (), "seed": 0, "draws": 10}
    there, back = (summarise([order], ("a", "b"), trial, Prices()) for order in (records, records[::-1]))
    assert json.dumps(there["rows"][0], sort_keys=True) == json.dumps(back["rows"][0], sort_keys=True)
    whole = collect_row([records], "none", 0.0)
    assert whole is not None
    assert there["rows"][0]["miou"] == mean_iou(whole.counts.sum(axis=(0, 1)))
    good, bad = (_record(name, np.random.default_rng(0)) for name in ("001", "002"))
    for row in good["rows"]:
        row |= {"counts": [[9, 0], [0, 9]], "miou": 0.1}
    for row in bad["rows"]:
        row |= {"counts": [[5, 4], [4, 5]], "miou": 0.9}
    assert ends([[good, bad]], "none", 0.0) == [("worst", "002", 0), ("best", "001", 0)]


def test_a_class_that_no_label_has_is_told_apart(judged: Judged, capsys: pytest.CaptureFixture[str]):
    """Rows are means over the classes of all frames' labels; a false class has pixels, and both means are told."""
    counts = [[[8, 0, 2], [1, 9, 0], [0, 0, 0]], [[7, 3, 0], [0, 10, 0], [0, 0, 0]]]
    records = [_record("001", np.random.default_rng(0)), _record("002", np.random.default_rng(0))]
    for record, one in zip(records, counts, strict=True):
        for row in record["rows"]:
            row |= {"counts": one, "inside": np.zeros((3, 3), int).tolist(), "boundary": [[1, 2], [1, 2], [0, 2]]}
    trial = {"shares": (0.5,), "policies": (), "seed": 0, "draws": 10}
    found = summarise([records], ("soil", "crop", "weed"), trial, Prices())
    row = found["rows"][0]
    iou = [15 / 21, 19 / 23]
    assert row["miou"] == pytest.approx(np.mean(iou))
    assert row["miou_of_shown_classes"] == pytest.approx(sum(iou) / 3)
    assert row["boundary_iou"] == pytest.approx(0.5)
    assert row["false_classes"] == {"weed": 2}
    assert np.isnan(row["per_class_iou"]["weed"])
    shown = {**judged[1], "rows": [*judged[1]["rows"][:1], *found["rows"]], "support": found["support"]}
    shown["rows"][0] = {**found["rows"][0], "policy": "none"}
    print_evaluation({**shown, "curves": found["curves"]}, Console(width=200))
    text = capsys.readouterr().out
    assert "2 px false" in text
    assert "of shown" in text
    assert "the 2 classes of the labels" in text


def _record(name: str, rng: np.random.Generator) -> dict[str, Any]:
    rows = [
        {
            "policy": policy,
            "draw": 0,
            "share": share,
            "seats": 2,
            "counts": rng.integers(1, 9, (2, 2)).tolist(),
            "inside": [[0, 0], [0, 0]],
            "boundary": [[1, 2], [1, 3]],
            "samples": 1.0,
            "bytes": 2.0,
            "multiply_adds": 3,
            "adds": {"glance": 1, "score": 0, "encode": 1, "decode": 1},
            "gain": 1.0,
            "best_gain": 2.0,
            "ap_top": None,
        }
        for policy, share in (("none", 0.0), ("oracle", 0.5), ("all", 1.0))
    ]
    return {"frame": name, "seats": 4, "rows": rows, "ranking": [], "positive_seats": 1}


def test_seconds_are_taken_in_turn_and_add_up():
    """Whatever slows the machine meets all parts alike; glance, scores and map make a row."""
    timed = {
        "glance": 1.0,
        "score": {"entropy": 0.5},
        "segment": {"0": 2.0, "0.1": 3.0, "1": 9.0},
        "control": {"dense 1": 7.0},
    }
    assert row_seconds(timed, "dense", 1.0) == 7
    assert row_seconds(timed, "margin", 0.1) is row_seconds(timed, "coarser", 1.1) is None
    assert row_seconds(timed, "entropy", 0.1) == 4.5
    assert row_seconds(timed, ORACLE, 0.1) == 4
    assert (row_seconds(timed, "none", 0.0), row_seconds(timed, "all", 1.0)) == (2, 9)
    went: list[str] = []
    works = {("segment", name): lambda name=name: went.append(name) for name in ("a", "b")}  # type: ignore[misc]
    taken = cpu_seconds(works, 2, warm_up=1)
    assert went == ["a", "b"] * 3
    assert all(seconds >= 0 for seconds in taken.values())


def test_the_farm_is_judged_on_seeds_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Small built-in fields, neither trained on nor shown, noisy: with equal time beside equal exposure."""
    monkeypatch.setattr("flows.training.data.FARM_SHAPE", (32, 48))
    monkeypatch.setattr("flows.training.look.chosen_effects", lambda *given: USUAL)  # choosing takes seconds a look
    made, weights = make_weights(classes=len(CLASSES), columns=6), tmp_path / "w.safetensors"
    save_weights(replace(made, class_names=CLASSES), weights)
    quick = {**QUICK, "policies": ("entropy",), "shares": (0.25,), "timed_frames": 0, "equal_time": True}
    content = evaluate_weights(EvaluateRequest("farm", (weights,), scenes=2, **quick))
    assert content["frames"] == [*farm_test_data(2, LineCamera()).train]
    assert 0 <= _row(content, "none", 0.0)["miou"] <= 1
    assert content["equal_time"][0]["frames"] == 2


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"shares": (10.0,)}, "--shares are shares of the seats from 0 to 1"),
        ({"policies": ("mask",)}, "'mask' is none that can be judged"),
        ({"draws": 0}, "--draws must be at least 1"),
        ({"timed_runs": 0}, "--timed-runs must be at least 1"),
        ({"seed": -1}, "--seed must be at least 0"),
        ({"scenes": 2}, "--scenes is for the built-in farm"),
        ({"frames": ("099",)}, "has no frame 099; it has 001, 002, 003"),
    ],
)
def test_what_cannot_be_is_refused(data: Path, tmp_path: Path, change: dict[str, Any], words: str):
    """The message names the flag, or the frames that there are."""
    request = EvaluateRequest(str(data), (write_weights(tmp_path / "w.safetensors"),), **QUICK)
    with pytest.raises(SceneError if "frames" in change else SettingsError, match=words):
        evaluate_weights(replace(request, **change))


def test_figures_are_printed(judged: Judged, data: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path):
    """Rows, classes and what the figures mean, from what was kept; with --json one object on stdout."""
    run_evaluate(judged[0], Console(stderr=True))
    shown = capsys.readouterr()
    for words in ("oracle*", "multiply-adds", "rig s", "crop", "uses labels", "paired bootstrap", "baseline: all"):
        assert words in shown.out
    assert "evaluation.json" in shown.err
    weights = write_weights(tmp_path / "w.safetensors")
    words = ["evaluate", str(data), "--weights", str(weights), "--shares", "0.5", "--policies", "entropy", "--json"]
    with pytest.raises(SystemExit) as left:
        main([*words, "--frames", "001", "--timed-frames", "0", "--draws", "5"])
    assert left.value.code == 0
    assert json.loads(capsys.readouterr().out)["frames"] == ["001"]
