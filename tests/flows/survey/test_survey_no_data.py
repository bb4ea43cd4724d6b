"""Surveys of scenes of which not all is known: stated no-data values, NaN, and numbers that are no readings."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from models.weights.files import save_weights
from pipeline.errors import SceneError
from storage.arrays.class_maps import ClassMap, load_class_map
from tests.conftest import CLASSES, RGB_NM, patchy_scene, random_weights

GAP = np.s_[20:31, 40:60]  # of 64 x 96 px


def _scene(folder: Path, fill: float | None, toml: str = "") -> Path:
    """A scene with a hole of ``fill``, labels beside it; whole where ``fill`` is None."""
    folder.mkdir()
    values, labels = patchy_scene((64, 96), 3, seed=4)
    if fill is not None:
        values[GAP] = fill
    np.save(folder / "scene.npy", values.astype(np.float32))
    np.save(folder / "labels.npy", labels)
    (folder / "scene.toml").write_text(toml)
    return folder / "scene.npy"


def _survey(survey_png: Any, scene: Path, **flags: Any) -> Any:
    labels, nm = str(scene.with_name("labels.npy")), ",".join(map(str, RGB_NM))
    return survey_png(scene.parent / "a", scene=str(scene), labels=labels, wavelengths=nm, **flags)


def _map(survey: Any, scene: Path) -> ClassMap:
    return load_class_map(scene.parent / "a" / survey.receipt["products"]["class_map"])


def test_no_data_neither_darkens_nor_becomes_a_class(survey_png: Any, tmp_path: Path) -> None:
    """The hole alone has none, the rest of the field is as light as without it, and the receipt counts the pixels."""
    stated, whole = _scene(tmp_path / "stated", 1e30, "nodata = 1e30"), _scene(tmp_path / "whole", None)
    one, plain = (_survey(survey_png, scene) for scene in (stated, whole))
    drawn = _map(one, stated)
    gap = np.zeros(drawn.classes.shape, np.bool_)
    gap[GAP] = True
    np.testing.assert_array_equal(drawn.classes == 255, gap)
    np.testing.assert_array_equal(np.isnan(drawn.confidence), gap)
    count = int(gap.sum())
    assert one.receipt["pixels"] == {
        "scene_without_a_value": count,
        "coarse_px_no_reading": 0,
        "fine_px_no_reading": 0,
        "map_without_a_class": count,
    }
    assert one.receipt["accuracy"]["pixels"] == 64 * 96 - count
    assert "pixels" not in plain.receipt
    assert (_map(plain, whole).classes == drawn.classes)[~gap].mean() > 0.9  # light is what it was


def test_no_data_that_nobody_stated_ends_a_survey(survey_png: Any, tmp_path: Path) -> None:
    """In one message with its place, before anything is captured."""
    scene = _scene(tmp_path / "s", 1e30)
    said = r"scene.npy has 660 values, the first 1e\+30 at y 20, x 40, band 0, .* write nodata = 1e\+30 into a"
    with pytest.raises(SceneError, match=said):
        _survey(survey_png, scene)
    assert not (scene.parent / "a").exists()


def test_readings_that_the_weights_cannot_take_are_counted(survey_png: Any, tmp_path: Path) -> None:
    """Weights for numbers a million times smaller: no pixel can be read, which the receipt says."""
    weights = random_weights(RGB_NM, CLASSES)
    small = replace(weights.normalisation, centre=np.zeros(3, np.float32), spread=np.full(3, 1e-4, np.float32))
    save_weights(replace(weights, normalisation=small), tmp_path / "w.safetensors")
    scene = _scene(tmp_path / "s", None)
    found = _survey(survey_png, scene, weights=str(tmp_path / "w.safetensors"), policy="sobel")
    pixels = found.receipt["pixels"]
    assert pixels["coarse_px_no_reading"] == 64 * 96 // 16
    assert pixels["fine_px_no_reading"] >= 0
    assert pixels["map_without_a_class"] == 0
    store = scene.parent / "a" / Path(found.receipt["products"]["class_map"]).parent
    assert json.loads((store / "strange.json").read_text())["coarse_px"] == 64 * 96 // 16


def test_scores_of_any_size_make_a_survey(survey_png: Any, tmp_path: Path) -> None:
    """A mask of 1e307 buys what a mask of 1 does, without a warning."""
    scene = _scene(tmp_path / "s", None)
    mask = np.random.default_rng(0).uniform(0, 1, (64, 96))
    bought = []
    for power in (0, 1020):
        np.save(tmp_path / "mask.npy", np.ldexp(mask, power))
        found = _survey(survey_png, scene, policy="mask", mask=str(tmp_path / "mask.npy"), budget="0.9")
        bought.append((found.receipt["savings"]["lines"]["done"], found.receipt["plan"]["score_share"]))
    assert bought[0] == pytest.approx(bought[1])
