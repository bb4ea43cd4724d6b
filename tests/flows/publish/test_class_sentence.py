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


PLACES = {
    (0, 0): "at the top left",
    (0, 1): "at the top",
    (0, 2): "at the top right",
    (1, 0): "on the left",
    (1, 1): "in the middle",
    (1, 2): "on the right",
    (2, 0): "at the bottom left",
    (2, 1): "at the bottom",
    (2, 2): "at the bottom right",
}


def place_of(weed: np.ndarray, data: np.ndarray | None = None) -> str:
    """Return the place of weed (y, x) in crop, in words; pixels without ``data`` have no class."""
    classes = np.where(weed, 1, 0).astype(np.uint8)
    if data is not None:
        classes[~data] = 255
    return main_places(classes, NAMES, None).get("weed", "")


def blob(shape: tuple[int, int], y: float, x: float, size: float) -> np.ndarray:
    """Return a disc at fractions of the height and width, whose diameters are fractions of them."""
    down, across = ((np.arange(side) + 0.5) / side for side in shape)
    return np.hypot(down[:, None] - y, across - x) <= size / 2


@pytest.mark.parametrize("shape", [(90, 90), (60, 240), (300, 45), (11, 13)])
@pytest.mark.parametrize(("row", "column"), PLACES)
def test_each_of_nine_places_has_its_words(shape: tuple[int, int], row: int, column: int) -> None:
    """Clumps of several sizes at the middle of each ninth, also beside it, and with 1 % elsewhere."""
    for size, y, x in ((0.15, 0, 0), (0.3, 0, 0), (0.25, 0.05, -0.05)):
        weed = blob(shape, (row + 0.5) / 3 + y, (column + 0.5) / 3 + x, size)
        assert place_of(weed) == PLACES[row, column], (size, y, x)
        weed[-1, -1] = True
        if weed.sum() > 50:
            assert place_of(weed) == PLACES[row, column], (size, y, x)


@pytest.mark.parametrize("width", [0.05, 0.2, 0.3])
@pytest.mark.parametrize("shape", [(80, 80), (40, 160), (200, 50)])
def test_bands_along_an_edge_have_its_words(shape: tuple[int, int], width: float) -> None:
    """A band through the middle has no place."""
    down, across = np.indices(shape) / np.array(shape)[:, None, None]
    found = [place_of(one) for one in (down < width, down >= 1 - width, across < width, across >= 1 - width)]
    assert found == ["at the top", "at the bottom", "on the left", "on the right"]
    assert place_of(abs(down - 0.5) < width / 2) == place_of(abs(across - 0.5) < width / 2) == ""


@pytest.mark.parametrize(
    "kind", ["everywhere", "scattered", "ring", "diagonal", "cross", "corners", "two clumps", "angle", "stripes", "bow"]
)
@pytest.mark.parametrize("shape", [(96, 96), (48, 180)])
def test_a_class_without_one_place_has_no_words(kind: str, shape: tuple[int, int]) -> None:
    """It is spread, or lies in clumps far apart, wherever its centre of area is."""
    down, across = (np.indices(shape) + 0.5) / np.array(shape)[:, None, None]
    edge = np.minimum(np.minimum(down, 1 - down), np.minimum(across, 1 - across))
    weed = {
        "everywhere": np.ones(shape, np.bool_),
        "scattered": np.random.default_rng(1).random(shape) < 0.1,
        "ring": edge < 0.1,
        "diagonal": abs(down - across) < 0.1,
        "cross": (abs(down - 0.5) < 0.05) | (abs(across - 0.5) < 0.05),
        "corners": (abs(down - 0.5) > 0.4) & (abs(across - 0.5) > 0.4),
        "two clumps": blob(shape, 0.2, 0.2, 0.2) | blob(shape, 0.8, 0.8, 0.2),
        "angle": (down < 0.12) | (across < 0.12),
        "stripes": np.floor(across * 12) % 2 == 0,
        "bow": (across < 0.15) | (across > 0.85),
    }[kind]
    assert place_of(weed) == ""


def test_two_clumps_on_one_side_share_its_words() -> None:
    """So do a large clump and a small one far away from it."""
    shape = (90, 120)
    assert place_of(blob(shape, 0.15, 0.15, 0.2) | blob(shape, 0.15, 0.85, 0.2)) == "at the top"
    assert place_of(blob(shape, 0.2, 0.85, 0.2) | blob(shape, 0.8, 0.85, 0.2)) == "on the right"
    assert place_of(blob(shape, 0.2, 0.2, 0.3) | blob(shape, 0.8, 0.8, 0.12)) == "at the top left"


@pytest.mark.parametrize(("row", "column"), PLACES)
def test_places_are_those_within_the_data(row: int, column: int) -> None:
    """The data are a part at the bottom right of the scene, with a hole."""
    data, weed = np.zeros((120, 200), np.bool_), np.zeros((120, 200), np.bool_)
    data[60:, 110:], data[62:66, 112:116] = True, False
    weed[60:, 110:] = blob((60, 90), (row + 0.5) / 3, (column + 0.5) / 3, 0.25)
    assert place_of(weed, data) == PLACES[row, column]


@pytest.mark.parametrize(
    ("shape", "rows", "columns", "words"),
    [
        ((1, 1), slice(None), slice(None), ""),
        ((1, 90), slice(None), slice(0, 9), "on the left"),
        ((1, 90), slice(None), slice(40, 50), "in the middle"),
        ((90, 1), slice(80, 90), slice(None), "at the bottom"),
        ((2, 200), slice(0, 1), slice(None), "at the top"),
        ((2, 2), slice(1, 2), slice(1, 2), "at the bottom right"),
    ],
)
def test_narrow_fields_have_places_along_their_length(
    shape: tuple[int, int], rows: slice, columns: slice, words: str
) -> None:
    """A field of one pixel has none."""
    weed = np.zeros(shape, np.bool_)
    weed[rows, columns] = True
    assert place_of(weed) == words


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
