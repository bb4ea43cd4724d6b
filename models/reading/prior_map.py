"""Fuse the prior map of a field with the current visit, pixel by pixel.

The temporal reader of the weights weighs both. Without a reader the more confident of the two is taken. Pixels that
the visit did not capture are mapped by their prior map, which fades with its age. The next visit starts from the
probabilities of their last capture: the number of visits since then changes nothing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from spectralzoom.models.evaluation.expected_scores import expected_counts
from spectralzoom.models.evaluation.metrics import confusion, overall_accuracy
from spectralzoom.models.network.sizes import CELL_PX
from spectralzoom.pipeline.geometry.grid import UNLABELLED

if TYPE_CHECKING:
    from torch import Tensor

    from spectralzoom.models.network.temporal_reader import TemporalReader

FAINTEST = -12.7  # least log-probability that is stored: one in 330 000
LIGHT_FADES_DAYS = 30.0  # in which the exposure of a prior map loses weight by a factor of e
FADES_DAYS = 120.0  # in which a prior map without a new capture loses weight by a factor of e, without a reader
SETTLED_DAYS = 1.0  # age from which the reader alone decides pixels that were not captured
SURE = 0.97  # confidence of the visit that overrules a prior map, without a reader
CERTAIN = 0.8  # confidence of prior map and map at which a pixel of another class counts as changed
BLOCK_PX = 16  # a side: differences are taken as equal within a block, and as independent between blocks
ERRORS_BEYOND = 2.0  # standard errors above the expected difference of two maps of the same ground
ROWS = 128  # fused at a time
DAYS_A_YEAR = 365.25
HALO = 5 * CELL_PX  # reach of the reader around a pixel, three coarse pixels and 3 px, in whole coarse pixels
Floats = NDArray[np.float32]


@dataclass(frozen=True)
class ClassProbabilities:
    """Class probabilities of a field, or of a part of it, after a visit."""

    log_probability: Floats  # (y, x, class); minus infinity for a class that is never drawn
    age_days: Floats  # (y, x) since the last capture; NaN without one
    light: Floats  # (y, x) sum of all captures, older ones weigh less: reference exposures over squared line spacing

    def classes(self) -> tuple[NDArray[np.uint8], Floats]:
        """Return the most probable class of each pixel and its probability; 255 and NaN for unknown pixels."""
        found, sure = likeliest(self.log_probability)
        return np.where(np.isfinite(sure), found, UNLABELLED).astype(np.uint8), np.exp(sure)


def likeliest(log_probability: Floats) -> tuple[NDArray[np.int64], Floats]:
    """Return the most probable class (..., class) -> (...) and its log-probability; 0 and NaN for unknown pixels."""
    import torch

    sure, found = torch.from_numpy(log_probability).max(dim=-1)
    return found.numpy(), sure.numpy()


@dataclass(frozen=True)
class CurrentVisit:
    """The current visit, as the fusion needs it."""

    log_probability: Floats  # (y, x, class); NaN for unknown pixels
    seen: NDArray[np.bool_]  # (y, x) pixels that were captured
    coarse: Floats  # (y / 2, x / 2, column) by `pooled`; NaN without a capture
    light: float  # exposure of most lines as a fraction of the reference
    step: int  # spacing of most lines [px]
    own_light: Floats | None = None  # (y, x) light / step^2 of each pixel's capture; None where all have the same

    def light_of(self, rows: slice) -> Floats | float:
        """Return light / step^2 of some rows."""
        return self.light / self.step**2 if self.own_light is None else self.own_light[rows]


@dataclass(frozen=True)
class PriorMap:
    """Class probabilities of an earlier visit, and their age in days."""

    probabilities: ClassProbabilities
    coarse: Floats | None  # as `CurrentVisit.coarse`, of the last visit; None if it is not comparable
    days: float
    day_of_year: float | None = None  # of the current visit; None where its date is unknown


def season_of(day_of_year: float | None) -> tuple[float, float]:
    """Return cosine and sine of the day as an angle of the year; both are 0 where the day is unknown."""
    if day_of_year is None:
        return 0.0, 0.0
    angle = 2 * math.pi * day_of_year / DAYS_A_YEAR
    return math.cos(angle), math.sin(angle)


def pooled(columns: Floats) -> Floats:
    """Return the means of 2 x 2 px of spectral features (y, x, column), over the finite values."""
    y, x = (-size % CELL_PX for size in columns.shape[:2])
    whole = np.pad(columns, [(0, y), (0, x), (0, 0)], mode="edge") if y or x else columns
    parts = np.stack([whole[i::CELL_PX, j::CELL_PX] for i in range(CELL_PX) for j in range(CELL_PX)])
    known = np.isfinite(parts)
    sums = np.where(known, parts, np.float32(0)).sum(axis=0)
    count = known.sum(axis=0, dtype=np.float32)
    return np.where(count > 0, sums / np.maximum(count, 1), np.float32(np.nan))


def first_probabilities(observation: CurrentVisit) -> ClassProbabilities:
    """Return the class probabilities of a field without a prior map: those of the current visit."""
    kept = _floored(observation.log_probability)
    light = np.where(observation.seen, observation.light_of(np.s_[:]), 0).astype(np.float32)
    return ClassProbabilities(kept, np.where(_known(kept), np.float32(0), np.float32(np.nan)), light)


def fuse(prior_map: PriorMap, observation: CurrentVisit, reader: TemporalReader | None) -> ClassProbabilities:
    """Return the class probabilities of today, from a prior map and the current visit.

    A pixel without a prior map takes the visit. A pixel without a visit takes the prior map, faded by its age.
    """
    today = observation.log_probability
    y = len(today)
    kept = np.empty_like(today)
    ages, light = np.empty((2, *observation.seen.shape), np.float32)
    high = max(ROWS // CELL_PX, 1) * CELL_PX
    for top in range(0, y, high):  # limits the memory of intermediate arrays
        first, last, stop = max(top - HALO, 0), min(top + high + HALO, y), min(top + high, y)
        part = _fused(prior_map, observation, reader, slice(first, last))
        own = slice(top - first, stop - first)
        kept[top:stop], ages[top:stop], light[top:stop] = part.log_probability[own], part.age_days[own], part.light[own]
    return ClassProbabilities(kept, ages, light)


COME_TRUE = 0.5  # fraction of a carried map's expected errors that occur: .34 to .74 on three farms after 3 and 7 days
EVERY_PX = 2  # rows and columns of a prior map from which lines are chosen: a quarter of the multiply-adds
CARRIED_AS_BY = (0.05, 2)  # light and line spacing for the reader without a visit: those of a quick scan


def carried(prior_map: PriorMap, reader: TemporalReader | None) -> ClassProbabilities:
    """Return the class probabilities of today without a visit."""
    shape = prior_map.probabilities.log_probability.shape
    coarse = (-(-shape[0] // CELL_PX), -(-shape[1] // CELL_PX), 1 if reader is None else reader.sizes.columns)
    nothing, features = (np.full(size, np.nan, np.float32) for size in (shape, coarse))
    return fuse(prior_map, CurrentVisit(nothing, np.zeros(shape[:2], np.bool_), features, *CARRIED_AS_BY), reader)


def _fused(
    prior_map: PriorMap, observation: CurrentVisit, reader: TemporalReader | None, rows: slice
) -> ClassProbabilities:
    """Return the class probabilities of some rows; the outermost rows lack some of their neighbours."""
    before, today = prior_map.probabilities.log_probability[rows], observation.log_probability[rows]
    known, shown = _known(before), _known(today)
    seen = observation.seen[rows] & shown
    age = prior_map.probabilities.age_days[rows] + np.float32(prior_map.days)
    days = np.nan_to_num(age, nan=0.0)
    flat = np.float32(-math.log(before.shape[-1]))
    images = [np.where(where[..., None], one, flat) for where, one in ((known, before), (seen, today))]
    never = np.isneginf(images[0]) | np.isneginf(images[1])
    old, new = (_normalised(_without(never, one)) for one in images)
    left = np.float32(math.exp(-prior_map.days / LIGHT_FADES_DAYS))
    rests_on = np.where(known, prior_map.probabilities.light[rows] * left, 0).astype(np.float32)
    if reader is None:
        after = _more_confident(old, new, seen, days)
    else:
        finite = (np.where(never, np.float32(FAINTEST), one) for one in (old, np.where(seen[..., None], new, 0)))
        after = _read(reader, prior_map, observation, (*finite, seen, days, rests_on), rows)
        after = _normalised(_without(never, after)) if never.any() else after
        # The reader was trained on visits that are days apart: without a capture it is phased in over the first day.
        fraction = np.where(seen, 1, np.minimum(days / np.float32(SETTLED_DAYS), 1))[..., None]
        if not (fraction == 1).all():
            with np.errstate(divide="ignore"):  # a class that is never drawn
                mixed = np.log((1 - fraction) * np.exp(old) + fraction * np.exp(after)).astype(np.float32)
            after = np.where(fraction == 1, after, mixed)
    after = np.where(known[..., None], after, today)  # the visit alone; NaN where that is unknown too
    kept = _floored(after)
    own_light = np.where(seen, observation.light_of(rows), 0).astype(np.float32)
    return ClassProbabilities(kept, np.where(seen, np.float32(0), age), rests_on + own_light)


def as_captured(prior_map: PriorMap, after: ClassProbabilities) -> ClassProbabilities:
    """Return what is stored for the next visit: pixels that this one did not capture are as at their last capture."""
    before = prior_map.probabilities.log_probability
    return replace(after, log_probability=np.where(after.age_days[..., None] > 0, before, after.log_probability))


def _normalised(log_probability: Floats) -> Floats:
    """Return log-probabilities (..., class) of probabilities that sum to 1."""
    return np.asarray(log_probability - np.log(np.exp(log_probability).sum(axis=-1, keepdims=True)))


def in_classes(log_probability: Floats, numbers: Sequence[int], untaught: Sequence[int] = ()) -> Floats:
    """Return log-probabilities (..., class) of other classes, given the present number of each; -1 is a new class.

    A new class gets the probability of one class of a uniform distribution, as does one that was never drawn. That of
    removed classes is spread over all others. ``untaught`` classes are never drawn: they count as removed.
    """
    taught = np.isin(np.arange(len(numbers)), untaught, invert=True)
    before = np.exp(log_probability[..., list(numbers)])
    removed = np.setdiff1d(np.arange(log_probability.shape[-1]), np.array(numbers)[taught])
    spread = np.exp(log_probability[..., removed]).sum(axis=-1, keepdims=True) / taught.sum(dtype=np.float32)
    kept = np.where((np.array(numbers) < 0) | (before == 0), 1 / taught.sum(dtype=np.float32), before) + spread
    return _normalised(_without(~taught, np.log(kept))).astype(np.float32)


def faded(log_probability: Floats, age_days: Floats) -> Floats:
    """Return a prior map that is mixed by its age with equal probabilities of all classes that it may have."""
    never = np.isneginf(log_probability)
    left = np.exp(-age_days.astype(np.float64) / FADES_DAYS).astype(np.float32)[..., None]
    mixed = left * np.exp(log_probability) + (1 - left) / (~never).sum(axis=-1, keepdims=True, dtype=np.float32)
    return _without(never, np.log(np.maximum(mixed, np.float32(math.exp(FAINTEST)))).astype(np.float32))


def _without(never: NDArray[np.bool_], log_probability: Floats) -> Floats:
    """Return log-probabilities (..., class) with minus infinity for the classes that are ``never`` drawn."""
    return np.where(never, np.float32(-np.inf), log_probability)


def _floored(log_probability: Floats) -> Floats:
    """Return log-probabilities of at least `FAINTEST`; NaN and minus infinity stay."""
    return _without(np.isneginf(log_probability), np.maximum(log_probability, np.float32(FAINTEST)).astype(np.float32))


def _more_confident(before: Floats, today: Floats, seen: NDArray[np.bool_], age: Floats) -> Floats:
    """Return the prior map, unless the visit is confident of another class; equal classes add their evidence."""
    old = faded(before, age)
    against = seen & (today.argmax(axis=-1) != old.argmax(axis=-1))
    together = old + np.where(seen[..., None], today, 0)
    together -= np.log(np.exp(together).sum(axis=-1, keepdims=True))
    surer = (today.max(axis=-1) > math.log(SURE)) | (today.max(axis=-1) > old.max(axis=-1) + math.log(2))
    return np.where((against & surer)[..., None], today, np.where(against[..., None], old, together))


def _read(
    reader: TemporalReader,
    prior_map: PriorMap,
    observation: CurrentVisit,
    images: Sequence[NDArray[np.generic]],
    rows: slice,
) -> Floats:
    """Return the reader's log-probabilities of some rows; the first row begins a coarse pixel."""
    import torch

    y, x = images[2].shape
    down, across = -(-y // CELL_PX), -(-x // CELL_PX)
    cells = slice(rows.start // CELL_PX, rows.start // CELL_PX + down)
    now = observation.coarse[cells, :across]
    past = now if prior_map.coarse is None else prior_map.coarse[cells, :across]
    both = _finite(past) & _finite(now) & (prior_map.coarse is not None)
    season = torch.tensor([season_of(prior_map.day_of_year)], dtype=torch.float32)
    taken = torch.tensor([observation.light]), torch.tensor([float(observation.step)]), season

    def fine(values: NDArray[np.generic]) -> Tensor:
        fill = [(0, CELL_PX * down - y), (0, CELL_PX * across - x), *[(0, 0)] * (values.ndim - 2)]
        return _image(np.pad(values, fill, mode="edge"))

    with torch.inference_mode():
        coarsely = (_image(np.nan_to_num(values, posinf=0, neginf=0)) for values in (past, now))
        found = reader(*map(fine, images), *taken, *coarsely, _image(both))
    return np.ascontiguousarray(found[0, :, :y, :x].permute(1, 2, 0).numpy(), np.float32)


def _known(log_probability: Floats) -> NDArray[np.bool_]:
    """Return which pixels of (y, x, class) have probabilities."""
    return np.asarray(~np.isnan(log_probability).any(axis=-1), np.bool_)


def _finite(values: Floats) -> NDArray[np.bool_]:
    """Return which pixels of (y, x, channel) are finite in every channel."""
    return np.asarray(np.isfinite(values).all(axis=-1), np.bool_)


def _image(values: NDArray[np.generic]) -> Tensor:
    """Return (y, x) or (y, x, channel) as a batch of one image, (1, channel, y, x)."""
    import torch

    deep = values[..., None] if values.ndim == 2 else values
    # not deep[None], as in `models.reading.inference.overview_of`
    return torch.from_numpy(np.ascontiguousarray(deep, np.float32))[None].permute(0, 3, 1, 2)


@dataclass(frozen=True)
class TemporalAgreement:
    """Comparison of prior map, current visit and map, added up over regions of a field."""

    observation: NDArray[np.int64]  # (class before, class of the visit alone) pixels that both know
    changed: NDArray[np.int64]  # (class before, class of the map) pixels where both are confident
    before: NDArray[np.float64]  # (likely class, mapped class) of the prior map, by its probabilities, of these pixels
    now: NDArray[np.float64]  # the same of the map

    def __add__(self, other: TemporalAgreement) -> TemporalAgreement:
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return TemporalAgreement(*(own + its for own, its in pairs))

    @property
    def expected(self) -> NDArray[np.float64]:
        """Return the expected pixels (class before, class of the map) of two maps of the same ground.

        The probabilities of both maps give the confusion of each likely class. Errors at pixels of one class are taken
        as independent.
        """
        both = self.before + self.now
        likely = both.sum(axis=1, keepdims=True)
        of_class = np.divide(both, likely, out=np.zeros_like(both), where=likely > 0)
        return np.asarray(self.before.T @ of_class, np.float64)

    @property
    def beyond(self) -> NDArray[np.int64]:
        """Return pixels (class before, class of the map) that changed beyond the expected difference.

        It is 0 if the excess is within two standard errors. Errors within 16 x 16 px count as one.
        """
        expected = self.expected
        excess = self.changed - expected
        significant = excess > ERRORS_BEYOND * BLOCK_PX * np.sqrt(expected)
        np.fill_diagonal(significant, False)
        return np.where(significant, np.rint(excess), 0).astype(np.int64)

    @property
    def agreement(self) -> float:
        """Return the fraction of pixels with equal classes in prior map and visit; NaN without a pixel."""
        return overall_accuracy(self.observation)


def compare(
    prior_map: PriorMap, observation: CurrentVisit, after: ClassProbabilities, part: tuple[slice, slice]
) -> TemporalAgreement:
    """Compare the prior map of some rows and columns with the visit and with the fused map."""
    classes = after.log_probability.shape[-1]
    before, today, now = (
        values[part]
        for values in (prior_map.probabilities.log_probability, observation.log_probability, after.log_probability)
    )
    (old, old_sure), (shown, shown_sure), (new, new_sure) = map(likeliest, (before, today, now))
    known = np.isfinite(old_sure) & np.isfinite(shown_sure) & observation.seen[part]
    least = math.log(CERTAIN)
    sure = known & (old_sure > least) & (new_sure > least)
    return TemporalAgreement(
        confusion(old[known], shown[known], classes),
        confusion(old[sure], new[sure], classes),
        expected_counts([before[sure]], classes),
        expected_counts([now[sure]], classes),
    )


def changed_from(prior_map: PriorMap, after: ClassProbabilities) -> NDArray[np.uint8]:
    """Return the earlier class of captured pixels (y, x) whose prior map and map are confident of two; else 255."""
    old, old_sure = likeliest(prior_map.probabilities.log_probability)
    new, new_sure = likeliest(after.log_probability)
    sure = np.minimum(old_sure, new_sure) > math.log(CERTAIN)  # NaN is not
    return np.where(sure & (old != new) & (after.age_days == 0), old, UNLABELLED).astype(np.uint8)
