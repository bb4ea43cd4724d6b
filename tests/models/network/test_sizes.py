"""Multiply-adds against torch's own counter."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode, sdpa_flop_count

from models.network.segmenter import Segmenter
from models.network.sizes import SegmenterConfig, multiply_adds
from models.policies.policies import score_multiply_adds
from pipeline.geometry.grid import SceneGrid


def _attention(q: Any, k: Any, v: Any, *args: Any, out_shape: Any = None, **kwargs: Any) -> int:
    return sdpa_flop_count(q, k, v)


@pytest.mark.parametrize("kernel", [False, True])
@pytest.mark.parametrize(("patch", "factor", "patch_index"), [(16, 4, 7), (8, 2, 1), (32, 4, 3)])
def test_closed_form_equals_the_counter(patch: int, factor: int, patch_index: int, kernel: bool) -> None:
    """The closed form counts just what torch counts while the model runs."""
    config = SegmenterConfig(classes=5, columns=6, patch=patch, factor=factor, patch_kernel=kernel)
    model = Segmenter(config).eval()
    grid = SceneGrid(2 * patch * factor, 3 * patch * factor, patch, factor)
    coarse = torch.zeros(1, 6, 2 * patch, 3 * patch)
    counter = FlopCounterMode(
        display=False, custom_mapping={torch.ops.aten._scaled_dot_product_flash_attention_for_cpu: _attention}
    )
    with torch.inference_mode(), counter:
        model(coarse, torch.zeros(1, patch_index, 6, patch, patch), torch.arange(patch_index)[None])
    assert multiply_adds(config, grid, patch_index, 0).total == counter.get_total_flops() / 2


def test_more_patches_cost_more() -> None:
    """The coarse prediction does not depend on the patches; encode and decode grow with them."""
    config, grid = SegmenterConfig(classes=5), SceneGrid(256, 256, 16, 4)
    few, many = (multiply_adds(config, grid, patch_index, 270) for patch_index in (1, 20))
    assert few.coarse_prediction == many.coarse_prediction
    assert few.encode < many.encode
    assert few.decode < many.decode


@pytest.mark.parametrize("patch", [16, 32])
def test_received_attention_costs_one_layer_of_weights(patch: int) -> None:
    """Queries times keys of the last layer, and what each token receives summed over heads and queries."""
    config, grid = SegmenterConfig(classes=5, patch=patch), SceneGrid(10 * patch, 8 * patch, patch, 4)
    tokens = 3 * 2 * config.token_side**2  # coarse patches, the last row of them partly off the scene
    queries = torch.zeros(config.heads, tokens, config.dim // config.heads, device="meta")
    with FlopCounterMode(display=False) as counter:
        _ = queries @ queries.transpose(1, 2)
    added = score_multiply_adds("self-attention", config, grid)
    assert added == counter.get_total_flops() / 2 + config.heads * tokens**2


@pytest.mark.parametrize(("policy", "times"), [("sobel", 1), ("saliency", 2), ("spectral-residual", 1)])
def test_policies_of_the_image_go_through_all_columns(policy: str, times: int) -> None:
    """Each column more adds one multiply-add a coarse pixel for every pass over them."""
    grid = SceneGrid(256, 256, 16, 4)
    few, many = (score_multiply_adds(policy, SegmenterConfig(5, columns), grid) for columns in (2, 24))
    assert many - few == times * 22 * 64 * 64
