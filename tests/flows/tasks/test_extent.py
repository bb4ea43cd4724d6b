"""How much there is to do in a survey: laws of the units that costs grow with, and what its model computes."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from flows.tasks.extent import work_done, work_of_map
from flows.tasks.run import SurveyRun
from models.network.sizes import SegmenterConfig, multiply_adds
from models.policies.policies import score_multiply_adds
from pipeline.geometry.grid import SceneGrid


def test_a_large_field_is_counted_region_by_region() -> None:
    """Sixteen times the field takes as many fields and their halos."""
    small, large = (work_of_map(run, run.grid.valid_patches()) for run in (_run(2560, "gain"), _run(10240, "gain")))
    assert 16 * small.decode < large.decode < 16 * 1.3 * small.decode
    assert 16 * small.total < large.total < 16 * 1.3 * small.total


CONFIG, BANDS = SegmenterConfig(classes=4), 8


def _run(side: int, policy: str, *, plain: bool = False) -> SurveyRun:
    """As much of a survey as is asked for its sizes."""
    made: Any = SimpleNamespace(
        grid=SceneGrid(side, side, 16, 4),
        described=SimpleNamespace(config=CONFIG),
        scene=SimpleNamespace(wavelength_nm=np.linspace(400, 1000, BANDS)),
        settings=SimpleNamespace(policy=policy),
        plan=SimpleNamespace(plain=plain),
        prior=None,
        budget=None,
        chooses=not plain,
    )
    return cast("SurveyRun", made)


@pytest.mark.parametrize(("policy", "scan_passes"), [("gain", 2), ("entropy", 2), ("sobel", 1), ("random", 1)])
def test_a_policy_that_asks_the_coarse_prediction_reads_the_coarse_look_once_more(
    policy: str, scan_passes: int
) -> None:
    """The map reads it anyway, from what is stored; scores of the coarse prediction read it before that."""
    run = _run(256, policy)
    score = score_multiply_adds(policy, CONFIG, run.grid)
    done, closed = work_done(run, np.array([3, 8])), multiply_adds(CONFIG, run.grid, 2, BANDS, score=score)
    assert done.coarse_prediction == scan_passes * closed.coarse_prediction
    assert (done.score, done.encode, done.decode) == (closed.score, closed.encode, closed.decode)


def test_a_plain_scan_is_read_and_nothing_scored() -> None:
    """What its map takes, whatever the policy of the settings is."""
    run, patch_index = _run(256, "gain", plain=True), np.arange(256)
    assert work_done(run, patch_index) == work_of_map(run, patch_index)
    assert work_done(run, patch_index).score == 0
