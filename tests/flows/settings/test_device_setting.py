"""The device that networks compute on, as a setting of surveys, trainings and evaluations."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

from flows.evaluate.command import evaluate_weights
from flows.evaluate.frames import EvaluateRequest
from flows.tasks.run import SurveyRun
from flows.tasks.survey_model import shipped_weights
from flows.training.train import train_weights
from flows.training.train_scenes import TrainRequest
from pipeline.errors import SettingsError
from tests.conftest import Survey

REFUSED = "--device mps: torch can use none on this machine; there is .*: give that, or auto"


@pytest.fixture(autouse=True)
def _no_such_device(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.backends.mps.is_available", lambda: False)


def test_a_survey_on_a_device_that_is_not_there_is_refused(survey_png: Survey, tmp_path: Path) -> None:
    """Before anything is captured or stored."""
    with pytest.raises(SettingsError, match=REFUSED):
        survey_png(tmp_path / "out", device="mps")
    assert not (tmp_path / "out").exists()


def test_trainings_and_evaluations_refuse_it_too(tmp_path: Path) -> None:
    """Before a scene is looked at."""
    with pytest.raises(SettingsError, match=REFUSED):
        train_weights(TrainRequest("farm", tmp_path / "w.safetensors", device="mps"))
    with pytest.raises(SettingsError, match=REFUSED):
        evaluate_weights(EvaluateRequest("farm", (shipped_weights(),), device="mps"))
    assert list(tmp_path.iterdir()) == []


def test_a_map_of_another_device_is_another_store() -> None:
    """Its last bits may differ; stores of the processor keep the keys that they had."""
    described = SimpleNamespace(key="w")
    runs = [SimpleNamespace(settings=SimpleNamespace(device=name), described=described) for name in ("cpu", "cuda")]
    keys = [SurveyRun.model_key.fget(run) for run in runs]  # type: ignore[attr-defined]
    assert keys == [{"weights": "w"}, {"weights": "w", "device": "cuda"}]
