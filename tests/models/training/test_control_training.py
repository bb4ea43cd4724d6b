"""Training of the networks that the segmenter is compared with, and their weights on disk."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from models.network.controls import build_network
from models.network.sizes import PRESETS, Preset, SegmenterConfig
from models.reading.control_maps import draw_with_control
from models.reading.inference import CoarseLook
from models.training.examples import Batch, CropSampler
from models.training.objective import SHARES, batch_loss, draw_paper_seats, phase_at
from models.training.train import TrainingSettings, run_identity, train
from models.weights.files import (
    Weights,
    check_two_scale,
    describe_weights,
    load_any_weights,
    load_weights,
    save_weights,
)
from pipeline.errors import WeightsError
from pipeline.geometry.grid import SceneGrid
from tests.models.conftest import ControlMaker, block_example, killed_after

CONFIG = SegmenterConfig(classes=3, columns=2, patch=8, factor=2, width=8, dim=16, layers=1, heads=2)
SETTINGS = TrainingSettings(steps=3, batch=2, crop=32, learning_rate=3e-3)
SHIFT = np.zeros(2, np.float32)
CONTROLS: list[Preset] = [preset for preset in PRESETS if preset != "two-scale"]


def _config(preset: Preset) -> SegmenterConfig:
    return replace(CONFIG, **PRESETS[preset])


def _batch(count: int = 2) -> Batch:
    return CropSampler([block_example(64, 16)], 8, 2, 32).draw(count, np.random.default_rng(0), SHIFT)


@pytest.mark.parametrize("preset", CONTROLS)
def test_a_killed_run_goes_on(preset: Preset, tmp_path: Path):
    """A control's checkpoint is gone on from; every preset's runs are told apart."""

    path, settings = tmp_path / "c", replace(SETTINGS, steps=4)
    with pytest.raises(KeyboardInterrupt):
        train(
            _config(preset), [block_example(64, 16)], SHIFT, settings, killed_after(3), checkpoint=path, keep_every_s=0
        )
    steps: list[int] = []
    train(
        _config(preset), [block_example(64, 16)], SHIFT, settings, lambda now: steps.append(now.step), checkpoint=path
    )
    assert steps == [3, 4]  # the killed step was not kept
    assert len({run_identity(_config(kind), [block_example(64, 16)], settings) for kind in PRESETS}) == len(PRESETS)


@pytest.mark.parametrize("preset", ["dense", "coarser", "upsampled"])
def test_dense_controls_draw_no_chance(preset: Preset):
    """They read each seat, whatever the generator says: two streams give one loss."""
    model, weight = build_network(_config(preset)), torch.ones(3)
    losses = [
        batch_loss(model, _batch(), weight, np.random.default_rng(seed), phase_at(0.0), soft_dice=True)
        for seed in (0, 1)
    ]
    assert losses[0] == losses[1]
    assert losses[0].requires_grad


def test_paper_seats_are_distinct_and_sometimes_none():
    """Every share of the segmenter's training occurs, no seat twice in a scene; some crops get no seat."""
    coarse = torch.randn(3, 2, 32, 32, generator=torch.Generator().manual_seed(0))
    drawn = [draw_paper_seats(coarse, 64, CONFIG, np.random.default_rng(seed)) for seed in range(80)]
    assert {row.shape[1] for row in drawn} == {0, *(round(64 * share) for share, _ in SHARES)}
    assert all(len(scene.unique()) == len(scene) for row in drawn for scene in row)
    assert {int(row.max()) for row in drawn if row.numel()} <= set(range(64))


def test_half_of_the_papers_seats_lie_on_edges():
    """With one edge in the coarse image, about half of the draws begin with a seat that touches it."""
    coarse = torch.zeros(1, 2, 32, 32)
    coarse[..., 18:] = 1.0  # an edge between columns 17 and 18: seats of column 4
    drawn = (draw_paper_seats(coarse, 64, CONFIG, np.random.default_rng(seed)) for seed in range(80))
    first = [int(row[0, 0]) % 8 == 4 for row in drawn if row.numel()]
    assert 0.35 < np.mean(first) < 0.75


@pytest.mark.parametrize("preset", PRESETS)
def test_weights_of_any_design_come_back(make_control: ControlMaker, preset: Preset, tmp_path: Path):
    """What was saved is loaded bit by bit and draws the same map."""
    path, before = tmp_path / "w.safetensors", make_control(preset)
    save_weights(before, path)
    after = load_any_weights(path)
    old, new = before.network.state_dict(), after.network.state_dict()
    assert list(old) == list(new)
    assert all(torch.equal(old[name], new[name]) for name in old)
    assert (after.config, after.basis, after.record) == (before.config, before.basis, before.record)
    assert describe_weights(path).config.preset == preset
    assert isinstance(after, Weights) == (preset == "two-scale")
    if preset != "two-scale":
        grid, rng = SceneGrid(16, 16, 8, 2), np.random.default_rng(0)
        look = CoarseLook(grid, rng.normal(0, 1, (8, 8, 4)).astype(np.float32))
        fine = rng.normal(0, 1, (4, 8, 8, 4))
        maps = [draw_with_control(weights, look, fine, np.arange(4)) for weights in (before, after)]
        assert (maps[0].confidence == maps[1].confidence).all()


@pytest.mark.parametrize("preset", CONTROLS)
def test_a_survey_refuses_a_control(make_control: ControlMaker, preset: Preset, tmp_path: Path):
    """The message names the file, the control in it, and how weights for a survey are made."""
    path = tmp_path / "w.safetensors"
    save_weights(make_control(preset), path)
    with pytest.raises(WeightsError, match=f"w.safetensors holds the control '{preset}'.*spectralzoom train DATASET"):
        load_weights(path)
    with pytest.raises(WeightsError, match="a survey needs weights of two scales"):
        check_two_scale(describe_weights(path).config, path)
