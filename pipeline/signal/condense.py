"""Condense lines: spectra to scores of the field's components, and the rare spectra that components do not hold.

A spectrum whose residual exceeds noise by a chi-square test, alone or with its neighbours, keeps its residual.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.grid import cuts
from spectralzoom.pipeline.geometry.scan import Sweep
from spectralzoom.pipeline.readings import SIGMA_OF_MEDIAN
from spectralzoom.pipeline.signal.calibrate import Bools, calibrate, judge_elements
from spectralzoom.pipeline.signal.components import Components, Scores
from spectralzoom.pipeline.signal.lines import BLOCK_LINES, CondensedLines
from spectralzoom.pipeline.signal.rounding import whole_steps
from spectralzoom.pipeline.signal.subspace import SignalStatistics
from spectralzoom.pipeline.source import Line, References, SweepLines

WHOLE, PARTIAL, UNUSABLE = 0, 1, 2  # all bands seen; some restored from the others; fewer than half of the bands seen
JOINT = ((2, 2), (1, 8), (8, 1))  # (line, sample) of neighbours whose residuals are tested together
ALONE = 1e-3  # probability beyond which the residual of one spectrum is limited in tests with its neighbours
LAW_ROUNDS = 4  # of the fit of the law
LAW_CLIP = 4.0  # spreads from the law beyond which a spectrum is left out of the fit
LEAST_EXPECTED = 0.2  # of the mean residual: least prediction of the law, ...
LEAST_RESIDUAL = 0.02  # ... and of the noise's variance: less is rounding
CANCELLED = 1e-4  # of a spectrum's square: a smaller difference of squares has lost digits of float32
SPECTRA_AT_ONCE = 256  # projected at a time: they stay in cache
RESIDUAL_STEP = 0.5  # in which residuals of rare spectra are kept [noise's deviations]

SLACK, DIGITS = 1e-3, 1e-5  # of a step, and of a score, by which sums of float32 may differ

Store = Callable[[int, Scores, NDArray[np.uint8]], None]
Report = Callable[[float], None]


@dataclass(frozen=True)
class ScoredLines:
    """Lines in components: scores before rounding, quality of each spectrum, and its residual."""

    scores: Scores  # (line, sample, component) in noise's deviations; 0 where nothing was seen
    quality: NDArray[np.uint8]  # (line, sample) WHOLE, PARTIAL or UNUSABLE
    residual: Scores  # (line, sample) mean square a degree of freedom, in the noise's variance; NaN where unusable


def score_lines(values: NDArray[np.float32], valid: Bools, components: Components) -> ScoredLines:
    """Project (line, sample, band) scene values onto components, by the bands that `calibrate` calls valid.

    A spectrum with missing bands gets the most probable scores by its other bands and the scatter of the field's
    scores. Least squares alone would leave some scores unknown where neighbouring bands are missing. Spectra of few
    bands have a known covariance: there a missing band takes its expected value. ``valid`` is (line, sample) or (line,
    sample, band).
    """
    lit = np.isfinite(components.mean)
    count = len(components)
    bands = int(lit.sum())
    scores, left = _projected(values, components)
    quality = np.where(valid if valid.ndim == 2 else valid.any(axis=2), WHOLE, UNUSABLE).astype(np.uint8)
    residual = np.maximum(left, 0) / np.float32(max(bands - count, 1))
    broken = ~np.isfinite(left) if valid.ndim == 2 else ~np.isfinite(left) | ~valid[..., lit].all(axis=2)
    if (broken & (quality == WHOLE)).any():
        there = np.isfinite(values[broken]) & lit & (valid[broken] if valid.ndim == 3 else valid[broken][:, None])
        if components.covariance is not None:
            spectra = components.completed(np.where(there, values[broken], np.float32(np.nan)))
            scores[broken] = components.white(spectra) @ components.axes.T.astype(np.float32)
            residual[broken] = 0
        else:
            white = np.where(there, components.white(values[broken]), np.float32(0))
            scores[broken], residual[broken] = _least_squares(white, there, components)
        seen = there.sum(axis=1)
        quality[broken] = np.where(2 * seen < bands, UNUSABLE, np.where(seen < bands, PARTIAL, quality[broken]))
    unusable = quality == UNUSABLE
    if count and unusable.any():
        scores[unusable] = 0
    residual[unusable] = np.nan
    return ScoredLines(scores, quality, residual.astype(np.float32))


def _projected(values: NDArray[np.float32], components: Components) -> tuple[Scores, Scores]:
    """Return scores (..., component) of spectra (..., band), and the squares of their residuals; NaN if broken."""
    axes = components.axes.T.astype(np.float32)
    flat = values.reshape(-1, components.bands)
    scores, left = np.empty((len(flat), len(components)), np.float32), np.empty(len(flat), np.float32)
    with np.errstate(invalid="ignore", over="ignore"):
        for part in cuts(len(flat), SPECTRA_AT_ONCE):
            white = components.white(flat[part])
            scores[part] = white @ axes
            square = np.einsum("nb,nb->n", white, white)
            left[part] = square - np.einsum("nk,nk->n", scores[part], scores[part])
            close = left[part] < CANCELLED * square
            if close.any():
                rest = white[close] - scores[part][close] @ axes.T
                left[part][close] = np.einsum("nb,nb->n", rest, rest)
    return scores.reshape(*values.shape[:-1], len(components)), left.reshape(values.shape[:-1])


def _least_squares(white: Scores, there: Bools, components: Components) -> tuple[Scores, Scores]:
    """Return scores (n, component) and residuals (n,) of whitened spectra (n, band), by their valid bands.

    With the components' spread they are the most probable scores of normal laws; without it any is as likely.
    Missing bands count as noise in the residual, so that it has the spread of a whole spectrum's.
    """
    axes = components.axes.T.astype(np.float32)
    count = len(components)
    bands = int(np.isfinite(components.mean).sum())
    prior = np.diag(np.full(count, 1e-6) if components.spread is None else 1 / np.maximum(components.spread, 1.0))
    products = (axes[:, :, None] * axes[:, None, :]).reshape(len(axes), -1)
    scores, residual = np.empty((len(white), count), np.float32), np.empty(len(white), np.float32)
    for part in cuts(len(white), 4096):
        gram = (there[part].astype(np.float32) @ products).reshape(-1, count, count).astype(np.float64)
        gram += prior
        scores[part] = np.linalg.solve(gram, (white[part] @ axes).astype(np.float64)[..., None])[..., 0]
        rest = np.where(there[part], white[part] - scores[part] @ axes.T, 0)
        left = np.einsum("nb,nb->n", rest, rest) + np.minimum(bands - there[part].sum(axis=1), bands - count)
        residual[part] = left / max(bands - count, 1)
    return scores, residual


@dataclass(frozen=True, eq=False)
class ResidualLaw:
    """The expected mean square residual of a spectrum: affine in its scores, since shot noise grows with the signal."""

    constant: float
    slope: NDArray[np.float64]  # (component,)
    freedom: float  # degrees of freedom that the residuals of single spectra spread by

    @classmethod
    def learned(cls, spectra: NDArray[np.float32], components: Components) -> ResidualLaw:
        """Fit the law to (n, band) spectra, without outliers."""
        freedom = max(int(np.isfinite(components.mean).sum()) - len(components), 1)
        seen = score_lines(spectra[None], np.ones((1, len(spectra)), np.bool_), components)
        known = np.isfinite(seen.residual[0])
        scores, residual = seen.scores[0][known].astype(np.float64), seen.residual[0][known].astype(np.float64)
        if len(residual) < 8 * (len(components) + 1) or np.median(residual) < LEAST_RESIDUAL:
            return cls(1.0, np.zeros(len(components)), float(freedom))
        design = np.concatenate([np.ones((len(scores), 1)), scores], axis=1)
        kept = residual <= np.median(residual) * 4
        for _ in range(LAW_ROUNDS):
            law = np.linalg.lstsq(design[kept], residual[kept], rcond=None)[0]
            floor = LEAST_EXPECTED * float(residual[kept].mean())
            ratio = residual / np.maximum(design @ law, max(floor, LEAST_RESIDUAL))
            spread = SIGMA_OF_MEDIAN * float(np.median(np.abs(ratio - np.median(ratio))))
            near = np.abs(ratio - 1) <= LAW_CLIP * spread
            kept = near if 2 * np.count_nonzero(near) >= len(near) else kept
        return cls(float(law[0]), law[1:], float(np.clip(2 / max(spread, 1e-6) ** 2, 1.0, freedom)))

    def expected(self, scores: Scores) -> Scores:
        """Return the (...) expected mean square residual of (..., component) scores."""
        least = max(LEAST_EXPECTED * self.constant, LEAST_RESIDUAL)
        return np.asarray(np.maximum(self.constant + scores @ self.slope.astype(np.float32), np.float32(least)))


def find_rare(ratio: NDArray[np.float32], law: ResidualLaw, false_alarm: float) -> Bools:
    """Find the (line, sample) spectra with more residual than noise gives, alone or with their neighbours.

    ``ratio`` is the residual over the expected one, NaN where unusable. ``false_alarm`` is the number of spectra of the
    whole image that noise alone may mark, over all tests together.
    """
    known = np.isfinite(ratio)
    part = false_alarm / (1 + len(JOINT)) / max(int(known.sum()), 1)
    rare = known & (ratio > _limit(law.freedom, part))
    filled = np.where(known, np.minimum(ratio, _limit(law.freedom, ALONE)), 1).astype(np.float64)
    for lines, samples in JOINT:
        if lines > ratio.shape[0] or samples > ratio.shape[1]:
            continue
        size = lines * samples
        high = np.zeros(ratio.shape, np.float32)
        within = tuple(slice(side // 2, (side // 2 - side + 1) or None) for side in (lines, samples))
        high[within] = scipy.ndimage.uniform_filter(filled, (lines, samples))[within] > _limit(
            law.freedom * size, part / size
        )
        if high.any():  # all spectra of the window that the mark came from
            back = tuple(-1 if side % 2 == 0 else 0 for side in (lines, samples))
            rare |= known & (
                scipy.ndimage.uniform_filter(high, (lines, samples), mode="constant", origin=back) > 0.5 / size
            )
    return rare


def _limit(freedom: float, false_alarm: float) -> float:
    """Return the mean square of noise, over its expectation, that is exceeded with a probability."""
    return float(scipy.special.chdtri(freedom, min(false_alarm, 0.5)) / freedom)


def residual_steps(
    values: NDArray[np.float32], scores: Scores, components: Components, valid: Bools | None = None
) -> NDArray[np.int32]:
    """Return the residuals of spectra (n, band) from scores (n, component), in half deviations; 0 in missing bands."""
    left = components.white(values) - scores @ components.axes.astype(np.float32)
    there = np.isfinite(left) if valid is None else np.isfinite(left) & valid
    return np.rint(np.where(there, left, 0) / RESIDUAL_STEP).astype(np.int32)


class LineStatistics:
    """Add a sweep's lines to the statistics of a field as they arrive, a block at a time."""

    def __init__(self, found: SignalStatistics, sweep: Sweep, references: References, camera: LineCamera) -> None:
        self._found = found
        self._elements = judge_elements(references)
        self._saturated = float(camera.full_scale_dn * sweep.binning)

    def add(self, lines: Sequence[Line], raw: NDArray[np.uint16]) -> None:
        """Add the next lines, at most 64, whose raw numbers are ``raw`` (line, sample, band)."""
        at = np.array([(line.mirror_x, line.mirror_y) if line.valid else (np.nan, np.nan) for line in lines])
        exposed = np.array([line.exposure_ms for line in lines])
        values, valid = calibrate(raw, self._elements, saturated_dn=self._saturated, position=at, exposure_ms=exposed)
        self._found.add(values, valid & np.array([line.valid for line in lines]).reshape(-1, *[1] * (valid.ndim - 1)))


