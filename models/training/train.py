"""Train the segmenter on crops, from a linear classifier of mean spectra, with averaged weights and checkpoints."""

from __future__ import annotations

import copy
import hashlib
import json
import math
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import scipy
import torch
from numpy.typing import NDArray
from sklearn.base import clone
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.linear_model import LogisticRegression
from torch import Tensor, nn

from spectralzoom.models.network.machine import PROCESSOR, give_back_freed_memory, keep_freed_memory
from spectralzoom.models.network.segmenter import Segmenter
from spectralzoom.models.network.sizes import AROUND_PX, PLANES, SegmenterConfig
from spectralzoom.models.training.capture_augmentation import REFERENCE_MS, CaptureAugmentation
from spectralzoom.models.training.examples import BRIGHTNESS, CropSampler, Example
from spectralzoom.models.training.objective import PHASES, batch_loss, class_weights
from spectralzoom.models.weights.checksummed_files import load_checkpoint, save_checkpoint
from spectralzoom.pipeline.errors import PipelineError
from spectralzoom.pipeline.geometry.grid import UNLABELLED

KEEP_EVERY_S = 120.0  # between checkpoints
FREED_EVERY = 50  # steps: crops of several sizes leave gaps of 9 MB a step in kept memory
PIXELS = 60_000  # to fit classifiers to, of all scenes together
CAPTURES = 16  # simulated for the linear classifier, of all scenes together or more
# Their mean scores more than either; the regression has a weak penalty.
LINEAR = (LinearDiscriminantAnalysis(solver="lsqr", shrinkage="auto"), LogisticRegression(C=10.0, max_iter=200))
KNOWN = ("overview_stem.first.", "overview_stem.stages.")  # parameters of large frames that ImageNet trained
KNOWN_RATE = 0.3  # of the learning rate, for these
NORM_BATCHES = 60  # over which the batch norms of the averaged weights are measured
CHECKED = 0.25, 200, 15  # fraction of the run or steps, whichever is earlier, and batches of norms, of the first check


@dataclass(frozen=True)
class TrainingSettings:
    """Settings of a training. ``minutes`` may end the run early; the learning rate follows."""

    steps: int = 2000
    batch: int = 4
    crop: int = 256
    learning_rate: float = 1.5e-3
    weight_decay: float = 0.02
    minutes: float = 36.0
    seed: int = 0
    average: float = 0.998  # decay of the averaged weights
    noise: float = 0.3  # largest added noise [spreads of the columns]
    weight_cap: float = 5.0
    darkest_ms: float = REFERENCE_MS  # shortest simulated exposure of crops; weights store the name


@dataclass(frozen=True)
class Progress:
    """Progress after a step."""

    step: int
    done: float  # 0..1, by steps or by time, whichever is further
    loss: float


class TrainingError(PipelineError, RuntimeError):
    """The loss was not finite three steps in a row."""


@dataclass
class Course:
    """Counters of a run, kept in its checkpoint."""

    step: int = 0
    seconds: float = 0.0  # up to the last checkpoint
    processor_seconds: float = 0.0  # the same
    skipped: int = 0
    unlabelled: int = 0  # steps whose crops had no label
    in_a_row: int = 0
    loss: float = math.nan  # smoothed


