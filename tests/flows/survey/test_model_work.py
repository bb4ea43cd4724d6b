"""What the receipt says that the model computed, against the readings that the stages of a survey make."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from flows.survey.extent import work_done, work_of_map
from flows.survey.run import SurveyRun
from models.network.cost import multiply_adds
from models.network.sizes import SegmenterConfig
from pipeline.geometry.grid import SceneGrid

CONFIG, BANDS = SegmenterConfig(classes=4), 8


def _run(side: int, policy: str) -> SurveyRun:
    """As much of a survey as is asked for its sizes."""
    made: Any = SimpleNamespace(
        grid=SceneGrid(side, side, 16, 4),
        described=SimpleNamespace(config=CONFIG),
        vgg=None,
        scene=SimpleNamespace(wavelength_nm=np.linspace(400, 1000, BANDS)),
        settings=SimpleNamespace(policy=policy),
    )
    return cast("SurveyRun", made)


@pytest.mark.parametrize(
    ("policy", "looks"), [("gain", 2), ("sobel", 2), ("random", 1), ("saliency", 1), ("vgg-static", 1)]
)
def test_a_policy_that_asks_the_glance_reads_the_coarse_look_once_more(policy: str, looks: int) -> None:
    """The map reads it anyway, from what is stored; scores of the glance read it before that."""
    run = _run(256, policy)
    done, closed = work_done(run, np.array([3, 8])), multiply_adds(CONFIG, run.grid, 2, BANDS, policy)
    assert done.glance == looks * closed.glance
    assert (done.score, done.encode, done.decode) == (closed.score, closed.encode, closed.decode)


def test_a_large_field_is_counted_region_by_region() -> None:
    """Sixteen times the field takes what sixteen such fields take, and its halos: attention ends with a region."""
    small, large = (work_of_map(run, run.grid.valid_seats()) for run in (_run(2560, "gain"), _run(10240, "gain")))
    assert 16 * small.decode < large.decode < 16 * 1.3 * small.decode
    assert 16 * small.total < large.total < 16 * 1.3 * small.total
