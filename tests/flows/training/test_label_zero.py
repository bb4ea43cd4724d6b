"""A training states what the label 0 stands for, however labels come."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from PIL import Image
from rich.console import Console

from spectralzoom.flows.evaluate.command import evaluate_weights
from spectralzoom.flows.settings.model_flags import EvaluateFlags, TrainFlags
from spectralzoom.flows.terminal.figures import format_percent
from spectralzoom.flows.training.data import open_training_data, zero_sentence
from spectralzoom.flows.training.train import run_train
from spectralzoom.flows.training.train_scenes import CAMERA, TrainRequest, observe_all
from spectralzoom.pipeline.errors import SceneError

NM = "wavelengths_nm = [600, 800]\n"
NAMED = "[classes]\nbare = 0\nwheat = 5\n"
KINDS = np.kron(np.array([[0, 5, 0, 5], [5, 0, 0, 0]]), np.ones((16, 10))).astype(np.uint8)  # 0 has 5 of 8 parts
SHARE = 5 / 8


def _scene(root: Path, labels: np.ndarray, ending: str, toml: str = "") -> Path:
    """Write a cube with its labels beside it, and return its path."""
    root.mkdir(exist_ok=True)
    light = np.random.default_rng(1).normal(0, 1, (*KINDS.shape, 2)) + KINDS[..., None] * [10.0, 4.0] + 20
    np.save(root / "cube.npy", light.astype(np.float32))
    if ending == "npy":
        np.save(root / "cube_labels.npy", labels)
    else:
        Image.fromarray(labels).save(root / f"cube_labels.{ending}")
    (root / "scene.toml").write_text(NM + toml)
    return root / "cube.npy"


def _told(path: Path) -> str:
    """Return the sentence of a training on a path, without the training."""
    data = open_training_data(str(path), 0, None, CAMERA)
    scenes = observe_all(TrainRequest(str(path), path), data, lambda *_: None)
    return zero_sentence(**scenes.label_zero)


GREEN = np.where(KINDS[..., None] == 0, 0, [0, 200, 0]).astype(np.uint8)
CLASS_0 = "label 0 is the class class_0: 62 % of the pixels; if it means unlabelled, write unlabelled = 0 into a scene"
BARE = "label 0 is the class bare: 62 % of the pixels"
NONE = "label 0 is no class, 62 % of the pixels are unlabelled; a table [classes] in a scene.toml can name it: NAME = 0"
THIRD = np.where(np.arange(40) < 10, 3, KINDS)  # with 0, 3 and 5


@pytest.mark.parametrize(
    ("labels", "ending", "toml", "words"),
    [
        (KINDS, "npy", "", CLASS_0),
        (KINDS.astype(np.float32), "npy", "", CLASS_0),
        (KINDS, "png", "", CLASS_0),
        (GREEN, "png", "", "label 0 is the class colour_000000: 62 % of the pixels; .* unlabelled = [0, 0, 0] into"),
        (KINDS, "npy", NAMED, BARE),
        (GREEN, "png", "[classes]\nbare = [0, 0, 0]\nwheat = [0, 200, 0]\n", BARE),
        (THIRD, "png", "unlabelled = 0\n", "label 0 is no class, 50 % of the pixels are unlabelled"),
        (np.where(KINDS == 0, 300, KINDS.astype(np.int32)), "npy", "", ""),
        (np.where(THIRD == 0, -1, THIRD.astype(np.int16)), "npy", "", "label 0 is no class, 50 % of the pixels are"),
    ],
    ids=["array", "floats", "picture", "colours", "named", "named colours", "unlabelled", "others", "negative"],
)
def test_the_sentence_of_a_file(tmp_path: Path, labels: np.ndarray, ending: str, toml: str, words: str) -> None:
    """Arrays and pictures, numbers and colours, with and without names; every label another than 0 needs no words."""
    told = _told(_scene(tmp_path, labels, ending, toml))
    first, _, last = words.partition(" .* ")
    assert told.startswith(first)
    assert last in told
    assert bool(told) == bool(words)
    assert told.endswith("beside the scene") == (words == CLASS_0 or "colour" in words)


def test_a_few_pixels_are_not_none() -> None:
    """One pixel of 4096 is a share above 0."""
    assert "class_0: < 0.1 % of the pixels" in zero_sentence("class_0", 1 / 4096)


@pytest.mark.parametrize("toml", ["", "unlabelled = 0\n"])
def test_the_sentence_of_a_folder(tmp_path: Path, toml: str) -> None:
    """Pixels of all scenes count together."""
    for name, size in (("a", 40), ("b", 20)):
        picture = np.repeat(THIRD[:, :size, None], 3, axis=2) * 20
        Image.fromarray(picture.astype(np.uint8)).save(tmp_path / f"{name}.png")
        Image.fromarray(THIRD[:, :size].astype(np.uint8)).save(tmp_path / f"{name}_mask.png")
    (tmp_path / "scene.toml").write_text(f"wavelengths_nm = [640, 550, 460]\n{toml}")
    share = ((THIRD == 0).sum() + (THIRD[:, :20] == 0).sum()) / (THIRD.size * 1.5)
    kind = "no class," if toml else "the class class_0:"
    assert _told(tmp_path).startswith(f"label 0 is {kind} {format_percent(share)} of the pixels")


@pytest.mark.parametrize("first", [0, 1])
def test_the_sentence_of_polygons(tmp_path: Path, first: int) -> None:
    """A polygon's 0 is a class; pixels outside of all are unlabelled."""
    path = tmp_path / "field.tif"
    light = np.random.default_rng(2).integers(1, 99, (2, 20, 40)).astype(np.uint16)
    place = {"crs": "EPSG:25832", "transform": rasterio.Affine(1, 0, 500_000, 0, -1, 5_000_000)}
    with rasterio.open(path, "w", "GTiff", 40, 20, 2, dtype="uint16", **place) as file:
        file.write(light)

    def area(number: int, west: int, east: int) -> dict[str, Any]:
        ring = [(500_000 + x, 5_000_000 - y) for x, y in ((west, 0), (east, 0), (east, 20), (west, 20), (west, 0))]
        shape = {"type": "Polygon", "coordinates": [ring]}
        return {"type": "Feature", "properties": {"class": number}, "geometry": shape}

    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::25832"}}
    areas = {"type": "FeatureCollection", "crs": crs, "features": [area(first, 0, 4), area(7, 10, 30)]}
    (tmp_path / "field.geojson").write_text(json.dumps(areas))
    (tmp_path / "scene.toml").write_text(NM)
    words = ("the class class_0: 10 %", "no class, 40 %")[first]
    assert _told(path).startswith(f"label 0 is {words} of the pixels")


def test_the_last_line_says_it_and_evaluate_says_what_to_do(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A training that took 0 for a class knows every pixel: no other labels of the scene can judge it."""
    path = _scene(tmp_path, KINDS, "npy")
    out = tmp_path / "w.safetensors"
    record = run_train(TrainRequest(str(path), out, TrainFlags(validation=0)), Console(width=300))
    assert capsys.readouterr().out.splitlines()[-1].startswith(CLASS_0)
    assert record["label_zero"] == {"name": "class_0", "fraction": SHARE}
    np.save(tmp_path / "test.npy", np.where(KINDS == 5, 0, 5).astype(np.uint8))
    with pytest.raises(SceneError) as refused:
        evaluate_weights(str(path), EvaluateFlags(weights=(out,), labels=str(tmp_path / "test.npy")))
    told = str(refused.value)
    assert "Judge by another scene, or by other labelled pixels of it: --labels FILE" in told
    assert "write unlabelled = 0 into a scene.toml beside the scene, and train again" in told
