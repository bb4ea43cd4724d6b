"""Controls on one scene: borders, chunks, seats that are missing, and what they cost."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode, sdpa_flop_count

from models.network.sizes import PRESETS, control_multiply_adds
from models.reading import control_maps
from models.reading.control_maps import draw_with_control
from models.reading.inference import CoarseLook, look_coarsely
from models.weights.files import AnyWeights
from pipeline.errors import ShapeError
from pipeline.geometry.grid import SceneGrid
from tests.models.conftest import ControlMaker, Maker

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


@pytest.mark.parametrize("preset", ["dense", "upsampled", "coarser"])
def test_the_size_of_chunks_changes_nothing(make_control: ControlMaker, preset: str, monkeypatch: pytest.MonkeyPatch):
    """Patches read 3 at a time give the map of all at once."""
    weights = make_control(preset)
    look, fine = _look(weights, 45, 61)
    seats = look.grid.valid_seats()
    first = draw_with_control(weights, look, fine[seats], seats)
    monkeypatch.setattr(control_maps, "PATCHES_AT_ONCE", 3)
    other = draw_with_control(weights, look, fine[seats], seats)
    assert np.abs(first.confidence - other.confidence).max() <= 1e-5
    assert (first.classes == other.classes).mean() > 0.999  # a tie may fall either way


@pytest.mark.parametrize("preset", CONTROLS)
def test_the_order_of_seats_changes_nothing(make_control: ControlMaker, preset: str):
    """Patches come with their numbers: in another order, and with padded ones among them, the map is the same."""
    weights = make_control(preset)
    look, fine = _look(weights, 24, 40)
    seats = look.grid.valid_seats()
    every = np.arange(len(fine))[::-1] if preset != "paper" else seats[::-1]
    drawn = [draw_with_control(weights, look, fine[some], some) for some in (seats, every)]
    assert np.abs(drawn[0].confidence - drawn[1].confidence).max() <= 1e-5


@pytest.mark.parametrize("preset", ["dense", "coarser"])
def test_missing_seats_are_counted(make_control: ControlMaker, preset: str):
    """A dense control that does not get the whole scene says how much is missing."""
    weights = make_control(preset)
    look, fine = _look(weights, 24, 40)
    seats = look.grid.valid_seats()[2:]
    with pytest.raises(ShapeError, match="reads all 15 valid seats, 2 of them are missing"):
        draw_with_control(weights, look, fine[seats], seats)


def test_upsampled_needs_no_seat(make_control: ControlMaker):
    """With each seat or none, the map is the same."""
    weights = make_control("upsampled")
    look, fine = _look(weights, 24, 40)
    seats = look.grid.valid_seats()
    drawn = [draw_with_control(weights, look, fine[some], some) for some in (seats, seats[:0])]
    assert (drawn[0].confidence == drawn[1].confidence).all()


def test_pixels_without_a_value_are_the_median(make_control: ControlMaker):
    """NaN and infinity count as 0, which is the median of a normalised column."""
    for preset in CONTROLS:
        weights = make_control(preset)
        look, fine = _look(weights, 24, 40)
        seats = look.grid.valid_seats()
        spoilt, zeroed = fine[seats].copy(), fine[seats].copy()
        spoilt[:, 2:4, 1], spoilt[:, 5, 5] = np.nan, np.inf
        zeroed[:, 2:4, 1], zeroed[:, 5, 5] = 0, 0
        maps = [draw_with_control(weights, look, patches, seats) for patches in (spoilt, zeroed)]
        assert (maps[0].confidence == maps[1].confidence).all()


def test_what_does_not_fit_is_refused(make_control: ControlMaker, tiny: Maker):
    """Weights of two scales, seats given twice or off the grid, and patches of another shape."""
    weights = make_control("paper")
    look, fine = _look(weights, 24, 40)
    with pytest.raises(ShapeError, match=r"of two scales; draw with models.reading.inference.segment"):
        draw_with_control(tiny(), look, fine[:1], np.array([0]))
    with pytest.raises(ShapeError, match="seat 3 is given more than once"):
        draw_with_control(weights, look, fine[:2], np.array([3, 3]))
    with pytest.raises(ShapeError, match="seat 99 is none of the"):
        draw_with_control(weights, look, fine[:1], np.array([99]))
    with pytest.raises(ShapeError, match=r"expected patches of shape \(1, 8, 8, 4\)"):
        draw_with_control(weights, look, fine[:2], np.array([0]))


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


def test_bands_are_paid_for_what_is_looked_at(make_control: ControlMaker):
    """Gathering bands costs a product a band and column for each px that is read: fine, coarse or mean."""
    grid = SceneGrid(64, 96, 8, 4)
    looked_at = {"dense": 64 * 96, "upsampled": 16 * 24, "coarser": 32 * 48, "paper": 16 * 24 + 5 * 64}
    for preset, pixels in looked_at.items():
        config = make_control(preset, factor=4).config
        few, many = (control_multiply_adds(config, grid, 5, bands).total for bands in (0, 10))
        assert many - few == pixels * 10 * config.columns
