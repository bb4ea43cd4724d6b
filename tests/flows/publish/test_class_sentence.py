"""The sentence on the classes of a field: areas, places, and changes since the visit before."""

from __future__ import annotations

import numpy as np
import pytest
from affine import Affine
from odc.geo.geobox import GeoBox

from spectralzoom.flows.publish.class_sentence import class_sentence, main_places

NAMES = ("crop", "weed", "soil", "tree")


def classes_of_a_field() -> np.ndarray:
    """Return a map with weed at the top right, soil in the middle, trees everywhere, and pixels without a class."""
    classes = np.zeros((40, 80), np.uint8)
    classes[2:8, 60:78] = 1
    classes[15:25, 30:50] = 2
    classes[::10, ::10] = 3
    classes[-1] = 255
    return classes


@pytest.mark.parametrize(
    ("affine", "crs", "weed"),
    [
        (None, None, "at the top right"),
        (Affine(1, 0, 5e5, 0, -1, 5e6), "EPSG:32632", "in the north-east"),
        (Affine(1, 0, 5e5, 0, 1, 5e6), "EPSG:32632", "in the south-east"),  # rows go north
        (Affine(0, 1, 5e5, 1, 0, 5e6), "EPSG:32632", "in the north-west"),  # rows go east
        (Affine(1, 0, 0, 0, -1, 0), "EPSG:3031", "at the top right"),  # both axes of this map point north
    ],
)
def test_places_are_those_of_the_picture_or_of_the_compass(affine: Affine | None, crs: str | None, weed: str) -> None:
    """Classes that are spread over the field have no place."""
    classes = classes_of_a_field()
    geobox = None if affine is None else GeoBox(classes.shape, affine, crs)
    assert main_places(classes, NAMES, geobox) == {"weed": weed, "soil": "in the middle"}
    assert main_places(np.full((3, 3), 255, np.uint8), NAMES, geobox) == {}


@pytest.mark.parametrize(
    ("areas", "words"),
    [
        (
            {"px": {"crop": 1}, "ha": {"crop": 3.7, "weed": 0.12, "tree": 0.15, "soil": 0.03}, "place": {"weed": "in"}},
            "Soil 300 m² (0.8 % of the field); weed 0.12 ha (3.0 %), mostly in; tree 0.15 ha (3.8 %); "
            "largest: crop 3.7 ha (92 %).",
        ),
        ({"px": {"bare_soil": 1999, "weed": 1, "tree": 0}}, "Bare soil 100 % of the field."),
        ({"px": {"crop": 0, "weed": 0}}, "No pixel has a class."),
    ],
)
def test_the_sentence_has_the_rarest_classes_and_the_largest(areas: dict, words: str) -> None:
    """Classes of less than 0.1 % of the field are left out; without the size of a pixel there are no areas."""
    assert class_sentence({"areas": areas}) == words


def test_a_revisit_begins_with_what_changed() -> None:
    """Changes are net, in hectares by the ground or by the size of a pixel; small ones are no change."""
    areas = {"px": {"crop": 800, "weed": 200}, "ha": {"crop": 8.0, "weed": 2.0}}
    prior = {"days": 7.0, "changes": [[60, 80, "crop", "weed"], [10, 10, "weed", "crop"]]}
    words = class_sentence({"areas": areas, "prior_map": prior})
    assert words.startswith("Since the visit 7.0 days earlier: weed +0.5 ha, now 2 ha (20 % of the field); crop -0.5")
    placed = {"areas": areas, "prior_map": prior, "ground": {"changes_ha": [[0.001, "crop", "weed"]]}}
    assert class_sentence(placed).startswith(
        "Since the visit 7.0 days earlier no class has changed. Weed 2 ha (20 % of"
    )
