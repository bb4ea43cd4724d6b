"""Parts of the networks: the transformer, patches down to tokens and back up, and codes of places."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from models.network.layers import Encoder, PatchHead, PatchStem
from models.network.sizes import level_widths
from tests.models.conftest import noise


@pytest.fixture
def encoder() -> Encoder:
    """Two blocks of width 16."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(1)
        return Encoder(16, 2, 2, 2).eval()


def _tokens(count: int, seed: int = 5) -> Tensor:
    return noise(seed, 1, count, 16)


@torch.inference_mode()
def test_what_is_kept_stands_for_the_tokens(encoder: Encoder):
    """Later tokens read the memory as one causal reading of all tokens would let them."""
    first, later = _tokens(5), _tokens(3, seed=6)
    _, memory = encoder(first)
    read, _ = encoder(later, memory)
    changed, _ = encoder(later, [(keys.roll(1, 2), values.roll(1, 2)) for keys, values in memory])
    assert (read - changed).abs().max() <= 2e-6  # a memory has no order
    assert (read - encoder(later)[0]).abs().max() > 1e-3  # and is read


@torch.inference_mode()
@pytest.mark.parametrize(("patch", "side"), [(4, 1), (8, 1), (32, 2), (64, 4)])
def test_a_patch_comes_back_at_its_size(patch: int, side: int):
    """Features of every level, finest first, a token for each part, and the width per pixel again."""
    widths = level_widths(8, patch)
    features, tokens = PatchStem(5, widths, 12, side)(torch.zeros(3, 5, patch, patch))
    assert [tuple(level.shape) for level in features] == [
        (3, width, patch >> i, patch >> i) for i, width in enumerate(widths)
    ]
    assert tokens.shape == (3, side**2, 12)
    assert PatchHead(widths, 12, side)(features, tokens).shape == (3, 8, patch, patch)


@torch.inference_mode()
def test_tokens_lie_row_by_row():
    """What stands in one quarter of a patch of 32 px changes the tokens near it, and most its own."""
    stem, patch = PatchStem(1, level_widths(8, 32), 12, 2), torch.zeros(1, 1, 32, 32)
    still = stem(patch)[1][0]
    patch[..., 2:14, 18:30] = 1.0  # above, right
    moved = (stem(patch)[1][0] - still).abs().sum(dim=1)
    assert moved.argmax() == 1
