"""Labels of every file type become class indices; values that are no class are reported and counted."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
import skimage
from PIL import Image

from spectralzoom.pipeline.errors import SceneError
from spectralzoom.storage.readers.labels import DEFAULT_COLOURS, class_colours, load_labels, map_values

COLOURS = {"soil": (0, 0, 0), "crop": (0, 255, 0), "weed": (255, 0, 0)}


def test_colours_become_indices(tmp_path: Path) -> None:
    """An exact colour gives the position of its class in the table."""
    index = np.random.default_rng(0).integers(0, 3, (5, 6))
    Image.fromarray(np.array(list(COLOURS.values()), np.uint8)[index]).save(tmp_path / "a.png")
    found = load_labels(tmp_path / "a.png", (5, 6), classes=COLOURS)
    np.testing.assert_array_equal(found.index, index)
    assert found.names == ("soil", "crop", "weed")
    assert found.colours.tolist() == [[0, 0, 0], [0, 255, 0], [255, 0, 0]]


def test_an_unknown_colour_is_counted(tmp_path: Path) -> None:
    """The error names the colour and its number of pixels, unless it means unlabelled."""
    image = np.zeros((4, 4, 3), np.uint8)
    image[0, :3] = 9
    Image.fromarray(image).save(tmp_path / "a.png")
    with pytest.raises(SceneError, match=r"3 px of colour \[9, 9, 9\], which is no class"):
        load_labels(tmp_path / "a.png", (4, 4), classes=COLOURS)
    assert (load_labels(tmp_path / "a.png", (4, 4), classes=COLOURS, unlabelled=(9, 9, 9)).index == 255).sum() == 3


@pytest.mark.parametrize("ending", ["npy", "mat", "png"])
def test_numbers_become_indices(tmp_path: Path, ending: str) -> None:
    """Numbers of a .npy, .mat or grey PNG give indices; the unlabelled number gives 255."""
    codes = np.array([[0, 7, 3], [3, 3, 7]], np.uint8)
    path = tmp_path / f"a.{ending}"
    if ending == "npy":
        np.save(path, codes)
    elif ending == "mat":
        scipy.io.savemat(path, {"m": codes})
    else:
        Image.fromarray(codes).save(path)
    found = load_labels(path, (2, 3), classes={"seven": 7, "three": 3}, unlabelled=0)
    assert found.index.tolist() == [[255, 0, 1], [1, 1, 0]]


def test_a_palette_gives_indices(tmp_path: Path) -> None:
    """An indexed PNG gives its indices; classes that are colours refuse it."""
    image = Image.new("P", (2, 2))
    image.putpalette([0, 0, 0, 0, 255, 0, 255, 0, 0])
    image.putdata([0, 1, 2, 1])
    image.save(tmp_path / "a.png")
    classes = {"soil": 0, "crop": 1, "weed": 2}
    assert load_labels(tmp_path / "a.png", (2, 2), classes=classes).index.tolist() == [[0, 1], [2, 1]]
    with pytest.raises(SceneError, match=r"have numbers, and .classes. or unlabelled has colours"):
        load_labels(tmp_path / "a.png", (2, 2), classes=COLOURS)


@pytest.mark.parametrize(("classes", "unlabelled_px"), [({}, 2), (COLOURS, 1)])
def test_transparent_pixels_are_unlabelled_unless_stated(
    tmp_path: Path, classes: dict[str, tuple[int, int, int]], unlabelled_px: int
) -> None:
    """A note counts them; a transparent pixel with a colour of [classes] has that class."""
    colours = [[(0, 0, 0, 0), (0, 255, 0, 255)], [(9, 9, 9, 0), (255, 0, 0, 255)]]
    Image.fromarray(np.array(colours, np.uint8)).save(tmp_path / "a.png")
    found = load_labels(tmp_path / "a.png", (2, 2), classes=classes)
    assert int((found.index == 255).sum()) == unlabelled_px
    assert f"{unlabelled_px} px of the label file are transparent" in found.notes[0]


def test_classes_are_found_where_none_are_stated(tmp_path: Path) -> None:
    """Each value becomes a class named after its number; NaN stays unlabelled."""
    np.save(tmp_path / "a.npy", np.array([[1.0, 5.0], [np.nan, 5.0]]))
    found = load_labels(tmp_path / "a.npy", (2, 2), classes={})
    assert found.names == ("class_1", "class_5")
    assert found.index.tolist() == [[0, 1], [255, 1]]
    assert len(set(DEFAULT_COLOURS)) == len(DEFAULT_COLOURS) >= 64


@pytest.mark.parametrize(
    ("values", "numbers"), [((6, 0, 254), (6, 0, 254)), ((0, 255), ()), ((1, 300), ()), (((0, 0, 0), (9, 9, 9)), ())]
)
def test_maps_have_label_values_where_a_byte_holds_all(values: Any, numbers: tuple[int, ...]) -> None:
    """255 is no class in maps, and colours are no numbers: then maps count from 0."""
    assert map_values(values) == numbers


def test_a_note_says_where_maps_cannot_have_the_labels_values(tmp_path: Path) -> None:
    """A label above 254 does not fit the byte of a map."""
    np.save(tmp_path / "a.npy", np.array([[1, 300]]))
    found = load_labels(tmp_path / "a.npy", (1, 2), classes={})
    assert found.values == (1, 300)
    assert found.notes == ("maps number the classes from 0, as a label is not 0 to 254",)


def test_class_colours_are_distinct() -> None:
    """Stated colours and those of the file win; others get the default colours that are free, in their order."""
    colours = class_colours({str(number): number for number in range(8)})
    lab = skimage.color.rgb2lab(colours[:, None])[:, 0]
    assert np.linalg.norm(lab[:, None] - lab[None], axis=-1)[~np.eye(8, dtype=bool)].min() >= 15
    assert len({tuple(colour) for colour in class_colours(dict.fromkeys(map(str, range(64)), 1)).tolist()}) == 64
    first, second = map(list, DEFAULT_COLOURS[:2])
    found = class_colours({"a": 1, "b": 2, "c": 3}, {"b": DEFAULT_COLOURS[0]}).tolist()
    assert found[:2] == [second, first]
    assert class_colours({"water": (9, 9, 9)}).tolist() == [[9, 9, 9]]


@pytest.mark.parametrize("classes", [{}, {"grass": 1, "soil": 5}, {"lost": -1, "grass": 1, "soil": 5}])
def test_negative_values_are_unlabelled_unless_stated(tmp_path: Path, classes: dict[str, int]) -> None:
    """NaN is always unlabelled."""
    np.save(tmp_path / "a.npy", np.array([[-1.0, 5.0], [np.nan, 1.0]]))
    found = load_labels(tmp_path / "a.npy", (2, 2), classes=classes)
    assert (found.index == 255).tolist() == [["lost" not in classes, False], [True, False]]
    assert any("negative" in note for note in found.notes) == ("lost" not in classes)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (
            np.zeros((3, 2)),
            "are 3 x 2 px, the scene is 2 x 3 px .*its sides are exchanged: turn the labels or the picture",
        ),
        (np.zeros((3, 3)), r"are 3 x 3 px, the scene is 2 x 3 px \(y x x\); give labels"),
        (np.full((2, 3), np.inf), "huge numbers"),
        (np.full((2, 3), 1e20), "huge numbers"),
    ],
)
def test_labels_that_do_not_fit_are_refused(tmp_path: Path, values: Any, words: str) -> None:
    """The message says where only the sides are exchanged."""
    np.save(tmp_path / "a.npy", values)
    with pytest.raises(SceneError, match=words):
        load_labels(tmp_path / "a.npy", (2, 3), classes={})


def test_the_orientation_tag_of_labels_is_named(tmp_path: Path) -> None:
    """Labels are turned as pictures are: a note says so, and the refusal of their size."""
    (exif := Image.Exif())[274] = 6
    Image.fromarray(np.array([[1, 2, 3], [1, 2, 3]], np.uint8)).save(tmp_path / "a.png", exif=exif)
    found = load_labels(tmp_path / "a.png", (3, 2), classes={})
    assert found.index.tolist() == [[0, 0], [1, 1], [2, 2]]
    assert "its orientation tag 6" in found.notes[0]
    with pytest.raises(SceneError, match=r"sides are exchanged.*orientation tag 6"):
        load_labels(tmp_path / "a.png", (2, 3), classes={})


@pytest.mark.parametrize(
    ("pixel", "unlabelled", "words"),
    [
        ((0, 120, 0), None, r"have colours, and \[classes\] or unlabelled has numbers"),  # no packed number
        (0, 1, "value 1 as unlabelled and as class soil"),
    ],
)
def test_classes_that_labels_cannot_have_are_refused(tmp_path: Path, pixel: Any, unlabelled: Any, words: str) -> None:
    """Labels in colours cannot have numbered classes, and a class cannot have the unlabelled number."""
    Image.fromarray(np.full((2, 2, np.size(pixel)), pixel, np.uint8).squeeze()).save(tmp_path / "a.png")
    with pytest.raises(SceneError, match=words):
        load_labels(tmp_path / "a.png", (2, 2), classes={"soil": 1}, unlabelled=unlabelled)
