"""Labels come out as class indices whatever they are stored as; what is no class is named and counted."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
from numpy.typing import NDArray
from PIL import Image

from pipeline.errors import SceneError
from storage.readers.labels import HYKO_CLASSES, HYKO_LABELS, RANUS_CLASSES, default_colour, load_labels
from storage.readers.scene_files import load_scene_file

COLOURS = {"soil": (0, 0, 0), "crop": (0, 255, 0), "weed": (255, 0, 0)}


def test_colours_become_indices(tmp_path: Path) -> None:
    """Exact colours give the class's place in the table."""
    index = np.random.default_rng(0).integers(0, 3, (5, 6))
    Image.fromarray(np.array(list(COLOURS.values()), np.uint8)[index]).save(tmp_path / "a.png")
    found = load_labels(tmp_path / "a.png", (5, 6), classes=COLOURS)
    np.testing.assert_array_equal(found.index, index)
    assert found.names == ("soil", "crop", "weed")
    assert found.colours.tolist() == [[0, 0, 0], [0, 255, 0], [255, 0, 0]]


def test_shades_of_blue_are_not_grey(tmp_path: Path) -> None:
    """Colours without red and green are themselves, stated or found, not grey values of the same number."""
    image = np.zeros((2, 3, 3), np.uint8)
    image[0, :, 2] = 255
    Image.fromarray(image).save(tmp_path / "a.png")
    stated = load_labels(tmp_path / "a.png", (2, 3), classes={"water": (0, 0, 255)}, unlabelled=(0, 0, 0))
    assert stated.index.tolist() == [[0, 0, 0], [255, 255, 255]]
    found = load_labels(tmp_path / "a.png", (2, 3), classes={}, unlabelled=(0, 0, 0))
    assert found.colours.tolist() == [[0, 0, 255]]


def test_found_colours_name_their_classes(tmp_path: Path) -> None:
    """A class found by its colour has one name in every file, whatever other colours the file holds."""
    names = []
    for number, colours in enumerate([[(200, 0, 0), (0, 200, 0), (0, 0, 200)], [(200, 0, 0), (0, 200, 0)]]):
        Image.fromarray(np.array([colours], np.uint8)).save(tmp_path / f"{number}.png")
        names.append(load_labels(tmp_path / f"{number}.png", (1, len(colours)), classes={}).names)
    assert names == [("colour_0000c8", "colour_00c800", "colour_c80000"), ("colour_00c800", "colour_c80000")]


def test_grey_values_stand_for_grey_colours(tmp_path: Path) -> None:
    """A grey image of two classes stated by colour: the value g is the colour (g, g, g)."""
    np.save(tmp_path / "a.npy", np.array([[0, 9], [9, 0]], np.uint8))
    found = load_labels(tmp_path / "a.npy", (2, 2), classes={"a": (9, 9, 9), "b": (0, 0, 0)})
    assert found.index.tolist() == [[1, 0], [0, 1]]


def test_an_unknown_colour_is_counted(tmp_path: Path) -> None:
    """A colour that is no class is named with its pixels, unless it means unlabelled."""
    image = np.zeros((4, 4, 3), np.uint8)
    image[0, :3] = 9
    Image.fromarray(image).save(tmp_path / "a.png")
    with pytest.raises(SceneError, match=r"3 px of colour \[9, 9, 9\], which is no class"):
        load_labels(tmp_path / "a.png", (4, 4), classes=COLOURS)
    found = load_labels(tmp_path / "a.png", (4, 4), classes=COLOURS, unlabelled=(9, 9, 9))
    assert (found.index == 255).sum() == 3


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


def test_a_palette_is_read_either_way(tmp_path: Path) -> None:
    """An indexed PNG gives its indices for numbered classes and its colours for coloured ones."""
    image = Image.new("P", (2, 2))
    image.putpalette([0, 0, 0, 0, 255, 0, 255, 0, 0])
    image.putdata([0, 1, 2, 1])
    image.save(tmp_path / "a.png")
    for classes in (COLOURS, {"soil": 0, "crop": 1, "weed": 2}):
        assert load_labels(tmp_path / "a.png", (2, 2), classes=classes).index.tolist() == [[0, 1], [2, 1]]


