"""Boundary IoU: what lies near borders, and how that of two maps agrees."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from models.evaluation.metrics import (
    boundary_counts,
    boundary_iou,
    boundary_px,
    confusion,
    labelled_classes,
    mean_boundary_iou,
    near_border,
)
from pipeline.errors import ShapeError

MAPS = arrays(np.uint8, (7, 9), elements=st.sampled_from([0, 1, 2, 255]))


@given(MAPS, st.integers(1, 4))
def test_the_border_is_within_its_width(region: np.ndarray, width: int):
    """A pixel is kept exactly when a pixel outside the region, or the edge, is within the width (chessboard)."""
    inside = region == 1
    framed = np.pad(inside, width)
    slow = [
        [inside[y, x] and not framed[y : y + 2 * width + 1, x : x + 2 * width + 1].all() for x in range(9)]
        for y in range(7)
    ]
    assert near_border(inside, width).tolist() == slow


@given(MAPS)
def test_a_perfect_map_agrees_at_every_border(labels: np.ndarray):
    """The IoU of a class with itself is 1; a class that is not there has none."""
    present = np.array([(labels == number).any() for number in range(3)])
    iou = boundary_iou(boundary_counts(labels, np.where(labels == 255, 0, labels), 3), present)
    assert (iou[present] == 1).all()
    assert np.isnan(iou[~present]).all()


def test_a_worked_case():
    """A block of 4 x 4 moved by one column: rings of 12 px, 6 px in both, 18 in either."""
    labels, drawn = np.zeros((10, 10), np.uint8), np.zeros((10, 10), np.uint8)
    labels[3:7, 3:7], drawn[3:7, 4:8] = 1, 1
    counts = boundary_counts(labels, drawn, 2, width=1)
    assert counts[1].tolist() == [6, 18]
    assert boundary_iou(counts, counts[:, 1] > 0)[1] == pytest.approx(1 / 3)


def test_only_borders_count():
    """A hole deep inside is missed with a narrow boundary where the plain IoU sees it."""
    labels = np.ones((21, 21), np.uint8)
    drawn = labels.copy()
    drawn[10, 10] = 0
    counts = boundary_counts(labels, drawn, 2, width=2)
    ring = 21**2 - 17**2
    assert counts[1].tolist() == [ring, ring + 24]  # the hole has a border of its own, 5 x 5 less itself


def test_unlabelled_pixels_do_not_count():
    """What the map says where no label is has no part in it."""
    labels = np.full((6, 6), 255, np.uint8)
    labels[:3] = 1
    drawn = np.where(labels == 255, 2, 1).astype(np.uint8)
    counts = boundary_counts(labels, drawn, 3, width=1)
    assert counts[0].tolist() == counts[2].tolist() == [0, 0]
    assert boundary_iou(counts, counts[:, 1] > 0)[1] == 1


def test_no_class_has_no_mean():
    """Nothing labelled: NaN, neither 0 nor 1."""
    empty = np.full((4, 4), 255, np.uint8)
    assert np.isnan(mean_boundary_iou(boundary_counts(empty, np.zeros((4, 4), np.uint8), 2), np.zeros(2, bool)))


@given(MAPS, MAPS, st.integers(1, 3))
def test_a_false_class_adds_nothing_to_the_mean(labels: np.ndarray, drawn: np.ndarray, width: int):
    """The mean is over the classes that the labels have: showing class 3, which they never have, is only a miss."""
    known = np.minimum(drawn, 2)
    labelled = labelled_classes(confusion(labels, known, 4))
    means = [
        mean_boundary_iou(boundary_counts(labels, np.where(known == 2, number, known), 4, width), labelled)
        for number in (2, 3)
    ]
    if (labels == 2).any():
        assert means[1] <= means[0] + 1e-12
    else:
        assert means[1] == pytest.approx(means[0], nan_ok=True)


@pytest.mark.parametrize(("shape", "width"), [((3, 4), 1), ((300, 400), 10), ((966, 1296), 32)])
def test_the_width_follows_the_diagonal(shape: tuple[int, int], width: int):
    """Two percent of the diagonal, a pixel at least."""
    assert boundary_px(shape) == width


def test_maps_of_other_sizes_are_refused():
    """The message names both sizes."""
    with pytest.raises(ShapeError, match=r"labels are \(2, 3\), the class map is \(3, 2\)"):
        boundary_counts(np.zeros((2, 3), int), np.zeros((3, 2), int), 2)