@dataclass(frozen=True, eq=False)
class CondensedSweep:
    """Facts of a sweep after its scores are stored."""

    rare: NDArray[np.intp]  # (rare, 2) line and sample, by line
    residuals: NDArray[np.int32]  # (rare, band) in half deviations of the noise
    known: int  # spectra with enough valid bands
    saturated: int  # spectra of valid lines that miss bands which their sample's elements have


@dataclass(frozen=True, eq=False)
class Condenser:
    """Condense sweeps of a field by its components."""

    components: Components
    law: ResidualLaw
    camera: LineCamera
    false_alarm: float  # spectra of a sweep that noise alone may make rare
    step: float = 1.0  # of rounded scores [noise's deviations]

    def sweep(self, lines: SweepLines, store: Store, report: Report = lambda done: None) -> CondensedSweep:
        """Pass the scores of all lines to ``store``, and find the rare spectra."""
        count, samples = len(lines.valid_line), len(lines.references.dark)
        ratio = np.empty((count, samples), np.float32)
        missing = np.zeros((count, samples), np.int32)
        for first, values, valid in calibrated_blocks(lines, self.camera):
            block = slice(first, first + len(values))
            seen = score_lines(values, valid, self.components)
            store(first, seen.scores, seen.quality)
            ratio[block] = seen.residual / self.law.expected(seen.scores)
            if not valid.all():
                missing[block] = (~valid).sum(axis=2) if valid.ndim == 3 else values.shape[2] * ~valid
            report((first + len(values)) / count)
        elements = judge_elements(lines.references)
        without = (elements.out | ~elements.lit).all(axis=1)  # samples with no band that is valid in any line
        never = np.where(without, elements.out.shape[1], elements.out.sum(axis=1))
        saturated = int((missing > never)[lines.valid_line].sum())
        rare = find_rare(ratio, self.law, self.false_alarm)
        residuals = [np.zeros((0, self.components.bands), np.int32)]  # of rare spectra, from their rounded scores
        blocks = set((np.flatnonzero(rare.any(axis=1)) // BLOCK_LINES).tolist())  # their lines are read again
        for first, values, valid in calibrated_blocks(lines, self.camera, blocks):
            here = rare[first : first + len(values)]
            scores = score_lines(values, valid, self.components).scores
            rounded = whole_steps(scores, self.step)[here] * np.float32(self.step)
            there = None if valid.ndim == 2 else valid[here]
            residuals.append(residual_steps(values[here], rounded, self.components, there))
        return CondensedSweep(np.argwhere(rare), np.concatenate(residuals), int(np.isfinite(ratio).sum()), saturated)


def calibrated_blocks(
    lines: SweepLines, camera: LineCamera, chosen: Collection[int] | None = None
) -> Iterator[tuple[int, NDArray[np.float32], NDArray[np.bool_]]]:
    """Yield the first line, scene values and validity of 64 lines at a time; of ``chosen`` blocks only.

    A line that is not valid because its position is unknown keeps its values. A lost line holds zeros, which are out.
    """
    elements = judge_elements(lines.references)
    saturated = float(camera.full_scale_dn * lines.sweep.binning)
    for part in cuts(len(lines.valid_line), BLOCK_LINES):
        if chosen is not None and part.start // BLOCK_LINES not in chosen:
            continue
        raw = lines.read(part.start, part.stop)
        values, valid = calibrate(
            raw, elements, saturated_dn=saturated, position=lines.position[part], exposure_ms=lines.exposure_ms[part]
        )
        lost = ~lines.valid_line[part]
        if lost.any():
            valid[lost] &= raw[lost].any(axis=2).reshape(-1, raw.shape[1], *[1] * (valid.ndim - 2))
        yield part.start, values, valid


def differing_lines(
    lines: SweepLines, stored: CondensedLines, camera: LineCamera, components: Components | None = None
) -> list[int]:
    """Return the lines with a stored score that differs by more than rounding from that of the raw line.

    The rest of a spectrum is noise by the tests of condensing, or was stored. ``components`` are those that the lines
    were condensed by, if they hold more than what is stored.
    """
    wrong: list[int] = []
    for first, values, valid in calibrated_blocks(lines, camera):
        last = first + len(values)
        seen = score_lines(values, valid, components or stored.components)
        off = np.abs(stored.read(first, last) * np.float32(stored.step) - seen.scores)
        usable = seen.quality != UNUSABLE
        most = 0.5 if stored.step <= 1 else 1  # see `whole_steps`
        same = (off <= (most + SLACK) * stored.step + DIGITS * np.abs(seen.scores)).all(axis=2) | ~usable
        wrong += (first + np.flatnonzero(~(same & (usable == stored.usable[first:last])).all(axis=1))).tolist()
    return wrong
