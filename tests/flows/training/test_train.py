"""Training as a flow: what is refused before the first look, what the record says was trained on, who is told."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from flows.cli.main import main
from flows.settings.load import load_settings
from flows.survey.run import open_run
from flows.training import train as flow
from flows.training.train import TrainRequest, run_train, suggested_patch, train_weights, usual_crop
from models.network.sizes import PRESETS, Preset
from models.training.train import TrainingSettings
from models.weights.files import load_any_weights, load_weights
from pipeline.errors import SceneError, SettingsError, WeightsError
from tests.flows.small_fields import write_field

SETTINGS = TrainingSettings(steps=1, batch=1, crop=16)


def _folder(root: Path) -> Path:
    return write_field(root, (16, 16), ("001", "002", "003", "004"))


def _request(tmp_path: Path, **choices: Any) -> TrainRequest:
    sizes = {"patch": 8, "factor": 2, "width": 4, "settings": SETTINGS, **choices}
    return TrainRequest(str(_folder(tmp_path / "data")), tmp_path / "w.safetensors", **sizes)


def test_the_record_tells_what_was_trained_on(tmp_path: Path):
    """Scenes kept for validation or held out are not among those that the weights were trained on."""
    record = train_weights(_request(tmp_path, validation=1, hold_out=("003",)))
    split = record["split"]
    assert len(split["train"]) == 2
    assert len(split["validation"]) == 1
    assert not set(split["train"]) & {*split["validation"], "003"}
    assert split["held_out"] == ["003"]
    assert record["training"]["steps"] == 1
    assert load_weights(tmp_path / "w.safetensors").record["split"] == split


@pytest.mark.parametrize("sizes", [{"patch": 24}, {"patch": 8, "factor": 16}, {"factor": 0}])
def test_sizes_that_do_not_fit_are_refused_before_the_first_look(
    tmp_path: Path, sizes: dict[str, int], monkeypatch: pytest.MonkeyPatch
):
    """No scene is looked at for a segmenter that cannot be built."""
    monkeypatch.setattr(flow, "observe_scene", lambda *args: pytest.fail("a scene was looked at"))
    with pytest.raises(SettingsError, match="choose another --patch or --factor"):
        train_weights(_request(tmp_path, **sizes))


def test_a_folder_to_write_to_must_be_there(tmp_path: Path):
    """The message says so before any scene is read."""
    with pytest.raises(SettingsError, match="does not exist; make it first"):
        train_weights(TrainRequest("farm", tmp_path / "none" / "w.safetensors"))


@pytest.mark.parametrize("ending", ["", ".part", ".checkpoint", ".checkpoint.part"])
def test_a_folder_in_the_place_of_a_file_is_named(tmp_path: Path, ending: str, capsys: pytest.CaptureFixture[str]):
    """Where weights or the state of the run go: one message before any scene is read, and the exit code of usage."""
    out = tmp_path / "w.safetensors"
    (tmp_path / f"w.safetensors{ending}").mkdir()
    with pytest.raises(SystemExit) as left:
        main(["train", "nowhere", "-o", str(out)])
    shown = " ".join(capsys.readouterr().err.split())
    assert left.value.code == SettingsError.exit_code
    assert "defect" not in shown
    assert f"w.safetensors{ending} is a folder" in shown


def test_scenes_of_other_bands_are_not_mixed(tmp_path: Path):
    """One camera's scenes make one set of weights: the scene that differs is named."""
    request = _request(tmp_path)
    data = flow.open_training_data(request.dataset, 0, None, request.camera)
    first, second = data.scenes(data.train[:2])
    common = flow._common(request, first)
    flow._check_alike(second, common)
    with pytest.raises(SceneError, match=r"scene 002.* has other bands"):
        flow._check_alike(replace(second, wavelength_nm=second.wavelength_nm + 10), common)


@pytest.mark.parametrize(
    ("shape", "built_in", "patch"),
    [((512, 640), True, 16), ((1024, 1280), False, 32), ((300, 900), False, 16), ((145, 145), False, 8)],
)
def test_patches_follow_the_size_of_scenes(shape: tuple[int, int], built_in: bool, patch: int):
    """Small scenes get small patches, so that there are seats to choose from."""
    assert suggested_patch(shape, built_in=built_in) == patch


ROWS = {
    "two-scale": {"none", "random", "sobel", "entropy", "gain", "all"},
    "paper": {"none", "random", "sobel", "all"},
    "dense": {"all"},
    "upsampled": {"none"},
    "coarser": {"all"},
}


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_trains_and_shows_the_rows_it_has(tmp_path: Path, preset: Preset):
    """The file holds the network that was asked for; its figures are those that it can give."""
    shown = io.StringIO()
    request = _request(tmp_path, validation=1, preset=preset)
    record = run_train(request, Console(file=shown, width=100))
    assert load_any_weights(request.out).config.preset == preset
    figures = record["validation"]
    assert set(figures) - {"scenes", "share_of_seats"} == ROWS[preset]
    for name in ROWS[preset]:
        assert all(0 <= figures[name][figure] <= 1 for figure in ("miou", "miou_of_shown_classes", "overall_accuracy"))
        assert name in shown.getvalue()


def test_without_validation_scenes_a_control_is_not_judged(tmp_path: Path):
    """Nothing stands in the record where no scene was kept, and the last line says how to judge the weights."""
    shown = io.StringIO()
    request = _request(tmp_path, validation=0, preset="dense")
    assert run_train(request, Console(file=shown, width=100))["validation"] is None
    told = f"spectralzoom evaluate {request.dataset} --weights OTHERS --control {request.out}"
    assert told in shown.getvalue()


