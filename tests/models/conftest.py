"""A segmenter small enough for tests, with weights of its own for every term that starts from zero."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from models.network.controls import build_network
from models.network.segmenter import Segmenter, SegmenterConfig
from models.network.sizes import PRESETS, Preset
from models.network.spectral import Normalisation, SpectralBasis
from models.weights.files import AnyWeights, Weights

Maker = Callable[..., Weights]


def make_weights(seed: int = 0, **sizes: Any) -> Weights:
    """Random weights of the given sizes; whatever training starts from zero is drawn too, so that nothing is idle."""
    made = make_any_weights(seed, **sizes)
    assert isinstance(made.network, Segmenter)
    return Weights(made.network, made.basis, made.normalisation, made.class_names, made.class_colours, made.record)


def make_any_weights(seed: int = 0, **sizes: Any) -> AnyWeights:
    """Random weights of the network that the sizes name."""
    small = {
        "classes": 3,
        "columns": 4,
        "patch": 8,
        "factor": 2,
        "width": 8,
        "coarse_width": 8,
        "dim": 16,
        "layers": 1,
        "heads": 2,
    }
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        model = build_network(SegmenterConfig(**{**small, **sizes})).eval()
        for parameter in model.parameters():
            if not parameter.any():
                torch.nn.init.normal_(parameter, std=0.3)
    columns = model.config.columns
    centre, spread = np.linspace(0.2, 0.4, columns), np.linspace(0.05, 0.1, columns)
    whitening = np.eye(columns) + 0.1
    return AnyWeights(
        model,
        SpectralBasis(400.0, 1000.0, columns),
        Normalisation(*(array.astype(np.float32) for array in (centre, spread, whitening))),
        tuple(f"class {number}" for number in range(model.config.classes)),
        np.arange(3 * model.config.classes, dtype=np.uint8).reshape(-1, 3),
        {"seed": seed},
    )


@pytest.fixture
def tiny() -> Maker:
    """Maker of small random weights: ``tiny(seed, classes=..., patch=..., factor=..., positions=...)``."""
    return make_weights


@pytest.fixture
def make_control() -> Callable[..., AnyWeights]:
    """Maker of small random weights of a control: ``make_control(preset, seed, classes=..., patch=...)``."""

    def make(preset: Preset, seed: int = 0, **sizes: Any) -> AnyWeights:
        return make_any_weights(seed, **sizes, **PRESETS[preset])

    return make
