"""Compute the loss of a training step: of the map with and without patches, and of the scorer.

A crop is segmented by the overview alone, and with a fraction of the patches drawn from ``FRACTIONS``. The scorer
learns the decrease of the loss at a labelled patch. There are three phases. Patches are placed at random and by the
entropy of the overview. Later they are also placed by the scorer. At last crops are larger and batches smaller.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812 - its usual name
from numpy.typing import NDArray
from torch import Tensor

from models.network.segmenter import Segmenter, cut
from models.network.sizes import MOST_GAIN, SegmenterConfig
from models.training.examples import Batch
from pipeline.geometry.grid import UNLABELLED

OVERVIEW_WEIGHT, SCORER_WEIGHT = 0.6, 1.0  # of the overview and the scorer; the map with patches has 1
FRACTIONS = ((0.1, 0.2), (0.25, 0.35), (0.5, 0.25), (1.0, 0.2))  # (of the patches, probability)
HUBER_NAT = 0.1  # larger errors of the scorer count linearly
RANK_WEIGHT = 0.2
RANK_NAT = 0.05  # pairs that differ by less hardly count


@dataclass(frozen=True)
class Phase:
    """Probabilities of the placements of patches, and size of crops, until a fraction of the run."""

    until: float
    random: float
    entropy: float
    gain: float
    larger: int = 1  # factor of the area of crops; a batch has fewer by it


PHASES = (Phase(0.5, 0.5, 0.5, 0.0), Phase(0.7, 0.3, 0.35, 0.35), Phase(1.0, 0.2, 0.4, 0.4, larger=2))


def phase_at(done: float) -> Phase:
    """Return the phase at the fraction ``done`` of a run."""
    return next((phase for phase in PHASES if done < phase.until), PHASES[-1])


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
    """Return the loss of one batch: of the map with patches, of the overview, and of the scores."""
    overview = model.read_overview(batch.image, batch.origin)
    score = model.score(overview).flatten(1)
    patch_index = draw_patches(overview.logits.detach(), score.detach(), model.config, rng, phase)
    cells = cut(batch.detail, model.config.patch)
    chosen = cells.gather(1, patch_index[:, :, None, None, None].expand(-1, -1, *cells.shape[2:]))
    drawn = model.composite(overview.logits, model.read_patches(overview, chosen, patch_index), patch_index)
    with_patches, without = (pixel_losses(logits, batch.labels) for logits in (drawn, overview.logits))
    gain = F.avg_pool2d((without - with_patches).detach()[:, None], model.config.patch).flatten(1)
    known = F.max_pool2d((batch.labels != UNLABELLED).float()[:, None], model.config.patch).flatten(1) > 0
    scoring = scoring_loss(score.gather(1, patch_index), gain.gather(1, patch_index), known.gather(1, patch_index))
    maps = [
        map_loss(logits, losses, batch.labels, weight, soft_dice=soft_dice)
        for logits, losses in zip((drawn, overview.logits), (with_patches, without), strict=True)
    ]
    return maps[0] + OVERVIEW_WEIGHT * maps[1] + SCORER_WEIGHT * scoring


def draw_patches(
    overview: Tensor, score: Tensor, config: SegmenterConfig, rng: np.random.Generator, phase: Phase
) -> Tensor:
    """Draw (B, K) distinct patch numbers: at random, by entropy or by expected gain.

    ``overview`` are logits (B, classes, H, W), ``score`` the expected gain of the patches (B, patches).
    """
    fractions, odds = zip(*FRACTIONS, strict=True)
    count = max(1, round(float(rng.choice(fractions, p=odds)) * score.shape[1]))
    chance = torch.from_numpy(rng.random(score.shape)).to(score.dtype).to(score.device)
    placed = rng.choice(3, p=(phase.random, phase.entropy, phase.gain))
    if placed == 1:
        entropy = torch.special.entr(overview.float().softmax(dim=1)).sum(dim=1)
        score = F.avg_pool2d(entropy[:, None], config.patch).flatten(1)
    expected_gain = chance if placed == 0 else score + 0.1 * score.abs().mean() * chance
    return expected_gain.argsort(dim=1, descending=True, stable=True)[:, :count]


def pixel_losses(logits: Tensor, labels: Tensor) -> Tensor:
    """Return the cross-entropy of each pixel, (B, classes, y, x) -> (B, y, x) float32; 0 where unlabelled."""
    return F.cross_entropy(logits.float(), labels, ignore_index=UNLABELLED, reduction="none")


def map_loss(logits: Tensor, losses: Tensor, labels: Tensor, weight: Tensor, *, soft_dice: bool) -> Tensor:
    """Return the class-weighted mean of the ``losses`` of labelled pixels, plus half the soft Dice loss on request.

    0, with a gradient of 0, where no pixel is labelled or every label has weight 0.
    """
    labelled = labels != UNLABELLED
    weights = torch.where(labelled, weight[labels.where(labelled, 0)], 0.0)
    total = weights.sum()
    if not total > 0:
        return logits.sum() * 0.0
    loss = (losses * weights).sum() / total
    if not soft_dice:
        return loss
    probability = logits.float().softmax(dim=1) * labelled[:, None]
    truth = F.one_hot(labels.where(labelled, 0), logits.shape[1]).permute(0, 3, 1, 2) * labelled[:, None]
    both = (probability * truth).sum(dim=(0, 2, 3))
    size = probability.sum(dim=(0, 2, 3)) + truth.sum(dim=(0, 2, 3))
    present = truth.sum(dim=(0, 2, 3)) > 0
    return loss + 0.5 * (1 - 2 * both[present] / (size[present] + 1)).mean()


def scoring_loss(score: Tensor, gain: Tensor, known: Tensor) -> Tensor:
    """Return the loss of scores (B, K) against gains (B, K), in size and order.

    It is Huber's loss plus, with a fifth of the weight, that of pairs in the wrong order. Patches that are not
    ``known`` (B, K) have no label and are left out. Without a known one the loss and its gradient are 0.
    """
    if not known.any():
        return score.sum() * 0.0
    gain = gain.clamp(-MOST_GAIN, MOST_GAIN)
    size = F.smooth_l1_loss(score[known], gain[known], beta=HUBER_NAT)
    apart = gain[:, :, None] - gain[:, None, :]
    pairs = (apart > 0) & known[:, :, None] & known[:, None, :]
    if not pairs.any():
        return size
    wrong = F.softplus((score[:, None, :] - score[:, :, None]) / RANK_NAT)
    weight = apart.clamp(0, 1) * pairs
    return size + RANK_WEIGHT * RANK_NAT * (wrong * weight).sum() / weight.sum()
