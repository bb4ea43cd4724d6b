"""A survey with each policy that needs neither labels, nor a file, nor weights of its own."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from flows.publish.receipt import check_receipt
from flows.publish.survey_command import run_survey
from flows.settings.load import load_settings
from flows.survey.field_work import SHARD, FieldWork
from flows.survey.run import open_run
from flows.survey.stages.attention import attend
from models.policies.policies import IMAGE_POLICIES, NETWORK_POLICIES, POLICIES, SEEDED_POLICIES
from models.reading.regions import plan_regions
from pipeline.errors import SettingsError
from storage.archive.archive import StageRef
from storage.arrays.mosaics import load_attention

FREE = [policy for policy in POLICIES if policy not in ("mask", *NETWORK_POLICIES)]


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One archive for all, with a survey in it: its coarse look serves the others."""
    folder = tmp_path_factory.mktemp("policies")
    run_survey(load_settings(None, _flags(folder, "random")), Console(quiet=True))
    return folder


def _flags(archive: Path, policy: str, **more: str) -> dict[str, Any]:
    size = {"size": "128x128", "budget": "0.9", "engine": "plain", "controls": False}
    return {**size, "out": str(archive), "seed": "1", "policy": policy, **more}


def _mosaic(archive: Path) -> Path:
    (path,) = archive.glob("stages/rectify/*/mosaic.zarr")
    return path


@pytest.mark.parametrize("policy", FREE)
def test_every_policy_surveys(archive: Path, policy: str) -> None:
    """Each leaves a whole receipt under its own name, finite scores for all seats, and detail where it asked for it."""
    done = run_survey(load_settings(None, _flags(archive, policy)), Console(quiet=True))
    receipt: Any = check_receipt(done.receipt)
    assert receipt["settings"]["policy"] == policy
    assert receipt["accuracy"]["miou"] > 0
    (stage,) = [stage for stage in receipt["stages"] if stage["name"] == "attend"]
    attention = load_attention(archive / "stages" / "attend" / stage["key"] / "attention.zarr")
    assert attention.policy == policy
    assert np.isfinite(attention.score).all()
    assert 0 < (attention.rank >= 0).sum() < attention.rank.size
    work = receipt["savings"]["multiply_adds"]
    assert (work["score"] > 0) == (policy not in ("random", "stratified", "centre", "uniform"))


@pytest.mark.parametrize("policy", FREE)
def test_only_drawn_placements_know_the_seed(archive: Path, policy: str) -> None:
    """Another seed of the survey is another key of the scores where they are drawn, and the same where they are not."""
    run = open_run(load_settings(None, _flags(archive, policy)))
    mosaic = StageRef("rectify", "m", _mosaic(archive).parent)
    runs = [replace(run, settings=replace(run.settings, seed=seed)) for seed in (1, 2)]
    keys = {attend.key(attend.needed(one, mosaic)) for one in runs}
    assert len(keys) == (2 if policy in SEEDED_POLICIES else 1)


@pytest.mark.parametrize("policy", IMAGE_POLICIES)
def test_saliency_sees_a_cut_field_as_a_whole(archive: Path, policy: str) -> None:
    """A field that is read in regions is scored as one image: the scores are those of the field that is not cut."""
    run = open_run(load_settings(None, _flags(archive, policy)))
    whole = FieldWork.of(run)
    cut = replace(whole, regions=plan_regions(run.grid, SHARD, most_px=(64, 640), halo=0))
    assert len(cut.regions) == 2
    found = [work.score(policy, _mosaic(archive), lambda done: None) for work in (whole, cut)]
    assert (found[0] == found[1]).all()


def test_an_image_beyond_memory_is_refused(archive: Path) -> None:
    """The message says which policy wants the whole image, what it takes, and the least memory that does."""
    run = open_run(load_settings(None, _flags(archive, "saliency")))
    work = replace(FieldWork.of(run), memory=2**20)
    with pytest.raises(SettingsError, match=r"exceeds --memory 1 MiB: the policy 'saliency' sees .* as a whole"):
        work.score("saliency", _mosaic(archive), lambda done: None)
