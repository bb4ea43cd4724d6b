"""Class probabilities of a field after a visit: the prior map brought to today, pixel by pixel.

Where weights have a reader of memories, it weighs what is remembered against what was seen; without one the surer of
both stands. Where today's look did not go, the memory stays and fades with its age.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from models.evaluation.expected_scores import expected_counts
from models.evaluation.metrics import confusion, kappa, overall_accuracy
from models.network.sizes import CELL_PX
from pipeline.geometry.grid import UNLABELLED
from pipeline.lazy import deferred
from pipeline.products.areas import BLOCK_PX

if TYPE_CHECKING:
    import torch
    from torch import Tensor

    from models.network.temporal_reader import TemporalReader
else:
    torch = deferred("torch")

FAINTEST = -12.7  # of logarithms of probabilities that are kept: one in 330 000
LIGHT_FADES_DAYS = 30.0  # in which the light that a memory rests on is worth e times less
FADES_DAYS = 120.0  # in which a memory that nobody looks after is worth e times less, without a reader
SETTLED_DAYS = 1.0  # from which on a reader has all the say of what nobody looked at
SURE = 0.97  # of today's look, without a reader, to speak against a memory
CERTAIN = 0.8  # of memory and map alike, so that a pixel of another class counts as changed
ERRORS_BEYOND = 2.0  # standard errors that more pixels differ by than of two maps of the same ground
ROWS = 128  # read at a time
SEEN_PX = 3  # that the reader sees beside a pixel, and three coarse pixels
LEAST_AGREEMENT, LEAST_KAPPA = 0.5, 0.35  # of a memory that is of this field; less of both, and it is put aside
Floats = NDArray[np.float32]


@dataclass(frozen=True)
class ClassProbabilities:
    """Class probabilities of a field, or of a part of it, after a visit."""

    log_probability: Floats  # (y, x, class)
    age_days: Floats  # (y, x) since a look went there
    light: Floats  # (y, x) that it rests on: reference exposures a pixel, of all looks; 0 where there was none

    def classes(self) -> tuple[NDArray[np.uint8], Floats]:
        """The likeliest class of each pixel and its probability; 255 and NaN where nothing is known."""
        known = np.isfinite(self.log_probability[..., 0])
        found = np.nan_to_num(self.log_probability, nan=-np.inf).argmax(axis=-1)
        sure = np.exp(np.take_along_axis(self.log_probability, found[..., None], axis=-1)[..., 0])
        classes = np.where(known, found, UNLABELLED).astype(np.uint8)
        return classes, np.where(known, sure, np.nan).astype(np.float32)


@dataclass(frozen=True)
class CurrentVisit:
    """Today's look, as far as a memory has to know it."""

    log_probability: Floats  # (y, x, class); NaN where nothing can be said
    seen: NDArray[np.bool_]  # (y, x) where it went in detail
    coarse: Floats  # (y / 2, x / 2, column) by `pooled`; NaN where nothing was seen
    light: float  # exposure of a line as a fraction of the reference
    step: int  # pixels from line to line


@dataclass(frozen=True)
class PriorMap:
    """A memory as it was left, and how many days ago."""

    probabilities: ClassProbabilities
    coarse: Floats | None  # as `CurrentVisit`'s, of the last look; None where it cannot be compared
    days: float


def pooled(columns: Floats) -> Floats:
    """Bring spectral features (y, x, column) to the pixels that a reader sees: means of 2 x 2, of those known."""
    y, x = (-size % CELL_PX for size in columns.shape[:2])
    whole = np.pad(columns, [(0, y), (0, x), (0, 0)], mode="edge") if y or x else columns
    parts = np.stack([whole[i::CELL_PX, j::CELL_PX] for i in range(CELL_PX) for j in range(CELL_PX)])
    known = np.isfinite(parts)
    sums = np.where(known, parts, np.float32(0)).sum(axis=0)
    count = known.sum(axis=0, dtype=np.float32)
    return np.where(count > 0, sums / np.maximum(count, 1), np.float32(np.nan))


def first_probabilities(observation: CurrentVisit) -> ClassProbabilities:
    """Return the class probabilities of a field without a prior map: those of the current visit."""
    kept = np.maximum(observation.log_probability, np.float32(FAINTEST))  # NaN stays
    light = np.where(observation.seen, observation.light / observation.step**2, 0).astype(np.float32)
    return ClassProbabilities(kept, _ages(kept, np.zeros(observation.seen.shape, np.float32)), light)


