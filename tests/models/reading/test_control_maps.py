"""Controls on one scene: borders, chunks, seats that are missing, and what they cost."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode, sdpa_flop_count

from models.network.sizes import PRESETS, control_multiply_adds
from models.reading.control_maps import draw_with_control
from models.reading.inference import CoarseLook, look_coarsely
from models.weights.files import AnyWeights
from pipeline.geometry.grid import SceneGrid
from tests.models.conftest import ControlMaker

NM = np.linspace(400, 1000, 9)
CONTROLS = [preset for preset in PRESETS if preset != "two-scale"]


def _look(weights: AnyWeights, height: int, width: int) -> tuple[CoarseLook, np.ndarray]:
    """The coarse look at a random scene, and a patch for every seat."""
    p, s, columns = weights.config.patch, weights.config.factor, weights.config.columns
    grid, rng = SceneGrid(height, width, p, s), np.random.default_rng(0)
    look = look_coarsely(weights, [rng.uniform(0.1, 0.5, (*grid.coarse_shape, len(NM)))], NM, grid)
    count = grid.seat_shape[0] * grid.seat_shape[1]
    return look, rng.normal(0, 1, (count, p, p, columns)).astype(np.float32)


@pytest.mark.parametrize("size", [(37, 53), (1, 1), (32, 16), (48, 15)])
@pytest.mark.parametrize("preset", CONTROLS)
def test_maps_have_the_size_of_the_scene(make_control: ControlMaker, preset: str, size: tuple[int, int]):
    """Any size works, down to a single pixel."""
    weights = make_control(preset)
    look, fine = _look(weights, *size)
    seats = look.grid.valid_seats()
    drawn = draw_with_control(weights, look, fine[seats], seats)
    assert drawn.classes.shape == drawn.confidence.shape == size
    assert drawn.classes.max() < 3
    assert 1 / 3 - 1e-6 <= drawn.confidence.min() <= drawn.confidence.max() <= 1


@pytest.mark.parametrize("preset", CONTROLS)
def test_maps_are_those_that_training_saw(make_control: ControlMaker, preset: str):
    """Patches read some at a time and logits brought up in strips give the map that the loss is taken of."""
    weights = make_control(preset, factor=4)
    look, fine = _look(weights, 64, 96)
    seats = look.grid.valid_seats()[:: 7 if preset == "paper" else 1]
    drawn = draw_with_control(weights, look, fine[seats], seats)
    network: Any = weights.network
    with torch.inference_mode():
        patches = torch.from_numpy(fine[seats]).permute(0, 3, 1, 2)[None]
        coarse = torch.from_numpy(look.columns).permute(2, 0, 1)[None]
        logits = network.draw(coarse, patches, torch.from_numpy(seats)[None])[0].softmax(dim=0)
    assert np.abs(drawn.confidence - logits.max(dim=0)[0].numpy()).max() <= 1e-5


def _attention(q: Any, k: Any, v: Any, *args: Any, out_shape: Any = None, **kwargs: Any) -> int:
    return sdpa_flop_count(q, k, v)


@pytest.mark.parametrize("sizes", [{"patch": 16, "factor": 4}, {"patch": 8, "factor": 2}, {"patch": 32, "factor": 4}])
@pytest.mark.parametrize("preset", CONTROLS)
def test_closed_forms_equal_the_counter(make_control: ControlMaker, preset: str, sizes: dict[str, int]):
    """The closed form counts just what torch counts while the map is drawn, at borders too."""
    weights = make_control(preset, layers=2, **sizes)
    step = sizes["patch"]
    look, fine = _look(weights, 5 * step - 3, 3 * step + 1)
    seats = look.grid.valid_seats()[: 4 if preset == "paper" else None]
    counter = FlopCounterMode(
        display=False, custom_mapping={torch.ops.aten._scaled_dot_product_flash_attention_for_cpu: _attention}
    )
    with counter:
        draw_with_control(weights, look, fine[seats], seats)
    assert control_multiply_adds(weights.config, look.grid, len(seats), 0).total == counter.get_total_flops() / 2
