"""Compute the loss of a training step: of the map with and without patches.

A crop is segmented by the overview alone, and with a fraction of the patches drawn from ``FRACTIONS``. They are placed
at random, or by the entropy of the overview, later more often. At last crops are larger and batches smaller.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812 - its usual name
from numpy.typing import NDArray
from torch import Tensor

from spectralzoom.models.network.segmenter import Segmenter, cut
from spectralzoom.models.network.sizes import SegmenterConfig
from spectralzoom.models.training.examples import Batch
from spectralzoom.pipeline.geometry.grid import UNLABELLED

OVERVIEW_WEIGHT = 0.6  # the map with patches has 1
PATCHED = 0.1  # of the steps of deep networks, whose full network corrects little and costs as much as the rest
FRACTIONS = ((0.1, 0.2), (0.25, 0.35), (0.5, 0.25), (1.0, 0.2))  # (of the patches, probability)


@dataclass(frozen=True)
class Phase:
    """Placement of patches and size of crops, until a fraction of the run."""

    until: float
    random: float  # probability of a placement at random; else it is by entropy
    larger: int = 1  # factor of the area of crops; a batch has fewer by it


PHASES = (Phase(0.5, 0.5), Phase(0.7, 0.3), Phase(1.0, 0.2, larger=2))


def class_weights(labels: Iterable[NDArray[np.uint8]], classes: int, cap: float) -> Tensor:
    """Return weights 1 / sqrt(frequency), with mean 1 over the labelled pixels, capped; 0 for an absent class."""
    counts = np.zeros(classes)
    for image in labels:
        counts += np.bincount(image[image != UNLABELLED], minlength=classes)
    fraction = counts / max(counts.sum(), 1)
    weight = np.divide(1, np.sqrt(fraction), out=np.zeros(classes), where=fraction > 0)
    weight /= max((weight * fraction).sum(), 1e-12)
    return torch.from_numpy(np.minimum(weight, cap).astype(np.float32))


def batch_loss(
    model: Segmenter, batch: Batch, weight: Tensor, rng: np.random.Generator, phase: Phase, *, soft_dice: bool
) -> Tensor:
    """Return the loss of one batch: of the map with patches, and of the overview; in most steps of the latter alone."""
    overview = model.read_overview(batch.image, batch.origin)

    def loss_of(logits: Tensor) -> Tensor:
        return map_loss(logits, batch.labels, weight, soft_dice=soft_dice)

    if model.config.deep and rng.random() >= PATCHED:
        return loss_of(overview.logits)
    patch_index = draw_patches(overview.logits.detach(), model.config, rng, phase)
    cells = cut(batch.detail, model.config.patch)
    chosen = cells.gather(1, patch_index[:, :, None, None, None].expand(-1, -1, *cells.shape[2:]))
    drawn = model.composite(overview.logits, model.read_patches(overview, chosen, patch_index), patch_index)
    return loss_of(drawn) + OVERVIEW_WEIGHT * loss_of(overview.logits)


def draw_patches(overview: Tensor, config: SegmenterConfig, rng: np.random.Generator, phase: Phase) -> Tensor:
    """Draw (B, K) distinct patch numbers, at random or by the entropy of logits ``overview`` (B, classes, H, W)."""
    entropy = torch.special.entr(overview.float().softmax(dim=1)).sum(dim=1)
    score = F.avg_pool2d(entropy[:, None], config.patch).flatten(1)
    fractions, odds = zip(*FRACTIONS, strict=True)
    count = max(1, round(float(rng.choice(fractions, p=odds)) * score.shape[1]))
    chance = torch.from_numpy(rng.random(score.shape)).to(score.dtype).to(score.device)
    placed = chance if rng.random() < phase.random else score + 0.1 * score.mean() * chance
    return placed.argsort(dim=1, descending=True, stable=True)[:, :count]


def map_loss(logits: Tensor, labels: Tensor, weight: Tensor, *, soft_dice: bool) -> Tensor:
    """Return the class-weighted mean cross-entropy of labelled pixels, plus half the soft Dice loss on request.

    ``logits`` are (B, classes, y, x) of any precision, ``labels`` (B, y, x). The loss is 0, with a gradient of 0, where
    no pixel is labelled or every label has weight 0.
    """
    losses = F.cross_entropy(logits.float(), labels, ignore_index=UNLABELLED, reduction="none")
    labelled = labels != UNLABELLED
    weights = torch.where(labelled, weight[labels.where(labelled, 0)], 0.0)
    total = weights.sum()
    if not total > 0:
        return losses.sum() * 0.0
    loss = (losses * weights).sum() / total
    if not soft_dice:
        return loss
    probability = logits.float().softmax(dim=1) * labelled[:, None]
    truth = F.one_hot(labels.where(labelled, 0), logits.shape[1]).permute(0, 3, 1, 2) * labelled[:, None]
    both = (probability * truth).sum(dim=(0, 2, 3))
    size = probability.sum(dim=(0, 2, 3)) + truth.sum(dim=(0, 2, 3))
    present = truth.sum(dim=(0, 2, 3)) > 0
    return loss + 0.5 * (1 - 2 * both[present] / (size[present] + 1)).mean()
