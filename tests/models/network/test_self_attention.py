"""Received attention: shares that add up, no favoured order or block size, what the encoder itself computes, patches."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from models.network.self_attention import (
    LAST_QUERIES,
    TokenReading,
    attention_of_patches,
    queries_kept,
    received_attention,
    token_image,
)
from models.policies.policies import score_patches
from models.reading.inference import CoarsePrediction, coarse_prediction_of_columns
from models.weights.files import Weights
from pipeline.errors import ShapeError
from pipeline.geometry.grid import SceneGrid
from tests.models.conftest import Maker

Array = NDArray[np.float32]


def noise(seed: int, *shape: int) -> Array:
    """Seeded normal numbers."""
    return np.random.default_rng(seed).standard_normal(shape).astype(np.float32)


def seen_by(weights: Weights, height: int = 48, width: int = 64, seed: int = 0) -> CoarsePrediction:
    """What small weights see of a noisy scene."""
    grid = SceneGrid(height, width, weights.config.patch, weights.config.factor)
    y, x = (size // grid.factor for size in grid.padded_shape)
    return coarse_prediction_of_columns(weights, noise(seed, y, x, weights.config.columns), grid)


@pytest.mark.parametrize(("heads", "tokens", "width"), [(1, 1, 1), (2, 7, 4), (4, 60, 32)])
def test_fractions_add_up_to_one(heads: int, tokens: int, width: int):
    """Softmax rows sum to 1, and so does their mean over heads and queries, however extreme the logits."""
    for size in (1.0, 1e4):
        fraction = received_attention(size * noise(1, heads, tokens, width), noise(2, heads, tokens, width))
        assert fraction.shape == (tokens,)
        assert fraction.sum() == pytest.approx(1.0, abs=1e-6)
        assert (fraction >= 0).all()


def test_it_is_what_the_last_layer_computes(tiny: Maker):
    """Queries and keys are those with which torch mixes values: values that name the tokens give the weights back."""
    weights = tiny(layers=2)
    read = seen_by(weights).tokens
    assert read is not None
    heads, tokens, width = read.keys.shape
    assert (heads, width) == (weights.config.heads, weights.config.dim // weights.config.heads)
    names = torch.eye(tokens).expand(1, heads, tokens, tokens)
    mixed = torch.nn.functional.scaled_dot_product_attention(
        torch.from_numpy(read.queries)[None], torch.from_numpy(read.keys)[None], names
    )
    assert received_attention(read.queries, read.keys) == pytest.approx(mixed.mean(dim=(0, 1, 2)).numpy(), abs=1e-6)


def test_queries_are_kept_inside_alone(tiny: Maker):
    """Neither after a reading that failed nor in another thread is anything kept; those of the last layer are."""
    weights = tiny(layers=2)
    image = torch.from_numpy(noise(9, 1, 4, 16, 24))

    def fail() -> None:
        with queries_kept():
            raise ShapeError("reading failed")

    with pytest.raises(ShapeError, match="reading failed"):
        fail()
    assert LAST_QUERIES.get() is None
    with queries_kept() as kept, ThreadPoolExecutor(1) as pool, torch.inference_mode():
        pool.submit(weights.segmenter.read_coarse, image).result()
        assert kept == []
        reading = weights.segmenter.read_coarse(image)
        assert [queries.shape for queries in kept] == [reading.memory[-1][0].shape]
    assert LAST_QUERIES.get() is None


def test_threads_that_read_at_once_keep_their_own(tiny: Maker):
    """Regions of a field are read by one network in several threads: each scores as it does alone."""
    weights = tiny(layers=2)
    alone = [score_patches("self-attention", seen_by(weights, seed=seed)) for seed in range(8)]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda seed: score_patches("self-attention", seen_by(weights, seed=seed)), range(8)))
    assert np.array(together) == pytest.approx(np.array(alone), abs=1e-5)
    assert np.ptp(alone, axis=0).max() > 1e-3


def test_tokens_are_laid_out_patch_by_patch():
    """Four tokens of a patch lie row by row inside it, patches row by row."""
    image = token_image(np.arange(24.0), (2, 3), 2)
    assert image.tolist() == [
        [0, 1, 4, 5, 8, 9],
        [2, 3, 6, 7, 10, 11],
        [12, 13, 16, 17, 20, 21],
        [14, 15, 18, 19, 22, 23],
    ]


@pytest.mark.parametrize(("side", "factor"), [(1, 4), (2, 4), (2, 2), (2, 1)])
def test_patches_over_the_token_that_is_read_come_first(side: int, factor: int):
    """The greatest patch lies on the token that everything reads, and the patches share out what tokens receive."""
    cells = (3, 4)
    tokens = cells[0] * cells[1] * side**2
    keys = np.ones((1, tokens, 4), np.float32)
    keys[:, 5 * side**2] = 50.0  # the first token of the patch at row 1, column 1
    found = attention_of_patches(TokenReading(np.ones_like(keys), keys, side), (3 * factor, 4 * factor), factor)
    row, column = np.unravel_index(np.argmax(found), found.shape)
    place = (np.array([row, column]) + 0.5) / factor * side  # in tokens
    assert (np.floor(place) == side).all() or side > factor
    assert found.mean() == pytest.approx(1.0, rel=1e-6)


@pytest.mark.parametrize("patch", [8, 32])
def test_the_policy_scores_patches_by_their_fraction(tiny: Maker, patch: int):
    """Patches off the scene score 0, those on it what they receive, border patches a fraction of it; 1 is the usual."""
    weights = tiny(patch=patch)
    seen = seen_by(weights, 5 * patch - 3, 7 * patch - 5)
    scores = score_patches("self-attention", seen).reshape(seen.grid.patch_shape)
    assert seen.tokens is not None
    received = attention_of_patches(seen.tokens, seen.grid.patch_shape, seen.grid.factor)
    assert scores == pytest.approx(received * seen.grid.valid_fraction())
    assert received.mean() == pytest.approx(1.0, rel=1e-5)
    assert np.ptp(received) > 1e-4
