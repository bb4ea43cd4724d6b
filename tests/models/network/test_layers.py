"""Parts of the networks: the transformer, patches down to tokens and back up, and codes of places."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from models.network.layers import (
    ChannelNorm,
    Encoder,
    PatchHead,
    PatchStem,
    TokenAttention,
    code_1d,
    code_2d,
    paper_numbers,
)
from models.network.sizes import level_widths
from pipeline.errors import ShapeError
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
    stem, patches = PatchStem(3, [8, 16], 12, 1), noise(0, 7, 3, 8, 8)
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
    x = noise(4, 2, 8, 3, 3)
    assert (ChannelNorm(8)(10 * x) - ChannelNorm(8)(x)).abs().max() <= 1e-4


PLACE = st.tuples(st.integers(0, 4000), st.integers(0, 4000))


@given(PLACE, PLACE, PLACE)
def test_codes_know_distances_not_places(a: tuple[int, int], b: tuple[int, int], by: tuple[int, int]):
    """The product of two codes depends on the way between them alone, so crops can lie anywhere."""
    here, there, shift = (torch.tensor(place, dtype=torch.float64) for place in (a, b, by))
    still = code_2d(here, 32) @ code_2d(there, 32)
    moved = code_2d(here + shift, 32) @ code_2d(there + shift, 32)
    assert moved.item() == pytest.approx(still.item(), abs=1e-5)


def test_a_code_repeats_from_two_seats_to_128():
    """The quickest sine has a period of 2 seats, the slowest of 128, alike down and across."""
    near, two, far = (code_2d(torch.tensor([y, y], dtype=torch.float64), 16) for y in (0.3, 2.3, 128.3))
    assert near[[0, 8]] == pytest.approx(two[[0, 8]], abs=1e-6)
    assert near[[3, 11]] == pytest.approx(far[[3, 11]], abs=1e-6)
    assert near[:8].tolist() == near[8:].tolist()


def test_rows_do_not_wrap_in_two_dimensions():
    """The far side of the row before is no neighbour, as it is in the paper's code."""
    start, right, wrapped = (code_2d(torch.tensor(yx), 128) for yx in ([5.5, 15.5], [5.5, 16.5], [6.5, 0.5]))
    assert start @ right > 1.2 * (start @ wrapped)


def test_width_and_precision_are_checked():
    """A width that does not divide by 4 and places in half precision are refused."""
    with pytest.raises(ShapeError, match="divides by 4, got 10"):
        code_2d(torch.zeros(1, 2), 10)
    with pytest.raises(ShapeError, match=r"got torch\.bfloat16"):
        code_2d(torch.zeros(1, 2, dtype=torch.bfloat16), 16)
    with pytest.raises(ShapeError, match=r"got torch\.float16"):
        code_1d(torch.zeros(1, dtype=torch.float16), 16)


def _paper(yx: list[list[float]], fine: bool, columns: int = 16, factor: int = 2) -> list[float]:
    places = torch.tensor(yx, dtype=torch.float64)
    scale = torch.full((len(yx),), 0.0 if fine else 1.0)
    return paper_numbers(places, scale, columns, factor).tolist()


def test_patches_are_numbered_as_in_the_paper():
    """With 4 seats a patch: 1, 6, 11 ... along a row, and the paper's example 21 -> 26."""
    row = [[1.0, 2.0 * n + 1] for n in range(6)]
    assert _paper(row, fine=False) == [1, 6, 11, 16, 21, 26]
    assert _paper([[3.0, 1.0]], fine=False) == [16 * 5 + 1]  # the next row goes on counting


def test_seats_follow_their_patch():
    """The seats of patch 21 are 22 to 25, row by row, and 26 is the next patch."""
    seats = [[y + 0.5, 8 + x + 0.5] for y in (0, 1) for x in (0, 1)]
    assert _paper(seats, fine=True) == [22, 23, 24, 25]


@pytest.mark.parametrize(("factor", "size"), [(2, (3, 5)), (4, (2, 3))])
def test_no_number_is_given_twice(factor: int, size: tuple[int, int]):
    """Patches and seats of a whole scene together take every number from 1 once."""
    rows, columns = size
    patches = [[(y + 0.5) * factor, (x + 0.5) * factor] for y in range(rows) for x in range(columns)]
    seats = [[y + 0.5, x + 0.5] for y in range(rows * factor) for x in range(columns * factor)]
    numbers = _paper(patches, False, columns, factor) + _paper(seats, True, columns, factor)
    assert sorted(numbers) == list(range(1, rows * columns * (factor**2 + 1) + 1))


@pytest.mark.parametrize(
    ("first", "second", "cosine"),
    [(21, 26, 0.741), (21, 101, 0.459), (76, 81, 0.741), (21, 22, 0.973), (21, 25, 0.769), (25, 26, 0.973)],
)
def test_the_papers_code_has_no_columns(first: int, second: int, cosine: float):
    """Right neighbour and row wrap look alike, and a patch's last seat is nearer to the next patch."""
    a, b = code_1d(torch.tensor([first, second]), 768)
    assert torch.cosine_similarity(a, b, dim=0).item() == pytest.approx(cosine, abs=1e-3)