def fuse(memory: PriorMap, observation: CurrentVisit, reader: TemporalReader | None) -> ClassProbabilities:
    """Bring a memory to today by what was seen.

    A pixel of which the memory knows nothing takes today's look, and one that nothing can be said of today keeps its
    memory.
    """
    today = observation.log_probability
    y = len(today)
    kept, ages, light = np.empty_like(today), *np.empty((2, *observation.seen.shape), np.float32)
    s = CELL_PX
    high, halo = max(ROWS // s, 1) * s, -(-(3 * s + SEEN_PX) // s) * s
    for top in range(
        0, y, high
    ):  # what lies between memory and class probabilities is never there for all rows at once
        first, last, stop = max(top - halo, 0), min(top + high + halo, y), min(top + high, y)
        part, own = _recalled(memory, observation, reader, slice(first, last)), slice(top - first, stop - first)
        kept[top:stop], ages[top:stop], light[top:stop] = part.log_probability[own], part.age_days[own], part.light[own]
    return ClassProbabilities(kept, ages, light)


COME_TRUE = (
    0.5  # of the expected errors of what a reader carried: .34 to .74 on three farms, 3 and 7 days without a look
)
CARRIED_AS_BY = (0.05, 2)  # the light and step of a look that sees nothing, for the reader: those of a quick one


def carried(memory: PriorMap, reader: TemporalReader | None) -> ClassProbabilities:
    """Bring a memory to today without a look: what is believed where nobody goes, and how surely."""
    shape = memory.probabilities.log_probability.shape
    s, columns = CELL_PX, 1 if reader is None else reader.sizes.columns
    unseen, coarse = np.zeros(shape[:2], np.bool_), (-(-shape[0] // s), -(-shape[1] // s), columns)
    nothing = CurrentVisit(_nothing(shape), unseen, _nothing(coarse), *CARRIED_AS_BY)
    return fuse(memory, nothing, reader)


def _nothing(shape: tuple[int, ...]) -> Floats:
    return np.full(shape, np.nan, np.float32)


def _recalled(
    memory: PriorMap, observation: CurrentVisit, reader: TemporalReader | None, rows: slice
) -> ClassProbabilities:
    """Return the class probabilities of some rows; the outermost rows see fewer neighbours than there are."""
    before, today = memory.probabilities.log_probability[rows], observation.log_probability[rows]
    known, shown = _told(before), _told(today)
    seen = observation.seen[rows] & shown
    age = np.nan_to_num(memory.probabilities.age_days[rows], nan=0.0) + np.float32(memory.days)
    flat = np.float32(-math.log(before.shape[-1]))
    old, new = (_summing_to_1(np.where(where[..., None], one, flat)) for where, one in ((known, before), (seen, today)))
    left = np.float32(math.exp(-memory.days / LIGHT_FADES_DAYS))
    rests_on = np.where(known, memory.probabilities.light[rows] * left, 0).astype(np.float32)
    if reader is None:
        after = _the_surer(old, new, seen, age)
    else:
        images = old, np.where(seen[..., None], new, 0), seen, age, rests_on
        after = _held_until_settled(old, _read(reader, memory, observation, images, rows), seen, memory.days)
    after = np.where(known[..., None], after, today)  # today's look alone; NaN where that has nothing either
    kept = np.maximum(after, np.float32(FAINTEST)).astype(np.float32)
    own_light = np.where(seen, observation.light / observation.step**2, 0).astype(np.float32)
    return ClassProbabilities(kept, _ages(kept, np.where(seen | ~known, 0, age)), rests_on + own_light)


def _held_until_settled(old: Floats, after: Floats, seen: NDArray[np.bool_], days: float) -> Floats:
    """Mix memory and reader where nobody looked: on the first day the reader's share grows from 0 to 1, (y, x, class).

    A reader was trained on days; of a memory of this minute it has nothing to tell that the memory does not know.
    """
    fraction = min(days / SETTLED_DAYS, 1.0)
    if fraction == 1:
        return after
    mixed = np.log((1 - fraction) * np.exp(old) + fraction * np.exp(after)).astype(np.float32)
    held: Floats = np.where(seen[..., None], after, mixed)
    return held


def _summing_to_1(log_probability: Floats) -> Floats:
    """Logarithms of probabilities (..., class) that sum to 1."""
    summing: Floats = log_probability - np.log(np.exp(log_probability).sum(axis=-1, keepdims=True))
    return summing


def _ages(log_probability: Floats, age_days: Floats) -> Floats:
    """Ages, NaN where nothing is known."""
    ages: Floats = np.where(np.isfinite(log_probability[..., 0]), age_days, np.nan).astype(np.float32)
    return ages


def in_classes(log_probability: Floats, numbers: Sequence[int]) -> Floats:
    """Bring (..., class) log-probabilities to other classes: for each its number here, or -1 for one that is new.

    A new class is as likely as one of those that were, of which the memory knew nothing.
    """
    new = [number < 0 for number in numbers]
    taken = np.where(new, np.float32(-math.log(len(numbers))), log_probability[..., list(numbers)])
    taken -= np.log(np.exp(taken).sum(axis=-1, keepdims=True))
    found: Floats = np.where(np.isfinite(log_probability[..., :1]), taken, np.nan).astype(np.float32)
    return found


def faded(log_probability: Floats, age_days: Floats) -> Floats:
    """Fade a memory with its age: mix it with equal probabilities."""
    left = np.exp(-age_days.astype(np.float64) / FADES_DAYS).astype(np.float32)[..., None]
    mixed = left * np.exp(log_probability) + (1 - left) / log_probability.shape[-1]
    expected_gain: Floats = np.log(np.maximum(mixed, np.float32(math.exp(FAINTEST)))).astype(np.float32)
    return expected_gain


def _the_surer(before: Floats, today: Floats, seen: NDArray[np.bool_], age: Floats) -> Floats:
    """The memory, unless today's look is sure of another class; where both agree they are surer together."""
    old = faded(before, age)
    against = seen & (today.argmax(axis=-1) != old.argmax(axis=-1))
    together = old + np.where(seen[..., None], today, 0)
    together -= np.log(np.exp(together).sum(axis=-1, keepdims=True))
    surer = (today.max(axis=-1) > math.log(SURE)) | (today.max(axis=-1) > old.max(axis=-1) + math.log(2))
    found: Floats = np.where((against & surer)[..., None], today, np.where(against[..., None], old, together))
    return found


def _read(
    reader: TemporalReader,
    memory: PriorMap,
    observation: CurrentVisit,
    images: Sequence[NDArray[np.generic]],
    rows: slice,
) -> Floats:
    """Return the reader's log-probabilities of some rows, which begin with a coarse pixel."""
    s, (y, x) = CELL_PX, images[2].shape
    down, across = -(-y // s), -(-x // s)
    cells = slice(rows.start // s, rows.start // s + down)
    now = observation.coarse[cells, :across]
    past = now if memory.coarse is None else memory.coarse[cells, :across]
    both = _told(past) & _told(now)
    if memory.coarse is None:
        both[...] = False
    taken = torch.tensor([observation.light]), torch.tensor([float(observation.step)])

    def fine(values: NDArray[np.generic]) -> Tensor:
        fill = [(0, s * down - y), (0, s * across - x), *[(0, 0)] * (values.ndim - 2)]
        return _image(np.pad(values, fill, mode="edge"))

    with torch.inference_mode():
        coarsely = (_image(np.nan_to_num(values, posinf=0, neginf=0)) for values in (past, now))
        found = reader(*map(fine, images), *taken, *coarsely, _image(both))
    return np.ascontiguousarray(found[0, :, :y, :x].permute(1, 2, 0).numpy(), np.float32)


def _told(values: Floats) -> NDArray[np.bool_]:
    """Pixels of (y, x, channel) of which every channel says something."""
    return np.asarray(np.isfinite(values).all(axis=-1), np.bool_)


def _image(values: NDArray[np.generic]) -> Tensor:
    """(y, x) or (y, x, channel) as one image of a batch, (1, channel, y, x)."""
    deep = values[..., None] if values.ndim == 2 else values
    return torch.from_numpy(np.ascontiguousarray(deep.transpose(2, 0, 1)[None], np.float32))


@dataclass(frozen=True)
class TemporalAgreement:
    """Comparison of prior map, current visit and map, added up over regions of a field."""

    observation: NDArray[np.int64]  # (class before, class of today's look alone) pixels that both know
    changed: NDArray[np.int64]  # (class before, class of the map) pixels that both are sure of
    before: NDArray[np.float64]  # (likely class, mapped class) of the memory, by its probabilities, of these pixels
    now: NDArray[np.float64]  # the same of the map

    def __add__(self, other: TemporalAgreement) -> TemporalAgreement:
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return TemporalAgreement(*(own + its for own, its in pairs))

    @property
    def expected(self) -> NDArray[np.float64]:
        """Pixels (class before, class of the map) of two maps of the same ground, by the maps' own probabilities.

        Both maps tell what a likely class is mapped as, so that a class that is gone keeps its errors. Errors are taken
        to be independent at pixels of one class.
        """
        both = self.before + self.now
        likely = both.sum(axis=1, keepdims=True)
        of_class = np.divide(both, likely, out=np.zeros_like(both), where=likely > 0)
        return np.asarray(self.before.T @ of_class, np.float64)

    @property
    def beyond(self) -> NDArray[np.int64]:
        """Pixels (class before, class of the map) that changed, beyond what two maps of the same ground differ by.

        0 where the excess lies within two standard errors, errors within blocks of 16 x 16 px taken to come together.
        """
        expected = self.expected
        excess = self.changed - expected
        told = excess > ERRORS_BEYOND * BLOCK_PX * np.sqrt(expected)
        np.fill_diagonal(told, False)
        return np.where(told, np.rint(excess), 0).astype(np.int64)

    @property
    def agreement(self) -> float:
        """Fraction of the pixels that the look shows as they are remembered; NaN where there are none."""
        return overall_accuracy(self.observation)

    @property
    def is_of_another_field(self) -> bool:
        """Return whether prior map and visit have hardly more in common than any two fields."""
        return self.agreement < LEAST_AGREEMENT and kappa(self.observation) < LEAST_KAPPA  # NaN is not


def compare(
    memory: PriorMap, observation: CurrentVisit, after: ClassProbabilities, part: tuple[slice, slice]
) -> TemporalAgreement:
    """Compare what was remembered of some rows and columns with today's look and with what is believed now."""
    classes = after.log_probability.shape[-1]
    before, today, now = (
        values[part]
        for values in (memory.probabilities.log_probability, observation.log_probability, after.log_probability)
    )
    known = _told(before) & _told(today) & observation.seen[part]
    old, new = (np.nan_to_num(values, nan=-np.inf).argmax(axis=-1) for values in (before, now))
    shown = np.nan_to_num(today, nan=-np.inf).argmax(axis=-1)
    least = math.log(CERTAIN)
    sure = known & (before.max(axis=-1) > least) & (now.max(axis=-1) > least)
    return TemporalAgreement(
        confusion(old[known], shown[known], classes),
        confusion(old[sure], new[sure], classes),
        expected_counts([before[sure]], classes),
        expected_counts([now[sure]], classes),
    )


def changed_from(memory: PriorMap, after: ClassProbabilities) -> NDArray[np.uint8]:
    """The class that a pixel (y, x) had where memory and map are sure of two different ones; 255 everywhere else."""
    before, now = memory.probabilities.log_probability, after.log_probability
    least = math.log(CERTAIN)
    sure = (before.max(axis=-1) > least) & (now.max(axis=-1) > least)  # NaN is not
    old, new = (np.nan_to_num(values, nan=-9).argmax(axis=-1) for values in (before, now))
    return np.where(sure & (old != new), old, UNLABELLED).astype(np.uint8)


def changed_fractions(old: NDArray[np.uint8], patch: int) -> Floats:
    """Fraction of each patch's pixels that ``old`` of `changed_from` has a class for, (patch_y, patch_x)."""
    y, x = (-(-size // patch) * patch for size in old.shape)
    padded = np.pad(old != UNLABELLED, [(0, y - old.shape[0]), (0, x - old.shape[1])])
    fractions: Floats = padded.reshape(y // patch, patch, x // patch, patch).mean(axis=(1, 3), dtype=np.float32)
    return fractions
