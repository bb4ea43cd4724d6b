"""Training data: labelled scenes in both looks, and random crops of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from torch import Tensor

from models.network.spectral import SpectralBasis
from models.training import examples
from models.training.examples import CropSampler, Example, observe
from pipeline.errors import SceneError
from pipeline.geometry.camera import LineCamera, expose, footprint
from pipeline.geometry.grid import SceneGrid
from pipeline.simulator.scenes.scene import RasterScene, SceneRaster, raster_from_values

CAMERA = LineCamera(bits=14)
NM = np.linspace(450, 950, 6)


def _scene(shape: tuple[int, int] = (40, 50), camera: LineCamera = CAMERA) -> RasterScene:
    rng = np.random.default_rng(1)
    labels = rng.integers(0, 3, shape, dtype=np.uint8)
    values = (rng.uniform(0.2, 0.8, (*shape, 6)) + labels[..., None]).astype(np.float32)
    return raster_from_values(values, camera, name="s", wavelength_nm=NM, labels=labels, class_names=("a", "b", "c"))


def _observed(scene: RasterScene, camera: LineCamera = CAMERA, seed: int = 0) -> Example:
    basis = SpectralBasis.spanning(NM)
    return observe(scene, camera, SceneGrid(*scene.shape, 8, 2), basis, np.random.default_rng(seed))


def test_both_looks_are_the_cameras_own():
    """Columns of both looks are the spectral columns of the camera's reflectances of the whole padded scene."""
    bright = replace(CAMERA, electrons_per_dn=1e6, read_noise_e=0.0)  # so much light that noise is below rounding
    scene = _scene((32, 48), bright)
    seen, (matrix, _) = _observed(scene, bright), SpectralBasis.spanning(NM).matrix(NM)
    light, scale = scene.planes * scene.electrons, scene.white_reference / scene.white_reference_electrons
    for step, columns in ((1, seen.fine), (2, seen.coarse)):
        expected = (expose(footprint(light, bright), bright, step=step, rng=None) * scale) @ matrix
        assert columns == pytest.approx(expected, abs=3e-3)


def test_the_looks_of_a_padded_scene():
    """Looks and labels have the padded size; what was added is unlabelled and mirrors the scene."""
    scene = _scene()
    seen = _observed(scene)
    assert seen.fine.shape == (48, 64, 6)
    assert seen.coarse.shape == (24, 32, 6)
    assert (seen.labels[:40, :50] == scene.labels).all()
    assert (seen.labels[40:] == 255).all()
    assert (seen.labels[:, 50:] == 255).all()
    assert seen.shape == (40, 50)
    assert np.abs(seen.fine[40:44] - seen.fine[38:34:-1]).mean() < 0.1


def test_exposure_changes_noise_and_not_reflectance():
    """A quarter of the exposure gives the same mean columns with more noise."""
    short = replace(CAMERA, exposure_ms=CAMERA.exposure_ms / 4)
    usual, other = (_observed(_scene(), seed=seed).fine for seed in (0, 1))
    brief, again = (_observed(_scene(), short, seed).fine for seed in (0, 1))
    assert brief.mean() == pytest.approx(usual.mean(), rel=0.01)
    assert (brief - again).std() > 1.8 * (usual - other).std()


def test_scenes_without_labels_teach_nothing():
    """A scene without labels, and examples without one labelled pixel, are refused."""
    with pytest.raises(SceneError, match="scene s has no labels"):
        _observed(replace(_scene(), raster=SceneRaster.of(_scene().planes)))
    blank = Example(
        "e",
        np.zeros((32, 32, 1), np.float16),
        np.zeros((16, 16, 1), np.float32),
        np.full((32, 32), 255, np.uint8),
        (32, 32),
    )
    with pytest.raises(SceneError, match="none of 2 scenes has a labelled pixel"):
        CropSampler([blank, blank], 8, 2, 32)


def _example(shape: tuple[int, int], name: str = "e", labelled: float = 1.0) -> Example:
    """An example whose one column is the label plus 1, at both scales the place's own."""
    rng = np.random.default_rng(len(name))
    labels = np.kron(rng.integers(0, 5, (shape[0] // 2, shape[1] // 2)), np.ones((2, 2))).astype(np.uint8)
    fine, coarse = (labels[..., None] + 1).astype(np.float16), (labels[::2, ::2, None] + 1).astype(np.float32)
    labels[rng.random(shape) >= labelled] = 255
    return Example(name, fine, coarse, labels, shape)


def _image(patch_index: Tensor) -> np.ndarray:
    """Patches of square crops back to images."""
    b, count, _, p, _ = patch_index.shape
    side = round(count**0.5)
    return patch_index[:, :, 0].view(b, side, side, p, p).permute(0, 1, 3, 2, 4).reshape(b, side * p, -1).numpy()


def test_crops_show_one_place_in_both_looks():
    """However a crop is turned, its patches, coarse pixels and labels belong together and share one brightness."""
    sampler = CropSampler([_example((64, 96)), _example((48, 48), "other")], 8, 2, 32)
    batch = sampler.draw(12, np.random.default_rng(3), np.zeros(1, np.float32))
    fine, coarse, labels = _image(batch.fine), batch.coarse[:, 0].numpy(), batch.labels.numpy()
    gain = (fine / (labels + 1)).mean(axis=(1, 2), keepdims=True)
    assert fine == pytest.approx((labels + 1) * gain, rel=1e-5)
    assert coarse == pytest.approx(fine[:, ::2, ::2], rel=1e-5)
    assert gain.std() > 0.01


@pytest.mark.parametrize(("crop", "size"), [(16, 16), (40, 32), (1, 16), (400, 48)])
def test_crops_are_whole_cells_within_the_smallest_scene(crop: int, size: int):
    """The wished size is brought down to whole coarse patches, and never below one."""
    sampler = CropSampler([_example((64, 96)), _example((48, 80))], 8, 2, crop)
    batch = sampler.draw(2, np.random.default_rng(0), np.zeros(1, np.float32))
    assert batch.labels.shape == (2, size, size)
    assert batch.coarse.shape == (2, 1, size // 2, size // 2)
    assert batch.fine.shape == (2, (size // 8) ** 2, 1, 8, 8)


def test_crops_follow_the_labels():
    """Scenes are drawn by their labelled area, and a crop without a label is drawn again."""
    dark = replace(_example((64, 64)), labels=np.full((64, 64), 255, np.uint8))
    corner = np.full((64, 64), 255, np.uint8)
    corner[20:40, 20:40] = 4
    sampler = CropSampler([dark, replace(dark, labels=corner)], 8, 2, 16)
    labels = sampler.draw(30, np.random.default_rng(0), np.zeros(1, np.float32)).labels
    assert (labels == 4).flatten(1).any(dim=1).all()


def test_a_coarse_pixel_has_the_noise_of_more_light(monkeypatch: pytest.MonkeyPatch):
    """It gathers ``factor`` times the light of a fine one: its noise is that of the fine look over the root of it."""
    monkeypatch.setattr(examples, "NOISY", 1.0)
    sampler = CropSampler([replace(_example((64, 64)), labels=np.zeros((64, 64), np.uint8))], 8, 4, 64, noise=1.0)
    flat = sampler.examples[0]
    flat.fine[:], flat.coarse[:] = 0, 0
    for seed in range(3):
        batch = sampler.draw(1, np.random.default_rng(seed), np.zeros(1, np.float32))
        assert batch.fine.std() / batch.coarse.std() == pytest.approx(2, rel=0.1)
