"""Scenes of different sizes read together: the maps of one by one, whatever they are packed with."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from models.network.layers import encode_packed
from models.reading import inference
from models.reading.inference import (
    CoarsePass,
    CoarsePrediction,
    coarse_prediction_batch,
    packs,
    read_coarse_prediction,
    segment,
    segment_batch,
)
from models.weights.files import Weights
from pipeline.errors import ShapeError
from pipeline.geometry.grid import SceneGrid
from tests.models.conftest import Maker

Scenes = tuple[list[CoarsePass], list[np.ndarray], list[np.ndarray]]
SIZES = [(37, 53), (1, 1), (48, 16), (16, 16), (60, 44), (17, 90)]
COUNTS = [5, 1, 0, 4, 40, 9]


def _scenes(weights: Weights, seed: int = 0) -> Scenes:
    """Looks, patches and patches of scenes that have nothing in common."""
    p, s, columns = weights.config.patch, weights.config.factor, weights.config.columns
    rng = np.random.default_rng(seed)
    scan_passes, patches, patch_index = [], [], []
    for number, (size, count) in enumerate(zip(SIZES, COUNTS, strict=True)):
        grid = SceneGrid(*size, p, s)
        y, x = (side // s for side in grid.padded_shape)
        origin = (0, 0) if number % 2 else (4 * number, 12)
        scan_passes.append(CoarsePass(grid, rng.standard_normal((y, x, columns), dtype=np.float32), origin=origin))
        patch_index.append(rng.permutation(int(np.prod(grid.patch_shape)))[:count])
        patches.append(rng.standard_normal((len(patch_index[-1]), p, p, columns), dtype=np.float32))
    return scan_passes, patches, patch_index


@pytest.mark.parametrize("sizes", [{}, {"patch": 32, "factor": 4, "layers": 2}, {"positions": "paper"}])
@pytest.mark.parametrize("most", [1, 20, 1000])
def test_packed_maps_are_those_of_one_by_one(tiny: Maker, sizes: dict, most: int, monkeypatch: pytest.MonkeyPatch):
    """However scenes are packed, classes are the same and confidence differs by 1e-6 at most."""
    monkeypatch.setattr(inference, "packs", lambda counts: packs(counts, most))
    weights = tiny(**sizes)
    scan_passes, patches, patch_index = _scenes(weights)
    together = segment_batch(weights, scan_passes, patches, patch_index)
    for drawn, *scene in zip(together, scan_passes, patches, patch_index, strict=True):
        alone = segment(weights, *scene)
        assert (drawn.classes == alone.classes).all()
        assert np.abs(drawn.confidence - alone.confidence).max() <= 1e-6


def test_packed_coarse_predictions_are_those_of_one_by_one(tiny: Maker):
    """Probabilities, gains and what the tokens ask are those of each scene alone."""
    weights = tiny(layers=2)
    scan_passes, _, _ = _scenes(weights)
    for seen, coarse_pass in zip(coarse_prediction_batch(weights, scan_passes), scan_passes, strict=True):
        alone = read_coarse_prediction(weights, coarse_pass)
        assert np.abs(seen.probability - alone.probability).max() <= 1e-6
        assert np.abs(seen.gain - alone.gain).max() <= 1e-5
        assert np.abs(seen.tokens.queries - alone.tokens.queries).max() <= 1e-5
        assert (seen.grid, seen.origin) == (coarse_pass.grid, coarse_pass.origin)


def test_coarse_predictions_and_bare_looks_mix(tiny: Maker):
    """A scene already glanced at is not read again, and its map is that of its look."""
    weights = tiny()
    scan_passes, patches, patch_index = _scenes(weights)
    mixed = [
        read_coarse_prediction(weights, coarse_pass) if number % 2 else coarse_pass
        for number, coarse_pass in enumerate(scan_passes)
    ]
    for one, other in zip(
        segment_batch(weights, mixed, patches, patch_index),
        segment_batch(weights, scan_passes, patches, patch_index),
        strict=True,
    ):
        assert (one.classes == other.classes).all()
        assert np.abs(one.confidence - other.confidence).max() <= 1e-6


def test_a_kept_reading_counts_for_its_own_precision_place_and_weights_only(
    tiny: Maker, monkeypatch: pytest.MonkeyPatch
):
    """The coarse image is read again where precision, place, living tokens or weights are not those of the coarse prediction."""
    weights, other = tiny(0), tiny(1)
    scan_passes, patches, patch_index = _scenes(weights)
    seen: CoarsePrediction = read_coarse_prediction(weights, scan_passes[0])
    again = []
    read = inference._read_coarse
    monkeypatch.setattr(inference, "_read_coarse", lambda *given: again.append(len(given[1])) or read(*given))
    segment(weights, seen, patches[0], patch_index[0])
    segment(weights, seen, patches[0], patch_index[0], precision="bfloat16")
    segment(weights, replace(seen, origin=(4, 4)), patches[0], patch_index[0])
    living = np.arange(inference._patches_in(seen) * weights.config.token_side**2) > 0
    segment(weights, replace(seen, living=living), patches[0], patch_index[0])
    segment(other, seen, patches[0], patch_index[0])
    assert again == [0, 1, 1, 1, 1]


def test_a_scene_that_cannot_be_is_refused_before_any_is_read(tiny: Maker, monkeypatch: pytest.MonkeyPatch):
    """A bad patch in the last scene stops the batch."""
    weights = tiny()
    scan_passes, patches, patch_index = _scenes(weights)
    monkeypatch.setattr(inference, "_read_coarse", lambda *given: pytest.fail("read"))
    with pytest.raises(ShapeError, match="patch 5000 is none"):
        segment_batch(weights, scan_passes, patches, [*patch_index[:-1], np.r_[patch_index[-1][1:], 5000]])


def test_packed_tokens_are_encoded_as_each_scene_alone(tiny: Maker):
    """With and without what was read before, tokens and memories are the encoder's own."""
    encoder, rng = tiny(layers=3).segmenter.encoder, torch.Generator().manual_seed(0)
    scenes = [torch.randn(count, 16, generator=rng) for count in (1, 7, 30)]
    with torch.inference_mode():
        first, memories = encode_packed(encoder, scenes)
        second, _ = encode_packed(encoder, scenes, memories)
        for tokens, own, memory, after in zip(scenes, first, memories, second, strict=True):
            alone, kept = encoder(tokens[None])
            assert (own - alone[0]).abs().max() <= 1e-5
            assert (memory[-1][1] - kept[-1][1]).abs().max() <= 1e-5
            assert (after - encoder(tokens[None], kept)[0][0]).abs().max() <= 1e-5
