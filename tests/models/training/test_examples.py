"""Training data: labelled scenes as the camera captures them, and random crops of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from spectralzoom.models.network.sizes import PLANES
from spectralzoom.models.network.spectral import Normalisation, SpectralBasis
from spectralzoom.models.training.capture_augmentation import CaptureAugmentation, ColumnNoise
from spectralzoom.models.training.examples import CropSampler, Example, observe
from spectralzoom.pipeline.errors import SceneError
from spectralzoom.pipeline.geometry.camera import LineCamera, expose, footprint
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.pipeline.simulator.scenes.scene import RasterScene, raster_from_values

CAMERA = LineCamera(bits=14)
NM = np.linspace(450, 950, 6)


def _scene(shape: tuple[int, int] = (40, 50), camera: LineCamera = CAMERA) -> RasterScene:
    rng = np.random.default_rng(1)
    labels = rng.integers(0, 3, shape, dtype=np.uint8)
    values = (rng.uniform(0.2, 0.8, (*shape, 6)) + labels[..., None]).astype(np.float32)
    return raster_from_values(values, camera, name="s", wavelength_nm=NM, labels=labels, class_names=("a", "b", "c"))


def _observed(scene: RasterScene, camera: LineCamera = CAMERA, seed: int = 0) -> Example:
    return observe(scene, camera, SceneGrid(*scene.shape, 8), SpectralBasis.spanning(NM), np.random.default_rng(seed))


def test_observed_columns_are_those_of_the_camera():
    """Columns are the spectral columns of the camera's reflectances of the whole padded scene."""
    bright = replace(CAMERA, electrons_per_dn=1e6, read_noise_e=0.0)  # so much light that noise is below rounding
    scene = _scene((32, 48), bright)
    matrix, _ = SpectralBasis.spanning(NM).matrix(NM)
    light = scene.planes * scene.electrons
    scale = scene.white_reference / scene.white_reference_electrons
    expected = (expose(footprint(light, bright), bright, rng=None) * scale) @ matrix
    assert _observed(scene, bright).columns == pytest.approx(expected, abs=3e-3)


def test_observed_scenes_are_padded_by_mirroring():
    """Columns and labels have the padded size; the added pixels are unlabelled and mirror the scene."""
    scene = _scene((36, 50))
    seen = _observed(scene)
    assert seen.columns.shape == (40, 56, 6)
    assert (seen.labels[:36, :50] == scene.labels).all()
    assert (seen.labels[36:] == 255).all()
    assert (seen.labels[:, 50:] == 255).all()
    assert seen.shape == (36, 50)
    assert np.abs(seen.columns[36:40] - seen.columns[34:30:-1]).mean() < 0.1


def test_examples_without_a_labelled_pixel_are_refused():
    """Training on them would change nothing; the error has the number of scenes."""
    blank = Example("e", np.zeros((32, 32, 1), np.float16), np.full((32, 32), 255, np.uint8), (32, 32))
    with pytest.raises(SceneError, match="none of 2 scenes has a labelled pixel"):
        CropSampler([blank, blank], 8, 32)


def _example(shape: tuple[int, int], name: str = "e") -> Example:
    """Return an example whose one column is the label plus 1."""
    labels = np.random.default_rng(len(name)).integers(0, 5, shape).astype(np.uint8)
    return Example(name, (labels[..., None] + 1).astype(np.float16), labels, shape)


def test_both_networks_see_the_same_crop():
    """However a crop is turned, pixels and labels stay together and share one brightness, at the reference."""
    sampler = CropSampler([_example((64, 96)), _example((48, 48), "other")], 8, 32)
    batch = sampler.draw(12, np.random.default_rng(3), np.zeros(1, np.float32))
    columns = batch.image[:, 0].numpy()
    labels = batch.labels.numpy()
    gain = (columns / (labels + 1)).mean(axis=(1, 2), keepdims=True)
    assert columns == pytest.approx((labels + 1) * gain, rel=1e-5)
    assert gain.std() > 0.01
    assert torch.equal(batch.image, batch.detail)
    assert not batch.image[:, 1:].any()  # the planes of the reference


def test_zoomed_crops_keep_labels_aligned():
    """Crops show 0.66 to 1.41 times as many pixels: stripes of 16 px have 11 to 24. Only borders of stripes mix."""
    stripes = np.repeat(np.arange(8, dtype=np.uint8), 16)[None].repeat(128, axis=0)
    example = Example("e", (stripes[..., None] + 1).astype(np.float16), stripes, stripes.shape)
    batch = CropSampler([example], 8, 64, zoomed=True).draw(40, np.random.default_rng(0), np.zeros(1, np.float32))
    light = batch.image[:, 0] / (batch.labels + 1)
    own = (light / light.flatten(1).median(dim=1).values[:, None, None] - 1).abs() < 0.01
    assert own.flatten(1).float().mean(dim=1).min() > 0.7
    assert {3, 4, 6} <= {len(labels.unique()) for labels in batch.labels}


@pytest.mark.parametrize(
    ("patch", "smallest", "crop", "size"),
    [(8, 48, 16, 32), (8, 48, 400, 32), (16, 64, 70, 64), (8, 24, 16, 16), (8, 24, 400, 24), (64, 128, 100, 64)],
)
def test_crops_are_whole_cells_within_the_smallest_scene(patch: int, smallest: int, crop: int, size: int):
    """The size is reduced to whole tokens and patches, but never below one; smaller scenes give whole patches."""
    sampler = CropSampler([_example((128, 192)), _example((smallest, 160))], patch, crop)
    batch = sampler.draw(2, np.random.default_rng(0), np.zeros(1, np.float32))
    assert batch.labels.shape == (2, size, size)
    assert batch.image.shape == batch.detail.shape == (2, 1 + PLANES, size, size)
    assert batch.origin.shape == (2, 2)


def test_crops_contain_labelled_pixels():
    """Scenes are drawn by their labelled area, and a crop without a label is drawn again."""
    dark = replace(_example((64, 64)), labels=np.full((64, 64), 255, np.uint8))
    corner = np.full((64, 64), 255, np.uint8)
    corner[20:40, 20:40] = 4
    sampler = CropSampler([dark, replace(dark, labels=corner)], 8, 16)
    labels = sampler.draw(30, np.random.default_rng(0), np.zeros(1, np.float32)).labels
    assert (labels == 4).flatten(1).any(dim=1).all()


def test_crops_are_augmented_if_their_noise_is_known():
    """Planes of these crops are those of shorter exposures; planes of a scene without noise stay 0."""
    plain = Normalisation(np.zeros(1, np.float32), np.ones(1, np.float32), np.eye(1, dtype=np.float32))
    augmentation = CaptureAugmentation(plain, min_exposure_ms=10.0)
    for known in (ColumnNoise(np.full(1, 1e-4), np.full((1, 1), 1e-4)), None):
        sampler = CropSampler([replace(_example((64, 64)), noise=known)], 8, 32, augmentation=augmentation)
        batch = sampler.draw(4, np.random.default_rng(0), np.zeros(1, np.float32))
        assert bool((batch.image[:, 1] > 0).any()) == (known is not None)
