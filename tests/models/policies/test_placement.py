"""The gain oracle, the gain of placements relative to it, and the rows of other placements."""

from __future__ import annotations

import math

import numpy as np
import pytest

from models.evaluation.metrics import agreement, confusion, mean_iou
from models.policies import placement
from models.reading.inference import coarse_prediction_of_columns, segment
from models.weights.files import Weights
from pipeline.geometry.grid import SceneGrid
from tests.models.conftest import make_weights, scene_columns


def _two_classes(height: int = 24, width: int = 32):
    weights = make_weights(classes=2)
    coarse_pass, fine = scene_columns(weights, height, width)
    seen = coarse_prediction_of_columns(weights, coarse_pass.columns, coarse_pass.grid)
    labels = np.random.default_rng(0).integers(0, 2, (height, width)).astype(np.uint8)
    return weights, coarse_pass.grid, seen, fine, labels


def test_oracle_gain_is_the_loss_that_patches_remove():
    """With two classes a map's confidence gives its loss: the gain is the overview's loss less the full map's."""
    weights, grid, seen, fine, labels = _two_classes()

    def loss(patch_index: np.ndarray) -> np.ndarray:
        drawn = segment(weights, seen, fine[patch_index], patch_index)
        right = np.where(drawn.classes == labels, drawn.confidence, 1 - drawn.confidence)
        full = np.zeros(grid.padded_shape)
        full[: grid.height, : grid.width] = -np.log(right.astype(np.float64))
        rows, columns = grid.patch_shape
        return full.reshape(rows, 8, columns, 8).mean(axis=(1, 3)).ravel()

    expected = loss(np.empty(0, np.intp)) - loss(grid.every_patch())
    assert placement.oracle_gain(weights, seen, fine, labels) == pytest.approx(expected, abs=1e-4)


def test_an_unlabelled_patch_has_no_gain():
    """A patch without a labelled pixel has a gain of exactly 0, and no gain exceeds 5."""
    weights, _, seen, fine, labels = _two_classes(20, 30)
    labels[:8, :8] = 255
    gain = placement.oracle_gain(weights, seen, fine, labels)
    assert gain[0] == 0
    assert gain.any()
    assert (np.abs(gain) <= 5).all()


def _scene(weights: Weights) -> placement.ReadTwice:
    coarse_pass, _ = scene_columns(weights, 30, 45)
    labels = np.random.default_rng(2).integers(0, 3, (30, 45)).astype(np.uint8)
    labels[:3] = 255
    seen = coarse_prediction_of_columns(weights, coarse_pass.columns, coarse_pass.grid)
    return placement.ReadTwice.of(weights, seen, labels)


def _run(weights: Weights, fraction: float = 0.35, seed: int = 0) -> placement.Placements:
    return placement.run_controls(_scene(weights), weights.config.classes, fraction=fraction, seed=seed)


def test_mixing_two_maps_equals_segmenting_the_patches():
    """A patch's pixels do not depend on which other patches are read, so both give the same counts."""
    weights = make_weights()
    coarse_pass, _ = scene_columns(weights, 30, 45)
    seen = coarse_prediction_of_columns(weights, coarse_pass.columns, coarse_pass.grid)
    scene = _scene(weights)
    some = np.random.default_rng(4).random(seen.grid.patch_shape) < 0.5
    index = np.flatnonzero(some)
    drawn = segment(weights, seen, seen.patches(index), index)
    expected = confusion(scene.labels, drawn.classes, weights.config.classes)
    assert (scene.overview != scene.full).any()
    np.testing.assert_array_equal(scene.counts(some, weights.config.classes), expected)


def test_every_row_counts_every_labelled_pixel():
    """Each placement segments the whole scene; the random one does so several times."""
    rows = _run(make_weights())
    assert {int(counts.sum()) for draws in rows.values() for counts in draws} == {27 * 45}
    assert list(rows) == ["none", "all", "gain", "entropy", "sobel", "random"]
    assert len(rows["random"]) == placement.RANDOM_DRAWS


def test_random_rows_follow_the_seed():
    """Equal seeds draw equal placements, other seeds others, and the draws of one run differ."""
    weights = make_weights()
    first, same, other = (np.array(_run(weights, seed=seed)["random"]) for seed in (1, 1, 2))
    assert (first == same).all()
    assert (first != other).any()
    assert (first[0] != first[1]).any()


