"""Training of the two-scale segmenter on crops, for every budget at once.

Each step reads the crop twice: with no fine seat, and with a share of the seats drawn from ``SHARES``, placed half of
the time at random and half of the time by the entropy of the first reading, so that one set of weights serves every
budget and policy.
"""

from __future__ import annotations

import copy
import hashlib
import json
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812 - its usual name
from numpy.typing import NDArray
from torch import Tensor

from models.checkpoint import load_checkpoint, save_checkpoint
from models.examples import Batch, CropSampler, Example
from models.process import keep_freed_memory
from models.segmenter import Segmenter, SegmenterConfig
from pipeline.errors import PipelineError
from pipeline.grid import UNLABELLED

KEEP_EVERY_S = 120.0  # between checkpoints
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


@dataclass
class Course:
    """How far a run has come; plain numbers, kept in its checkpoint."""

    step: int = 0
    seconds: float = 0.0  # of earlier processes, up to the last checkpoint
    skipped: int = 0
    in_a_row: int = 0
    loss: float = math.nan  # smoothed


class Trainer:
    """A training run: where it stands, and one step further at a time."""

    def __init__(
        self,
        config: SegmenterConfig,
        examples: list[Example],
        gain_shift: NDArray[np.float32],
        settings: TrainingSettings,
    ) -> None:
        self.settings, self.gain_shift = settings, gain_shift
        self.rng = np.random.default_rng([settings.seed, 0x7EA])
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(settings.seed)
            self.model = Segmenter(config)
        self.model.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.averaged = copy.deepcopy(self.model).eval()
        groups = _parameter_groups(self.model, settings.weight_decay)
        self.optimiser = torch.optim.AdamW(groups, settings.learning_rate)
        self.sampler = CropSampler(examples, config.patch, config.factor, settings.crop)
        self.weight = class_weights(examples, config.classes, settings.weight_cap)
        self.course = Course()
        self._started = time.monotonic()

    @property
    def done(self) -> float:
        """How far the run is, 0..1, by steps or by time, whichever is further."""
        seconds = self.course.seconds + time.monotonic() - self._started
        return max(self.course.step / self.settings.steps, seconds / (60 * self.settings.minutes))

    def step(self, done: float) -> None:
        """Take one step of a run that is ``done`` so far (0..1): the learning rate follows from it.

        Raises
        ------
        TrainingError : the loss or its gradient was not finite three steps in a row.
        """
        course = self.course
        for group in self.optimiser.param_groups:
            group["lr"] = self.settings.learning_rate * rate_at(done)
        batch = self.sampler.draw(self.settings.batch, self.rng, self.gain_shift)
        loss = batch_loss(self.model, batch, self.weight, self.settings, self.rng, soft_dice=done > 0.3)
        course.step += 1
        course.in_a_row = 0 if _step(self.model, self.optimiser, loss) else course.in_a_row + 1
        course.skipped += course.in_a_row > 0
        if course.in_a_row == 3:
            last = course.step
            raise TrainingError(f"the loss was not finite in steps {last - 2} to {last}; lower the learning rate")
        _average(self.averaged, self.model, min(self.settings.average, course.step / (course.step + 20)))
        value = float(loss.detach())
        if math.isfinite(value):
            course.loss = value if math.isnan(course.loss) else 0.97 * course.loss + 0.03 * value

    def keep(self, path: Path, identity: str) -> None:
        """Write a checkpoint."""
        now = time.monotonic()
        self.course.seconds, self._started = self.course.seconds + now - self._started, now
        tensors = {f"model.{name}": tensor for name, tensor in self.model.state_dict().items()}
        tensors |= {f"averaged.{name}": tensor for name, tensor in self.averaged.state_dict().items()}
        for number, moments in self.optimiser.state_dict()["state"].items():
            tensors |= {f"optimiser.{number}.{name}": tensor for name, tensor in moments.items()}
        save_checkpoint(path, identity, {"course": asdict(self.course), "rng": self.rng.bit_generator.state}, tensors)

    def go_on(self, path: Path, identity: str) -> bool:
        """Go on from a checkpoint of the same run; False where there is none."""
        found = load_checkpoint(path, identity)
        if found is None:
            return False
        about, tensors = found
        state: dict[int, dict[str, Tensor]] = {}
        parts: dict[str, dict[str, Tensor]] = {"model": {}, "averaged": {}}
        for name, tensor in tensors.items():
            part, _, rest = name.partition(".")
            if part == "optimiser":
                number, _, moment = rest.partition(".")
                state.setdefault(int(number), {})[moment] = tensor
            else:
                parts[part][rest] = tensor
        self.model.load_state_dict(parts["model"])
        self.averaged.load_state_dict(parts["averaged"])
        groups = self.optimiser.state_dict()["param_groups"]
        self.optimiser.load_state_dict({"state": state, "param_groups": groups})
        self.rng.bit_generator.state = about["rng"]
        self.course, self._started = Course(**about["course"]), time.monotonic()
        return True

    def summary(self) -> dict[str, float | int]:
        """Steps, skipped steps, the last smoothed loss and seconds."""
        course = self.course
        seconds = round(course.seconds + time.monotonic() - self._started)
        return {
            "steps": course.step,
            "skipped_steps": course.skipped,
            "last_loss": round(course.loss, 5),
            "seconds": seconds,
        }


def train(
    config: SegmenterConfig,
    examples: list[Example],
    gain_shift: NDArray[np.float32],
    settings: TrainingSettings,
    report: Callable[[Progress], None] = lambda progress: None,
    *,
    checkpoint: Path | None = None,
    keep_every_s: float = KEEP_EVERY_S,
) -> tuple[Segmenter, dict[str, float | int]]:
    """Train a segmenter and give its averaged weights with a summary (steps, skipped steps, last loss, seconds).

    The same settings and examples start from the same weights and draw the same crops and seats. What follows is equal
    to rounding only: sums differ in their last bit with where memory lies, and ``minutes`` may end the run elsewhere.

    Parameters
    ----------
    checkpoint
        File that the state is kept in; a killed run of the same settings and examples goes on from it.

    Raises
    ------
    TrainingError : the loss or its gradient was not finite three steps in a row.
    """
    keep_freed_memory()
    trainer = Trainer(config, examples, gain_shift, settings)
    identity = run_identity(config, examples, settings)
    if checkpoint is not None:
        trainer.go_on(checkpoint, identity)
    kept = time.monotonic()
    while (done := trainer.done) < 1:
        trainer.step(done)
        report(Progress(trainer.course.step, settings.steps, done, trainer.course.loss))
        if checkpoint is not None and time.monotonic() - kept >= keep_every_s:
            trainer.keep(checkpoint, identity)
            kept = time.monotonic()
    return trainer.averaged, trainer.summary()


def run_identity(config: SegmenterConfig, examples: list[Example], settings: TrainingSettings) -> str:
    """Hash of all that makes a run what it is: a checkpoint of another run is not gone on from."""
    digest = hashlib.sha256(json.dumps([config.as_dict(), asdict(settings)], sort_keys=True).encode())
    for example in examples:
        digest.update(example.name.encode())
        digest.update(np.ascontiguousarray(example.coarse).tobytes())
        digest.update(np.ascontiguousarray(example.labels).tobytes())
    return digest.hexdigest()[:20]


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
