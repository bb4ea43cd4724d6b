"""The other orientation: the same seconds, its own coarse pass, and the sentence."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.camera import LineCamera
from pipeline.coverage import coarse_sweeps
from pipeline.crop_rows import CropRows
from pipeline.grid import SceneGrid
from pipeline.orientation import compare_orientations
from pipeline.planning import plan_fine
from pipeline.scan import CostModel

CAMERA, COST = LineCamera(), CostModel()
GRID = SceneGrid(640, 640, 32, 4)


def row_of_seats() -> np.ndarray:
    """Worth in one row of seats from end to end."""
    scores = np.zeros(GRID.seat_shape)
    scores[7] = 1.0
    return scores.ravel()


def test_lines_along_the_worth_show_more_of_it():
    """A row of seats is one short run for lines along it, and a scan of the whole field for lines across."""
    report = compare_orientations(GRID, CAMERA, COST, "y", row_of_seats(), budget_s=20.0)
    assert report.other.worth_share == 1.0
    assert report.other.fine_lines == 35
    assert report.taken.worth_share < 0.5
    assert report.sentence.startswith("lines lie along y and show ")
    assert "along x they would show 100.0% in the same time" in report.sentence


def test_both_have_the_same_seconds():
    """What the other coarse pass takes more, its fine pass has less."""
    grid = SceneGrid(300, 1280, 32, 4)
    scores = np.random.default_rng(0).exponential(size=int(np.prod(grid.seat_shape)))
    report = compare_orientations(grid, CAMERA, COST, "x", scores, budget_s=30.0)
    whole = COST.seconds(coarse_sweeps(grid, CAMERA, "x"), CAMERA) + 30.0
    assert report.taken.coarse_s < whole
    assert report.other.coarse_s != report.taken.coarse_s
    assert report.other.coarse_s + report.other.fine_s <= whole


def test_a_plan_made_already_is_not_made_again():
    """The plan that is handed in is the one reported."""
    plan = plan_fine(GRID, CAMERA, COST, "y", row_of_seats(), budget_s=20.0)
    report = compare_orientations(GRID, CAMERA, COST, "y", row_of_seats(), budget_s=5.0, plan=plan)
    assert (report.taken.fine_s, report.taken.fine_lines) == (plan.seconds, plan.lines)


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        (None, "fine, here 18.3 s"),
        (CropRows(None, 0.02), "the field shows no crop rows"),
        (CropRows(88.0, 0.3), "crop rows run at 88 deg, nearest to y (strength 0.30)"),
    ],
)
def test_rows_are_named(rows: CropRows | None, words: str):
    """The sentence ends with the rows where they were looked for."""
    sentence = compare_orientations(GRID, CAMERA, COST, "y", row_of_seats(), budget_s=20.0, rows=rows).sentence
    assert (words in sentence) if rows else ("crop rows" not in sentence)


def test_no_time_for_the_other_coarse_pass_is_said():
    """A field that the other orientation scans in more strips can leave its coarse pass unaffordable."""
    grid = SceneGrid(200, 641, 32, 4)
    report = compare_orientations(grid, CAMERA, COST, "y", np.ones(int(np.prod(grid.seat_shape))), budget_s=0.0)
    turned = compare_orientations(grid, CAMERA, COST, "x", np.ones(int(np.prod(grid.seat_shape))), budget_s=0.0)
    without = next(each for each in (report, turned) if each.other is None)
    assert "the coarse pass alone takes" in without.sentence


def test_scores_without_worth_have_no_share():
    """Nothing wanted, nothing shown: a share would be 0 over 0."""
    report = compare_orientations(GRID, CAMERA, COST, "x", np.zeros(400), budget_s=9.0)
    assert report.taken.worth_share is None
    assert "show none of the score" in report.sentence
