"""What weights know of the data they were trained on, and what a survey makes of that."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from flows.settings.load import load_settings
from flows.survey.run import open_run
from flows.training.data import open_training_data, pack_mask, read_farm_name, unpack_mask
from flows.training.train import TrainRequest, train_weights
from models.training.train import TrainingSettings
from models.weights.files import load_weights
from pipeline.errors import SceneError
from pipeline.geometry.camera import LineCamera

TOML = """
labels = "labels/{number}_labels.png"
[classes]
left = [0, 0, 0]
right = [255, 0, 0]
"""
SHORT = TrainingSettings(steps=2, batch=1, crop=64, minutes=5)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
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


def request(dataset: Path | str, out: Path, **more: object) -> TrainRequest:
    """A training run of two steps."""
    return TrainRequest(str(dataset), out, patch=8, factor=2, width=8, settings=SHORT, **more)  # type: ignore[arg-type]


def test_weights_keep_the_split(folder: Path, tmp_path: Path) -> None:
    """Names held out are in no training list, and the file says which scenes were trained on."""
    out = tmp_path / "w.safetensors"
    train_weights(request(folder, out, hold_out=("002",), validation=1))
    split = load_weights(out).record["split"]
    assert split["held_out"] == ["002"]
    assert set(split["train"]) | set(split["validation"]) == {"001", "003"}


def test_a_survey_says_that_a_scene_was_trained_on(folder: Path, tmp_path: Path) -> None:
    """The accuracy on a training scene comes with a warning, that on a held-out one does not."""
    out = tmp_path / "w.safetensors"
    train_weights(request(folder, out, hold_out=("002",), validation=0))
    notes = {}
    for number in ("001", "002"):
        flags = {"scene": str(folder / f"{number}.png"), "weights": str(out), "out": str(tmp_path / "a"), "budget": 1}
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
    train_weights(request(tmp_path / "cube.npy", out, choices={**given, "train_mask": str(tmp_path / "mask.npy")}))
    flags = {**given, "scene": str(tmp_path / "cube.npy"), "weights": str(out), "out": str(tmp_path / "a"), "budget": 1}
    run = open_run(load_settings(None, flags))
    assert run.labels is not None
    assert (run.labels[:10] == 255).all()
    assert (run.labels[10:] != 255).all()


def test_the_same_seed_gives_the_same_weights(folder: Path, tmp_path: Path) -> None:
    """Two runs of one command agree to rounding, in another order of sums; another seed gives other weights."""
    found = []
    for name, seed in (("one", 0), ("two", 0), ("other", 1)):
        out = tmp_path / f"{name}.safetensors"
        train_weights(replace(request(folder, out, validation=0), settings=replace(SHORT, seed=seed)))
        tensors = load_weights(out).segmenter.state_dict().values()
        found.append(np.concatenate([tensor.numpy().ravel().astype(np.float64) for tensor in tensors]))
    one, two, other = found
    assert np.linalg.norm(one - two) < 1e-3 * np.linalg.norm(one - other)


def test_scenes_without_labels_are_refused(tmp_path: Path) -> None:
    """Training on a picture without labels says what is missing."""
    Image.fromarray(np.zeros((40, 40, 3), np.uint8)).save(tmp_path / "bare.png")
    with pytest.raises(SceneError, match="no labels"):
        train_weights(request(tmp_path / "bare.png", tmp_path / "w.safetensors"))


def test_masks_pack_and_unpack() -> None:
    """The pixels in a record come back exactly, whatever their number."""
    mask = np.random.default_rng(0).random((13, 7)) < 0.3
    assert (unpack_mask(pack_mask(mask), (13, 7)) == mask).all()


def test_farm_scenes_are_apart_from_surveys() -> None:
    """Training and validation seeds of the farm are disjoint, and far above those a user tries."""
    data = open_training_data("farm", None, 24, LineCamera())
    seeds = [read_farm_name(name)[0] for name in (*data.train, *data.validation)]
    assert len(set(seeds)) == len(seeds)
    assert min(seeds) >= 100_000
