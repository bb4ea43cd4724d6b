"""`spectralzoom evaluate`: the frames that it judges, the figures that it writes and the input that it refuses."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from spectralzoom.flows.cli.main import main
from spectralzoom.flows.evaluate.command import evaluate_weights, print_evaluation, run_evaluate
from spectralzoom.flows.evaluate.frames import observe_frame, open_candidates
from spectralzoom.flows.evaluate.judge import ALL, NONE, Choice, Row, judge_frame, summarise
from spectralzoom.flows.settings.model_flags import EvaluateFlags, TrainFlags
from spectralzoom.flows.training.data import farm_test_data
from spectralzoom.flows.training.train import train_weights
from spectralzoom.flows.training.train_scenes import TrainRequest
from spectralzoom.models.evaluation.metrics import average_accuracy, kappa, mean_iou, overall_accuracy
from spectralzoom.models.evaluation.taught_labels import pack_mask
from spectralzoom.models.weights.files import load_weights, save_weights
from spectralzoom.pipeline.errors import SceneError, SettingsError, WeightsError
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.simulator.render import USUAL
from spectralzoom.pipeline.simulator.scenes.farm.farm_plan import CLASSES
from spectralzoom.pipeline.simulator.scenes.scene import RasterScene
from tests.flows.evaluate.conftest import Judged
from tests.flows.small_fields import FRAMES, NAMES, QUICK, scene_at, write_field, write_weights
from tests.models.conftest import make_weights


def _row(content: dict[str, Any], policy: str, fraction: float) -> dict[str, Any]:
    return next(row for row in content["rows"] if (row["policy"], row["fraction"]) == (policy, fraction))


def test_evaluation_has_a_row_per_policy_and_fraction(judged: Judged):
    """Rows hold the mean over the weights, its spread and costs; the folder holds evaluation.json alone."""
    request, content = judged
    keys = [(row["policy"], row["fraction"]) for row in content["rows"]]
    policies = [(policy, fraction) for policy in ("gain", "random") for fraction in (0.25, 0.5)]
    assert keys == [("none", 0.0), *policies, ("all", 1.0)]
    assert content["frames"] == list(FRAMES)
    assert [one["frames"] for one in content["weights"]] == [[*FRAMES]] * 2
    assert {path.name for path in request.out.iterdir()} == {"evaluation.json"}
    assert json.loads((request.out / "evaluation.json").read_text())["rows"][1]["miou"] == content["rows"][1]["miou"]
    row = _row(content, "gain", 0.25)
    assert row["miou"] == pytest.approx(np.mean(row["by_weights"]))
    assert row["spread"] == pytest.approx(np.std(row["by_weights"], ddof=1))
    assert len(row["by_weights"]) == 2
    for column in ("patches", "multiply_adds"):  # more patches cost more
        assert row[column] < _row(content, "gain", 0.5)[column] < _row(content, "all", 1.0)[column]


def test_frames_trained_on_are_left_out(data: Path, tmp_path: Path):
    """Trained weights are judged on the frames held out; those of validation taught them in the end."""
    quick = TrainFlags(hold_out=("003",), validation=1, steps=1)
    out = tmp_path / "w.safetensors"
    train_weights(TrainRequest(str(data), out, quick))
    split = load_weights(out).record["split"]
    content = evaluate_weights(str(data), EvaluateFlags(weights=(out,), **QUICK))
    brief = content["brief"]
    assert brief["weights"]["miou"] == _row(content, "all", 1.0)["miou"]
    assert 0 < brief["plain"]["miou"] <= 1
    assert 0 < brief["plain"]["multiply_adds_a_pixel"] < brief["weights"]["multiply_adds_a_pixel"]
    assert content["frames"] == content["weights"][0]["frames"] == ["003"]
    assert set(split["validation"]) <= set(split["train"])
    assert {*split["validated"]} == {*scene_at(data, *split["validation"]).content}
    assert content["left_out"] == sorted(split["train"])
    with pytest.raises(SceneError, match="frames trained on are refused"):
        evaluate_weights(str(data), EvaluateFlags(weights=(out,), frames=tuple(split["train"])))
    with pytest.raises(SceneError, match=rf"no weights are left for {', '.join(sorted(split['train']))}: "):
        evaluate_weights(str(data), EvaluateFlags(weights=(out,), frames=FRAMES))


def _content(scene: RasterScene, trained: np.ndarray) -> dict[str, str]:
    """Return the record of a training on these pixels of a scene."""
    return dict.fromkeys(scene.content, pack_mask(trained))


def test_each_fold_is_judged_on_its_own_frames(data: Path, tmp_path: Path):
    """In cross-validation, the fold that did not train on a frame judges it; figures are means over the folds."""
    scenes = {name: scene_at(data, name).key for name in FRAMES}
    first = write_weights(tmp_path / "a.safetensors", 0, split={"train": {"001": scenes["001"]}})
    second = write_weights(tmp_path / "b.safetensors", 1, split={"train": {n: scenes[n] for n in ("002", "003")}})
    content = evaluate_weights(str(data), EvaluateFlags(weights=(first, second), **QUICK))
    assert [one["frames"] for one in content["weights"]] == [["002", "003"], ["001"]]
    assert content["frames"] == list(FRAMES)
    assert sum(content["support"].values()) == 3 * 24 * 40
    folds = [evaluate_weights(str(data), EvaluateFlags(weights=(one,), **QUICK)) for one in (first, second)]
    row, *own = (one["rows"][0] for one in (content, *folds))
    assert row["by_weights"] == [one["miou"] for one in own]
    assert row["miou"] == pytest.approx(np.mean(row["by_weights"]))
    alone = evaluate_weights(str(data), EvaluateFlags(weights=(first, second), frames=("001",), **QUICK))
    assert [weights["frames"] for weights in alone["weights"]] == [[], ["001"]]


def test_validation_frames_are_in_no_headline(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """The training chose by them; the headline is that of the held-out frames alone."""
    split = {"validation": {"002": scene_at(data, "002").key}}
    weights = (write_weights(tmp_path / "w.safetensors", split=split),)
    content = run_evaluate(str(data), EvaluateFlags(weights=weights, fractions=""), Console())
    assert "thresholds by 002: scores of these" in " ".join(content["data_notes"])
    assert (content["headline"], content["frames"]) == ("held out", ["001", "003"])
    alone = evaluate_weights(str(data), EvaluateFlags(weights=weights, fractions="", frames=("001", "003")))
    assert (content["brief"], content["support"]) == (alone["brief"], alone["support"])
    (one,) = content["apart"].values()
    assert one["frames"] == ["002"]
    assert f"validation: mIoU {100 * one['rows'][-1]['miou']:.1f} of 1 frame" in capsys.readouterr().out


def test_validation_frames_alone_have_no_headline(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """The files' content identifies them, whatever bands are read and whatever their names are."""
    scene = scene_at(data, "002")
    split = {"validation": {"other": "in other bands"}, "validated": [*scene.content]}
    flags = EvaluateFlags(
        weights=(write_weights(tmp_path / "w.safetensors", split=split),), fractions="", frames=("002",)
    )
    content = run_evaluate(str(data), flags, Console())
    assert (content["headline"], content["brief"], content["rows"]) == (None, {}, [])
    assert [*content["apart"]] == ["validation"]
    shown = capsys.readouterr().out
    assert shown.startswith("no mIoU: no frame was held out")
    assert "validation: mIoU " in shown


