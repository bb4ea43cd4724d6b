"""A trained segmenter on one scene: sizes, patches, borders, strips and pixels without a value."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from models.reading.inference import (
    CoarsePrediction,
    coarse_prediction,
    read_coarse_pass,
    read_coarse_prediction,
    segment,
)
from models.weights.files import Weights
from pipeline.geometry.grid import SceneGrid
from tests.models.conftest import Maker

NM = np.linspace(400, 1000, 9)
NONE = np.empty(0, np.int64)


def _coarse_pass(weights: Weights, height: int, width: int, seed: int = 0) -> tuple[CoarsePrediction, np.ndarray]:
    """The coarse prediction at a random scene, and a patch for every patch."""
    p, s, columns = weights.config.patch, weights.config.factor, weights.config.columns
    grid, rng = SceneGrid(height, width, p, s), np.random.default_rng(seed)
    seen = coarse_prediction(weights, rng.uniform(0.1, 0.5, (*grid.coarse_shape, len(NM))), NM, grid)
    count = grid.patch_shape[0] * grid.patch_shape[1]
    return seen, rng.normal(0, 1, (count, p, p, columns)).astype(np.float32)


@pytest.mark.parametrize("size", [(37, 53), (1, 1), (16, 16), (17, 1), (1, 40), (48, 15)])
@pytest.mark.parametrize("factor", [1, 2, 4])
def test_maps_have_the_size_of_the_scene(tiny: Maker, size: tuple[int, int], factor: int):
    """Any size works, with no patch, one patch and every patch, down to a single pixel."""
    weights = tiny(factor=factor)
    seen, fine = _coarse_pass(weights, *size)
    for patch_index in (NONE, seen.grid.valid_patches()[-1:], seen.grid.valid_patches()):
        drawn = segment(weights, seen, fine[patch_index], patch_index)
        assert drawn.classes.shape == drawn.confidence.shape == size
        assert drawn.classes.dtype == np.uint8
        assert drawn.classes.max() < 3
        assert 1 / 3 - 1e-6 <= drawn.confidence.min() <= drawn.confidence.max() <= 1


def test_patches_lie_at_their_patches(tiny: Maker):
    """Exchanging the patches of two patches changes the map in both, and a patch's map follows its patch's pixels."""
    weights = tiny(classes=6)
    seen, fine = _coarse_pass(weights, 32, 32)
    drawn = segment(weights, seen, fine[:2], np.array([3, 12]))
    moved = segment(weights, seen, fine[:2], np.array([12, 3]))
    changed = np.abs(drawn.confidence - moved.confidence).reshape(4, 8, 4, 8).max(axis=(1, 3))
    assert sorted(np.argsort(changed, axis=None)[-2:].tolist()) == [3, 12]


@pytest.mark.parametrize("bands", [NM, NM[:3]])
def test_a_look_in_swaths_is_the_look_at_once(tiny: Maker, bands: np.ndarray):
    """Rows of the mosaic that come some at a time give the very same columns, with bands for all of them or not."""
    weights, grid = tiny(), SceneGrid(37, 53, 8, 2)
    coarse = np.random.default_rng(0).uniform(0.1, 0.5, (*grid.coarse_shape, len(bands))).astype(np.float32)
    whole = coarse_prediction(weights, coarse, bands, grid)
    parts = read_coarse_pass(weights, np.split(coarse, [1, 9]), bands, grid)
    assert (parts.columns == whole.columns).all()
    assert (read_coarse_prediction(weights, parts).probability == whole.probability).all()


@pytest.mark.parametrize("origin", [(0, 0), (12, 40)])
def test_a_region_is_drawn_as_training_saw_crops(tiny: Maker, origin: tuple[int, int]):
    """Reading in steps and chunks gives the composite that the loss of training is taken of, at the same places."""
    weights = tiny()
    seen, fine = _coarse_pass(weights, 32, 48)
    moved, patch_index = replace(seen, origin=origin), np.array([5, 0, 17, 23, 9])
    drawn, model = segment(weights, moved, fine[patch_index], patch_index), weights.segmenter
    with torch.inference_mode():
        columns = torch.from_numpy(seen.columns).permute(2, 0, 1)[None]
        numbers, patches = (
            torch.from_numpy(patch_index)[None],
            torch.from_numpy(fine[patch_index]).permute(0, 3, 1, 2)[None],
        )
        coarse, detail = model(columns, patches, numbers, torch.tensor([origin]))
        confidence = model.composite(coarse, detail, numbers)[0].softmax(dim=0).max(dim=0).values.numpy()
    assert np.abs(drawn.confidence - confidence).max() <= 1e-5
    same = (drawn.confidence == segment(weights, seen, fine[patch_index], patch_index).confidence).all()
    assert same == (origin == (0, 0))
