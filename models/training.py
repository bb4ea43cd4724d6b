"""Training of the two-scale segmenter on crops, for every budget at once.

Each step reads the crop twice: with no fine seat, and with a share of the seats drawn from ``SHARES``, placed half of
the time at random and half of the time by the entropy of the first reading, so that one set of weights serves every
budget and policy.
"""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812 - its usual name
from numpy.typing import NDArray
from torch import Tensor

from models.examples import Batch, CropSampler, Example
from models.process import keep_freed_memory
from models.segmenter import Segmenter, SegmenterConfig
from pipeline.errors import PipelineError
from pipeline.grid import UNLABELLED

SHARES = ((0.125, 0.25), (0.25, 0.25), (0.35, 0.2), (0.5, 0.2), (1.0, 0.1))  # (share of the seats, how often)


@dataclass(frozen=True)
class TrainingSettings:
    """How long and how to train. ``minutes`` ends the run early, with the learning rate brought down in time."""

    steps: int = 2000
    batch: int = 4
    crop: int = 256
    learning_rate: float = 1.5e-3
    weight_decay: float = 0.02
    minutes: float = 36.0
    seed: int = 0
    average: float = 0.998  # decay of the averaged weights
    glance_weight: float = 0.4
    weight_cap: float = 5.0


@dataclass(frozen=True)
class Progress:
    """State after a step, for a progress bar."""

    step: int
    steps: int
    done: float  # 0..1, by steps or by time, whichever is further
    loss: float


class TrainingError(PipelineError, RuntimeError):
    """The loss was not finite three steps in a row."""


def train(
    config: SegmenterConfig,
    examples: list[Example],
    gain_shift: NDArray[np.float32],
    settings: TrainingSettings,
    report: Callable[[Progress], None] = lambda progress: None,
) -> tuple[Segmenter, dict[str, float | int]]:
    """Train a segmenter and give its averaged weights with a summary (steps, skipped steps, last loss, seconds).

    The same settings and examples start from the same weights and draw the same crops and seats. What follows is equal
    to rounding only: sums differ in their last bit with where memory lies, and ``minutes`` may end the run elsewhere.

    Raises
    ------
    TrainingError : the loss or its gradient was not finite three steps in a row.
    """
    keep_freed_memory()
    rng = np.random.default_rng([settings.seed, 0x7EA])
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.seed)
        model = Segmenter(config)
    model.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    averaged = copy.deepcopy(model).eval()
    optimiser = torch.optim.AdamW(_parameter_groups(model, settings.weight_decay), settings.learning_rate)
    sampler = CropSampler(examples, config.patch, config.factor, settings.crop)
    weight = class_weights(examples, config.classes, settings.weight_cap)
    started, taken, skipped, in_a_row, smooth = time.monotonic(), 0, 0, 0, math.nan
    for step in range(1, settings.steps + 1):
        done = max((step - 1) / settings.steps, (time.monotonic() - started) / (60 * settings.minutes))
        if done >= 1:
            break
        for group in optimiser.param_groups:
            group["lr"] = settings.learning_rate * rate_at(done)
        batch = sampler.draw(settings.batch, rng, gain_shift)
        loss = batch_loss(model, batch, weight, settings, rng, soft_dice=done > 0.3)
        in_a_row = 0 if _step(model, optimiser, loss) else in_a_row + 1
        taken, skipped = step, skipped + (in_a_row > 0)
        if in_a_row == 3:
            raise TrainingError(f"the loss was not finite in steps {step - 2} to {step}; lower the learning rate")
        _average(averaged, model, min(settings.average, step / (step + 20)))
        value = float(loss.detach())
        if math.isfinite(value):
            smooth = value if math.isnan(smooth) else 0.97 * smooth + 0.03 * value
        report(Progress(step, settings.steps, done, smooth))
    seconds = round(time.monotonic() - started)
    return averaged, {"steps": taken, "skipped_steps": skipped, "last_loss": round(smooth, 5), "seconds": seconds}


def rate_at(done: float) -> float:
    """Learning rate over the run as a share of the highest: 5 % warm-up, then a cosine down to 1 %."""
    if done < 0.05:
        return 0.05 + 0.95 * done / 0.05
    return float(0.01 + 0.99 * 0.5 * (1 + np.cos(np.pi * (done - 0.05) / 0.95)))