def test_folds_have_their_own_validation_frames(data: Path, tmp_path: Path):
    """A frame that one fold chose by is held out for another."""
    splits = [{"validation": {name: scene_at(data, name).key}} for name in ("001", "002")]
    weights = tuple(write_weights(tmp_path / f"{n}.safetensors", n, split=one) for n, one in enumerate(splits))
    content = evaluate_weights(str(data), EvaluateFlags(weights=weights, fractions=""))
    assert content["frames"] == list(FRAMES)
    assert content["apart"]["validation"]["frames"] == ["001", "002"]
    first = evaluate_weights(str(data), EvaluateFlags(weights=weights[:1], fractions="", frames=("002", "003")))
    assert content["rows"][0]["by_weights"][0] == first["rows"][0]["miou"]


@pytest.mark.parametrize(("validated", "words"), [(FRAMES, "0.safetensors"), (("001",), "2 sets of weights")])
def test_the_headline_names_the_weights_that_judged(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], validated: tuple[str, ...], words: str
) -> None:
    """Weights that have validation frames alone are none of them."""
    splits = [{}, {"validation": {name: scene_at(data, name).key for name in validated}}]
    weights = tuple(write_weights(tmp_path / f"{n}.safetensors", n, split=one) for n, one in enumerate(splits))
    run_evaluate(str(data), EvaluateFlags(weights=weights, fractions=""), Console(width=200))
    first, second, *_ = capsys.readouterr().out.splitlines()
    assert first.startswith(f"mIoU, held out: {words} ")
    assert second.endswith(f"3 frames, {words}")


def test_untrained_pixels_are_in_no_headline_beside_held_out_frames(data: Path, tmp_path: Path):
    """They are no forecast for other scenes."""
    scene = scene_at(data)
    half = np.arange(scene.shape[0])[:, None] < np.full(scene.shape, 12)
    weights = (write_weights(tmp_path / "w.safetensors", split={"taught": _content(scene, half)}),)
    content = evaluate_weights(str(data), EvaluateFlags(weights=weights, fractions=""))
    assert (content["headline"], content["frames"]) == ("held out", ["002", "003"])
    assert content["apart"]["untrained pixels of training frames"]["frames"] == ["001"]


