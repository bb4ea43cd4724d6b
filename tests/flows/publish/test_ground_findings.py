"""What receipts say of the ground: hectares by age and by change, and the words for them."""

from __future__ import annotations

from typing import Any

import numpy as np

from flows.publish.findings import changed_hectares, ground_words, older_hectares
from pipeline.geometry.grid import UNLABELLED
from pipeline.ground.field_places import NoPlace
from storage.arrays.class_maps import ClassMap

PLACE = NoPlace((2, 4), pixel_m=10.0)  # a hundredth of a hectare a pixel
GROUND: dict[str, Any] = {"crs": "EPSG:32632", "resolution_m": 0.12, "areas_ha": {"bare_soil": 1.0, "weed": 0.0}}


def test_hectares_are_older_than_days_and_not_as_old() -> None:
    """A look of exactly so many days ago is not longer ago; what was never looked at is of no age."""
    age = np.array([[0.0, 1.0, 1.125, 7.0], [7.125, 30.0, 400.0, np.nan]], np.float32)
    found = older_hectares(PLACE, age)
    np.testing.assert_allclose([found[days] for days in ("1", "7", "30")], [0.05, 0.03, 0.01])


def test_changed_hectares_are_told_from_class_to_class() -> None:
    """Largest first; a pixel without a class today, as outside of zones, counts nothing."""
    now = np.array([[0, 0, 1, 1], [2, UNLABELLED, 2, 2]], np.uint8)
    old = np.array([[1, 255, 0, 0], [0, 0, 255, 255]], np.uint8)
    names = "soil", "crop", "unknown", *(f"class_{number}" for number in range(3, 16))  # a pair is 255, too
    legend = names, np.zeros((16, 3), np.uint8)
    found = changed_hectares(PLACE, old, ClassMap(now, np.ones(now.shape, np.float32), *legend))
    assert [(round(area, 6), *pair) for area, *pair in found] == [
        (0.02, "soil", "crop"),
        (0.01, "soil", "unknown"),
        (0.01, "crop", "soil"),
    ]


def test_words_tell_what_changed_and_what_is_old() -> None:
    """From which class to which, with hectares; days with what is older. Small areas are in square metres."""
    later = {"changes_ha": [[0.5, "crop", "bare_soil"], [0.0004, "weed", "crop"]], "older_ha": {"1": 0.25, "7": 0.0}}
    words = ground_words(GROUND | later)
    assert "the classes cover bare soil 1 ha." in words
    assert "Of it 0.5 ha changed since the look before: crop to bare soil 0.5 ha, weed to crop 4 m²." in words
    assert words.endswith("Last looked at: 0.25 ha more than 1 day ago.")


def test_a_first_look_has_no_words_of_change() -> None:
    """Nor has a receipt of an earlier version, which knows of no ages."""
    fresh = {"older_ha": {"1": 0.0, "7": 0.0, "30": 0.0}}
    assert ground_words(GROUND) == ground_words(GROUND | fresh)
    assert ground_words(GROUND).endswith("the classes cover bare soil 1 ha.")
