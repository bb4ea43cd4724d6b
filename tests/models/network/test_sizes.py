"""Multiply-adds against torch's own counter."""

from __future__ import annotations

import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode, sdpa_flop_count

from models.network.segmenter import Segmenter
from models.network.sizes import CELL_PX, PLANES, SegmenterConfig, TemporalSizes, multiply_adds
from models.network.temporal_reader import TemporalReader
from models.policies.policies import score_multiply_adds
from pipeline.geometry.grid import SceneGrid


@pytest.mark.parametrize(
    ("sizes", "patch_index"),
    [({"patch": 16}, 7), ({"patch": 8, "overview_width": 12}, 1), ({"patch": 32, "layers": 1, "deep": True}, 3)],
)
@pytest.mark.parametrize("width", [96, 104])  # with patches of 8 px, a part of the last tokens
def test_closed_form_equals_the_counter(sizes: dict[str, int], patch_index: int, width: int) -> None:
    """The closed form counts just what torch counts while the model runs."""
    config = SegmenterConfig(classes=5, columns=6, **sizes)
    grid = SceneGrid(64, width, config.patch)
    model, image = Segmenter(config).eval(), torch.zeros(1, 6 + PLANES, *grid.padded_shape)
    attention = torch.ops.aten._scaled_dot_product_flash_attention_for_cpu
    flops = {attention: lambda q, k, v, *args, out_shape=None, **kwargs: sdpa_flop_count(q, k, v)}
    counter = FlopCounterMode(display=False, custom_mapping=flops)
    with torch.inference_mode(), counter:
        model(image, image, torch.arange(patch_index)[None], torch.zeros(1, 2))
    assert multiply_adds(config, grid, patch_index, 0).total == counter.get_total_flops() / 2


def test_the_temporal_reader_costs_what_the_counter_counts() -> None:
    """Its closed form too, of fine and coarse pixels."""
    sizes = TemporalSizes(classes=5, columns=6)
    fine, coarse = torch.zeros(1, 1, 16, 24), torch.zeros(1, 6, 16 // CELL_PX, 24 // CELL_PX)
    scores, one, counter = fine.expand(1, 5, 16, 24), torch.ones(1), FlopCounterMode(display=False)
    with torch.inference_mode(), counter:
        TemporalReader(sizes).eval()(
            scores, scores, fine, fine, fine, one, one, torch.zeros(1, 2), coarse, coarse, coarse[:, :1]
        )
    assert sizes.multiply_adds(16 * 24) == counter.get_total_flops() / 2


def test_each_patch_costs_the_same_and_the_overview_none_of_it() -> None:
    """What the policy took is added; columns are made of each band, again for patches that were captured apart."""
    config = SegmenterConfig(classes=5)
    grid = SceneGrid(250, 256, 16)
    one, many, bare = (multiply_adds(config, grid, *given, score=9) for given in ((1, 270), (20, 270), (20, 0)))
    assert one.overview == many.overview == bare.overview + 256**2 * 270 * config.columns
    assert 20 * one.detail == many.detail == bare.detail
    apart = multiply_adds(config, grid, 20, 270, apart=True)
    assert apart.detail == bare.detail + 20 * 16**2 * 270 * config.columns
    assert many.total == many.overview + many.detail + 9


def test_edges_go_through_all_columns_once() -> None:
    """Each column more adds one multiply-add a pixel."""
    grid = SceneGrid(256, 256, 16)
    few, many = (score_multiply_adds("sobel", SegmenterConfig(5, columns), grid) for columns in (2, 24))
    assert many - few == 22 * 256 * 256
