"""The segmenter and its layers: dependencies of overview and patches, composites, and multiply-adds."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import torch.nn.functional as F  # noqa: N812 - its usual name
from hypothesis import given
from hypothesis import strategies as st
from torch.utils.flop_counter import FlopCounterMode, sdpa_flop_count

from spectralzoom.models.network.layers import AROUND_PX, mean_around
from spectralzoom.models.network.segmenter import Head, Segmenter, Stem, cut, joined
from spectralzoom.models.network.sizes import (
    CELL_PX,
    PLANES,
    TOKEN_PX,
    SegmenterConfig,
    TemporalSizes,
    level_widths,
    multiply_adds,
)
from spectralzoom.models.network.temporal_reader import TemporalReader
from spectralzoom.models.policies.policies import score_multiply_adds
from spectralzoom.pipeline.geometry.grid import SceneGrid
from tests.models.conftest import make_network, noise, read_both

IMAGE = noise(0, 1, 4 + PLANES, 64, 96)  # 2 x 3 tokens, 8 x 12 patches


@torch.inference_mode()
@pytest.mark.parametrize("size", [(1, 1), (37, 53), (64, 65)])
def test_partial_tokens_are_read_with_a_repeated_border(size: tuple[int, int]):
    """An image of any size has the overview of the same image padded with its border to whole tokens."""
    model = make_network()
    image = IMAGE[..., : size[0], : size[1]]
    whole = F.pad(image, (0, -size[1] % 32, 0, -size[0] % 32), mode="replicate")
    own, expected = model.read_overview(image), model.read_overview(whole)
    assert own.logits.shape[2:] == own.features.shape[2:] == size
    for one, other in ((own.logits, expected.logits), (own.features, expected.features)):
        assert (one - other[..., : size[0], : size[1]]).abs().max() <= 1e-5


@pytest.mark.parametrize("size", [(1, 1), (2, 9), (40, 7)])
def test_means_around_a_pixel_ignore_what_is_beyond_the_border(size: tuple[int, int]):
    image = noise(1, 1, 3, *size)
    reach = AROUND_PX // 2
    for y, x in np.ndindex(size):
        around = image[..., max(0, y - reach) : y + reach + 1, max(0, x - reach) : x + reach + 1]
        assert (mean_around(image)[..., y, x] - around.mean(dim=(2, 3))).abs().max() <= 1e-5


@torch.inference_mode()
def test_a_patch_depends_on_its_own_pixels_and_overview_only():
    """Other patches, their order and the overview elsewhere do not change it."""
    model = make_network()
    numbers = torch.tensor([[5, 95, 13]])
    overview = model.read_overview(IMAGE)
    patches = cut(IMAGE.flip(2), 8)[:, numbers[0]]
    read = model.read_patches(overview, patches, numbers)
    alone = model.read_patches(overview, patches[:, 2:], numbers[:, 2:])
    assert (alone - read[:, 2:]).abs().max() <= 1e-5
    moved = model.read_overview(IMAGE)
    other = patches.clone()
    moved.features[..., 8:16, 8:16] += 1  # under patch 13
    other[:, 1] += 1
    for seen, which in (((moved, patches), 2), ((overview, other), 1)):
        changed = model.read_patches(*seen, numbers)
        assert [number for number in range(3) if (changed - read)[0, number].abs().max() > 1e-4] == [which]


@torch.inference_mode()
def test_composite_places_patches_by_their_numbers():
    """All other pixels have the overview's logits; each scene has its own patches, and there may be none."""
    model = make_network()
    overview = noise(0, 2, 3, 16, 32)
    fine = noise(1, 2, 3, 3, 8, 8)
    patch_index = torch.tensor([[0, 5, 7], [6, 1, 2]])
    expected = overview.clone()
    for scene in range(2):
        for place, number in enumerate(patch_index[scene].tolist()):
            y, x = number // 4 * 8, number % 4 * 8
            expected[scene, :, y : y + 8, x : x + 8] = fine[scene, place]
    assert torch.equal(model.composite(overview, fine, patch_index), expected)
    assert torch.equal(model.composite(overview, fine[:, :0], patch_index[:, :0]), overview)


def test_every_parameter_has_a_gradient():
    """The loss is that of a map with some patches."""
    model = make_network(layers=2)
    numbers = torch.tensor([[3, 0, 9]])
    logits, patches = read_both(model, IMAGE, IMAGE, numbers, torch.zeros(1, 2))
    model.composite(logits, patches, numbers).square().mean().backward()
    idle = [name for name, value in model.named_parameters() if value.grad is None or not value.grad.any()]
    assert not idle


