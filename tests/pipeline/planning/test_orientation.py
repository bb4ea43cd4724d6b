"""Crop rows of known directions, and the other orientation: the same seconds, its own coarse pass, the sentence."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.errors import ShapeError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import CostModel
from pipeline.planning.coverage import coarse_sweeps, with_margin
from pipeline.planning.fine_pass import plan_fine
from pipeline.planning.orientation import CropRows, compare_orientations, find_rows


def sine_rows(angle_deg: float, period: float, noise: float, shape: tuple[int, int] = (200, 256)) -> np.ndarray:
    """Sine rows along an angle from x towards y, with noise of the same size."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    across = y * np.cos(np.deg2rad(angle_deg)) - x * np.sin(np.deg2rad(angle_deg))
    return np.sin(2 * np.pi * across / period) + noise * np.random.default_rng(1).normal(size=shape)


@settings(max_examples=30, deadline=None)
@given(st.floats(0, 179.9), st.floats(4, 9))
def test_the_direction_of_rows_is_found(angle: float, period: float):
    """Within four degrees, at any angle and from four pixels apart, with noise half as strong as the rows."""
    found = find_rows(sine_rows(angle, period, 0.5))
    assert found.angle_deg is not None
    assert abs((found.angle_deg - angle + 90) % 180 - 90) < 4


def test_gaps_weeds_and_missing_pixels_do_not_matter():
    """Half of the rows gone, a bright track across them and NaN pixels leave the direction."""
    image = sine_rows(30.0, 6.0, 0.3)
    rng = np.random.default_rng(2)
    image[rng.random(image.shape) < 0.05] = np.nan
    image[40:90, 100:200] = rng.normal(size=(50, 100))
    image[:, 60:64] += 40.0
    found = find_rows(image)
    assert found.angle_deg == pytest.approx(30.0, abs=3)
    assert found.nearest_axis == "x"


@pytest.mark.parametrize("seed", range(5))
def test_noise_has_no_rows(seed: int):
    """White noise points anywhere."""
    found = find_rows(np.random.default_rng(seed).normal(size=(120, 150)))
    assert (found.angle_deg, found.nearest_axis) == (None, None)
    assert found.strength < 0.1


@pytest.mark.parametrize(
    "image",
    [
        np.ones((60, 60)),
        np.full((60, 60), np.nan),
        np.zeros((1, 1)),
        np.zeros((0, 5)),
        np.zeros((1, 40)),
        sine_rows(30.0, 6.0, 0.1, (12, 40)),
    ],
    ids=["flat", "nan", "one pixel", "empty", "one row", "three tiles"],
)
def test_nothing_to_see_is_none(image: np.ndarray):
    """A flat, unknown or tiny picture has no rows and strength 0."""
    assert find_rows(image) == CropRows(None, 0.0)


def test_one_border_between_fields_is_no_row():
    """A step across an otherwise even picture speaks for its own tiles alone."""
    image = np.random.default_rng(0).normal(size=(200, 240))
    image[90:] += 30.0
    assert find_rows(image).angle_deg is None


@pytest.mark.parametrize("seed", [0, 5])
def test_plots_with_rows_every_which_way_have_no_common_direction(seed: int):
    """Strong rows that plots do not agree on are none of the field's, even where their mean is not small."""
    turns = np.random.default_rng(seed).uniform(0, 180, 4)
    found = find_rows(np.block([[sine_rows(turn, 6.0, 0.3, (40, 40)) for turn in turns] for _ in range(3)]))
    assert found.strength > 0.12
    assert found.angle_deg is None


def test_a_trace_of_rows_is_too_little():
    """Rows deep below the noise, though all tiles agree on them, are not reported."""
    assert find_rows(sine_rows(30.0, 6.0, 3.0, (300, 350))).angle_deg is None


@pytest.mark.parametrize(("angle", "axis"), [(0, "x"), (44.5, "x"), (46, "y"), (90, "y"), (134.5, "y"), (136, "x")])
def test_the_nearest_axis(angle: float, axis: str):
    """Rows up to 45 deg from x count as along x."""
    assert CropRows(float(angle), 0.5).nearest_axis == axis