def test_classes_are_found_where_none_are_stated(tmp_path: Path) -> None:
    """Values become classes named after their number, NaN stays unlabelled."""
    np.save(tmp_path / "a.npy", np.array([[1.0, 5.0], [np.nan, 5.0]]))
    found = load_labels(tmp_path / "a.npy", (2, 2), classes={})
    assert found.names == ("class_1", "class_5")
    assert found.index.tolist() == [[0, 1], [255, 1]]
    assert len({default_colour(index) for index in range(80)}) == 80


def test_a_photograph_is_no_label_file(tmp_path: Path) -> None:
    """More than 64 colours are not taken for classes, and fractions not for numbers."""
    noise = np.random.default_rng(0).integers(0, 255, (20, 20, 3), dtype=np.uint8)
    Image.fromarray(noise).save(tmp_path / "a.png")
    with pytest.raises(SceneError, match="different colours, at most 64"):
        load_labels(tmp_path / "a.png", (20, 20), classes={})
    np.save(tmp_path / "a.npy", noise[..., 0] / 3)
    with pytest.raises(SceneError, match="fractions"):
        load_labels(tmp_path / "a.npy", (20, 20), classes={})


def test_another_size_is_refused_with_both(tmp_path: Path) -> None:
    """The message holds the labels' and the scene's size."""
    np.save(tmp_path / "a.npy", np.zeros((3, 4), int))
    with pytest.raises(SceneError, match="3 x 4 px, the scene is 4 x 3 px"):
        load_labels(tmp_path / "a.npy", (4, 3), classes={})


def test_unlabelled_cannot_be_a_class(tmp_path: Path) -> None:
    """One number cannot mean a class and no class."""
    np.save(tmp_path / "a.npy", np.zeros((3, 4), int))
    with pytest.raises(SceneError, match="value 0 is unlabelled and also class soil"):
        load_labels(tmp_path / "a.npy", (3, 4), classes={"soil": 0}, unlabelled=0)


NM = np.linspace(470, 630, 5)


def _hyko(path: Path, **more: Any) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    rng = np.random.default_rng(2)
    cube = rng.random((6, 7, 5)).astype(np.float32)
    labels = rng.integers(0, 11, (6, 7), dtype=np.uint8)
    content = {
        "data": cube,
        "wavelengths": NM[None],
        HYKO_LABELS: labels,
        "label_spectral_reflectances": labels // 2,
        "image": np.zeros((6, 7, 3), np.uint8),
        "stats": {"mean": 1.0},
        "id_spectral_reflectances": np.arange(9)[None],
    }
    scipy.io.savemat(path, {**content, **more}, long_field_names=True)
    return cube, labels


def test_hyko_frame(tmp_path: Path) -> None:
    """Cube, wavelengths and semantic labels come from one file; 0 is unlabelled."""
    cube, labels = _hyko(tmp_path / "a.mat")
    scene = load_scene_file(tmp_path / "a.mat")
    np.testing.assert_array_equal(scene.values, cube)
    np.testing.assert_allclose(scene.wavelength_nm, NM)
    assert scene.class_names == tuple(HYKO_CLASSES)
    np.testing.assert_array_equal(scene.labels, np.where(labels == 0, 255, labels - 1))
    assert any("HyKo2" in note for note in scene.provenance)


