"""Multiply-adds against torch's own counter."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode, sdpa_flop_count

from models.network.segmenter import Segmenter
from models.network.sizes import SegmenterConfig, TemporalSizes, multiply_adds
from models.network.temporal_reader import TemporalReader
from models.policies.policies import score_multiply_adds
from pipeline.geometry.grid import SceneGrid


def _attention(q: Any, k: Any, v: Any, *args: Any, out_shape: Any = None, **kwargs: Any) -> int:
    return sdpa_flop_count(q, k, v)


@pytest.mark.parametrize(("patch", "factor", "patch_index"), [(16, 4, 7), (8, 2, 1), (32, 4, 3)])
def test_closed_form_equals_the_counter(patch: int, factor: int, patch_index: int) -> None:
    """The closed form counts just what torch counts while the model runs."""
    config = SegmenterConfig(classes=5, columns=6, patch=patch, factor=factor)
    model = Segmenter(config).eval()
    grid = SceneGrid(2 * patch * factor, 3 * patch * factor, patch, factor)
    coarse = torch.zeros(1, 6, 2 * patch, 3 * patch)
    counter = FlopCounterMode(
        display=False, custom_mapping={torch.ops.aten._scaled_dot_product_flash_attention_for_cpu: _attention}
    )
    with torch.inference_mode(), counter:
        model(coarse, torch.zeros(1, patch_index, 6, patch, patch), torch.arange(patch_index)[None])
    assert multiply_adds(config, grid, patch_index, 0).total == counter.get_total_flops() / 2


@pytest.mark.parametrize("factor", [2, 4])
def test_the_temporal_reader_costs_what_the_counter_counts(factor: int) -> None:
    """Its closed form too, of fine and coarse pixels."""
    sizes = TemporalSizes(classes=5, columns=6, factor=factor)
    fine, coarse = torch.zeros(1, 1, 16, 24), torch.zeros(1, 6, 16 // factor, 24 // factor)
    scores, one, counter = fine.expand(1, 5, 16, 24), torch.ones(1), FlopCounterMode(display=False)
    with torch.inference_mode(), counter:
        TemporalReader(sizes).eval()(scores, scores, fine, fine, fine, one, one, coarse, coarse, coarse[:, :1])
    assert sizes.multiply_adds(16 * 24) == counter.get_total_flops() / 2


def test_more_patches_cost_more() -> None:
    """The coarse prediction does not depend on the patches; encode and decode grow with them."""
    config, grid = SegmenterConfig(classes=5), SceneGrid(256, 256, 16, 4)
    few, many = (multiply_adds(config, grid, patch_index, 270) for patch_index in (1, 20))
    assert few.coarse_prediction == many.coarse_prediction
    assert few.encode < many.encode
    assert few.decode < many.decode


def test_edges_go_through_all_columns_once() -> None:
    """Each column more adds one multiply-add a coarse pixel."""
    grid = SceneGrid(256, 256, 16, 4)
    few, many = (score_multiply_adds("sobel", SegmenterConfig(5, columns), grid) for columns in (2, 24))
    assert many - few == 22 * 64 * 64
