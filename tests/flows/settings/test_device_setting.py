"""The device for the networks, as a setting of surveys, trainings and evaluations."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from spectralzoom.flows.evaluate.command import evaluate_weights
from spectralzoom.flows.opening.survey_model import shipped_weights
from spectralzoom.flows.settings.model_flags import EvaluateFlags, TrainFlags
from spectralzoom.flows.stages.field_work import WeightsFile
from spectralzoom.flows.training.train import train_weights
from spectralzoom.flows.training.train_scenes import TrainRequest
from spectralzoom.models.weights.files import describe_weights
from spectralzoom.pipeline.errors import SettingsError
from spectralzoom.storage.store import text_of
from tests.conftest import Survey

REFUSED = "--device mps: torch can use none on this machine; there is .*: give that, or auto"


@pytest.fixture(autouse=True)
def _no_such_device(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.backends.mps.is_available", lambda: False)


def test_a_survey_on_an_absent_device_is_refused(survey_png: Survey, tmp_path: Path) -> None:
    """The error comes before an archive is made."""
    with pytest.raises(SettingsError, match=REFUSED):
        survey_png(tmp_path / "out", device="mps")
    assert not (tmp_path / "out").exists()


def test_trainings_and_evaluations_refuse_an_absent_device(tmp_path: Path) -> None:
    """They write no file."""
    with pytest.raises(SettingsError, match=REFUSED):
        train_weights(TrainRequest("farm", tmp_path / "w.safetensors", TrainFlags(device="mps")))
    with pytest.raises(SettingsError, match=REFUSED):
        evaluate_weights("farm", EvaluateFlags(weights=(shipped_weights(),), device="mps"))
    assert list(tmp_path.iterdir()) == []


def test_a_map_of_another_device_is_another_store() -> None:
    """Its last bits may differ; another file of the same weights gives the same map."""
    path = shipped_weights()
    here, there = (WeightsFile.of(path, describe_weights(path), device) for device in ("cpu", "cuda"))
    assert text_of(here) != text_of(there)
    assert text_of(replace(here, path=Path("copy"))) == text_of(here)
