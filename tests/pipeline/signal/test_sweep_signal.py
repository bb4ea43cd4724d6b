"""A sweep, block by block: statistics of arriving lines, stored scores, and stored lines that differ."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from spectralzoom.pipeline.signal.calibrate import calibrate
from spectralzoom.pipeline.signal.components import Components
from spectralzoom.pipeline.signal.condense import (
    RESIDUAL_STEP,
    UNUSABLE,
    CondensedSweep,
    Condenser,
    LineStatistics,
    ResidualLaw,
    differing_lines,
)
from spectralzoom.pipeline.signal.lines import BLOCK_LINES
from spectralzoom.pipeline.signal.rounding import whole_steps
from spectralzoom.pipeline.signal.subspace import SignalStatistics, find_components
from spectralzoom.pipeline.source import Line
from tests.pipeline.signal.made_spectra import CAMERA, MadeLines, field_of, raw_of

SHAPE = (150, 40)
BANDS = 24


@dataclass
class Stored:
    """Scores as a store would keep them."""

    components: Components
    step: float
    scores: NDArray[np.int32]
    quality: NDArray[np.uint8]

    @property
    def usable(self) -> NDArray[np.bool_]:
        """Return a mask of the usable spectra."""
        return self.quality != UNUSABLE

    def write(self, first: int, scores: NDArray[np.float32], quality: NDArray[np.uint8]) -> None:
        """Store some lines."""
        part = slice(first, first + len(scores))
        self.scores[part], self.quality[part] = whole_steps(scores, self.step), quality

    def read(self, start: int, stop: int) -> NDArray[np.int32]:
        """Return scores of some lines in steps."""
        return self.scores[start:stop]

    def restored(self, done: CondensedSweep) -> NDArray[np.float32]:
        """Return scene values of all lines."""
        values = self.components.restore(self.scores.astype(np.float32) * np.float32(self.step))
        line, sample = done.rare.T
        values[line, sample] += done.residuals * RESIDUAL_STEP * np.nan_to_num(self.components.noise)
        return values


def statistics_of_lines(lines: MadeLines) -> SignalStatistics:
    """Return the statistics of lines as they arrive."""
    found = SignalStatistics(lines.raw.shape[2], lines.raw.shape[0] * lines.raw.shape[1])
    taker = LineStatistics(found, lines.sweep, lines.references, CAMERA)
    facts = zip(lines.raw, lines.position, lines.valid_line, strict=True)
    taken = [Line(n, data, *at, 0.1 * n, 100.0, bool(valid)) for n, (data, at, valid) in enumerate(facts)]
    for first in range(0, len(taken), BLOCK_LINES):
        block = slice(first, first + BLOCK_LINES)
        taker.add(taken[block], lines.raw[block])
    return found


def condense(lines: MadeLines, step: float = 1.0) -> tuple[Stored, CondensedSweep]:
    """Store all lines of a sweep."""
    found = statistics_of_lines(lines)
    components = find_components(found)
    condenser = Condenser(components, ResidualLaw.learned(found.spectra, components), CAMERA, 0.01, step)
    shape = lines.raw.shape[:2]
    stored = Stored(components, step, np.zeros((*shape, len(components)), np.int32), np.zeros(shape, np.uint8))
    return stored, condenser.sweep(lines, stored.write)


def made_lines(**how: float) -> MadeLines:
    """Return lines of 3 materials; the third block is not full."""
    return MadeLines.of(raw_of(field_of(3, SHAPE, BANDS, **how).values))


def values_of(lines: MadeLines) -> NDArray[np.float32]:
    """Return scene values of raw lines."""
    return calibrate(lines.raw, lines.references, saturated_dn=1e9, position=lines.position)[0]


def test_statistics_of_arriving_lines_equal_those_of_their_values() -> None:
    """Blocks of 64 lines and the remainder, calibrated, count the same as all values at once."""
    lines = made_lines()
    values = values_of(lines)
    found = statistics_of_lines(lines)
    whole = SignalStatistics(BANDS, values[..., 0].size)
    whole.add(values, np.ones(SHAPE, np.bool_))
    assert (found.count, found.means) == (whole.count, 10 * (16 + 16 + 5))
    np.testing.assert_allclose(find_components(found).noise, find_components(whole).noise, rtol=0.01)


def test_invalid_lines_are_left_out_of_the_statistics() -> None:
    """Any values in such lines are ignored."""
    lines = made_lines()
    lines.valid_line[[5, 140]] = False
    lines.raw[5] = 3000
    assert statistics_of_lines(lines).count == 148 * 40


@pytest.mark.parametrize("hot", [False, True])
def test_invalid_lines_are_unusable_only_without_light(hot: bool) -> None:
    """An invalid line of zeros is unusable; one with light is restored, for both forms of validity."""
    lines = made_lines()
    lines.valid_line[[5, 140]] = False
    lines.raw[5] = 0
    if hot:
        lines.raw[9, 3, 2] = CAMERA.full_scale_dn
    stored, done = condense(lines)
    assert np.argwhere(stored.quality == UNUSABLE).tolist() == [[5, sample] for sample in range(40)]
    off = (stored.restored(done) - values_of(lines))[140] / stored.components.noise
    assert np.sqrt(np.mean(off**2)) == pytest.approx(1, abs=0.1)
    assert differing_lines(lines, stored, CAMERA) == []


@pytest.mark.parametrize("step", [0.5, 1.0, 3.0])
def test_scores_are_stored_in_steps(step: float) -> None:
    """Restored values differ from raw ones by the noise and the rounding to a step, and none is rare."""
    lines = made_lines()
    stored, done = condense(lines, step)
    off = (stored.restored(done) - values_of(lines)) / stored.components.noise
    count = len(stored.components)
    assert np.mean(off**2) == pytest.approx((BANDS - count * (1 - step**2 / 12)) / BANDS, rel=0.05)
    assert (len(done.rare), done.known) == (0, 150 * 40)
    assert differing_lines(lines, stored, CAMERA) == []


def test_changed_and_lost_lines_are_found() -> None:
    """Exactly three lines differ: with other raw values, with a score a step off, and with a lost spectrum."""
    lines = made_lines()
    stored, _ = condense(lines)
    stored.quality[149, 0] = UNUSABLE
    stored.scores[77, 13, 1] += 1
    lines.raw[66] = lines.raw[0]
    assert differing_lines(lines, stored, CAMERA) == [66, 77, 149]


def test_saturated_spectra_are_restored_or_unusable() -> None:
    """With some bands at full scale quality is 1, with all of them 2. Neither changes components or noise."""
    lines = made_lines()
    before = find_components(statistics_of_lines(lines))
    values = values_of(lines)
    lines.raw[20, 10:14, ::3] = CAMERA.full_scale_dn
    lines.raw[80, 5] = CAMERA.full_scale_dn
    stored, done = condense(lines)
    assert np.argwhere(stored.quality == 1).tolist() == [[20, sample] for sample in range(10, 14)]
    assert np.argwhere(stored.quality == UNUSABLE).tolist() == [[80, 5]]
    assert len(stored.components) == len(before)
    np.testing.assert_allclose(stored.components.noise, before.noise, rtol=0.02)
    assert np.abs((stored.restored(done) - values)[20, 10:14] / before.noise).max() < 5
    assert len(done.rare) == 0
    assert done.saturated == 5


def test_saturated_spectra_are_counted_in_all_lines() -> None:
    """One band saturates everywhere; an invalid line and the spectra of a dead column do not count."""
    bad = np.zeros((40, BANDS), np.bool_)
    bad[8] = True
    lines = replace(made_lines(), references=MadeLines.of(made_lines().raw, bad).references)
    lines.raw[..., 3] = CAMERA.full_scale_dn
    lines.valid_line[70] = False
    _, done = condense(lines)
    assert done.saturated == 149 * 39


def test_dead_columns_are_unusable_and_dead_elements_are_filled() -> None:
    """The single bad element is filled from its neighbours, and no stored line differs."""
    bad = np.zeros((40, BANDS), np.bool_)
    bad[8], bad[25, 4] = True, True
    lines = replace(made_lines(), references=MadeLines.of(made_lines().raw, bad).references)
    lines.raw[:, 8], lines.raw[:, 25, 4] = 0, 4095
    stored, done = condense(lines)
    unusable = stored.quality == UNUSABLE
    assert np.flatnonzero(unusable.all(axis=0)).tolist() == [8]
    assert unusable.sum() == 150
    assert (done.known, done.saturated) == (150 * 39, 0)
    assert differing_lines(lines, stored, CAMERA) == []


def test_a_dark_frame_that_drifts_per_element_makes_many_spectra_rare() -> None:
    """Such drift is neither of low rank nor noise: over 5 % are rare, too many for exceptions, so raw lines stay."""
    made = field_of(3, SHAPE, BANDS)
    own = np.random.default_rng(2).normal(size=(40, BANDS)) * made.noise
    drift = 6 * np.linspace(0, 1, 150)[:, None, None] * own
    lines = MadeLines.of(raw_of((made.values + drift).astype(np.float32)))
    stored, done = condense(lines)
    assert len(done.rare) > 0.05 * done.known
    off = ((stored.restored(done) - values_of(lines)) / stored.components.noise)[tuple(done.rare.T)]
    assert np.abs(off).max() <= RESIDUAL_STEP / 2 + 1e-3


def test_progress_ends_at_one() -> None:
    """Every block reports the completed fraction."""
    lines = made_lines()
    told = []
    found = statistics_of_lines(lines)
    components = find_components(found)
    condenser = Condenser(components, ResidualLaw.learned(found.spectra, components), CAMERA, 1.0)
    condenser.sweep(lines, lambda first, scores, quality: scores, told.append)
    assert told == [64 / 150, 128 / 150, 1.0]
