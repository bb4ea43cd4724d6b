"""Confusion counts, and the scores computed from them."""

from __future__ import annotations

from unittest import mock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from spectralzoom.models.evaluation import metrics
from spectralzoom.pipeline.errors import ShapeError

PAIRS = st.lists(st.tuples(st.sampled_from([0, 1, 2, 3, 255]), st.integers(0, 3)), max_size=60)


def _maps(pairs: list[tuple[int, int]]) -> tuple[np.ndarray, np.ndarray]:
    both = np.array(pairs, np.uint8).reshape(-1, 2)
    return both[:, 0], both[:, 1]


@given(PAIRS, st.integers(0, 60))
def test_counts_of_parts_add_up(pairs: list[tuple[int, int]], cut: int):
    """Counts of a map are the sum of its parts' counts, and their total is the number of labelled pixels."""
    labels, drawn = _maps(pairs)
    whole = metrics.confusion(labels, drawn, 4)
    parts = metrics.confusion(labels[:cut], drawn[:cut], 4) + metrics.confusion(labels[cut:], drawn[cut:], 4)
    assert (whole == parts).all()
    with mock.patch.object(metrics, "PIXELS_AT_ONCE", 7):
        assert (metrics.confusion(labels, drawn, 4) == whole).all()
    assert whole.sum() == np.count_nonzero(labels != 255)


@given(PAIRS, st.permutations(range(4)))
def test_renumbering_classes_changes_no_mean(pairs: list[tuple[int, int]], names: list[int]):
    """The IoU of the classes is permuted; mIoU, accuracies and kappa stay."""
    labels, drawn = _maps(pairs)
    renamed = np.append(names, [255] * 252).astype(np.uint8)
    before, after = metrics.confusion(labels, drawn, 4), metrics.confusion(renamed[labels], renamed[drawn], 4)
    assert metrics.iou_per_class(after)[names] == pytest.approx(metrics.iou_per_class(before), nan_ok=True)
    for mean in (metrics.mean_iou, metrics.overall_accuracy, metrics.average_accuracy, metrics.kappa):
        assert mean(after) == pytest.approx(mean(before), nan_ok=True)


@given(PAIRS)
def test_iou_is_that_of_pixel_sets(pairs: list[tuple[int, int]]):
    """The IoU of a class is the intersection of its two pixel sets over their union; without a label it is NaN."""
    labels, drawn = _maps(pairs)
    labels, drawn = labels[labels != 255], drawn[labels != 255]
    for number, iou in enumerate(metrics.iou_per_class(metrics.confusion(labels, drawn, 4))):
        both, either = ((labels == number) & (drawn == number)).sum(), ((labels == number) | (drawn == number)).sum()
        assert iou == pytest.approx(both / either if (labels == number).any() else np.nan, nan_ok=True)


def test_scores_of_six_pixels_are_those_worked_out_by_hand():
    """Four pixels are right; IoU is 2/3, 1/3 and 1/2, and kappa is half of the agreement that chance leaves."""
    counts = metrics.confusion(np.array([0, 0, 1, 1, 2, 2]), np.array([0, 0, 1, 0, 2, 1]), 3)
    assert counts.tolist() == [[2, 0, 0], [1, 1, 0], [0, 1, 1]]
    assert metrics.iou_per_class(counts) == pytest.approx([2 / 3, 1 / 3, 1 / 2])
    assert metrics.agreement(counts) == pytest.approx({"miou": 0.5, "overall_accuracy": 2 / 3})
    assert metrics.average_accuracy(counts) == pytest.approx(2 / 3)
    assert metrics.kappa(counts) == pytest.approx((2 / 3 - 1 / 3) / (2 / 3))


def test_kappa_is_0_for_agreement_by_chance():
    """A perfect map has kappa 1, and a single class has none."""
    assert metrics.kappa(np.outer([30, 70], [40, 60])) == pytest.approx(0)
    assert metrics.kappa(np.diag([3, 4])) == 1
    assert np.isnan(metrics.kappa(np.array([[5, 0], [0, 0]])))


LABELLED = st.lists(st.tuples(st.integers(0, 2), st.integers(0, 4)), min_size=1, max_size=60)  # classes 3, 4: false


@given(LABELLED, st.lists(st.tuples(st.booleans(), st.integers(0, 4)), min_size=60, max_size=60))
def test_better_in_every_class_is_better_in_the_mean(pairs: list[tuple[int, int]], spoilt: list[tuple[bool, int]]):
    """A map that is at least as good in every class has no lower mIoU, whatever false classes either map shows."""
    labels, better = _maps(pairs)
    touched, to = (np.array(column)[: len(labels)] for column in zip(*spoilt, strict=True))
    false = ~np.isin(better, labels)
    worse = np.where(touched & ((better == labels) | (false & (to != labels))), to, better)
    one, other = metrics.confusion(labels, better, 5), metrics.confusion(labels, worse, 5)
    held = metrics.labelled_classes(one)
    assert (metrics.iou_per_class(one)[held] >= metrics.iou_per_class(other)[held]).all()
    assert metrics.mean_iou(one) >= metrics.mean_iou(other) - 1e-12


@given(LABELLED, st.data())
def test_false_pixels_lower_only_their_own_class(pairs: list[tuple[int, int]], data: st.DataObject):
    """The mIoU falls by their fraction of their class, divided by the number of classes; false classes count them."""
    labels, _ = _maps(pairs)
    drawn = labels.copy()
    stray = data.draw(st.lists(st.integers(0, len(labels) - 1), unique=True))
    drawn[stray] = data.draw(st.sampled_from([3, 4]))
    present = np.unique(labels)
    lost = sum(np.isin(np.flatnonzero(labels == number), stray).mean() for number in present)
    counts = metrics.confusion(labels, drawn, 5)
    assert metrics.mean_iou(counts) == pytest.approx(1 - lost / len(present))
    assert metrics.false_pixels(counts)[3:].sum() == metrics.false_pixels(counts).sum() == len(stray)


@pytest.mark.parametrize("kind", [np.uint8, np.int16, np.int64])
def test_maps_of_any_integer_type_are_counted(kind: type):
    """Classes up to 254 do not overflow their type."""
    labels = np.array([254, 200, 255 if kind is np.uint8 else 3, 254]).astype(kind)
    assert metrics.confusion(labels, np.array([254, 200, 3, 200], np.uint8), 255)[254].sum() == 2


def test_a_map_of_another_size_is_refused():
    """The error names both sizes."""
    with pytest.raises(ShapeError, match=r"labels are \(2, 3\), the class map is \(3, 2\)"):
        metrics.confusion(np.zeros((2, 3), int), np.zeros((3, 2), int), 2)


def test_calibration_error_compares_confidence_with_accuracy():
    """An error of 0.8 in 10 of 40 pixels gives 0.2; counts of two maps add up; without a pixel the error is NaN."""
    nine = np.full(10, 0.9)
    right = np.arange(10) < 9
    assert metrics.calibration_error(metrics.confidence_counts(nine, right)) == pytest.approx(0, abs=1e-12)
    assert metrics.calibration_error(metrics.confidence_counts(nine, ~right)) == pytest.approx(0.8)
    assert metrics.calibration_error(metrics.confidence_counts(np.array([0.0, 1.0]), np.array([False, True]))) == 0
    both = metrics.confidence_counts(nine, ~right) + metrics.confidence_counts(np.full(30, 0.5), np.arange(30) < 15)
    assert metrics.calibration_error(both) == pytest.approx(0.8 * 10 / 40)
    assert np.isnan(metrics.calibration_error(metrics.confidence_counts(np.empty(0), np.empty(0, bool))))
