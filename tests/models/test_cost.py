"""Multiply-adds against torch's own counter."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode, sdpa_flop_count

from models.cost import multiply_adds
from models.segmenter import Segmenter, SegmenterConfig
from pipeline.grid import SceneGrid


def _attention(q: Any, k: Any, v: Any, *args: Any, out_shape: Any = None, **kwargs: Any) -> int:
    return sdpa_flop_count(q, k, v)


@pytest.mark.parametrize(("patch", "factor", "seats"), [(16, 4, 7), (8, 2, 1), (32, 4, 3)])
def test_closed_form_equals_the_counter(patch: int, factor: int, seats: int) -> None:
    """The closed form counts just what torch counts while the model runs."""
    config = SegmenterConfig(classes=5, columns=6, patch=patch, factor=factor)
    model = Segmenter(config).eval()
    grid = SceneGrid(2 * patch * factor, 3 * patch * factor, patch, factor)
    coarse = torch.zeros(1, 6, 2 * patch, 3 * patch)
    counter = FlopCounterMode(
        display=False, custom_mapping={torch.ops.aten._scaled_dot_product_flash_attention_for_cpu: _attention}
    )
    with torch.inference_mode(), counter:
        model(model.view(coarse), torch.zeros(1, seats, 6, patch, patch), torch.arange(seats)[None])
    assert multiply_adds(config, grid, seats, 0, None).total == counter.get_total_flops() / 2


def test_more_seats_cost_more() -> None:
    """Glance and score do not depend on the seats; encode and decode grow with them."""
    config, grid = SegmenterConfig(classes=5), SceneGrid(256, 256, 16, 4)
    few, many = (multiply_adds(config, grid, seats, 270, "entropy") for seats in (1, 20))
    assert (few.glance, few.score) == (many.glance, many.score)
    assert few.encode < many.encode
    assert few.decode < many.decode
