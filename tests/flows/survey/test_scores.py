"""Scores read from receipts of any age, and what is said of single classes."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flows.survey.scores import definitions_differ, false_class_words, score_of, worst_class
from models.evaluation.metrics import agreement, confusion, iou_per_class, mean_iou, miou_of_shown_classes
from tests.flows.publish.test_receipt import make_receipt

NAMES = ("soil", "crop", "weed", "track")
MAP = st.lists(st.integers(0, 3), min_size=24, max_size=24)


def _before(truth: list[int], *maps: list[int]) -> tuple[dict[str, Any], float]:
    """The accuracy of a receipt of before, of this map, none and all; and what this map scores now."""
    found = []
    for drawn in maps:
        counts = confusion(np.array(truth), np.array(drawn), 4)
        shown = counts.sum(axis=0) + counts.sum(axis=1) > 0
        iou = np.where(shown, np.nan_to_num(iou_per_class(counts)), np.nan)
        per_class = {name: None if np.isnan(one) else float(one) for name, one in zip(NAMES, iou, strict=True)}
        found.append({"miou": miou_of_shown_classes(counts), "per_class_iou": per_class, "overall_accuracy": 0.5})
    now = mean_iou(confusion(np.array(truth), np.array(maps[0]), 4))
    return {**found[0], "none": found[1], "all": found[2]}, now


@given(st.lists(st.integers(0, 2), min_size=24, max_size=24), MAP, MAP, MAP)
def test_an_older_receipt_scores_as_it_would_now_or_not_at_all(
    truth: list[int], this: list[int], none: list[int], every: list[int]
):
    """Its mean is taken over the classes of the truth, as far as its three maps tell which these are."""
    accuracy, now = _before(truth, this, none, every)
    found = score_of({"accuracy": accuracy})["miou"]
    maps = [accuracy["per_class_iou"], accuracy["none"]["per_class_iou"], accuracy["all"]["per_class_iou"]]
    unclear = any(all(one[name] == 0 for one in maps) for name in NAMES)
    assert (found is None) if unclear else found == pytest.approx(now)


def test_a_receipt_of_now_gives_its_own_figures():
    """Both figures as they stand there."""
    assert score_of(make_receipt()) == {"miou": 0.75, "overall_accuracy": 0.934}


@pytest.mark.parametrize("accuracy", [None, 3, {}, {"miou": "x"}, {"per_class_iou": [1], "none": 2, "all": None}])
def test_what_was_not_judged_has_no_score(accuracy: object):
    """No labels, or a receipt that somebody has damaged."""
    assert score_of({"accuracy": accuracy}) == {"miou": None, "overall_accuracy": None}
    assert score_of({}) == {"miou": None, "overall_accuracy": None}


def test_the_worst_class_is_one_of_the_truth():
    """A false class has no IoU and cannot be it; nothing judged has none."""
    accuracy: Any = copy.deepcopy(make_receipt()["accuracy"])
    assert worst_class(accuracy) == ("bare_weed", 0.2, 0.6, 0.8)
    accuracy["per_class_iou"] = {"wheat": None}
    assert worst_class(accuracy) is None


def test_false_classes_are_told_of_every_map():
    """Each map that shows one is named, with the pixels of each class."""
    accuracy: Any = copy.deepcopy(make_receipt()["accuracy"])
    accuracy["none"]["false_classes"] = {"wheat": 30, "bare_track": 1}
    words = "Shown although the truth has none: this survey wheat 2 px; none wheat 30 px, bare track 1 px."
    assert false_class_words(accuracy) == words
    accuracy["false_classes"] = accuracy["none"]["false_classes"] = {}
    assert false_class_words(accuracy) == ""


@given(MAP, MAP)
def test_definitions_differ_where_a_map_shows_a_false_class(truth: list[int], drawn: list[int]):
    """And nowhere else, to the last bit; a receipt of before, which has one definition, has no other."""
    counts = confusion(np.array(truth), np.array(drawn), 4)
    figures = agreement(counts)
    expected = figures["miou"] > 0 and not set(drawn) <= set(truth)
    assert definitions_differ([figures]) == expected
    assert not definitions_differ([{"miou": figures["miou"]}])