@pytest.mark.parametrize(("held", "words"), [(("003",), "--frames 003$"), ((), "train .* --hold-out 003 -o FILE")])
def test_the_refusal_of_training_frames_says_what_to_do(data: Path, tmp_path: Path, held: tuple[str], words: str):
    """It names the frames that were held out, or how to hold some out."""
    split = {"train": {name: scene_at(data, name).key for name in ("001", "002")}, "held_out": held}
    weights = (write_weights(tmp_path / "w.safetensors", split=split),)
    with pytest.raises(SceneError, match=words):
        evaluate_weights(str(data), EvaluateFlags(weights=weights, frames=("001",)))


def test_trained_pixels_of_a_frame_are_left_out(data: Path, tmp_path: Path):
    """Weights are judged on the other pixels."""
    scene = scene_at(data)
    half = np.arange(scene.shape[0])[:, None] < np.full(scene.shape, 12)
    weights = (write_weights(tmp_path / "w.safetensors", split={"taught": _content(scene, half)}),)
    content = evaluate_weights(str(data), EvaluateFlags(weights=weights, frames=("001",), **QUICK))
    assert content["headline"] == "untrained pixels of training frames"
    assert sum(content["support"].values()) == 12 * 40
    assert any(note.startswith("trained pixels are left out of 001: ") for note in content["data_notes"])


def test_training_frames_are_recognised_in_other_bands(data: Path, tmp_path: Path):
    """The content of the files identifies a frame, not the bands that are read."""
    scene = scene_at(data)
    split = {"train": {"001": "of other bands"}, "taught": _content(scene, np.ones(scene.shape, bool))}
    weights = (write_weights(tmp_path / "w.safetensors", split=split),)
    assert evaluate_weights(str(data), EvaluateFlags(weights=weights, fractions=""))["left_out"] == ["001"]


def test_frames_without_a_label_are_refused(tmp_path: Path):
    """No labelled pixel is left to judge."""
    data = write_field(tmp_path / "field")
    Image.fromarray(np.full((24, 40, 3), 9, np.uint8)).save(data / "annotations" / "001_annotation.png")
    toml = data / "scene.toml"
    toml.write_text("unlabelled = [9, 9, 9]\n" + toml.read_text())
    weights = (write_weights(tmp_path / "w.safetensors"),)
    with pytest.raises(SceneError, match="no labelled pixel is left on the 1 frames"):
        evaluate_weights(str(data), EvaluateFlags(weights=weights, frames=("001",), **QUICK))


def test_weights_that_cannot_be_judged_together_are_refused(tmp_path: Path):
    """A camera record of another version, the same weights twice and different classes are refused."""
    (one,) = open_candidates((write_weights(tmp_path / "w.safetensors", camera={"lens": 1}),))
    with pytest.raises(WeightsError, match=r"cannot read .*it is of another version"):
        _ = one.camera
    first, again = write_weights(tmp_path / "a.safetensors"), write_weights(tmp_path / "b.safetensors")
    with pytest.raises(SettingsError, match="the same weights are given twice"):
        open_candidates((first, again))
    save_weights(make_weights(1, classes=3, columns=3), again)
    with pytest.raises(SettingsError, match=r"differs from .* in camera, patch or classes"):
        open_candidates((first, again))


def test_folds_with_and_without_context_are_judged_together(data: Path, tmp_path: Path):
    """Labels choose a mixture with a context or without; the best plain classifier costs the same in both."""
    parts = {"parts": (("values", 0, 1.0),), "corrected": False}
    paths = tuple(tmp_path / f"{context}.safetensors" for context in (False, True))
    for context, path in enumerate(paths):
        made = make_weights(classes=2, columns=3, context=bool(context), **parts)
        save_weights(replace(made, class_names=NAMES, record={"plain": 0}), path)
    assert len(evaluate_weights(str(data), EvaluateFlags(weights=paths, **QUICK))["rows"][0]["by_weights"]) == 2
    briefs = [evaluate_weights(str(data), EvaluateFlags(weights=(path,), **QUICK))["brief"] for path in paths]
    bare, with_context = ({name: one["multiply_adds_a_pixel"] for name, one in brief.items()} for brief in briefs)
    assert with_context["plain"] == bare["plain"] == bare["weights"] < with_context["weights"]


