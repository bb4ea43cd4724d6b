"""A segmenter small enough for tests, with weights of its own for every term that starts from zero."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from models.segmenter import Segmenter, SegmenterConfig
from models.spectral import Normalisation, SpectralBasis
from models.weights import Weights

Maker = Callable[..., Weights]


def make_weights(seed: int = 0, **sizes: Any) -> Weights:
    """Random weights of the given sizes; whatever training starts from zero is drawn too, so that nothing is idle."""
    small = {"classes": 3, "columns": 4, "patch": 8, "factor": 2, "width": 8, "dim": 16, "layers": 1, "heads": 2}
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        model = Segmenter(SegmenterConfig(**{**small, **sizes})).eval()
        for parameter in model.parameters():
            if not parameter.any():
                torch.nn.init.normal_(parameter, std=0.3)
    columns = model.config.columns
    centre, spread = np.linspace(0.2, 0.4, columns), np.linspace(0.05, 0.1, columns)
    whitening = np.eye(columns) + 0.1
    return Weights(
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
