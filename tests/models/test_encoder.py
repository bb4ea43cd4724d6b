"""The transformer over tokens of both scales."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from models.encoder import Attention, Encoder
from pipeline.errors import ShapeError


@pytest.fixture
def encoder() -> Encoder:
    """Two blocks of width 16."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(1)
        return Encoder(16, 2, 2, 2).eval()


def _tokens(count: int, batch: int = 1) -> tuple[Tensor, Tensor, Tensor]:
    x = torch.randn(batch, count, 16, generator=torch.Generator().manual_seed(5))
    return x, torch.zeros(batch, count), torch.ones(batch, count, dtype=torch.bool)


@torch.inference_mode()
def test_tokens_have_no_order(encoder: Encoder):
    """Permuted tokens give the permuted result; places come from the codes alone."""
    x, scale, valid = _tokens(12)
    order = torch.randperm(12, generator=torch.Generator().manual_seed(2))
    assert (encoder(x[:, order], scale, valid) - encoder(x, scale, valid)[:, order]).abs().max() <= 2e-6


@torch.inference_mode()
def test_a_token_of_four_times_the_ground_weighs_as_four(encoder: Encoder):
    """With alpha = 1 one token of twice the side does to the others what four equal tokens do."""
    encoder.area_weight.fill_(1.0)
    x, scale, valid = _tokens(6)
    wide = scale.clone()
    wide[0, 0] = 1.0
    x_four = torch.cat([x, x[:, :1].expand(-1, 3, -1)], dim=1)
    four = encoder(x_four, torch.zeros(1, 9), torch.ones(1, 9, dtype=torch.bool))
    assert (encoder(x, wide, valid) - four[:, :6]).abs().max() <= 2e-6


@torch.inference_mode()
def test_ground_does_not_count_before_it_is_learned(encoder: Encoder):
    """A new encoder treats tokens of both scales alike."""
    x, scale, valid = _tokens(6)
    assert (encoder(x, scale + 2, valid) == encoder(x, scale, valid)).all()


@torch.inference_mode()
def test_logits_stay_bounded(encoder: Encoder):
    """Attention sees normalised queries and keys: inputs a million times larger give a finite result."""
    x, scale, valid = _tokens(6)
    assert encoder(1e6 * x, scale, valid).isfinite().all()


def test_heads_must_share_the_width():
    """The message says width and heads."""
    with pytest.raises(ShapeError, match="width 16 do not divide by 3 heads"):
        Attention(16, 3)