class Trainer:
    """Network, optimiser and counters of a training run."""

    def __init__(
        self,
        config: SegmenterConfig,
        examples: list[Example],
        gain_shift: NDArray[np.float32],
        settings: TrainingSettings,
        start: Mapping[str, Tensor] | None = None,
        augmentation: CaptureAugmentation | None = None,
        device: str = PROCESSOR,
    ) -> None:
        self.settings = settings
        self.gain_shift = gain_shift
        self.rng = np.random.default_rng([settings.seed, 0x7EA])
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(settings.seed)
            self.model = Segmenter(config)
        if start is not None:
            self.model.load_state_dict(start, strict=False)
        if config.parts:
            self.model.mixture.requires_grad_(requires_grad=False)  # it is fitted already
        self.model.to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.averaged = copy.deepcopy(self.model).eval()
        groups: list[dict[str, object]] = []  # matrices and kernels decay, gains and shifts do not
        for name, one in sorted(self.model.named_parameters(), key=lambda named: named[1].ndim <= 1):
            rate = KNOWN_RATE if name.startswith(KNOWN) else 1.0
            groups.append({"params": [one], "rate": rate, "weight_decay": settings.weight_decay * (one.ndim > 1)})
        self.optimiser = torch.optim.AdamW(groups, settings.learning_rate)
        self.sampler = CropSampler(
            examples, config.patch, settings.crop, settings.noise, config.deep, augmentation, device
        )
        self.weight = class_weights([one.labels for one in examples], config.classes, settings.weight_cap).to(device)
        self.course = Course()
        self._started, self._worked = time.monotonic(), time.process_time()

    @property
    def done(self) -> float:
        """Progress of the run, 0..1, by steps or time, whichever is further: the processor's, or an accelerator's."""
        if self.model.device.type == PROCESSOR:
            seconds = self.course.processor_seconds + time.process_time() - self._worked
        else:
            seconds = self.course.seconds + time.monotonic() - self._started
        return max(self.course.step / self.settings.steps, seconds / (60 * self.settings.minutes))

    def step(self, done: float) -> None:
        """Take one step; the learning rate follows from the fraction of the run that is ``done``.

        Raises TrainingError where the loss or its gradient was not finite three steps in a row.
        """
        course = self.course
        for group in self.optimiser.param_groups:
            group["lr"] = self.settings.learning_rate * rate_at(done) * group["rate"]
        phase = next((one for one in PHASES if done < one.until), PHASES[-1])
        fewer = phase.larger if self.sampler.size(phase.larger) > self.sampler.size() else 1  # in large scenes
        batch = self.sampler.draw(max(1, self.settings.batch // fewer), self.rng, self.gain_shift, larger=phase.larger)
        course.step += 1
        if not (batch.labels != UNLABELLED).any():  # decay and momentum alone would move the weights
            course.unlabelled += 1
            return
        loss = batch_loss(self.model, batch, self.weight, self.rng, phase, soft_dice=done > 0.3)
        course.in_a_row = 0 if _step(self.model, self.optimiser, loss) else course.in_a_row + 1
        course.skipped += course.in_a_row > 0
        if course.in_a_row == 3:
            last = course.step
            raise TrainingError(f"the loss was not finite in steps {last - 2} to {last}; lower the learning rate")
        keep = min(self.settings.average, course.step / (course.step + 20))
        with torch.no_grad():
            for slow, quick in zip(self.averaged.parameters(), self.model.parameters(), strict=True):
                slow.lerp_(quick, 1 - keep)
        value = float(loss.detach())
        if math.isfinite(value):
            course.loss = value if math.isnan(course.loss) else 0.97 * course.loss + 0.03 * value

    def measure_norms(self, batches: int) -> None:
        """Measure the batch norms of the averaged weights over crops, where they have some."""
        if self.averaged.config.deep:
            drawn = (self.sampler.draw(self.settings.batch, self.rng, self.gain_shift).image for _ in range(batches))
            torch.optim.swa_utils.update_bn(drawn, self.averaged.overview_stem)

    def keep(self, path: Path, identity: str) -> None:
        """Write a checkpoint."""
        now, worked = time.monotonic(), time.process_time()
        self.course.seconds += now - self._started
        self.course.processor_seconds += worked - self._worked
        self._started, self._worked = now, worked
        tensors = {f"model.{name}": tensor for name, tensor in self.model.state_dict().items()}
        tensors |= {f"averaged.{name}": tensor for name, tensor in self.averaged.state_dict().items()}
        for number, moments in self.optimiser.state_dict()["state"].items():
            tensors |= {f"optimiser.{number}.{name}": tensor for name, tensor in moments.items()}
        save_checkpoint(path, identity, {"course": asdict(self.course), "rng": self.rng.bit_generator.state}, tensors)

    def resume(self, path: Path, identity: str) -> bool:
        """Load a checkpoint of the same run; return False where there is none."""
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
        self.optimiser.load_state_dict({"state": state, "param_groups": self.optimiser.state_dict()["param_groups"]})
        self.rng.bit_generator.state = about["rng"]
        self.course = Course(**about["course"])
        self._started, self._worked = time.monotonic(), time.process_time()
        return True

    def summary(self) -> dict[str, float | int]:
        """Return steps, skipped steps, the smoothed loss, and wall and processor seconds."""
        course = self.course
        return {
            "steps": course.step,
            "skipped_steps": course.skipped,
            "unlabelled_steps": course.unlabelled,
            "last_loss": round(course.loss, 5),
            "seconds": round(course.seconds + time.monotonic() - self._started),
            "processor_seconds": round(course.processor_seconds + time.process_time() - self._worked),
        }


@dataclass(frozen=True)
class LabelledPixels:
    """Features of labelled pixels and their classes."""

    features: NDArray[np.float32]  # (pixel, column) means of `AROUND_PX` x `AROUND_PX` px
    labels: NDArray[np.uint8]  # (pixel,)

    @staticmethod
    def drawn(
        examples: Sequence[Example], rng: np.random.Generator, augmentation: CaptureAugmentation | None = None
    ) -> LabelledPixels:
        """Draw labelled pixels at random, about `PIXELS`, from each scene in proportion to its number.

        With an ``augmentation`` scenes are captured as crops are. A classifier of bright pixels has large logits, and
        a training unlearns its errors on dark pixels for thousands of steps.
        """
        counts = [int(np.count_nonzero(one.labels != UNLABELLED)) for one in examples]
        captures = 1 if augmentation is None else math.ceil(CAPTURES / len(examples))
        fraction = min(1.0, PIXELS / max(sum(counts), 1)) / captures
        features, labels = [], []
        for example, count in [pair for pair in zip(examples, counts, strict=True) for _ in range(captures)]:
            columns = torch.from_numpy(example.columns).float()
            if augmentation is not None and example.noise is not None:
                columns = augmentation.draw(columns, example.noise, rng)[0][..., :-PLANES]
            places = np.flatnonzero(example.labels != UNLABELLED)
            places = np.sort(rng.choice(places, min(count, math.ceil(count * fraction)), replace=False))
            means = scipy.ndimage.uniform_filter(columns.numpy(), (AROUND_PX, AROUND_PX, 1), mode="nearest")
            features.append(means.reshape(-1, means.shape[-1])[places])
            labels.append(example.labels.ravel()[places])
        return LabelledPixels(np.concatenate(features), np.concatenate(labels))

    def brightened(self, gain_shift: NDArray[np.float32], rng: np.random.Generator) -> LabelledPixels:
        """Vary the light of each pixel as that of crops: a classifier that relies on it would be unlearned first."""
        gain = rng.normal(1.0, BRIGHTNESS, (len(self.features), 1)).astype(np.float32)
        return LabelledPixels(self.features * gain + (gain - 1) * gain_shift, self.labels)


def linear_classifier(pixels: LabelledPixels, classes: int) -> dict[str, Tensor]:
    """Fit a linear classifier; return it as tensors of the segmenter's ``spectral`` layer.

    Its logits are the means of those of linear discriminants with shrinkage and of a logistic regression. They are 0
    for a class without a pixel, which the segmenter masks (`SegmenterConfig.untaught`).
    """
    weight, bias = np.zeros((classes, pixels.features.shape[1])), np.zeros(classes)
    known = np.unique(pixels.labels)
    for classifier in LINEAR:
        with warnings.catch_warnings(action="ignore", category=UserWarning):  # not converged; a class of one pixel
            fitted = clone(classifier).fit(pixels.features, pixels.labels)
        slope, offset = fitted.coef_, fitted.intercept_
        if len(known) == 2:  # one function separates both
            slope, offset = np.concatenate([0 * slope, slope]), np.concatenate([0 * offset, offset])
        weight[known] += slope / len(LINEAR)
        bias[known] += offset / len(LINEAR)
    return {
        "spectral.weight": torch.from_numpy(weight.astype(np.float32))[:, :, None, None],
        "spectral.bias": torch.from_numpy(bias.astype(np.float32)),
    }


def scaled(segmenter: Segmenter, fraction: float) -> Segmenter:
    """Return a copy whose networks correct the classifiers of pixels by a ``fraction``."""
    mixed = copy.deepcopy(segmenter)
    with torch.no_grad():
        for last in (mixed.overview_classes, mixed.full_classes):
            for own in last.parameters():
                own.mul_(fraction)
    return mixed


def train(
    config: SegmenterConfig,
    examples: list[Example],
    gain_shift: NDArray[np.float32],
    settings: TrainingSettings,
    report: Callable[[Progress], None] = lambda progress: None,
    *,
    start: Mapping[str, Tensor] | None = None,
    helps: Callable[[Segmenter], bool] | None = None,
    augmentation: CaptureAugmentation | None = None,
    checkpoint: Path | None = None,
    keep_every_s: float = KEEP_EVERY_S,
    device: str = PROCESSOR,
) -> tuple[Segmenter, dict[str, float | int]]:
    """Train a segmenter; return its averaged weights, on the processor, and a summary (steps, last loss, seconds).

    The same settings and examples start from the same weights and draw the same crops and patches. Results are equal
    up to rounding: the order of sums depends on memory alignment, and ``minutes`` may end the run elsewhere.

    ``start`` are named initial tensors; others are random. Where ``helps`` says no to the averaged weights at its one
    call, after `CHECKED` of the run, this ends. ``checkpoint`` is a file of the state, from which a killed
    run of the same settings and examples continues. ``device`` is one of `models.network.machine.choose_device`.

    Raises TrainingError: the loss or its gradient was not finite three steps in a row.
    """
    keep_freed_memory()
    trainer = Trainer(config, examples, gain_shift, settings, start, augmentation, device)
    identity = run_identity(config, examples, settings, start)
    if checkpoint is not None:
        trainer.resume(checkpoint, identity)
    kept, checked = time.monotonic(), helps is None
    while (done := trainer.done) < 1:
        trainer.step(done if trainer.course.step else 0.0)  # the first learning rate does not depend on the clock
        if trainer.course.step % FREED_EVERY == 0:
            give_back_freed_memory()
        report(Progress(trainer.course.step, done, trainer.course.loss))
        if checkpoint is not None and time.monotonic() - kept >= keep_every_s:
            trainer.keep(checkpoint, identity)
            kept = time.monotonic()
        if not checked and (done >= CHECKED[0] or trainer.course.step >= CHECKED[1]):
            checked = True
            trainer.measure_norms(CHECKED[2])
            if helps is not None and not helps(trainer.averaged):
                break
    else:
        trainer.measure_norms(NORM_BATCHES)
    return trainer.averaged.to(PROCESSOR), trainer.summary()


def halfway(start: Segmenter, trained: Segmenter) -> Segmenter:
    """Return a network with the mean weights of both: good where either was (Wortsman et al. 2022, WiSE-FT)."""
    mean = copy.deepcopy(trained)
    with torch.no_grad():
        for own, before in zip(mean.state_dict().values(), start.state_dict().values(), strict=True):
            if own.is_floating_point():
                own.lerp_(before.to(own.device), 0.5)
    return mean


def run_identity(
    config: SegmenterConfig, examples: list[Example], settings: TrainingSettings, start: Mapping[str, Tensor] | None
) -> str:
    """Return the hash that identifies the checkpoints of a run: of all that it depends on but time and a mixture."""
    about = [asdict(config), asdict(replace(settings, minutes=math.inf))]
    digest = hashlib.sha256(json.dumps(about, sort_keys=True).encode())
    for example in examples:
        digest.update(example.name.encode())
        digest.update(np.ascontiguousarray(example.columns).tobytes())
        digest.update(np.ascontiguousarray(example.labels).tobytes())
    for name, tensor in (start or {}).items():
        if not name.startswith("mixture."):  # fitted anew it is equal up to rounding
            digest.update(name.encode())
            digest.update(tensor.numpy().tobytes())
    return digest.hexdigest()[:20]


def rate_at(done: float) -> float:
    """Return the learning rate as a fraction of the highest: 5 % warm-up, then a cosine down to 1 %."""
    if done < 0.05:
        return 0.05 + 0.95 * done / 0.05
    return float(0.01 + 0.99 * 0.5 * (1 + np.cos(np.pi * (done - 0.05) / 0.95)))


def _step(model: nn.Module, optimiser: torch.optim.Optimizer, loss: Tensor) -> bool:
    """Take one optimiser step, unless the loss or the gradient is not finite; return whether it was taken."""
    optimiser.zero_grad(set_to_none=True)
    if not torch.isfinite(loss):
        return False
    loss.backward()  # type: ignore[no-untyped-call]
    if not torch.isfinite(torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)):
        return False
    optimiser.step()
    return True