def test_cubes_are_refused():
    """One image is asked for, not bands."""
    with pytest.raises(ShapeError, match=r"one \(y, x\) image, got shape \(4, 4, 3\)"):
        find_rows(np.zeros((4, 4, 3)))


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
    assert report.sentence.startswith("with camera lines down the picture the fine sweeps show ")
    assert "; with lines across the picture they would show 100.0 % in no more time (" in report.sentence


def test_both_have_the_same_seconds():
    """What the other coarse pass takes more, its fine pass has less."""
    grid = SceneGrid(300, 1280, 32, 4)
    scores = np.random.default_rng(0).exponential(size=int(np.prod(grid.seat_shape)))
    report = compare_orientations(grid, CAMERA, COST, "x", scores, budget_s=30.0)
    whole = COST.seconds(coarse_sweeps(grid, CAMERA, "x"), CAMERA) + 30.0
    assert report.taken.coarse_s < whole
    assert report.other.coarse_s != report.taken.coarse_s
    assert report.other.coarse_s + report.other.fine_s <= whole


def test_what_a_threshold_left_is_left_in_either_orientation():
    """Where one run of lines pays, the other orientation is compared for the seconds spent, not for those allowed."""
    scores = row_of_seats() + 0.001
    report = compare_orientations(GRID, CAMERA, COST, "x", scores, budget_s=40.0, threshold=0.5)
    assert 0 < report.taken.fine_s < 10
    assert report.other.coarse_s + report.other.fine_s <= report.taken.coarse_s + report.taken.fine_s


@pytest.mark.parametrize("more", [{"overlap_px": 300}, {"margin_px": 40}])
def test_overlaps_and_margins_of_the_coarse_pass_are_paid_for(more: dict[str, int]):
    """The coarse seconds of either orientation are those of strips that overlap, or begin earlier, by as much."""
    grid = SceneGrid(700, 1280, 32, 4)
    scores = np.zeros(int(np.prod(grid.seat_shape)))
    report = compare_orientations(grid, CAMERA, COST, "x", scores, budget_s=60.0, **more)
    for one in (report.taken, report.other):
        sweeps = coarse_sweeps(grid, CAMERA, one.along, overlap_px=more.get("overlap_px", 0))
        assert one.coarse_s == COST.seconds(with_margin(sweeps, CAMERA, more.get("margin_px", 0)), CAMERA)
        assert one.coarse_s > COST.seconds(coarse_sweeps(grid, CAMERA, one.along), CAMERA)


def test_a_plan_made_already_is_not_made_again():
    """The plan that is handed in is the one reported."""
    plan = plan_fine(GRID, CAMERA, COST, "y", row_of_seats(), budget_s=20.0)
    report = compare_orientations(GRID, CAMERA, COST, "y", row_of_seats(), budget_s=5.0, plan=plan)
    assert (report.taken.fine_s, report.taken.fine_lines) == (plan.seconds, plan.lines)


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        (None, "fine, here 18.3 s"),
        (CropRows(None, 0.02), "; no crop rows are seen"),
        (CropRows(88.0, 0.3), "; crop rows run down the picture, to within 2 degrees"),
        (CropRows(100.5, 0.3), "; crop rows run down the picture, to within 11 degrees"),
        (CropRows(170.0, 0.3), "; crop rows run across the picture, to within 10 degrees"),
        (CropRows(0.0, 0.3), "; crop rows run across the picture, to within 0 degrees"),
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
    assert "the picture it could not be done: the coarse pass alone takes" in without.sentence


def test_scores_without_worth_have_no_share():
    """Nothing wanted, nothing shown: a share would be 0 over 0."""
    report = compare_orientations(GRID, CAMERA, COST, "x", np.zeros(400), budget_s=9.0)
    assert report.taken.worth_share is None
    assert report.sentence == "no place is worth a second look"
