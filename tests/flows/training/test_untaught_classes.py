"""Classes of scene.toml without a training pixel: training names them, and nothing that follows draws them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from spectralzoom.flows.evaluate.command import evaluate_weights
from spectralzoom.flows.opening.open_field import open_field
from spectralzoom.flows.settings.model_flags import EvaluateFlags, TrainFlags
from spectralzoom.flows.settings.settings import load_settings
from spectralzoom.flows.training.train import train_weights
from spectralzoom.flows.training.train_scenes import TrainRequest
from spectralzoom.models.network.spectral import LineSpec
from spectralzoom.models.reading.inference import map_of_columns
from spectralzoom.models.weights.files import Weights, load_weights
from spectralzoom.pipeline.errors import SceneError
from spectralzoom.pipeline.geometry.grid import SceneGrid

NAMES = ("weed", "soil", "crop")  # values 3, 1, 2 of the labels
VALUES = {"soil": 1, "crop": 2, "weed": 3}
SHAPE = (16, 16)
NOTE = "class weed has no pixel in the training frames; it will never be drawn"
TRAINED = ("002", "003", "004")  # 001 is kept for validation


def _folder(root: Path, weeds: dict[str, np.ndarray] | None = None) -> Path:
    """Write four cubes of soil and crop, with weed where ``weeds`` says so by frame, and return their folder."""
    (root / "masks").mkdir(parents=True)
    rng = np.random.default_rng(0)
    classes = "".join(f"{name} = {VALUES[name]}\n" for name in NAMES)
    about = "unlabelled = 0\nwavelengths_nm = [500, 600, 700, 800]\nlabels = 'masks/{number}.npy'\n"
    (root / "scene.toml").write_text(f"{about}[classes]\n{classes}")
    for number in ("001", *TRAINED):
        labels = rng.integers(1, 3, SHAPE).astype(np.uint8)
        labels[(weeds or {}).get(number, np.zeros(SHAPE, bool))] = 3
        values = labels[..., None] * np.linspace(0.5, 1, 4) + rng.normal(0, 0.05, (*SHAPE, 4))
        np.save(root / "masks" / f"{number}.npy", labels)
        np.save(root / f"{number}.npy", values.astype(np.float32))
    return root


def _request(folder: Path, out: Path, **more: Any) -> TrainRequest:
    quick: dict[str, Any] = {"steps": 2, "validation": 1}
    return TrainRequest(str(folder), out, TrainFlags(**quick | more))


def _expect_without_weed(weights: Weights) -> None:
    """Expect a map without weed, also of columns that resemble its pixels or nothing that was seen."""
    rng = np.random.default_rng(1)
    for scale in (1.0, 100.0):
        columns = rng.normal(0, scale, (*SHAPE, weights.config.columns)).astype(np.float32)
        drawn, every_class = map_of_columns(weights, columns, SceneGrid(*SHAPE, 8), LineSpec())
        assert drawn.classes.min() > 0
        np.testing.assert_allclose(np.exp(every_class[..., 1:]).sum(axis=-1), 1, atol=1e-5)
        assert np.isneginf(every_class[..., 0]).all()


PIXELS = np.zeros(SHAPE, bool)
PIXELS[:3, :3] = True


@pytest.mark.parametrize("case", ["named alone", "without values"])
def test_classes_without_a_training_pixel_are_named_and_never_drawn(case: str, tmp_path: Path) -> None:
    """No label has the class, or its pixels have no value."""
    where = {"named alone": (), "without values": TRAINED}
    folder = _folder(tmp_path / "field", dict.fromkeys(where[case], PIXELS))
    if case == "without values":
        for number in TRAINED:
            values = np.load(folder / f"{number}.npy")
            values[PIXELS] = np.nan
            np.save(folder / f"{number}.npy", values)
    asked = _request(folder, tmp_path / "w.safetensors")
    notes: list[str] = []
    train_weights(asked, tell=notes.append)
    assert notes.count(NOTE) == 1
    weights = load_weights(asked.out)
    assert weights.config.untaught == (0,)
    _expect_without_weed(weights)


def test_one_class_alone_is_refused(tmp_path: Path) -> None:
    """A frame without any label beside it does not help."""
    folder = _folder(tmp_path / "field")
    for number in ("001", *TRAINED):
        labels = np.full(SHAPE, 2 if number == "001" else 0, np.uint8)
        np.save(folder / "masks" / f"{number}.npy", labels)
    with pytest.raises(SceneError, match="training needs two or more classes, and all labels are crop in 001"):
        train_weights(_request(folder, tmp_path / "w.safetensors", validation=0))


def test_a_class_of_one_pixel_is_taught(tmp_path: Path) -> None:
    """It has no note, and the map may have it."""
    one = np.zeros(SHAPE, bool)
    one[5, 5] = True
    folder = _folder(tmp_path / "field", {"002": one})
    notes: list[str] = []
    train_weights(_request(folder, tmp_path / "w.safetensors"), tell=notes.append)
    assert not any("no pixel in the training" in note for note in notes)
    assert load_weights(tmp_path / "w.safetensors").config.untaught == ()


def test_evaluation_and_surveys_name_classes_that_weights_never_draw(tmp_path: Path) -> None:
    """The class of held-out labels has IoU 0; folds that lack different classes are judged together."""
    folder = _folder(tmp_path / "field", {"001": PIXELS})
    fold = _request(folder, tmp_path / "a.safetensors", validation=0, hold_out=("001",))
    train_weights(fold)
    other = _request(folder, tmp_path / "b.safetensors", validation=0, hold_out=("002",))
    train_weights(other)
    content = evaluate_weights(str(folder), EvaluateFlags(weights=(fold.out, other.out), fractions="0.5"))
    assert content["frames"] == ["001", "002"]
    assert f"a.safetensors: {NOTE}" in content["warnings"]
    assert not any(note.startswith("b.safetensors") for note in content["warnings"])
    assert content["support"]["weed"] == 9
    assert {row["per_class_iou"]["weed"] for row in content["rows"]} == {0.0}
    asked = {"scene": str(folder / "001.npy"), "source": "raster", "weights": str(fold.out), "out": str(tmp_path / "o")}
    warned = " ".join(open_field(load_settings(None, asked)).warnings)
    assert "classes without a training pixel, which are never drawn: weed" in warned