def test_positions_that_a_preset_cannot_have_are_refused(tmp_path: Path):
    """The flag is named before any scene is read; so is a factor that a coarser grid cannot be made of."""
    with pytest.raises(SettingsError, match="--positions paper is not for --preset coarser"):
        run_train(_request(tmp_path / "a", preset="coarser", positions="paper"), Console(quiet=True))
    with pytest.raises(SettingsError, match="needs an even factor, got 1; choose another --patch or --factor"):
        train_weights(_request(tmp_path / "b", preset="coarser", factor=1))


def test_the_papers_network_trains_on_whole_scenes():
    """Its numbers of places depend on the width of what it reads; the others' do not."""
    assert usual_crop("farm", "paper") == usual_crop("frames", "paper") == 1024
    assert [usual_crop("farm", "dense"), usual_crop("frames", "two-scale")] == [256, 384]


def test_a_survey_with_a_control_is_refused(tmp_path: Path):
    """Before the scene is opened: weights of a control make no survey."""
    request = _request(tmp_path, validation=0, preset="paper")
    train_weights(request)
    flags = {"scene": str(tmp_path / "data" / "images" / "001_image.png"), "weights": str(request.out)}
    for planning in (False, True):
        with pytest.raises(WeightsError, match=r"holds the control 'paper'.*a survey needs weights of two scales"):
            open_run(load_settings(None, {**flags, "out": str(tmp_path / "a")}), planning=planning)


TOML = """
labels = "labels/{number}_labels.png"
[classes]
left = [0, 0, 0]
right = [255, 0, 0]
"""
SHORT = TrainingSettings(steps=2, batch=1, crop=64, minutes=5)


@pytest.fixture
def halves(tmp_path: Path) -> Path:
    """Three small frames with labels: bright on the right."""
    rng = np.random.default_rng(3)
    (tmp_path / "labels").mkdir()
    for number in ("001", "002", "003"):
        image = rng.integers(0, 60, (64, 72, 3)).astype(np.uint8)
        labels = np.zeros((64, 72, 3), np.uint8)
        image[:, 40:] += 120
        labels[:, 40:, 0] = 255
        Image.fromarray(image).save(tmp_path / f"{number}.png")
        Image.fromarray(labels).save(tmp_path / "labels" / f"{number}_labels.png")
    (tmp_path / "scene.toml").write_text(TOML)
    return tmp_path


def _two_steps(dataset: Path | str, out: Path, **more: object) -> TrainRequest:
    """A training run of two steps."""
    return TrainRequest(str(dataset), out, patch=8, factor=2, width=8, settings=SHORT, **more)  # type: ignore[arg-type]


def test_a_survey_says_that_a_scene_was_trained_on(halves: Path, tmp_path: Path) -> None:
    """The accuracy on a training scene comes with a warning, that on a held-out one does not."""
    out = tmp_path / "w.safetensors"
    train_weights(_two_steps(halves, out, hold_out=("002",), validation=0))
    notes = {}
    for number in ("001", "002"):
        flags = {"scene": str(halves / f"{number}.png"), "weights": str(out), "out": str(tmp_path / "a"), "budget": 1}
        notes[number] = " ".join(open_run(load_settings(None, flags)).notes)
    assert "trained on this scene" in notes["001"]
    assert "trained on this scene" not in notes["002"]


def test_pixels_trained_on_are_not_judged(tmp_path: Path) -> None:
    """With a training mask the survey of the same file counts the other labelled pixels alone."""
    rng = np.random.default_rng(4)
    labels = rng.integers(1, 3, (40, 40)).astype(np.uint8)
    mask = np.where(np.arange(40)[:, None] < 10, labels, 0).astype(np.uint8)
    np.save(tmp_path / "cube.npy", (labels[..., None] * np.ones(4)).astype(np.float32))
    np.save(tmp_path / "labels.npy", labels)
    np.save(tmp_path / "mask.npy", mask)
    given = {"labels": str(tmp_path / "labels.npy"), "wavelengths": [500, 600, 700, 800]}
    out = tmp_path / "w.safetensors"
    train_weights(_two_steps(tmp_path / "cube.npy", out, choices={**given, "train_mask": str(tmp_path / "mask.npy")}))
    flags = {**given, "scene": str(tmp_path / "cube.npy"), "weights": str(out), "out": str(tmp_path / "a"), "budget": 1}
    run = open_run(load_settings(None, flags))
    assert run.labels is not None
    assert (run.labels[:10] == 255).all()
    assert (run.labels[10:] != 255).all()


def test_the_same_seed_gives_the_same_weights(halves: Path, tmp_path: Path) -> None:
    """Two runs of one command agree to rounding, in another order of sums; another seed gives other weights."""
    found = []
    for name, seed in (("one", 0), ("two", 0), ("other", 1)):
        out = tmp_path / f"{name}.safetensors"
        train_weights(replace(_two_steps(halves, out, validation=0), settings=replace(SHORT, seed=seed)))
        tensors = load_weights(out).segmenter.state_dict().values()
        found.append(np.concatenate([tensor.numpy().ravel().astype(np.float64) for tensor in tensors]))
    one, two, other = found
    assert np.linalg.norm(one - two) < 1e-3 * np.linalg.norm(one - other)


def test_scenes_without_labels_are_refused(tmp_path: Path) -> None:
    """Training on a picture without labels says what is missing."""
    Image.fromarray(np.zeros((40, 40, 3), np.uint8)).save(tmp_path / "bare.png")
    with pytest.raises(SceneError, match="no labels"):
        train_weights(_two_steps(tmp_path / "bare.png", tmp_path / "w.safetensors"))