def test_hyko_materials_and_other_arrays(tmp_path: Path) -> None:
    """The labels of materials are taken when asked for, and an array that is named is read as any other."""
    _, labels = _hyko(tmp_path / "a.mat")
    scene = load_scene_file(tmp_path / "a.mat", labels=f"{tmp_path / 'a.mat'}:label_spectral_reflectances")
    assert scene.class_names == tuple(f"class_{number}" for number in np.unique(labels // 2))
    assert load_scene_file(f"{tmp_path / 'a.mat'}:image", wavelengths=[600, 500, 450]).values.shape == (6, 7, 3)


def test_hyko_frame_without_labels(tmp_path: Path) -> None:
    """Some frames of the set lack the semantic labels; wavelengths that do not fit are left out."""
    rng = np.random.default_rng(0)
    content = {"data": rng.random((4, 4, 5)), "wavelengths": NM[:4], "label_spectral_reflectances": np.ones((4, 4))}
    scipy.io.savemat(tmp_path / "a.mat", content, long_field_names=True)
    scene = load_scene_file(tmp_path / "a.mat", wavelengths=NM.tolist())
    assert scene.labels is None
    assert any("no labels" in note for note in scene.provenance)
    assert "wavelengths are left out: 4 for 5 bands" in scene.provenance


def _ranus(root: Path, *, named: bool = True) -> Path:
    rng = np.random.default_rng(4)
    endings = ("_rgb", "_nir", "_gt") if named else ("", "", "")
    truth = np.array(list(RANUS_CLASSES.values()), np.uint8)[rng.integers(0, 10, (5, 6))]
    truth[0, 0], truth[0, 1], truth[0, 2] = 0, (123, 2, 3), (1, 250, 3)  # black, almost ground, no class
    images = (rng.integers(0, 255, (5, 6, 3), dtype=np.uint8), rng.integers(0, 255, (5, 6), dtype=np.uint8), truth)
    for kind, ending, image in zip(("RGB", "NIR", "GT"), endings, images, strict=True):
        (root / kind / "01").mkdir(parents=True, exist_ok=True)
        Image.fromarray(image).save(root / kind / "01" / f"01_0001{ending}.png")
    return root / "RGB" / "01" / f"01_0001{endings[0]}.png"


@pytest.mark.parametrize("named", [True, False])
def test_ranus_frame(tmp_path: Path, named: bool) -> None:
    """Colour and near infrared are one scene of four bands; labels follow the classes' colours up to a tolerance."""
    scene = load_scene_file(_ranus(tmp_path, named=named))
    assert scene.values.shape == (5, 6, 4)
    assert scene.wavelength_nm.tolist() == [640, 550, 460, 800]
    assert scene.class_names == tuple(RANUS_CLASSES)
    assert scene.labels is not None
    assert scene.labels[0, :3].tolist() == [255, list(RANUS_CLASSES).index("ground"), 255]
    assert any("1 px of no class's colour" in note for note in scene.provenance)
    assert any("assumed" in note for note in scene.provenance)


def test_ranus_frames_depend_on_both_images(tmp_path: Path) -> None:
    """Another near-infrared image is another scene, under the same name of the colour image."""
    path = _ranus(tmp_path)
    before = load_scene_file(path).light_hash
    Image.fromarray(np.zeros((5, 6), np.uint8)).save(tmp_path / "NIR" / "01" / "01_0001_nir.png")
    assert load_scene_file(path).light_hash != before


def test_ranus_parts_missing(tmp_path: Path) -> None:
    """Without truth there are no labels, without near infrared it is an image like any other, other sizes are told."""
    path = _ranus(tmp_path)
    Image.fromarray(np.zeros((5, 7), np.uint8)).save(tmp_path / "NIR" / "01" / "01_0001_nir.png")
    with pytest.raises(SceneError, match="expected a colour and a grey image of the same pixels"):
        load_scene_file(path)
    (tmp_path / "NIR" / "01" / "01_0001_nir.png").unlink()
    assert load_scene_file(path).values.shape == (5, 6, 3)
    _ranus(tmp_path)
    (tmp_path / "GT" / "01" / "01_0001_gt.png").unlink()
    scene = load_scene_file(path)
    assert scene.labels is None
    assert any("no labels" in note for note in scene.provenance)
