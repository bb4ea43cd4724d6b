"""Train the temporal reader on sequences of visits to one land.

The prior map of each visit is the reader's own output for the visits before, as in surveys. Some visits capture a part
of the land.
"""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from spectralzoom.models.network.sizes import CELL_PX, TemporalSizes
from spectralzoom.models.network.temporal_reader import TemporalReader
from spectralzoom.models.reading.prior_map import FAINTEST, LIGHT_FADES_DAYS, season_of
from spectralzoom.models.training.objective import class_weights, map_loss
from spectralzoom.models.training.train import Progress

FAINT = 1e-5  # least probability of a pass
PARTLY_SEEN = 0.3  # fraction of later visits that capture a part of the land
INCOMPARABLE = 0.1  # fraction of visits whose spectral features are not comparable
UNDATED = 0.1  # fraction of sequences of visits whose days are unknown
WARM_UP = 50  # steps


@dataclass(frozen=True)
class PastPass:
    """Class probabilities of a land by one scan of a day, from the weights of the reader."""

    step: int  # line spacing [px]
    light: float  # exposure as a fraction of the reference
    probability: NDArray[np.float16]  # (y, x, class)
    coarse: NDArray[np.float16]  # (y / s, x / s, column) normalised


@dataclass(frozen=True)
class Visit:
    """A land on a day, as several scans show it."""

    moment: float  # day of the year
    labels: NDArray[np.uint8]
    scan_passes: Sequence[PastPass]


@dataclass(frozen=True)
class TemporalTraining:
    """Length and settings of a training of the reader."""

    minutes: float = 32.0
    steps: int = 4000
    seed: int = 0
    batch: int = 16
    crop: int = 64  # px
    visits: int = 4  # in a row
    learning_rate: float = 3e-3
    weight_decay: float = 0.01
    average: float = 0.995
    weight_cap: float = 5.0  # of rare classes


@dataclass(frozen=True)
class _Batch:
    """One visit of every sequence of a batch."""

    observation: Tensor  # (B, class, y, x) logarithms
    coarse: Tensor  # (B, column, y / s, x / s)
    labels: Tensor  # (B, y, x)
    seen: Tensor  # (B, 1, y, x)
    days: Tensor  # (B, 1, 1, 1) since the visit before
    light: Tensor  # (B,)
    step: Tensor  # (B,)
    season: Tensor  # (B, 2)
    comparable: Tensor  # (B, 1, 1, 1)


def train_reader(
    lands: Sequence[Sequence[Visit]],
    settings: TemporalTraining,
    report: Callable[[Progress], None] = lambda now: None,
    *,
    start: TemporalReader | None = None,
) -> tuple[TemporalReader, int]:
    """Train on visits to lands in the order of their days, from ``start`` where one is given.

    Returns the averaged reader and the number of steps.
    """
    first = lands[0][0].scan_passes[0]
    sizes = TemporalSizes(first.probability.shape[-1], first.coarse.shape[-1])
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.seed)
        reader = TemporalReader(sizes) if start is None else copy.deepcopy(start).train()
    reader = reader.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    averaged = copy.deepcopy(reader).eval()
    weight = class_weights([visit.labels for land in lands for visit in land], sizes.classes, settings.weight_cap)
    rng = np.random.default_rng([settings.seed, 0x3E3])
    optimiser = torch.optim.AdamW(reader.parameters(), settings.learning_rate, weight_decay=settings.weight_decay)
    step = 0
    loss = math.nan
    started = time.monotonic()
    while (done := max(step / settings.steps, (time.monotonic() - started) / (60 * settings.minutes))) < 1:
        rate = min(1, (step + 1) / WARM_UP) * (1 + math.cos(math.pi * done)) / 2
        for group in optimiser.param_groups:
            group["lr"] = settings.learning_rate * rate
        optimiser.zero_grad()
        value = _learn(reader, _sequences(lands, settings, rng), weight)
        torch.nn.utils.clip_grad_norm_(reader.parameters(), 1.0)
        optimiser.step()
        step += 1
        keep = min(settings.average, step / (step + 10))
        with torch.no_grad():
            for slow, quick in zip(averaged.parameters(), reader.parameters(), strict=True):
                slow.lerp_(quick, 1 - keep)
        loss = value if math.isnan(loss) else 0.98 * loss + 0.02 * value
        report(Progress(step, done, loss))
    return averaged, step