def _counts(right: int) -> np.ndarray:
    return np.array([[right, 100 - right], [100 - right, right]])


def test_placement_figures_are_those_worked_out_by_hand():
    """The figures are mIoU, accuracy, the closed fraction of the gap, and mean and spread of the random draws."""
    draws = [_counts(62), _counts(66), _counts(64)]
    rows = {"none": [_counts(60)], "all": [_counts(90)], "entropy": [_counts(80)], "random": draws}
    figures = placement.placement_figures(rows)
    none, every, entropy = (mean_iou(_counts(right)) for right in (60, 90, 80))
    closed = (entropy - none) / (every - none)
    assert figures["entropy"] == {**agreement(_counts(80)), "spread": None, "gap_closed": closed}
    drawn = [mean_iou(one) for one in draws]
    closed = (np.mean(drawn) - none) / (every - none)
    expected = {"miou": np.mean(drawn), "overall_accuracy": 0.64, "spread": np.std(drawn, ddof=1), "gap_closed": closed}
    assert figures["random"] == pytest.approx(expected)


def test_one_draw_has_no_spread_and_a_small_gap_no_fraction():
    """Figures that cannot be computed are None."""
    one = [_counts(60)]
    rows = placement.placement_figures({"none": one, "all": one, "sobel": [_counts(61)], "random": one})
    assert rows["random"] == {**agreement(_counts(60)), "spread": None, "gap_closed": None}
    assert rows["sobel"] == {**agreement(_counts(61)), "spread": None, "gap_closed": None}


FOUR = np.array([[0.6, 0.3], [0.05, 0.0]])


def _four_patches() -> placement.ReadTwice:
    """Return four patches of 2 px: the overview is wrong on all but the last, the full network on the last."""
    labels = np.repeat(np.repeat(np.array([[0, 1], [1, 0]], np.uint8), 2, 0), 2, 1)
    overview, full = 1 - labels, labels.copy()
    overview[2:, 2:], full[2:, 2:] = 0, 1
    return placement.ReadTwice(overview, full, {"gain": FOUR}, labels, SceneGrid(4, 4, 2))


def test_chosen_patches_are_read_in_full() -> None:
    """Two patches are read and become right; the third stays wrong, and the last is right by the overview."""
    np.testing.assert_array_equal(_four_patches().counts(FOUR >= 0.3, 2), [[8, 0], [4, 4]])


def test_reading_every_patch_includes_what_gets_worse() -> None:
    """The last patch is right by the overview, and wrong by the full network."""
    np.testing.assert_array_equal(_four_patches().counts(np.ones((2, 2), np.bool_), 2), [[4, 4], [0, 8]])


def test_cascade_table_has_losses_and_fractions() -> None:
    """Losses are relative to reading everything; leaving out a patch that a full reading spoils is a negative loss."""
    table = placement.CascadeTable.judged([_four_patches()], 2)
    assert table.least_gain == placement.LEAST_GAINS
    assert table.fraction[0] == 0.75
    assert table.fraction[-1] == 0.25
    assert table.loss[0] < 0 < table.loss[-1]


@pytest.mark.parametrize(
    ("loss", "gain", "fraction"),
    [(0.0, 0.02, 0.5), (0.1, math.sqrt(0.02 * 0.03), 0.4), (0.2, 0.03, 0.3), (1.0, 0.04, 0.1)],
)
def test_cascade_table_finds_the_highest_gain_within_a_loss(loss: float, gain: float, fraction: float) -> None:
    """Gain and fraction are interpolated by the logarithm of the gain; below the least loss there is none."""
    table = placement.CascadeTable((0.01, 0.02, 0.03, 0.04), (-0.1, 0.0, 0.2, 0.3), (0.9, 0.5, 0.3, 0.1))
    assert table.within(loss) == pytest.approx(gain)
    assert table.fraction_at(gain) == pytest.approx(fraction)
    assert table.within(-0.5) is None


def test_a_worse_row_ends_the_search() -> None:
    """Noise of few scenes must not select a higher gain behind it."""
    found = placement.CascadeTable((0.01, 0.02, 0.03), (0.0, 0.5, 0.1), (0.9, 0.5, 0.3)).within(0.2)
    assert found is not None
    assert 0.01 < found < 0.02
