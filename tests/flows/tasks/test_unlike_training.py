"""Notes on a scene unlike the training: its conditions before the capture, its spectra after it."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from spectralzoom.flows.publish.receipt_table import finding_rows
from spectralzoom.flows.settings.load import load_settings
from spectralzoom.flows.tasks.survey_model import beyond_training, training_note
from spectralzoom.models.network.spectral import UNLIKE, unlike_training
from spectralzoom.models.weights.files import TrainedOn, Weights, describe_weights, load_weights, save_weights
from tests.conftest import CLASSES, RGB_NM, Survey

SEEN = TrainedOn(3, (460.0, 640.0), (3.0, 100.0), 2, CLASSES, (96, 300), (24.0, 60.0), 0.12)


def of_other_scenes(weights: Weights) -> Weights:
    """Return weights whose training was a thousand times as bright."""
    known = weights.normalisation
    return replace(weights, normalisation=replace(known, centre=1000 * known.centre, spread=known.spread))


@given(st.integers(0, 100), st.floats(0, 3))
def test_patches_far_from_the_training_are_unlike_it(seed: int, far: float) -> None:
    """Noise of single pixels does not count: the mean spectrum of a patch does."""
    columns = np.random.default_rng(seed).normal(0, 1, (32, 48, 24)).astype(np.float32)
    columns[:16, :16] += np.float32(far)
    found = unlike_training(columns, 16)
    assert found.shape == (2, 3)
    assert not found.ravel()[1:].any()
    assert found[0, 0] == (far**2 > UNLIKE) or abs(far**2 - UNLIKE) < 0.5


@pytest.mark.parametrize("flags", [{"source": "raster"}, {"scan_step": 1, "effects": "none"}, {"budget": "0.8"}])
def test_spectra_unlike_the_training_are_noted_for_every_source(
    survey_png: Survey, weights: Path, tmp_path: Path, flags: dict[str, Any]
) -> None:
    """Receipt and page have the fraction of the field, the advice to train, and no expected score."""
    save_weights(of_other_scenes(load_weights(weights)), tmp_path / "w.safetensors")
    published = survey_png(tmp_path / "a", **{"weights": str(tmp_path / "w.safetensors"), "budget": None, **flags})
    receipt: Any = published.receipt
    assert receipt["unlike"] == {"fraction": 1.0}
    assert "expected" not in receipt
    words = dict(finding_rows(receipt))
    assert words["training"] == "100 % of the field is unlike the training data of the weights"
    assert "These weights do not know this field: train" in words["weights"]
    assert "do not know this field" in (published.folder / "report.html").read_text(encoding="utf-8")


def _notes(weights: Path, nm: tuple[float, ...] = RGB_NM, seen: TrainedOn = SEEN, **flags: Any) -> tuple[str, ...]:
    scene: Any = SimpleNamespace(wavelength_nm=np.array(nm), shape=(96, 128), light_fraction=1.0)
    found = beyond_training(load_settings(None, flags), scene, describe_weights(weights), seen)
    return training_note(found, weights)


@given(st.integers(96, 300), st.floats(3.0, 100.0))
def test_a_survey_within_the_training_range_has_no_note(weights: Path, day: int, exposure_ms: float) -> None:
    """Days 96 to 300 and exposures of 3 to 100 ms are within the training's."""
    assert _notes(weights, day=day, hour=12, scan_step=1, scan_exposure_ms=exposure_ms) == ()


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        ({"day": 20, "hour": 12}, r"day 20 of the year \(January; training: April to October\); a sun"),
        ({"scan_step": 1, "scan_exposure_ms": 1}, r"exposures of 1 ms \(training: 3 ms and more, by --min-"),
        ({"coarse_exposure_ms": 2}, "exposures of 2 ms"),
        ({"nm": (460.0, 470.0, 480.0)}, "the bands cover 2 of the weights' 3 spectral features"),
        ({"nm": (460.0, 900.0, 1500.0, 1600.0)}, "bands outside of 460-640 nm: 3 of 4"),
        ({"seen": replace(SEEN, ground_pixel_m=0.01)}, r"GSD of 12 cm \(training: 1 cm\)"),
    ],
)
def test_conditions_beyond_the_training_get_one_note(weights: Path, flags: dict[str, Any], words: str) -> None:
    """It gives the training's range and the command to train."""
    (note,) = _notes(weights, **flags)
    assert re.search(words, note), note
    assert "spectralzoom train DATASET -o" in note
