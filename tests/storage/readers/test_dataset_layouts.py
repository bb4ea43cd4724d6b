"""Frames of HyKo2 and RANUS, in small files made as public programs that read the sets expect them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
from numpy.typing import NDArray
from PIL import Image

from pipeline.errors import SceneError
from storage.readers.labels import HYKO_CLASSES, HYKO_LABELS, RANUS_CLASSES
from storage.readers.scene_files import load_scene_file

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
