"""A segmenter that is small enough for tests, with random weights for every term that starts from zero."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from spectralzoom.models.network.segmenter import Segmenter, cut
from spectralzoom.models.network.sizes import SegmenterConfig
from spectralzoom.models.network.spectral import Capture, LineSpec, Normalisation, SpectralBasis
from spectralzoom.models.reading.inference import CoarsePass, CoarsePrediction, read_coarse_pass, read_coarse_prediction
from spectralzoom.models.training.examples import Example
from spectralzoom.models.training.train import Progress
from spectralzoom.models.weights.files import Weights
from spectralzoom.pipeline.geometry.grid import SceneGrid

SMALL: dict[str, Any] = {"classes": 3, "columns": 4, "patch": 8, "width": 8, "overview_width": 8} | {
    "dim": 16,
    "heads": 2,
    "layers": 1,
}


def noise(seed: int, *shape: int) -> Tensor:
    """Return seeded normal numbers."""
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def coarse_prediction(
    weights: Weights,
    values: np.ndarray,
    wavelength_nm: np.ndarray,
    grid: SceneGrid,
    *,
    capture: Capture = LineSpec(),  # noqa: B008 - a value
) -> CoarsePrediction:
    """Predict from scene values (y, x, band); NaN is no data."""
    return read_coarse_prediction(weights, read_coarse_pass(weights, [values], wavelength_nm, grid, capture=capture))


def scene_columns(weights: Weights, height: int, width: int, seed: int = 0) -> tuple[CoarsePass, np.ndarray]:
    """Return a pass over a scene of noise, and other noise for every patch of its padded grid."""
    p = weights.config.patch
    columns = weights.config.columns
    grid = SceneGrid(height, width, p)
    rng = np.random.default_rng(seed)
    coarse_pass = CoarsePass(grid, rng.standard_normal((*grid.padded_shape, columns), np.float32))
    return coarse_pass, rng.standard_normal((int(np.prod(grid.patch_shape)), p, p, columns), np.float32)


def block_example(size: int = 32, block: int = 8) -> Example:
    """Return two classes in blocks, separated by the first column, with noise in the second."""
    rng = np.random.default_rng(4)
    labels = np.kron(rng.integers(0, 2, (size // block, size // block)), np.ones((block, block))).astype(np.uint8)
    columns = np.stack([2.0 * labels - 1, rng.normal(0, 1, labels.shape)], axis=-1)
    return Example("e", columns.astype(np.float16), labels, labels.shape)


def killed_after(step: int) -> Callable[[Progress], None]:
    """Return a progress report that interrupts training after some steps."""

    def report(now: Progress) -> None:
        if now.step == step:
            raise KeyboardInterrupt

    return report


def make_network(seed: int = 0, **sizes: Any) -> Segmenter:
    """Return a small network of the given sizes; terms that start from zero are drawn too, so that none is idle."""
    with torch.random.fork_rng(devices=[]), torch.no_grad():
        torch.manual_seed(seed)
        model = Segmenter(SegmenterConfig(**{**SMALL, **sizes})).eval()
        for parameter in model.parameters():
            idle = parameter == 0
            parameter[idle] = torch.normal(0.0, 0.3, parameter.shape)[idle]
    return model


def read_both(model: Segmenter, image: Tensor, detail: Tensor, index: Tensor, origin: Tensor) -> tuple[Tensor, Tensor]:
    """Return logits of the overview of ``image``, and of the patches ``index`` (B, K) of ``detail``."""
    overview = model.read_overview(image, origin)
    cells = cut(detail, model.config.patch)
    chosen = cells.gather(1, index[:, :, None, None, None].expand(-1, -1, *cells.shape[2:]))
    return overview.logits, model.read_patches(overview, chosen, index)


def plain_weights(**sizes: Any) -> Weights:
    """Return weights of two layers, with columns of one scale and no correlation."""
    made = make_weights(**{"layers": 2, **sizes})
    one = np.ones(made.config.columns, np.float32)
    return replace(made, normalisation=Normalisation(0.3 * one, 0.1 * one, np.diag(one)))


def make_weights(seed: int = 0, **sizes: Any) -> Weights:
    """Return random weights of a segmenter of these sizes."""
    model = make_network(seed, **sizes)
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
