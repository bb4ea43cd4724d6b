"""Weights of few labels, which have no network, and surveys by them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

from spectralzoom.flows.settings.model_flags import TrainFlags
from spectralzoom.flows.settings.settings import load_settings
from spectralzoom.flows.survey_command import run_survey
from spectralzoom.flows.training import train as flow
from spectralzoom.flows.training.train import train_weights
from spectralzoom.flows.training.train_scenes import TrainRequest
from spectralzoom.models.weights.files import describe_weights
from spectralzoom.pipeline.errors import BudgetError
from tests.conftest import QUIET
from tests.flows.small_fields import write_field


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a cube of 40 x 48 px, labels 3 and 7 in a corner, and their weights; do not change it."""
    root = tmp_path_factory.mktemp("few")
    classes = np.kron(np.indices((5, 6)).sum(axis=0) % 2, np.ones((8, 8))).astype(np.uint8) * 4 + 3
    values = classes[..., None] * np.array([1.0, 0.5]) + np.random.default_rng(0).normal(0, 0.3, (40, 48, 2))
    values[30:33, 30:34] = np.nan
    np.save(root / "cube.npy", values.astype(np.float32))
    np.save(root / "truth.npy", classes)
    classes[20:] = 0
    np.save(root / "labels.npy", classes)
    (root / "scene.toml").write_text("unlabelled = 0\nwavelengths_nm = [600, 800]\n")
    flags = TrainFlags(labels=str(root / "labels.npy"), validation=0)
    train_weights(TrainRequest(str(root / "cube.npy"), root / "w.safetensors", flags))
    return root


def _survey(trained: Path, out: Path, **flags: Any) -> Any:
    given = {"scene": str(trained / "cube.npy"), "weights": str(trained / "w.safetensors"), "engine": "plain"}
    return run_survey(
        load_settings(None, given | {"labels": str(trained / "labels.npy"), "out": str(out)} | flags), QUIET
    )


@pytest.mark.parametrize(
    "flags", [{"source": "raster", "controls": True}, {"source": "sim"}, {"source": "sim", "budget": "0.6"}], ids=str
)
def test_surveys_need_no_network(trained: Path, tmp_path: Path, flags: dict[str, Any]) -> None:
    """The map has the numbers of the labels; no patch is chosen, and nothing beside the classifiers is counted."""
    receipt = _survey(trained, tmp_path, **flags).receipt
    assert not describe_weights(trained / "w.safetensors").config.corrected
    drawn = xr.open_zarr(tmp_path / receipt["products"]["class_map"], consolidated=False)["classes"].values
    assert {*np.unique(drawn)} <= {3, 7, 255}
    truth = np.load(trained / "truth.npy")
    assert (drawn == truth).mean() > (0.7 if "budget" in flags else 0.95)
    assert not receipt.get("kept")
    assert not receipt["accuracy"].get("all")
    done = receipt["savings"]["multiply_adds"]
    assert done["done"] == done["full"] or "budget" in flags


@pytest.mark.parametrize("macs", ["50%", "1000"])
def test_fewer_multiply_adds_are_refused(trained: Path, tmp_path: Path, macs: str) -> None:
    """There is nothing to leave out."""
    with pytest.raises(BudgetError, match=rf"--macs {macs}.*no full network to leave out.*; leave out --macs"):
        _survey(trained, tmp_path, macs=macs, source="raster")


def test_classifiers_that_take_the_time_are_fitted_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without time for a network they do not learn from the validation scenes, which the record leaves out."""
    fits: list[int] = []
    fit = flow.fit_mixture

    def counted(examples: list[Any], *given: Any) -> Any:
        fits.append(len(examples))
        return fit(examples, *given)

    monkeypatch.setattr(flow, "fit_mixture", counted)
    field = write_field(tmp_path / "field", (16, 16), ("001", "002", "003", "004"))
    notes: list[str] = []
    flags = TrainFlags(minutes=1e-6, validation=1)
    record = train_weights(TrainRequest(str(field), tmp_path / "w.safetensors", flags), tell=notes.append)
    assert fits == [3]
    assert (list(record["split"]["train"]), list(record["split"]["validation"])) == (["002", "003", "004"], ["001"])
    assert record["trained_on"]["scenes"] == 3
    assert notes == [
        "the classifiers took half of --minutes or more: none learns from 1 validation scene, and there is no network"
    ]
