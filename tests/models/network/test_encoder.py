"""The transformer over tokens of both scales."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from models.network.layers import Encoder, TokenAttention
from pipeline.errors import ShapeError


@pytest.fixture
def encoder() -> Encoder:
    """Two blocks of width 16."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(1)
        return Encoder(16, 2, 2, 2).eval()


def _tokens(count: int, batch: int = 1, seed: int = 5) -> Tensor:
    return torch.randn(batch, count, 16, generator=torch.Generator().manual_seed(seed))


@torch.inference_mode()
def test_tokens_have_no_order(encoder: Encoder):
    """Permuted tokens give the permuted result; places come from the codes alone."""
    x = _tokens(12)
    order = torch.randperm(12, generator=torch.Generator().manual_seed(2))
    assert (encoder(x[:, order])[0] - encoder(x)[0][:, order]).abs().max() <= 2e-6


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
def test_parts_of_the_memory_join(encoder: Encoder):
    """A later look at the memory of an earlier one sees what one look at both sees of the first."""
    first, second = _tokens(4), _tokens(2, seed=7)
    _, alone = encoder(first)
    _, own = encoder(second, alone)
    joined = [tuple(torch.cat(pair, dim=2) for pair in zip(a, b, strict=True)) for a, b in zip(alone, own, strict=True)]
    third = _tokens(3, seed=8)
    assert encoder(third, joined)[0].isfinite().all()
    assert (encoder(third, joined)[0] - encoder(third, alone)[0]).abs().max() > 1e-4


@torch.inference_mode()
def test_tokens_left_out_reach_nobody(encoder: Encoder):
    """A token that is not valid changes nothing, NaN included, and leaves as zeros."""
    x, memory = _tokens(6), encoder(_tokens(3, seed=9))[1]
    valid = torch.tensor([[True, False, True, True, False, True]])
    spoiled = torch.where(valid[..., None], x, torch.nan)
    read, _ = encoder(spoiled, memory, valid)
    assert not read[~valid].any()
    assert (read[valid] - encoder(x[:, valid[0]], memory)[0][0]).abs().max() <= 2e-6


@torch.inference_mode()
def test_logits_stay_bounded(encoder: Encoder):
    """Attention sees normalised queries and keys: inputs a million times larger give a finite result."""
    assert encoder(1e6 * _tokens(6))[0].isfinite().all()


def test_heads_must_share_the_width():
    """The message says width and heads."""
    with pytest.raises(ShapeError, match="width 16 do not divide by 3 heads"):
        TokenAttention(16, 3)