def _learn(reader: TemporalReader, visits: Sequence[_Batch], weight: Tensor) -> float:
    """Carry prior maps through visits, learn from the labels of each but the first, and return the mean loss."""
    start = visits[0]
    state, coarse = start.observation, start.coarse
    age = torch.zeros_like(start.seen)
    rests_on = age + (start.light / start.step**2)[:, None, None, None]
    total = 0.0
    for now in visits[1:]:
        age = age + now.days
        rests_on = rests_on * torch.exp(-now.days / LIGHT_FADES_DAYS)
        small = now.seen[:, :, CELL_PX // 2 :: CELL_PX, CELL_PX // 2 :: CELL_PX]
        images = state, now.observation, now.seen, age, rests_on
        found = reader(*images, now.light, now.step, now.season, coarse, now.coarse, small * now.comparable)
        loss = map_loss(found, now.labels, weight, soft_dice=True)
        torch.autograd.backward(loss)
        total += float(loss.detach()) / (len(visits) - 1)
        state = found.detach().clamp(min=FAINTEST)
        state = state - state.logsumexp(dim=1, keepdim=True)
        age = age.where(now.seen == 0, 0)
        rests_on = rests_on + now.seen * (now.light / now.step**2)[:, None, None, None]
        coarse = now.coarse.where(small > 0, coarse)
    return total


def _sequences(lands: Sequence[Sequence[Visit]], settings: TemporalTraining, rng: np.random.Generator) -> list[_Batch]:
    """Draw crops of lands through several visits, rotated and mirrored alike."""
    drawn = [_sequence(lands[int(rng.integers(len(lands)))], settings, rng) for _ in range(settings.batch)]
    batches = []
    for visits in zip(*drawn, strict=True):
        batch = _Batch(*(torch.from_numpy(np.stack(part)) for part in zip(*visits, strict=True)))
        observation = batch.observation - batch.observation.logsumexp(dim=1, keepdim=True)
        batches.append(replace(batch, observation=observation, labels=batch.labels.long()))
    return batches


def _sequence(
    land: Sequence[Visit], settings: TemporalTraining, rng: np.random.Generator
) -> list[list[NDArray[np.generic]]]:
    """Return one crop through visits of a land, as in `_Batch`; the last visit is repeated if there are too few."""
    side = settings.crop
    first = int(rng.integers(0, max(len(land) - settings.visits, 0) + 1))
    visits = [land[min(first + number, len(land) - 1)] for number in range(settings.visits)]
    y, x = (CELL_PX * int(rng.integers(0, (size - side) // CELL_PX + 1)) for size in land[0].labels.shape)
    fine = np.s_[y : y + side, x : x + side]
    small = np.s_[y // CELL_PX : (y + side) // CELL_PX, x // CELL_PX : (x + side) // CELL_PX]
    turns, mirrored = int(rng.integers(4)), bool(rng.integers(2))
    sequence: list[list[NDArray[np.generic]]] = []
    before = visits[0].moment
    dated = rng.random() >= UNDATED
    for number, visit in enumerate(visits):
        coarse_pass = visit.scan_passes[int(rng.integers(len(visit.scan_passes)))]
        if number == 0 and rng.random() < 0.5:  # prior maps are often of the best scan
            coarse_pass = max(visit.scan_passes, key=lambda one: one.light / one.step**2)
        images = (
            np.log(np.maximum(coarse_pass.probability[fine].astype(np.float32), FAINT)),
            coarse_pass.coarse[small].astype(np.float32),
            visit.labels[fine],
            _seen(side, number > 0 and rng.random() < PARTLY_SEEN, rng),
        )
        turned = [np.rot90(image[::-1] if mirrored else image, turns) for image in images]
        channels_first = [image.transpose(2, 0, 1) if image.ndim == 3 else image for image in turned]
        days, comparable = ([[[one]]] for one in (abs(visit.moment - before), rng.random() >= INCOMPARABLE))
        season = season_of(visit.moment if dated else None)
        taken = (np.array(one, np.float32) for one in (days, coarse_pass.light, coarse_pass.step, season, comparable))
        sequence.append([*map(np.ascontiguousarray, channels_first), *taken])
        before = visit.moment
    return sequence


def _seen(side: int, partly: bool, rng: np.random.Generator) -> NDArray[np.float32]:
    """Draw the captured part of a visit, (y, x, 1): everything, a block of rows, or all other rows."""
    seen = np.ones((side, side, 1), np.float32)
    if partly:
        cell = 4 * CELL_PX
        low, high = sorted(cell * int(at) for at in rng.integers(0, side // cell + 1, 2))
        if rng.random() < 0.5:
            seen[:low] = 0
            seen[high:] = 0
        else:
            seen[low:high] = 0
    return seen
