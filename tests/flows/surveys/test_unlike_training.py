"""Notes on a scene unlike the training: its conditions before the capture, its spectra after it."""

from __future__ import annotations

import io
import re
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from spectralzoom.flows.opening.training_ranges import beyond_training, training_warning
from spectralzoom.flows.settings.model_flags import TrainFlags
from spectralzoom.flows.settings.settings import load_settings
from spectralzoom.flows.survey_command import run_survey
from spectralzoom.flows.training.train import train_weights
from spectralzoom.flows.training.train_scenes import TrainRequest
from spectralzoom.models.evaluation.unlike_scenes import TrainingSpectra
from spectralzoom.models.weights.files import TrainedOn, add_spectra, describe_weights
from tests.conftest import CLASSES, RGB_NM, Survey

SEEN = TrainedOn(3, (460.0, 640.0), (3.0, 100.0), 2, CLASSES, (96, 300), (24.0, 60.0), 0.12)


FAR = TrainingSpectra(np.eye(len(RGB_NM)), np.full(len(RGB_NM), 1e3), np.ones(len(RGB_NM)))


def with_spectra(weights: Path, out: Path, spectra: TrainingSpectra = FAR) -> str:
    """Write weights of training spectra far from those of any scene to ``out``, and return that."""
    shutil.copy(weights, out)
    add_spectra(out, spectra)
    return str(out)


@pytest.mark.parametrize("flags", [{"source": "raster"}, {"scan_step": 1, "effects": "none"}, {"budget": "0.8"}])
def test_spectra_unlike_the_training_are_noted_for_every_source(
    survey_png: Survey, weights: Path, tmp_path: Path, flags: dict[str, Any]
) -> None:
    """Terminal, receipt and page have one sentence with the figure, and there is no expected score."""
    console = Console(file=io.StringIO(), width=300)
    unlike = {"weights": with_spectra(weights, tmp_path / "w.safetensors"), "budget": None, **flags}
    published = survey_png(tmp_path / "a", console, **unlike)
    receipt: Any = published.receipt
    assert receipt["unlike"]["mean"] > 100
    assert "miou" not in receipt["expected"]
    words = r"the scene is unlike the training \(its .* lies? (\d+\.\d|more than 100) "
    words += r"times as far from it as any part .* rest\): "
    (note,) = receipt["warnings"]
    for text in (note, console.file.getvalue(), (published.folder / "report.html").read_text(encoding="utf-8")):
        assert len(re.findall(words + "the map may be wrong with confidence", text)) == 1


def test_spectra_like_the_training_have_no_note(survey_png: Survey, weights: Path, tmp_path: Path) -> None:
    """The training's statistics are those of the scene itself."""
    like = TrainingSpectra(FAR.axes, np.zeros(len(RGB_NM)), np.full(len(RGB_NM), 1e6), (1.0, 1e6))
    path = with_spectra(weights, tmp_path / "w.safetensors", like)
    assert "unlike" not in survey_png(tmp_path / "a", weights=path, budget=None, source="raster").receipt


def _notes(weights: Path, nm: tuple[float, ...] = RGB_NM, seen: TrainedOn = SEEN, **flags: Any) -> tuple[str, ...]:
    scene: Any = SimpleNamespace(wavelength_nm=np.array(nm), shape=(96, 128), light_fraction=1.0)
    found = beyond_training(load_settings(None, flags), scene, describe_weights(weights), seen)
    return training_warning(found, weights)


@given(st.integers(96, 300), st.floats(3.0, 100.0))
def test_a_survey_within_the_training_range_has_no_note(weights: Path, day: int, exposure_ms: float) -> None:
    """Days 96 to 300 and exposures of 3 to 100 ms are within the training's."""
    assert _notes(weights, day=day, hour=12, scan_step=1, scan_exposure_ms=exposure_ms) == ()


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        ({"day": 20, "hour": 12}, r"day 20 of the year \(January; training: April to October\); a sun"),
        ({"scan_step": 1, "scan_exposure_ms": 1}, r"exposures of 1 ms \(training: 3 ms and more, by --min-"),
        ({"scan_exposure_ms": 2, "zoom": "always"}, "exposures of 2 ms"),
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


def test_trained_weights_know_their_spectra(scene_files: Path, tmp_path: Path) -> None:
    """A survey of the trained scene has no note; one of a scene with other spectra has."""
    out, other = tmp_path / "w.safetensors", tmp_path / "other.npy"
    values = np.load(scene_files / "cube.npy")
    np.save(tmp_path / "labels.npy", np.indices(values.shape[:2])[1].astype(np.uint8) // 8 % 2)
    np.save(other, values[..., ::-1] + 2 * values.mean())
    nm = tuple(range(450, 750, 50))
    given = {"labels": str(tmp_path / "labels.npy"), "wavelengths": ",".join(map(str, nm)), "steps": 1}
    train_weights(TrainRequest(str(scene_files / "cube.npy"), out, TrainFlags(**given)))
    for scene, unlike in ((scene_files / "cube.npy", False), (other, True)):
        flags = {"scene": str(scene), "source": "raster", "weights": str(out), "wavelengths": list(nm)}
        flags |= {"engine": "plain", "out": str(tmp_path / scene.stem)}
        published = run_survey(load_settings(None, flags), Console(file=io.StringIO()))
        assert ("unlike" in published.receipt) == unlike
