"""Controls: the rows of other placements, and what they say of the gap."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from models.evaluation.metrics import agreement, confusion, mean_iou
from models.evaluation.placement import RANDOM_DRAWS, Controls, run_controls
from models.reading.inference import Glance, glance_of_columns, segment
from models.weights.files import Weights
from pipeline.geometry.grid import SceneGrid

Maker = Callable[..., Weights]


def _scene(height: int = 30, width: int = 45) -> tuple[Glance, np.ndarray, np.ndarray]:
    grid, rng = SceneGrid(height, width, 8, 2), np.random.default_rng(2)
    y, x = grid.padded_shape
    fine = rng.normal(0, 1, (y // 8 * (x // 8), 8, 8, 4)).astype(np.float32)
    labels = rng.integers(0, 3, (height, width)).astype(np.uint8)
    labels[:3] = 255
    return Glance(grid, rng.normal(0, 1, (y // 2, x // 2, 4)).astype(np.float32), np.empty(0)), fine, labels


def _run(weights: Weights, share: float = 0.35, seed: int = 0) -> Controls:
    seen, fine, labels = _scene()
    glimpse = glance_of_columns(weights, seen.columns, seen.grid)
    return run_controls(weights, glimpse, fine, labels, share=share, seed=seed)


def test_every_row_counts_every_labelled_pixel(tiny: Maker):
    """Each placement draws the whole scene, with as many seats as the share of the valid ones says."""
    controls = _run(tiny())
    rows = [controls.none, controls.every, *controls.policies.values(), *controls.random]
    assert {int(row.sum()) for row in rows} == {27 * 45}
    assert controls.seats == round(0.35 * 4 * 6)
    assert list(controls.policies) == ["gain", "entropy", "sobel"]
    assert len(controls.random) == RANDOM_DRAWS


def test_the_ends_do_not_depend_on_the_share(tiny: Maker):
    """A share of 0 is the row of no seat, a share of 1 the row of every seat, whatever the policy."""
    weights = tiny()
    none, every = _run(weights, 0.0), _run(weights, 1.0)
    assert all((row == none.none).all() for row in [*none.policies.values(), *none.random])
    for row in [*every.policies.values(), *every.random]:
        assert np.abs(row - every.every).sum() <= 2  # a tie may fall either way
    assert (none.every == every.every).all()


def test_rows_are_those_of_the_survey(tiny: Maker):
    """No seat and every seat are the maps that a survey draws with them."""
    weights, (seen, fine, labels) = tiny(), _scene()
    seats = seen.grid.valid_seats()
    drawn = segment(weights, glance_of_columns(weights, seen.columns, seen.grid), fine[seats], seats)
    assert (_run(weights).every == confusion(labels, drawn.classes, 3)).all()


def test_random_rows_follow_the_seed(tiny: Maker):
    """Equal seeds draw equal placements, other seeds others, and the draws of one run differ."""
    weights = tiny()
    first, same, other = (np.array(_run(weights, seed=seed).random) for seed in (1, 1, 2))
    assert (first == same).all()
    assert (first != other).any()
    assert (first[0] != first[1]).any()


def test_rows_are_reported_as_they_start(tiny: Maker):
    """A progress bar hears of each row by name."""
    weights, (seen, fine, labels) = tiny(), _scene()
    said: list[str] = []
    run_controls(
        weights,
        glance_of_columns(weights, seen.columns, seen.grid),
        fine,
        labels,
        share=0.1,
        seed=0,
        policies=("entropy",),
        report=said.append,
    )
    assert said == ["none", "all", "entropy"] + ["random"] * RANDOM_DRAWS


def _counts(right: int) -> np.ndarray:
    return np.array([[right, 100 - right], [100 - right, right]])


def test_figures_of_a_worked_case():
    """Both means and the pixels' accuracy, the share of the gap, and mean and spread of the random placements."""
    controls = Controls(
        0.35, 10, _counts(60), _counts(90), {"entropy": _counts(80)}, [_counts(62), _counts(66), _counts(64)]
    )
    rows = controls.as_dict()
    none, every, entropy = (mean_iou(_counts(right)) for right in (60, 90, 80))
    closed = (entropy - none) / (every - none)
    assert rows["entropy"] == {**agreement(_counts(80)), "spread": None, "gap_closed": closed}
    draws = [mean_iou(_counts(right)) for right in (62, 66, 64)]
    figures = {"miou": np.mean(draws), "miou_of_shown_classes": np.mean(draws), "overall_accuracy": 0.64}
    closed = (np.mean(draws) - none) / (every - none)
    assert rows["random"] == pytest.approx({**figures, "spread": np.std(draws, ddof=1), "gap_closed": closed})


def test_one_draw_has_no_spread_and_a_small_gap_no_share():
    """What cannot be said is None."""
    rows = Controls(0.35, 10, _counts(60), _counts(60), {"sobel": _counts(61)}, [_counts(60)]).as_dict()
    assert rows["random"] == {**agreement(_counts(60)), "spread": None, "gap_closed": None}
    assert rows["sobel"] == {**agreement(_counts(61)), "spread": None, "gap_closed": None}


def test_a_stray_class_does_not_move_the_gap():
    """All rows are of one set of classes: a false class in one of the ends leaves the share of the gap as it is."""
    stray, clean = np.zeros((3, 3), np.int64), np.zeros((3, 3), np.int64)
    stray[:2, :2] = clean[:2, :2] = _counts(80)
    stray[0, 1:] = [19, 1]  # a wrong pixel that shows what the labels lack
    none, every = np.zeros((3, 3), np.int64), np.zeros((3, 3), np.int64)
    none[:2, :2], every[:2, :2] = _counts(60), _counts(90)
    shares = [Controls(0.35, 10, none, every, {"gain": one}, [none]).as_dict()["gain"] for one in (clean, stray)]
    assert shares[0]["miou_of_shown_classes"] > shares[1]["miou_of_shown_classes"] + 0.2
    assert shares[1]["gap_closed"] == pytest.approx(shares[0]["gap_closed"], abs=0.01)
