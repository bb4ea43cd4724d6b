"""Maps mixed from two readings of a scene, and the losses of reading a part of it."""

from __future__ import annotations

import math
from dataclasses import asdict

import numpy as np
import pytest

from spectralzoom.models.evaluation.metrics import confusion
from spectralzoom.models.policies import placement
from spectralzoom.models.reading.inference import coarse_prediction_of_columns, segment
from spectralzoom.models.weights.files import Weights
from spectralzoom.pipeline.geometry.grid import SceneGrid
from tests.models.conftest import make_weights, scene_columns


def _scene(weights: Weights) -> placement.ReadTwice:
    coarse_pass, _ = scene_columns(weights, 30, 45)
    labels = np.random.default_rng(2).integers(0, 3, (30, 45)).astype(np.uint8)
    labels[:3] = 255
    seen = coarse_prediction_of_columns(weights, coarse_pass.columns, coarse_pass.grid)
    return placement.ReadTwice.of(weights, seen, labels)


def test_mixing_two_maps_equals_segmenting_the_patches():
    """A patch's pixels do not depend on which other patches are read, so both give the same counts."""
    weights = make_weights()
    coarse_pass, _ = scene_columns(weights, 30, 45)
    seen = coarse_prediction_of_columns(weights, coarse_pass.columns, coarse_pass.grid)
    scene = _scene(weights)
    some = np.random.default_rng(4).random(len(seen.grid.every_patch())) < 0.5
    index = np.flatnonzero(some)
    drawn = segment(weights, seen, seen.patches(index), index)
    expected = confusion(scene.labels, drawn.classes, weights.config.classes)
    assert (scene.overview != scene.full).any()
    np.testing.assert_array_equal(scene.counts(some, weights.config.classes), expected)


FOUR = np.array([0.6, 0.3, 0.05, 0.0])


def _four_patches() -> placement.ReadTwice:
    """Return four patches of 2 px: the overview is wrong on all but the last, the full network on the last."""
    labels = np.repeat(np.repeat(np.array([[0, 1], [1, 0]], np.uint8), 2, 0), 2, 1)
    overview, full = 1 - labels, labels.copy()
    overview[2:, 2:], full[2:, 2:] = 0, 1
    return placement.ReadTwice(overview, full, FOUR, labels, SceneGrid(4, 4, 2))


def test_chosen_patches_are_read_in_full() -> None:
    """Two patches become right, the third stays wrong; the last is right by the overview and wrong in full."""
    np.testing.assert_array_equal(_four_patches().counts(FOUR >= 0.3, 2), [[8, 0], [4, 4]])
    np.testing.assert_array_equal(_four_patches().counts(np.ones(4, np.bool_), 2), [[4, 4], [0, 8]])


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
    assert table.fractions_at(gain) == pytest.approx([fraction] * 3)
    assert table.within(-0.5) is None


def test_a_worse_row_ends_the_search() -> None:
    """Noise of few scenes must not select a higher gain behind it."""
    found = placement.CascadeTable((0.01, 0.02, 0.03), (0.0, 0.5, 0.1), (0.9, 0.5, 0.3)).within(0.2)
    assert found is not None
    assert 0.01 < found < 0.02


def test_cascade_table_keeps_the_range_of_its_scenes() -> None:
    """Three scenes of 1, 2 and 4 patches above 0.2 give their median, fewest and most; a record keeps all columns."""
    none = np.zeros((2, 8), np.uint8)
    gains = [np.where(np.arange(4) < count, 0.3, 0.0) for count in (2, 4, 1)]
    scenes = [placement.ReadTwice(none, none, gain, none, SceneGrid(2, 8, 2)) for gain in gains]
    table = placement.CascadeTable.read(asdict(placement.CascadeTable.judged(scenes, 2)))
    assert table.fractions_at(0.2) == pytest.approx([0.5, 0.25, 1.0])
    assert table.fractions_at(0.45) == [0, 0, 0]
