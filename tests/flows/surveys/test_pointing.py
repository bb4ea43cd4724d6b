"""Pointing errors of the mirror: overlaps for them, their registration, their correction, and the report."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from spectralzoom.flows.planning.capture_plan import PassLayout
from spectralzoom.flows.publish.receipt_table import finding_rows
from spectralzoom.flows.settings.settings import load_settings, parse_settings
from spectralzoom.flows.survey_command import run_survey
from spectralzoom.pipeline.errors import SettingsError
from spectralzoom.pipeline.geometry.grid import SceneGrid, patch_pixels
from spectralzoom.pipeline.geometry.scan import Sweep
from spectralzoom.pipeline.planning.coverage import full_sweeps, reach_px
from spectralzoom.pipeline.planning.fine_pass import every_nth
from spectralzoom.pipeline.simulator.effects.pointing import PointingErrors
from spectralzoom.storage.arrays.mosaics import open_mosaic
from tests.conftest import QUIET
from tests.flows.conftest import FEW_BANDS
from tests.prior_work import without_effects

OFF_PX = 6.0
SEED = 0


@pytest.fixture(scope="module")
def surveyed(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Path]:
    """Return receipt and archive of a farm in two swaths, captured with pointing errors."""
    archive = tmp_path_factory.mktemp("pointing")
    flags = {
        "scene": "farm",
        "size": "448x256",
        "camera.samples": "384",  # two swaths
        "scan_exposure_ms": "50",
        "bands": FEW_BANDS,
        "effects": "rotation,slit,smear,vignetting,shot,read-noise",  # without blur: lines far apart are not alike
        "seed": str(SEED),
        "budget": "0.7",
        "pointing_px": str(OFF_PX),
        "out": str(archive),
        "engine": "plain",
    }
    with without_effects():
        found = run_survey(load_settings(None, flags), QUIET).receipt
    return json.loads(json.dumps(found)), archive


def test_registration_finds_the_simulated_pointing_errors(surveyed: tuple[dict[str, Any], Path]) -> None:
    """Offsets relative to the reference sweep are within 0.5 px of the simulated ones, in coarse and fine passes."""
    pointing = surveyed[0]["pointing"]
    errors = PointingErrors(OFF_PX, SEED)
    coarse = pointing["coarse"]
    assert len(coarse["sweeps"]) > 1
    for name, offset in coarse["sweeps"].items():
        assert np.abs(errors.offset(name) - errors.offset(coarse["held"]) - offset).max() < 0.5
    assert coarse["residual_rms_px"] is None  # at most as many windows as unknowns: the residual means nothing
    told = {
        name: offset for name, offset in pointing["fine"]["sweeps"].items() if name not in pointing["fine"]["not_found"]
    }
    assert told
    for name, offset in told.items():
        assert np.abs(errors.offset(name) - errors.offset(coarse["held"]) - offset).max() < 0.5


def test_partly_seen_patches_are_counted(surveyed: tuple[dict[str, Any], Path]) -> None:
    """Each pass has its row in the findings."""
    receipt, archive = surveyed
    detail = open_mosaic(archive / receipt["products"]["mosaic"])
    kinds, number = detail.captures() or ([], np.zeros(detail.shape))
    unseen = patch_pixels(SceneGrid(*detail.shape, 16), np.array([step == 4 for _, step, _ in kinds])[number])
    unseen = unseen[json.loads((archive / receipt["products"]["plan"]).read_text())["patch_index"]]
    assert receipt["pointing"]["fine"]["partly_seen"] == np.count_nonzero(unseen.any(axis=(1, 2)))
    rows = dict(finding_rows(surveyed[0]))
    assert all("corrected by up to" in rows[f"pointing, {name}"] for name in ("coarse", "fine"))


def found_of(**told: Any) -> dict[str, Any]:
    """Return the part of a receipt about the pointing of a coarse pass."""
    nothing = {"held": "a", "sweeps": {"a": [0.0, 0.0]}, "residual_rms_px": None, "not_found": [], "too_narrow": []}
    return {"pointing": {"prior_px": 5.0, "coarse": {**nothing, **told}}}


TOLD: dict[str, tuple[dict[str, Any], str]] = {
    "put right": (
        {"sweeps": {"a": [0, 0], "b": [3, -4]}, "residual_rms_px": 0.123},
        "corrected by up to 5.0 px; residual rms 0.12 px",
    ),
    "none found": (
        {"held": "the mosaic", "sweeps": {"b": [0, 0]}, "not_found": ["b"]},
        "corrected by up to 0.0 px; not found b",
    ),
    "partly seen": (
        {"sweeps": {"a": [0, 0], "b": [3, -4]}, "too_narrow": [{}], "partly_seen": 7},
        "corrected by up to 5.0 px; 1 overlap too narrow to compare; partly seen 7",
    ),
}


@pytest.mark.parametrize("case", TOLD)
def test_findings_on_pointing_are_one_sentence(case: str) -> None:
    """Corrections, residuals, sweeps not found, narrow overlaps and partly seen patches each appear once."""
    told, words = TOLD[case]
    assert finding_rows(found_of(**told)) == [("pointing, coarse", words)]


GRID = SceneGrid(300, 1500, 16)
OFF = 20.0


def shared_px(sweeps: list[Sweep]) -> float:
    """Return the smallest overlap of neighbouring swaths [px]."""
    camera = parse_settings({}).camera
    reach = [one.swath_px + reach_px(one.swath_px, GRID.height, camera, one.binning) for one in sweeps]
    return min(float(left[1] - right[0]) for left, right in pairwise(reach))


def test_both_passes_have_overlap_and_margin_for_pointing_errors() -> None:
    """Neighbours with the largest errors still share 64 px, and both ends of the field are captured."""
    plan = PassLayout.of(parse_settings({"pointing_px": OFF, "budget": 1.0}), GRID).plan(1.0)
    assert plan.along == "x"
    assert plan.margin_px == 2 * OFF
    assert shared_px(plan.coarse) >= 2 * OFF + 64 * 4 - 1e-3
    assert shared_px(plan.full) >= 2 * OFF + 64 - 1e-3
    assert len(plan.full) == int(np.ceil(1500 / (640 - 2 * OFF - 64)))
    for sweep in (*plan.coarse, *plan.full):
        held = sweep.held_px()
        assert held[0, 0] <= -GRID.height / 2 - 2 * OFF
        assert held[-1, -1] >= GRID.height / 2 + 2 * OFF


def test_zero_pointing_error_adds_no_overlap() -> None:
    """Margins and findings are absent too; an overlap of a whole line is refused with the largest allowed error."""
    settings = parse_settings({"budget": 1.0})
    plan = PassLayout.of(settings, GRID).plan(None if settings.plain else settings.budget)
    assert plan.full == full_sweeps(GRID, settings.camera, plan.along)
    assert plan.coarse == every_nth(full_sweeps(GRID, settings.camera, plan.along))
    with pytest.raises(SettingsError, match=r"^--pointing-px 192: .* overlap by 640 px .* give less than 192$"):
        PassLayout.of(parse_settings({"pointing_px": 192.0}), GRID).plan(1.0)
    assert finding_rows(found_of(held="the mosaic", sweeps={})) == []
