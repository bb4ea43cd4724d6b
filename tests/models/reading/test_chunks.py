"""Scenes read some patches at a time, and readings that are kept."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from models.network import segmenter
from models.reading import inference
from models.reading.inference import CoarsePass, read_coarse_prediction, segment
from models.weights.files import Weights
from pipeline.errors import ShapeError
from pipeline.geometry.grid import SceneGrid
from tests.models.conftest import Maker

Scene = tuple[CoarsePass, np.ndarray, np.ndarray]


def _scene(weights: Weights, count: int = 40) -> Scene:
    """A coarse pass, numbers of patches and their pixels, of a scene of noise."""
    p, s, columns = weights.config.patch, weights.config.factor, weights.config.columns
    rng, grid = np.random.default_rng(0), SceneGrid(60, 90, p, s)
    y, x = (side // s for side in grid.padded_shape)
    coarse_pass = CoarsePass(grid, rng.standard_normal((y, x, columns), dtype=np.float32), origin=(4, 12))
    patch_index = rng.permutation(int(np.prod(grid.patch_shape)))[:count]
    return coarse_pass, rng.standard_normal((len(patch_index), p, p, columns), dtype=np.float32), patch_index


@pytest.mark.parametrize("sizes", [{}, {"patch": 32, "factor": 4, "layers": 2}])
@pytest.mark.parametrize("most", [1, 7])
def test_chunks_do_not_show(tiny: Maker, sizes: dict, most: int, monkeypatch: pytest.MonkeyPatch):
    """However many patches are read at a time, classes are the same and confidence differs by 1e-6 at most."""
    weights = tiny(**sizes)
    scene = _scene(weights, 5)
    whole = segment(weights, *scene)
    monkeypatch.setattr(segmenter, "PATCHES_AT_ONCE", most)
    drawn = segment(weights, *scene)
    assert (drawn.classes == whole.classes).all()
    assert np.abs(drawn.confidence - whole.confidence).max() <= 1e-6


def test_chunks_read_what_training_reads(tiny: Maker):
    """Logits of the coarse and the fine pass are those of the network's own reading of whole images."""
    weights = tiny(layers=2)
    coarse_pass, patches, patch_index = _scene(weights)
    model, image = weights.segmenter, torch.from_numpy(coarse_pass.columns).permute(2, 0, 1)[None]
    numbers, origin = torch.from_numpy(patch_index), torch.tensor([coarse_pass.origin])
    with torch.inference_mode():
        coarse, fine = model(image, torch.from_numpy(patches).permute(0, 3, 1, 2)[None], numbers[None], origin)
        reading = model.read_coarse_in_chunks(image, origin, None)
        parts = torch.cat(list(model.read_fine_in_chunks(reading, patches, numbers, origin)))
    assert (reading.logits - coarse).abs().max() <= 1e-5
    assert (parts - fine[0]).abs().max() <= 1e-5


def test_a_kept_reading_counts_for_its_own_place_and_weights_only(tiny: Maker, monkeypatch: pytest.MonkeyPatch):
    """The coarse image is read again where place, living tokens or weights are not those of the coarse prediction."""
    weights, other = tiny(0), tiny(1)
    coarse_pass, patches, patch_index = _scene(weights)
    seen = read_coarse_prediction(weights, coarse_pass)
    again: list[int] = []
    read = inference._read_coarse
    monkeypatch.setattr(inference, "_read_coarse", lambda *given: again.append(1) or read(*given))
    segment(weights, seen, patches, patch_index)
    assert not again
    living = (
        np.arange(np.prod(coarse_pass.grid.patch_shape) // coarse_pass.grid.factor**2 * weights.config.token_side**2)
        > 0
    )
    for who, what in ((weights, replace(seen, origin=(4, 4))), (weights, replace(seen, living=living)), (other, seen)):
        segment(who, what, patches, patch_index)
    assert len(again) == 3


def test_a_patch_that_cannot_be_is_refused_before_anything_is_read(tiny: Maker, monkeypatch: pytest.MonkeyPatch):
    """A bad patch is named."""
    weights = tiny()
    coarse_pass, patches, patch_index = _scene(weights)
    monkeypatch.setattr(inference, "_read_coarse", lambda *given: pytest.fail("read"))
    with pytest.raises(ShapeError, match="patch 5000 is none"):
        segment(weights, coarse_pass, patches, np.r_[patch_index[1:], 5000])
