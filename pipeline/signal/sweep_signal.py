"""Condensing the lines of a sweep, block by block: statistics as they arrive, scores once all are there."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import Sweep
from pipeline.signal.calibrate import calibrate, judge_elements
from pipeline.signal.components import Components
from pipeline.signal.condense import UNUSABLE, ResidualLaw, find_rare, residual_steps, score_lines, whole_steps
from pipeline.signal.lines import BLOCK_LINES, CondensedLines
from pipeline.signal.subspace import SignalStatistics
from pipeline.source import Line, References, SweepLines

Store = Callable[[int, NDArray[np.float32], NDArray[np.uint8]], None]
Report = Callable[[float], None]
Bools = NDArray[np.bool_]
SLACK, DIGITS = 1e-3, 1e-5  # of a step, and of a score, by which sums of float32 may differ


class LineStatistics:
    """Adds a sweep's lines to the statistics of a field as they come, 64 at a time."""

    def __init__(self, found: SignalStatistics, sweep: Sweep, references: References, camera: LineCamera) -> None:
        self._found, self._elements = found, judge_elements(references)
        self._saturated = float(camera.full_scale_dn * sweep.binning)
        self._waiting: list[Line] = []

    def add(self, line: Line) -> None:
        """Take the next line."""
        self._waiting.append(line)
        if len(self._waiting) == BLOCK_LINES:
            self.flush()

    def flush(self) -> None:
        """Add what waits."""
        if not self._waiting:
            return
        raw = np.stack([line.data for line in self._waiting])
        at = np.array([(line.mirror_x, line.mirror_y) if line.valid else (np.nan, np.nan) for line in self._waiting])
        values, valid = calibrate(raw, self._elements, saturated_dn=self._saturated, position=at)
        there = np.array([line.valid for line in self._waiting])
        self._found.add(values, valid & there.reshape(-1, *[1] * (valid.ndim - 1)))
        self._waiting.clear()


@dataclass(frozen=True, eq=False)
class CondensedSweep:
    """Facts of a sweep once its scores are stored."""

    rare: NDArray[np.intp]  # (rare, 2) line and sample, by line
    residuals: NDArray[np.int32]  # (rare, band) in half deviations of the noise
    known: int  # spectra of which enough bands were seen


@dataclass(frozen=True, eq=False)
class Condenser:
    """Condenses sweeps of a field by its components."""

    components: Components
    law: ResidualLaw
    camera: LineCamera
    false_alarm: float  # spectra of a sweep that noise alone may make rare
    step: float = 1.0  # in which scores are rounded [noise's deviations]

    def sweep(self, lines: SweepLines, store: Store, report: Report = lambda done: None) -> CondensedSweep:
        """Give the scores of all lines to ``store``, and find the rare spectra."""
        count, samples = len(lines.valid_line), len(lines.references.dark)
        ratio = np.empty((count, samples), np.float32)
        for first, values, valid in calibrated_blocks(lines, self.camera):
            seen = score_lines(values, valid, self.components)
            store(first, seen.scores, seen.quality)
            ratio[first : first + len(values)] = seen.residual / self.law.expected(seen.scores)
            report((first + len(values)) / count)
        rare = find_rare(ratio, self.law, self.false_alarm)
        return CondensedSweep(np.argwhere(rare), self._residuals(lines, rare), int(np.isfinite(ratio).sum()))

    def _residuals(self, lines: SweepLines, rare: NDArray[np.bool_]) -> NDArray[np.int32]:
        """Return the (rare, band) residuals of rare spectra from their rounded scores; their lines are read again."""
        found = [np.zeros((0, self.components.bands), np.int32)]
        blocks = set((np.flatnonzero(rare.any(axis=1)) // BLOCK_LINES).tolist())
        for first, values, valid in calibrated_blocks(lines, self.camera, blocks):
            here = rare[first : first + len(values)]
            scores = score_lines(values, valid, self.components).scores
            rounded = whole_steps(scores, self.step)[here] * np.float32(self.step)
            there = None if valid.ndim == 2 else valid[here]
            found.append(residual_steps(values[here], rounded, self.components, there))
        return np.concatenate(found)


def calibrated_blocks(
    lines: SweepLines, camera: LineCamera, chosen: Collection[int] | None = None
) -> Iterator[tuple[int, NDArray[np.float32], NDArray[np.bool_]]]:
    """Yield the first line, scene values and validity of 64 lines at a time; of ``chosen`` blocks alone.

    A line that is not valid, whose position is unknown, keeps its light. Where it was lost it holds zeros, which
    are out.
    """
    elements, saturated = judge_elements(lines.references), float(camera.full_scale_dn * lines.sweep.binning)
    for first in range(0, len(lines.valid_line), BLOCK_LINES):
        if chosen is not None and first // BLOCK_LINES not in chosen:
            continue
        part = slice(first, min(first + BLOCK_LINES, len(lines.valid_line)))
        raw = lines.read(part.start, part.stop)
        values, valid = calibrate(raw, elements, saturated_dn=saturated, position=lines.position[part])
        lost = ~lines.valid_line[part]
        if lost.any():
            valid[lost] &= raw[lost].any(axis=2).reshape(-1, raw.shape[1], *[1] * (valid.ndim - 2))
        yield first, values, valid


def differing_lines(
    lines: SweepLines, stored: CondensedLines, camera: LineCamera, components: Components | None = None
) -> list[int]:
    """Return the lines of which a stored score, read from the disk, is more than rounding off what the raw line gives.

    What scores leave of a spectrum is noise by the tests of condensing, or was kept. ``components`` are those that the
    lines were condensed by, where they know more than what is stored.
    """
    wrong = list[int]()
    for first, values, valid in calibrated_blocks(lines, camera):
        last = first + len(values)
        seen = score_lines(values, valid, components or stored.components)
        off = np.abs(stored.read(first, last) * np.float32(stored.step) - seen.scores)
        usable = seen.quality != UNUSABLE
        most = 0.5 if stored.step <= 1 else 1  # see `whole_steps`
        same = (off <= (most + SLACK) * stored.step + DIGITS * np.abs(seen.scores)).all(axis=2) | ~usable
        wrong += (first + np.flatnonzero(~(same & (usable == stored.usable[first:last])).all(axis=1))).tolist()
    return wrong