def test_one_frame_alone_has_overall_and_average_accuracy_and_kappa(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """The table of one frame shows them; the command keeps freed memory for reuse."""
    kept: list[bool] = []
    monkeypatch.setattr("spectralzoom.flows.evaluate.command.keep_freed_memory", lambda: kept.append(True))
    weights = (write_weights(tmp_path / "w.safetensors"),)
    flags = EvaluateFlags(weights=weights, frames=("001",), **QUICK)
    row = run_evaluate(str(data), flags, Console(stderr=True))["rows"][0]
    assert kept == [True]
    loaded = load_weights(weights[0])
    frame = observe_frame(scene_at(data), "001", loaded, LineCamera(), 0)
    (counts,) = judge_frame(*frame, 3, loaded, (), 0)[NONE].counts
    assert row["pixel_accuracy"] == overall_accuracy(counts)
    assert row["average_accuracy"] == average_accuracy(counts)
    assert row["kappa"] == kappa(counts)
    shown = capsys.readouterr().out
    assert all(word in shown for word in ("mIoU, held out: w.safetensors ", "overall", "average", "kappa", "MACs"))


def test_miou_of_frames_comes_from_their_summed_counts():
    """The order of the frames has no effect."""
    run = _judged("abcd", np.random.default_rng(0))
    there, back = (summarise([dict(order)], ("a", "b"), (0.5,), 8) for order in (run.items(), [*run.items()][::-1]))
    assert json.dumps(there["rows"][0], sort_keys=True) == json.dumps(back["rows"][0], sort_keys=True)
    assert there["rows"][0]["miou"] == mean_iou(np.sum([rows[NONE].counts[0] for rows in run.values()], axis=0))


def test_a_class_without_labels_has_false_pixels_and_no_iou(judged: Judged, capsys: pytest.CaptureFixture[str]):
    """The mean is taken over the classes of all frames' labels."""
    counts = [[[8, 0, 2], [1, 9, 0], [0, 0, 0]], [[7, 3, 0], [0, 10, 0], [0, 0, 0]]]
    run = {str(number): dict.fromkeys(CHOICES, Row(np.array([one]), 2, 3)) for number, one in enumerate(counts)}
    found = summarise([run], ("soil", "crop", "weed"), (0.5,), 8)
    row = found["rows"][0]
    assert row["miou"] == pytest.approx(np.mean([15 / 21, 19 / 23]))
    assert row["false_classes"] == {"weed": 2}
    assert np.isnan(row["per_class_iou"]["weed"])
    print_evaluation({**judged[1], **found}, Console(width=200))
    assert "2 px false" in capsys.readouterr().out


CHOICES: tuple[Choice, ...] = (NONE, ("gain", 0.5), ("random", 0.5), ALL)


def _judged(names: str, rng: np.random.Generator) -> dict[str, dict[Choice, Row]]:
    return {name: {choice: Row(rng.integers(1, 9, (1, 2, 2)), 2, 3) for choice in CHOICES} for name in names}


def test_the_farm_is_judged_on_test_seeds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The built-in fields of the test data have seeds of their own, apart from training."""
    monkeypatch.setattr("spectralzoom.flows.training.data.FARM_SHAPE", (32, 48))
    # choosing takes seconds
    monkeypatch.setattr("spectralzoom.models.training.examples.chosen_effects", lambda *_: USUAL)
    weights = tmp_path / "w.safetensors"
    save_weights(replace(make_weights(classes=len(CLASSES), columns=6), class_names=CLASSES), weights)
    content = evaluate_weights("farm", EvaluateFlags(weights=(weights,), scenes=2, fractions="0.25"))
    assert content["frames"] == [*farm_test_data(2, LineCamera()).train]
    assert 0 <= _row(content, "none", 0.0)["miou"] <= 1


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"fractions": "10"}, "--fractions are fractions of the patches from 0 to 1"),
        ({"seed": -1}, "--seed must be at least 0"),
        ({"scenes": 2}, "--scenes is for built-in scenes"),
        ({"frames": ("099",)}, "has no frame 099; it has 001, 002, 003"),
    ],
)
def test_invalid_requests_are_refused(data: Path, tmp_path: Path, change: dict[str, Any], words: str):
    """The message names the flag, or lists the existing frames."""
    flags = EvaluateFlags(weights=(write_weights(tmp_path / "w.safetensors"),), **QUICK | change)
    with pytest.raises(SettingsError, match=words):
        evaluate_weights(str(data), flags)


def test_figures_are_printed(judged: Judged, data: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path):
    """Rows, classes and notes are printed from the stored evaluation; --json prints one object on stdout."""
    run_evaluate(str(data), judged[0], Console(stderr=True))
    shown = capsys.readouterr()
    for words in ("gain", "MACs", "crop", "standard deviation over weights"):
        assert words in shown.out
    assert "evaluation.json" in shown.err
    weights = write_weights(tmp_path / "w.safetensors")
    words = ["evaluate", str(data), "--weights", str(weights), "--fractions", "0.5", "--json"]
    with pytest.raises(SystemExit) as left:
        main([*words, "--frames", "001"])
    assert left.value.code == 0
    assert json.loads(capsys.readouterr().out)["frames"] == ["001"]
