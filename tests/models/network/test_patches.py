"""Patches to features and tokens, and back up to features per pixel."""

from __future__ import annotations

import pytest
import torch

from models.network.layers import ChannelNorm, PatchHead, PatchStem
from models.network.sizes import level_widths
from pipeline.errors import ShapeError


@pytest.mark.parametrize(
    ("patch", "widths"), [(4, [8]), (8, [8, 16]), (16, [8, 16, 24]), (32, [8, 16, 24, 24]), (64, [8, 16, 24, 24, 24])]
)
def test_levels_go_down_to_four_pixels(patch: int, widths: list[int]):
    """Each halving is a level; channels grow to three times the width."""
    assert level_widths(8, patch) == widths


@pytest.mark.parametrize("patch", [0, 1, 2, 6, 12, 24, 40])
def test_patches_that_cannot_be_halved_to_four_are_refused(patch: int):
    """The message names the size."""
    with pytest.raises(ShapeError, match=f"power of two, got {patch};"):
        level_widths(8, patch)


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


@torch.inference_mode()
def test_context_falls_where_its_token_stands():
    """A token's context reaches the part of the patch that it stands for, and little else."""
    widths = level_widths(8, 32)
    head = PatchHead(widths, 12, 2)
    features = [torch.zeros(1, width, 32 >> i, 32 >> i) for i, width in enumerate(widths)]
    tokens = torch.zeros(1, 4, 12)
    still = head(features, tokens)
    tokens[0, 2] = 1.0  # below, left
    moved = (head(features, tokens) - still).abs().sum(dim=1)[0]
    assert moved[16:, :16].mean() > 4 * moved[:16, 16:].mean()


@torch.inference_mode()
def test_patches_do_not_see_each_other():
    """A patch reads the same alone and among others."""
    stem, patches = PatchStem(3, [8, 16], 12, 1), torch.randn(7, 3, 8, 8, generator=torch.Generator().manual_seed(0))
    _, together = stem(patches)
    alone = torch.cat([stem(patch[None])[1] for patch in patches])
    assert (together - alone).abs().max() <= 1e-6


def test_an_empty_pixel_has_a_finite_norm_and_gradient():
    """The norm of zeros is zero, and its gradient stays below 1000."""
    zero = torch.zeros(1, 8, 2, 2, requires_grad=True)
    normed = ChannelNorm(8)(zero)
    normed.sum().backward()
    assert not normed.any()
    assert zero.grad is not None
    assert zero.grad.abs().max() <= 1000.1


@torch.inference_mode()
def test_the_norm_forgets_brightness():
    """A pixel ten times as bright is normed to the same values."""
    x = torch.randn(2, 8, 3, 3, generator=torch.Generator().manual_seed(4))
    assert (ChannelNorm(8)(10 * x) - ChannelNorm(8)(x)).abs().max() <= 1e-4
