"""Numerical hard cases of training and metrics: rows 4, 13, 14, 16 and 26 of the design's table."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from spectralzoom.models.evaluation.metrics import mean_iou
from spectralzoom.models.network.segmenter import ChannelNorm, Segmenter, TokenAttention
from spectralzoom.models.network.sizes import PLANES, SegmenterConfig
from spectralzoom.models.network.spectral import Normalisation
from spectralzoom.models.training.examples import Example
from spectralzoom.models.training.objective import map_loss
from spectralzoom.models.training.train import Trainer, TrainingSettings
from spectralzoom.pipeline.geometry.grid import UNLABELLED
from tests.models.conftest import SMALL, read_both

SIZES: dict[str, Any] = SMALL | {"classes": 2}
SETTINGS = TrainingSettings(steps=4, batch=1, crop=16)
NO_SHIFT = np.zeros(4, np.float32)


def _example(labels: np.ndarray) -> Example:
    rng = np.random.default_rng(0)
    return Example("e", rng.normal(0, 1, (*labels.shape, 4)).astype(np.float16), labels, labels.shape)


def test_4_step_without_labels_changes_no_weight():
    """Weight decay does not act either; the steps count as unlabelled, not as skipped."""
    labels = np.full((64, 64), UNLABELLED, np.uint8)
    labels[0, 0] = 1
    trainer = Trainer(SegmenterConfig(**SIZES), [_example(labels)], NO_SHIFT, SETTINGS)
    trainer.sampler.examples = [_example(np.full((64, 64), UNLABELLED, np.uint8))]
    before = [parameter.clone() for parameter in trainer.model.parameters()]
    for _ in range(4):  # three in a row do not fail
        trainer.step(0.5)
    assert all(torch.equal(a, b) for a, b in zip(before, trainer.model.parameters(), strict=True))
    assert trainer.summary()["steps"] == trainer.summary()["unlabelled_steps"] == 4
    assert trainer.summary()["skipped_steps"] == 0


@pytest.mark.parametrize("size", [0.0, 1e-30, 1e-6])
def test_13_norms_of_zero_tokens_are_zero(size: float):
    """There is no cosine decoder; the existing norms give 0 for zero tokens, with bounded gradients."""
    attention = TokenAttention(16, 2)
    norm = ChannelNorm(8)
    pixels, tokens = torch.full((1, 8, 2, 2), size).requires_grad_(), torch.full((1, 3, 8), size).requires_grad_()
    for x, layer in ((pixels, norm), (tokens, attention.query_norm), (tokens, attention.key_norm)):
        out = layer(x)
        assert out.abs().max() <= 1
        assert size > 0 or not out.any()
        (gradient,) = torch.autograd.grad(out.sum(), x)
        assert gradient.abs().max() <= 1001  # 1 / sqrt(1e-6), and rounding


def test_14_segmenter_with_two_classes_has_gradients():
    """There is no mask_norm, which is a sign for two classes: logits have values of any size, and gradients."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        model = Segmenter(SegmenterConfig(**SIZES))
        image = torch.randn(1, 4 + PLANES, 32, 32)
    labels = (image[:, 0] > 0).long()
    none = torch.zeros(1, 0, dtype=torch.int64)
    logits = model.composite(*read_both(model, image, image, none, torch.zeros(1, 2)), none)
    loss = map_loss(logits, labels, torch.ones(2), soft_dice=True)
    loss.backward()  # type: ignore[no-untyped-call]
    for learned in (model.overview_classes.weight.grad, model.spectral.weight.grad):
        assert learned is not None
        assert all(row.abs().max() > 1e-4 for row in learned)
    with torch.no_grad():  # a step along the gradient
        model.spectral.weight -= model.spectral.weight.grad
        assert model.read_overview(image).logits.unique().numel() > 2


def test_16_columns_far_from_zero_keep_their_scale():
    """Normalisation uses medians, not a difference of squares: 4096.1 with a spread of 0.1 becomes a spread of 1."""
    sample = (4096.1 + np.random.default_rng(0).normal(0, 0.1, (5000, 3))).astype(np.float32)
    normalisation = Normalisation.measured(sample)
    assert (normalisation.spread > 0).all()
    assert normalisation.apply(sample, np.ones(3, bool)).std(axis=0) == pytest.approx(1, abs=0.05)


@pytest.mark.parametrize("kind", [torch.bfloat16, torch.float16])
def test_26_loss_of_half_precision_logits_sums_in_float32(kind: torch.dtype):
    """The mean over 1e5 pixels with 16-bit logits matches float64 to 1e-5, and with soft Dice to 1e-4."""
    generator = torch.Generator().manual_seed(0)
    logits = torch.randn(1, 3, 250, 400, generator=generator).to(kind)
    labels = torch.randint(0, 3, (1, 250, 400), generator=generator)
    weight = torch.tensor([1.0, 2.0, 0.5])
    exact = nn.functional.cross_entropy(logits.double(), labels, weight.double())
    assert float(map_loss(logits, labels, weight, soft_dice=False)) == pytest.approx(float(exact), rel=1e-5)
    rough = map_loss(logits, labels, weight, soft_dice=True)
    fine = map_loss(logits.double(), labels, weight.double(), soft_dice=True)
    assert float(rough) == pytest.approx(float(fine), rel=1e-4)


def test_26_large_pixel_counts_do_not_round():
    """2^24 + 1 pixels of one class, where float32 stops counting, keep their last pixel in the mean IoU."""
    counts = np.array([[2**24 + 1, 0], [1, 2**31]], np.int64)
    first, second = (2**24 + 1) / (2**24 + 2), 2**31 / (2**31 + 1)
    assert mean_iou(counts) == pytest.approx((first + second) / 2, rel=1e-12)
