"""Surveys with each policy that needs no labels."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from flows.publish.survey_command import run_survey
from flows.settings.load import load_settings
from flows.tasks.run import open_run
from flows.tasks.stages.attention import score
from models.policies.policies import POLICIES
from storage.archive.keys import StageRef
from storage.arrays.mosaics import load_attention
from tests.flows.conftest import FEW_BANDS
from tests.prior_work import without_effects

FREE = [policy for policy in POLICIES if policy != "mask"]


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
    assert 0 < (attention.rank >= 0).sum() <= attention.rank.size
    runs = [replace(run, settings=replace(run.settings, seed=seed)) for seed in (1, 2)]
    keys = {score.key(score.wants(one, mosaic)) for one in runs}
    assert len(keys) == (2 if policy == "random" else 1)
