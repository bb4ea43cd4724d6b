"""What reading a part of the patches in full loses."""

from __future__ import annotations

import math

import numpy as np
import pytest

from models.evaluation.placement import LEAST_GAINS, CascadeTable, ReadTwice
from pipeline.geometry.grid import SceneGrid

FOUR = np.array([[0.3, 0.03], [0.003, 0.0]])


def _scene() -> ReadTwice:
    """Four patches of 2 px: the overview is wrong on each but the last, which the full network gets wrong."""
    labels = np.repeat(np.repeat(np.array([[0, 1], [1, 0]], np.uint8), 2, 0), 2, 1)
    overview, full = 1 - labels, labels.copy()
    overview[2:, 2:], full[2:, 2:] = 0, 1
    return ReadTwice(overview, full, {"gain": FOUR}, labels, SceneGrid(4, 4, 2, 1))


def test_chosen_patches_are_read_in_full() -> None:
    """By hand: one patch is right from the overview, each other one once it is read in full."""
    np.testing.assert_array_equal(_scene().counts(FOUR >= 0.03, 2), [[8, 0], [4, 4]])


def test_everything_read_includes_what_gets_worse() -> None:
    """The last patch is right by the overview, and wrong by the full network."""
    np.testing.assert_array_equal(_scene().counts(np.ones((2, 2), np.bool_), 2), [[4, 4], [0, 8]])


def test_losses_stand_beside_fractions() -> None:
    """Relative to everything read; the patch that a full reading spoils is better left alone."""
    table = CascadeTable.judged([_scene()], 2)
    assert table.least_gain == LEAST_GAINS
    assert table.fraction[0] == 0.75
    assert table.fraction[-1] == 0.25
    assert table.loss[0] < 0 < table.loss[-1]


@pytest.mark.parametrize(
    ("loss", "wanted"),
    [(0.0, (0.02, 0.5)), (0.1, (math.sqrt(0.02 * 0.03), 0.4)), (0.2, (0.03, 0.3)), (1.0, (0.04, 0.1)), (-0.5, None)],
)
def test_the_highest_gain_within_a_loss(loss: float, wanted: tuple[float, float] | None) -> None:
    """Between two rows by the logarithm of the gain; none beyond the last."""
    table = CascadeTable((0.01, 0.02, 0.03, 0.04), (-0.1, 0.0, 0.2, 0.3), (0.9, 0.5, 0.3, 0.1))
    assert table.within(loss) == (wanted if wanted is None else pytest.approx(wanted))


def test_a_worse_row_ends_the_search() -> None:
    """Noise of few scenes does not open a higher gain behind it."""
    found = CascadeTable((0.01, 0.02, 0.03), (0.0, 0.5, 0.1), (0.9, 0.5, 0.3)).within(0.2)
    assert found is not None
    assert 0.01 < found[0] < 0.02
