"""Weights without hashes: said by those who use them, sealed by a verb, and the same weights afterwards."""

from __future__ import annotations

import io
import json
from pathlib import Path

import pytest
from rich.console import Console
from safetensors.torch import load_file, save_file

from flows.cli import main as cli
from flows.evaluate import command as evaluate_command
from flows.evaluate.command import run_evaluate
from flows.evaluate.frames import EvaluateRequest
from flows.settings.load import load_settings
from flows.survey.run import open_run
from models.weights.files import UNSEALED, describe_weights
from models.weights.sealed_files import SEAL, TENSORS
from tests.flows.small_fields import write_field, write_weights

SAID = "was made before weights had hashes: damage to its numbers cannot be told; to add them now: spectralzoom seal "


@pytest.fixture
def earlier(tmp_path: Path) -> Path:
    """Small weights as an earlier version wrote them."""
    path = write_weights(tmp_path / "w.safetensors")
    about = {name: value for name, value in describe_weights(path).about.items() if name not in (TENSORS, SEAL)}
    save_file(load_file(path), path, {"about": json.dumps({**about, "format": UNSEALED}, sort_keys=True)})
    return path


def test_a_survey_says_so_until_they_are_sealed(
    earlier: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One note with the command; its stages keep their keys."""
    data = write_field(tmp_path / "data")
    flags = {"scene": str(data / "images" / "001_image.png"), "weights": str(earlier), "out": str(tmp_path / "a")}
    settings = load_settings(None, {**flags, "budget": 1})
    before = open_run(settings)
    assert [note for note in before.notes if SAID in note] == [f"w.safetensors {SAID}{earlier}"]
    with pytest.raises(SystemExit) as ended:
        cli.main(["seal", str(earlier)])
    assert (ended.value.code, capsys.readouterr().err) == (0, f"{earlier}: sealed\n")
    after = open_run(settings)
    assert not any(SAID in note for note in after.notes)
    assert after.weights_key == before.weights_key


def test_evaluate_says_so(earlier: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After the figures."""
    told = io.StringIO()
    monkeypatch.setattr(evaluate_command, "evaluate_weights", lambda request, show: {"files": []})
    request = EvaluateRequest("data", (earlier,))
    run_evaluate(request, Console(file=told, width=500), as_json=True)
    assert f"note: w.safetensors {SAID}{earlier}" in told.getvalue()


def test_sealing_needs_files(capsys: pytest.CaptureFixture[str]) -> None:
    """One message, exit code 2."""
    with pytest.raises(SystemExit) as ended:
        cli.main(["seal"])
    assert (ended.value.code, capsys.readouterr().err[:30]) == (2, "error: seal needs files of wei")