@torch.inference_mode()
@pytest.mark.parametrize("patch", [4, 8, 32, 64])
def test_stem_and_head_keep_the_size_of_an_image(patch: int):
    """The stem has features of every level, finest first, down to 4 px; the head has the width per pixel."""
    widths = level_widths(8, patch)
    assert widths[:3] == [8, 16, 24][: len(widths)]
    features = Stem(5, widths)(torch.zeros(3, 5, patch, 2 * patch))
    shapes = [(3, width, patch >> i, 2 * patch >> i) for i, width in enumerate(widths)]
    assert [tuple(level.shape) for level in features] == shapes
    assert features[-1].shape[2] == 4
    assert Head(widths)(features).shape == (3, 8, patch, 2 * patch)


@given(st.integers(1, 3), st.integers(1, 4), st.sampled_from([1, 4]))
def test_cut_and_joined_patches_make_the_image_again(rows: int, columns: int, patch: int):
    """Patches are in order of rows: the second lies right of the first."""
    image = torch.arange(2 * 3 * rows * columns * patch**2).view(2, 3, rows * patch, columns * patch)
    cells = cut(image, patch)
    assert torch.equal(joined(cells, columns), image)
    if columns > 1:
        assert torch.equal(cells[:, 1], image[:, :, :patch, patch : 2 * patch])


@pytest.mark.parametrize(
    ("sizes", "patch_index"),
    [({"patch": 16}, 7), ({"patch": 8, "overview_width": 12}, 1), ({"patch": 32, "layers": 1, "deep": True}, 3)],
)
@pytest.mark.parametrize("width", [96, 104])  # with patches of 8 px, a part of the last tokens
def test_multiply_adds_equal_the_counter(sizes: dict[str, int], patch_index: int, width: int) -> None:
    """The closed form counts what torch counts while the model runs, less means and weights that are always 0."""
    config = SegmenterConfig(classes=5, columns=6, **sizes)
    grid = SceneGrid(64, width, config.patch)
    model = Segmenter(config).eval()
    image = torch.zeros(1, 6 + PLANES, *grid.padded_shape)
    attention = torch.ops.aten._scaled_dot_product_flash_attention_for_cpu
    flops = {attention: lambda q, k, v, *args, out_shape=None, **kwargs: sdpa_flop_count(q, k, v)}
    counter = FlopCounterMode(display=False, custom_mapping=flops)
    with torch.inference_mode(), counter:
        read_both(model, image, image, torch.arange(patch_index)[None], torch.zeros(1, 2))
    uncounted = 64 * -(-width // TOKEN_PX) * TOKEN_PX * config.classes * (AROUND_PX**2 + PLANES)
    assert multiply_adds(config, grid, patch_index, 0).total == counter.get_total_flops() / 2 - uncounted


def test_multiply_adds_of_the_temporal_reader_equal_the_counter() -> None:
    """The closed form covers fine and coarse pixels."""
    sizes = TemporalSizes(classes=5, columns=6)
    fine, coarse = torch.zeros(1, 1, 16, 24), torch.zeros(1, 6, 16 // CELL_PX, 24 // CELL_PX)
    scores = fine.expand(1, 5, 16, 24)
    one = torch.ones(1)
    reader = TemporalReader(sizes).eval()
    counter = FlopCounterMode(display=False)
    with torch.inference_mode(), counter:
        reader(scores, scores, fine, fine, fine, one, one, torch.zeros(1, 2), coarse, coarse, coarse[:, :1])
    assert sizes.multiply_adds(16 * 24) == counter.get_total_flops() / 2


def test_multiply_adds_are_proportional_to_patches() -> None:
    """Columns are computed from each band once; those of the policy are added."""
    config = SegmenterConfig(classes=5)
    grid = SceneGrid(250, 256, 16)
    one, many, bare = (multiply_adds(config, grid, *given, score=9) for given in ((1, 270), (20, 270), (20, 0)))
    assert one.overview == many.overview == bare.overview + 256**2 * 270 * config.columns
    assert 20 * one.detail == many.detail == bare.detail
    assert many.total == many.overview + many.detail + 9


def test_sobel_adds_one_multiply_add_per_column() -> None:
    """With 24 columns instead of 2 it takes 22 more per pixel."""
    grid = SceneGrid(256, 256, 16)
    few, many = (score_multiply_adds("sobel", SegmenterConfig(5, columns), grid) for columns in (2, 24))
    assert many - few == 22 * 256 * 256
