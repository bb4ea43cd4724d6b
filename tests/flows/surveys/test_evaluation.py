"""The score of a map: labels and controls at its offset, and figures from receipts."""

from __future__ import annotations

import copy
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from spectralzoom.flows.publish.scores import format_false_classes, format_worst_class, score_of
from spectralzoom.flows.stages import evaluate as evaluation
from spectralzoom.flows.stages import register
from spectralzoom.models.evaluation.metrics import confusion
from spectralzoom.models.evaluation.taught_labels import judged_labels
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.grid import UNLABELLED
from spectralzoom.pipeline.rectify.registration.illumination import LightRatio
from spectralzoom.pipeline.rectify.sweep_paths import sweep_paths
from spectralzoom.pipeline.simulator.effects.pointing import PointingErrors
from spectralzoom.storage.store import Archive, write_table
from tests.flows.publish.test_receipt import make_receipt

OFF = np.array([2.2, -1.4])  # along the line and the scan [px]


@pytest.mark.parametrize(("along", "down", "right"), [("x", -1, 2), ("y", 2, -1)])
def test_labels_are_shifted_by_the_offset_of_the_map(along: str, down: int, right: int) -> None:
    """The map's pixel p shows the field at p + offset, to the nearest pixel; outside of the labels is nodata."""
    labels = np.arange(30, dtype=np.uint8).reshape(5, 6)
    moved = evaluation.moved_labels(labels, OFF, along)  # type: ignore[arg-type]
    for row, column in np.ndindex(5, 6):
        at = row + down, column + right
        known = 0 <= at[0] < 5 and 0 <= at[1] < 6
        assert moved[row, column] == (labels[at] if known else UNLABELLED)


def test_a_false_class_is_listed_with_its_pixels() -> None:
    """A class in the map that the labels lack has pixels and no IoU, and does not count in the mean."""
    labels, drawn = np.array([0, 0, 0, 1, UNLABELLED], np.uint8), np.array([0, 0, 2, 1, 2], np.uint8)
    found = evaluation.map_figures(("soil", "crop", "tree"), confusion(labels, drawn, 3))
    assert found["false_classes"] == {"tree": 1}
    assert found["per_class_iou"] == pytest.approx({"soil": 2 / 3, "crop": 1.0, "tree": np.nan}, nan_ok=True)
    assert found["miou"] == pytest.approx(5 / 6)


def test_the_offset_of_a_map_is_that_of_the_reference_sweep(tmp_path: Path) -> None:
    """Without registration the offset is zero."""
    errors = PointingErrors(9.0, 4)
    build = lambda path: write_table(path / "registration.json", {"reference": "coarse-3"})  # noqa: E731
    off = evaluation.map_offset(errors, Archive.open(tmp_path).produce("register", build, version=1, params={})[0])
    np.testing.assert_array_equal(off, errors.offset("coarse-3"))
    assert (evaluation.map_offset(errors, None) == 0).all()


def test_light_gains_and_path_corrections_are_per_sweep(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two sweeps in different light meet halfway; offset, drift and gain apply to their own sweep."""
    ratio = LightRatio(0, 1, np.log([4.0, 4.0]), np.zeros(2))
    monkeypatch.setattr(register, "overlap_light", lambda *_: [ratio])
    placed: Any = [SimpleNamespace(lines=SimpleNamespace(sweep=SimpleNamespace(name=name))) for name in "ab"]
    found: Any = SimpleNamespace(windows=[SimpleNamespace(window=None, measured=True)])
    gains = register.light_gains(found, placed, LineCamera(), np.array([500.0, 600.0]))
    np.testing.assert_allclose(gains["a"], 2.0, rtol=1e-6)
    np.testing.assert_allclose(gains["b"], 0.5, rtol=1e-6)
    record = {"a": {"offset_px": [1.0, -2.0], "drift_px_per_line": [0.5, 0.0], "gain": [0.5, 2.0]}}
    sweeps = [SimpleNamespace(name=name, exposure_ms=None) for name in "ab"]
    cubes = [SimpleNamespace(sweep=sweep, time_s=np.arange(3.0), source="sim") for sweep in sweeps]
    one, other = sweep_paths(cubes, LineCamera(), record)  # type: ignore[arg-type]
    np.testing.assert_array_equal(one.shift_px, [[0.5, -2.0], [1.0, -2.0], [1.5, -2.0]])
    np.testing.assert_array_equal(one.gain, [0.5, 2.0])
    assert (other.shift_px == 0).all()
    assert other.gain is None


def test_receipts_give_score_worst_class_and_false_classes():
    """The worst class is one of the labels; each false class of the map is listed with its pixels."""
    assert score_of(make_receipt()) == {"miou": 0.75, "overall_accuracy": 0.934}
    accuracy: Any = copy.deepcopy(make_receipt()["accuracy"])
    assert format_worst_class(accuracy) == "The map's worst class is bare weed with 60.0."
    accuracy["per_class_iou"] = {"wheat": None}
    assert format_worst_class(accuracy) == ""
    accuracy: Any = copy.deepcopy(make_receipt()["accuracy"])
    accuracy["false_classes"] = {"wheat": 30, "bare_track": 1}
    words = "Shown although the truth has none: wheat 30 px, bare track 1 px."
    assert format_false_classes(accuracy) == words
    accuracy["false_classes"] = {}
    assert format_false_classes(accuracy) == ""


def test_labels_are_reordered_to_the_classes_of_the_weights() -> None:
    """Pixels without a label keep none."""
    labels = np.array([[0, 1, UNLABELLED]], np.uint8)
    scene: Any = SimpleNamespace(labels=labels, class_names=("b", "a"), shape=(1, 3), clear_key="", content=())
    weights: Any = SimpleNamespace(class_names=("a", "b"), record={})
    np.testing.assert_array_equal(judged_labels(scene, weights), [[1, 0, UNLABELLED]])
