"""A mirror that looks beside the plan: what the survey finds, puts right, and tells."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from flows.finding_words import sentences
from flows.settings import load_settings
from flows.survey_command import run_survey
from pipeline.simulator.pointing import PointingErrors

OFF_PX, SEED = 6.0, 3


@pytest.fixture(scope="module")
def surveyed(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Path]:
    """Receipt and archive of a farm in two strips, seen by such a mirror."""
    archive = tmp_path_factory.mktemp("pointing")
    flags = {
        "scene": "farm", "size": "768x512", "bands": "60,90,130,160,200,230", "seed": str(SEED), "budget": "0.7",
        "pointing_px": str(OFF_PX), "out": str(archive), "engine": "plain", "controls": False,
    }  # fmt: skip
    found = run_survey(load_settings(None, flags), Console(quiet=True)).receipt
    return json.loads(json.dumps(found)), archive


def test_coarse_sweeps_are_put_right_by_their_seams(surveyed: tuple[dict[str, Any], Path]) -> None:
    """What registration finds of every sweep beside the one it held is what the simulator got wrong."""
    coarse, errors = surveyed[0]["pointing"]["coarse"], PointingErrors(OFF_PX, 0.0, SEED)
    assert len(coarse["sweeps"]) > 1
    for name, offset in coarse["sweeps"].items():
        assert np.abs(errors.offset(name) - errors.offset(coarse["held"]) - offset).max() < 0.4
    assert coarse["residual_rms_px"] < 0.3


def test_fine_sweeps_are_put_right_on_the_mosaic(surveyed: tuple[dict[str, Any], Path]) -> None:
    """Every fine sweep that could be compared lies on the mosaic within half a pixel."""
    pointing, errors = surveyed[0]["pointing"], PointingErrors(OFF_PX, 0.0, SEED)
    held = errors.offset(pointing["coarse"]["held"])
    told = {name: offset for name, offset in pointing["fine"]["sweeps"].items() if name not in
            pointing["fine"]["not_found"]}  # fmt: skip
    assert told
    for name, offset in told.items():
        assert np.abs(errors.offset(name) - held - offset).max() < 0.5


def test_the_mirror_is_told_of_in_words(surveyed: tuple[dict[str, Any], Path]) -> None:
    """Terminal and report have a sentence for either pass."""
    words = " ".join(sentences(surveyed[0]))
    assert "The coarse sweeps were put right by up to" in words
    assert "The fine sweeps were put right by up to" in words


def test_detail_still_helps(surveyed: tuple[dict[str, Any], Path]) -> None:
    """Patches lie where the map says: with them the map is better than without."""
    accuracy = surveyed[0]["accuracy"]
    assert accuracy["miou"] > accuracy["none"]["miou"]