def class_weights(examples: list[Example], classes: int, cap: float) -> Tensor:
    """Weights 1 / sqrt(frequency), mean 1 over the labelled pixels' classes, capped; 0 for a class without a pixel."""
    counts = np.zeros(classes)
    for example in examples:
        counts += np.bincount(example.labels[example.labels != UNLABELLED], minlength=classes)
    share = counts / max(counts.sum(), 1)
    weight = np.divide(1, np.sqrt(share), out=np.zeros(classes), where=share > 0)
    weight /= max((weight * share).sum(), 1e-12)
    return torch.from_numpy(np.minimum(weight, cap).astype(np.float32))


def batch_loss(
    model: Segmenter,
    batch: Batch,
    weight: Tensor,
    settings: TrainingSettings,
    rng: np.random.Generator,
    *,
    soft_dice: bool,
) -> Tensor:
    """Loss of one batch: the map with a drawn share of seats, and the glance alone."""
    empty = torch.zeros(len(batch.labels), 0, dtype=torch.int64)
    view = model.view(batch.coarse, batch.origin)
    glance, no_patch = model(view, batch.fine[:, :0], empty, batch.origin)
    seats = draw_seats(glance.detach(), model.config, rng)
    fine = batch.fine.gather(1, seats[:, :, None, None, None].expand(-1, -1, *batch.fine.shape[2:]))
    coarse, patches = model(view, fine, seats, batch.origin)
    with_seats = map_loss(model.composite(coarse, patches, seats), batch.labels, weight, soft_dice=soft_dice)
    without = map_loss(model.composite(glance, no_patch, empty), batch.labels, weight, soft_dice=soft_dice)
    return with_seats + settings.glance_weight * without


def draw_seats(glance: Tensor, config: SegmenterConfig, rng: np.random.Generator) -> Tensor:
    """Draw how many seats and which: (B, K) distinct seat numbers."""
    shares, odds = zip(*SHARES, strict=True)
    cells = config.patch // config.factor
    entropy = torch.special.entr(glance.float().softmax(dim=1)).sum(dim=1)
    score = F.avg_pool2d(entropy[:, None], cells).flatten(1)
    count = max(1, round(float(rng.choice(shares, p=odds)) * score.shape[1]))
    chance = torch.from_numpy(rng.random(score.shape))
    placed = score + 0.1 * score.mean() * chance if rng.random() < 0.5 else chance
    return placed.argsort(dim=1, descending=True, stable=True)[:, :count]


def map_loss(logits: Tensor, labels: Tensor, weight: Tensor, *, soft_dice: bool) -> Tensor:
    """Class-weighted cross-entropy over labelled pixels, plus half the soft Dice loss where asked.

    0, with a gradient of 0, where no pixel is labelled or every label has weight 0.
    """
    labelled = labels != UNLABELLED
    if not weight[labels[labelled]].any():
        return logits.sum() * 0.0
    loss = F.cross_entropy(logits, labels, weight, ignore_index=UNLABELLED)
    if not soft_dice:
        return loss
    probability = logits.softmax(dim=1) * labelled[:, None]
    truth = F.one_hot(labels.where(labelled, 0), logits.shape[1]).permute(0, 3, 1, 2) * labelled[:, None]
    both = (probability * truth).sum(dim=(0, 2, 3))
    size = probability.sum(dim=(0, 2, 3)) + truth.sum(dim=(0, 2, 3))
    present = truth.sum(dim=(0, 2, 3)) > 0
    return loss + 0.5 * (1 - 2 * both[present] / (size[present] + 1)).mean()


def _step(model: Segmenter, optimiser: torch.optim.Optimizer, loss: Tensor) -> bool:
    """Take one optimiser step; False, and no step, when the loss or the gradient is not finite."""
    optimiser.zero_grad(set_to_none=True)
    if not torch.isfinite(loss):
        return False
    loss.backward()  # type: ignore[no-untyped-call]
    if not torch.isfinite(torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)):
        return False
    optimiser.step()
    return True


def _parameter_groups(model: Segmenter, decay: float) -> list[dict[str, object]]:
    """Matrices and kernels decay, gains and shifts do not."""
    matrices = [p for p in model.parameters() if p.ndim > 1]
    rest = [p for p in model.parameters() if p.ndim <= 1]
    return [{"params": matrices, "weight_decay": decay}, {"params": rest, "weight_decay": 0.0}]


@torch.no_grad()
def _average(averaged: Segmenter, model: Segmenter, keep: float) -> None:
    for slow, quick in zip(averaged.parameters(), model.parameters(), strict=True):
        slow.lerp_(quick, 1 - keep)
