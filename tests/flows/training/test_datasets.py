"""Data sets: names of scenes, held-out scenes, and the split of one scene by a mask."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import scipy.io
from PIL import Image

from spectralzoom.flows.training.data import load_data_set
from spectralzoom.pipeline.errors import SceneError
from tests.flows.small_fields import write_field

NUMBERS = ("003", "010", "021")
MASK_TO_CLASS = (2, 3, 5, 6, 8, 10, 11, 12, 14, 1, 4, 7, 9, 13, 15, 16)


def test_scenes_are_named_by_number(tmp_path: Path) -> None:
    """Each image is a scene with its own labels; held-out scenes are listed by name."""
    data = load_data_set(write_field(tmp_path, names=NUMBERS), hold_out=["010"])
    assert tuple(data.files) == NUMBERS
    assert data.held_out == ("010",)
    scene = data.load("010")
    assert scene.labels is not None
    np.testing.assert_array_equal(scene.values, np.asarray(Image.open(tmp_path / "images" / "010_image.png")))
    np.testing.assert_array_equal(scene.labels, scene.values[..., 1] > 100)


def test_all_scenes_cannot_be_held_out(tmp_path: Path) -> None:
    """Holding out all three scenes would leave none to train on."""
    write_field(tmp_path, names=NUMBERS)
    with pytest.raises(SceneError, match="leaves none to train on"):
        load_data_set(tmp_path, hold_out=NUMBERS)


def test_a_mask_splits_the_labels(tmp_path: Path) -> None:
    """Pixels outside of the mask, and those where mask and labels disagree, are not trained on."""
    np.save(tmp_path / "a.npy", np.ones((2, 3, 1)))
    np.save(tmp_path / "gt.npy", np.array([[0, 4, 9], [9, 4, 4]]))
    (tmp_path / "scene.toml").write_text(
        'wavelengths_nm = [600]\nlabels = "gt.npy"\nunlabelled = 0\n[classes]\na = 4\nb = 9\n'
    )
    scipy.io.savemat(tmp_path / "mask.mat", {"m": np.array([[1, 1, 1], [2, 0, 2]], np.uint8)})
    data = load_data_set(tmp_path / "a.npy", train_mask=tmp_path / "mask.mat", mask_classes=[9, 4])
    assert data.load("a", training=True).labels.tolist() == [[255, 255, 1], [255, 255, 0]]
    assert data.load("a").labels.tolist() == [[255, 0, 1], [1, 0, 0]]
    assert tuple(load_data_set(tmp_path, train_mask=tmp_path / "mask.mat").files) == ("a",)
    np.save(tmp_path / "binary.npy", np.array([[255, 0, 255], [0, 255, 255]], np.uint8))
    data = load_data_set(tmp_path / "a.npy", train_mask=tmp_path / "binary.npy")
    assert data.load("a", training=True).labels.tolist() == [[255, 255, 1], [255, 0, 0]]


@pytest.mark.parametrize(
    ("mask", "classes", "words"),
    [
        (2, [9], "goes up to 2, but only 1 mask classes"),
        (2, [9, 5], r"class 5 is none of the labels' \[4, 9\]"),
        (2**40, None, r"class 1 is none of the labels' \[4, 9\]"),
        (2, [9, 4], "the class of the labels in 0% of its pixels; give mask classes"),
    ],
)
def test_masks_that_do_not_fit_are_refused(tmp_path: Path, mask: int, classes: list[int] | None, words: str) -> None:
    """Too few mask classes, classes that the labels lack or have elsewhere, and stray numbers are refused."""
    np.save(tmp_path / "a.npy", np.ones((1, 2, 1)))
    np.save(tmp_path / "gt.npy", np.array([[4, 9]]))
    np.save(tmp_path / "mask.npy", np.array([[1, mask]]))
    (tmp_path / "scene.toml").write_text('wavelengths_nm = [600]\nlabels = "gt.npy"')
    chosen = {} if classes is None else {"mask_classes": classes}
    data = load_data_set(tmp_path / "a.npy", train_mask=tmp_path / "mask.npy", **chosen)  # type: ignore[arg-type]
    with pytest.raises(SceneError, match=words):
        data.load("a", training=True)


def test_indian_pines_splits_by_the_disjoint_mask(real_data: Path) -> None:
    """5,528 of the 10,249 labelled pixels are for training."""
    folder = real_data / "indian_pines"
    mask = folder / "indianpines_disjoint_dset.mat"
    data = load_data_set(folder / "Indian_pines_corrected.npy", train_mask=mask, mask_classes=MASK_TO_CLASS)
    (name,) = data.files
    labelled = [np.asarray(data.load(name, training=part).labels) != 255 for part in (True, False)]
    assert [np.count_nonzero(one) for one in labelled] == [5528, 10249]
