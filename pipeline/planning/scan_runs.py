"""Find covers: sets of runs of lines with the most expected gain less price, at a given price of a second.

Swaths overlap and lie at any offset, so several show the same patch, which counts once. A cover consists of chains of
runs, one run after the other along the scan. A dynamic programme chooses one chain exactly, over all offsets, while
the others are fixed. This is repeated until no chain improves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pipeline.planning.prices import ScanPrices
from pipeline.planning.swaths import Views

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
MOST_ROUNDS, WIDE_ROUNDS = 6, 2
LEAST_BLOCK = 4
TABLE_CELLS = 1_000_000
NEGLIGIBLE = 1e-12  # of the total worth


@dataclass(frozen=True, order=True)
class ScanRun:
    """Lines ``first`` to ``stop`` (half open) of one swath."""

    swath: int
    first: int
    stop: int


@dataclass(frozen=True)
class Tables:
    """Gain of views by line, cumulated: (swath, border) each, borders ``unit`` lines apart from line 0.

    ``closed`` counts views that end at or before a border, ``begun`` those that begin before it. So closed(e) -
    begun(c) is the gain of the run c..e, or less if a view is longer than the run.
    """

    closed: Floats
    begun: Floats
    unit: int
    block: int  # borders closer than this hold no view between them


def best_chains(tables: Tables, windows: Ints, line_price: float, run_price: float) -> list[list[ScanRun]]:
    """Return, for each window of swaths, the chain of runs with the most gain less price, one run after the other.

    best(e) = max(best(e - 1), max over swaths and c of best(c) + closed(e) - begun(c) - (e - c) line - run). It is
    computed for a block of borders at a time: no run opens and closes within one.

    ``windows`` are (window, swath) numbers of swaths; prices of a line and a run are in units of gain. Only lines that
    are turned far apart let two runs of a chain show one patch, which then counts twice: the caller has to check.
    """
    borders = tables.closed.shape[1]
    ramp = line_price * tables.unit * np.arange(borders)
    gain, toll = (tables.closed - ramp)[windows], (tables.begun - ramp + run_price)[windows]  # (window, strip, border)
    best, pick = np.zeros((len(windows), borders)), np.full((len(windows), borders), -1)
    since = np.zeros((len(windows), borders), np.intp)
    opened, start = -toll[:, :, 0], np.zeros(windows.shape, np.intp)
    for low in range(1, borders, tables.block):
        block = slice(low, min(low + tables.block, borders))
        value = opened[:, :, None] + gain[:, :, block]
        lane = value.argmax(axis=1)
        value = np.take_along_axis(value, lane[:, None], axis=1)[:, 0]
        level = np.maximum.accumulate(np.concatenate([best[:, low - 1 : low], value], axis=1), axis=1)
        best[:, block] = level[:, 1:]
        pick[:, block] = np.where(level[:, 1:] > level[:, :-1], lane, -1)
        since[:, block] = np.take_along_axis(start, lane, axis=1)
        fresh = best[:, None, block] - toll[:, :, block]
        at = fresh.argmax(axis=2)
        fresh = np.take_along_axis(fresh, at[:, :, None], axis=2)[:, :, 0]
        later = fresh > opened
        opened, start = np.where(later, fresh, opened), np.where(later, at + low, start)
    return [_traced(*each, tables.unit) for each in zip(windows, pick, since, strict=True)]


def _traced(swaths: Ints, pick: Ints, since: Ints, unit: int) -> list[ScanRun]:
    """Return the runs of a chain, traced back from the last one."""
    closes = np.maximum.accumulate(np.where(pick >= 0, np.arange(len(pick)), 0))
    runs, at = [], int(closes[-1])
    while at > 0:
        first = int(since[at])
        runs.append(ScanRun(int(swaths[pick[at]]), first * unit, at * unit))
        at = int(closes[first])
    return runs[::-1]


def joined(runs: Sequence[ScanRun], gap: int) -> list[ScanRun]:
    """Join runs of one swath that meet or lie at most ``gap`` lines apart, sorted."""
    found: list[ScanRun] = []
    for run in sorted(runs):
        if found and found[-1].swath == run.swath and run.first <= found[-1].stop + gap:
            last = found.pop()
            run = ScanRun(last.swath, last.first, max(last.stop, run.stop))
        found.append(run)
    return found


@dataclass(frozen=True)
class Cover:
    """Runs, the expected gain of the patches that they show, and their additive time."""

    runs: tuple[ScanRun, ...] = ()
    expected_gain: float = 0.0
    even_s: float = 0.0

    @property
    def lines(self) -> int:
        """Return the lines of all runs."""
        return sum(run.stop - run.first for run in self.runs)

    def seconds(self, prices: ScanPrices) -> float:
        """Return the exact time, with whole reloads [s]."""
        return prices.seconds(self.lines, len(self.runs))


@dataclass(frozen=True)
class Field:
    """A field as swaths show it: views of patches, their expected gain, and the prices of lines."""

    views: Views
    expected_gain: Floats  # (patch,), 0 for patches that are not wanted
    column: Ints  # (patch,) place along the line: swaths without a common column are planned separately
    prices: ScanPrices

    @cached_property
    def total(self) -> float:
        """Return the gain of all patches that some swath shows."""
        return float(self.expected_gain[np.unique(self.views.patch_number)].sum())

    @property
    def gap(self) -> int:
        """Return the lines between two runs of a swath that take as long as a second set-up."""
        return int(self.prices.run_s / self.prices.even_line_s)

    @cached_property
    def unit(self) -> int:
        """Return the lines between two borders of the tables: more than 1 only for very large fields."""
        return max(-(-(self.views.lines + 1) * len(self.views.swaths) // TABLE_CELLS), 1)

    @cached_property
    def _cells(self) -> tuple[int, Ints, Ints]:
        """Return the number of borders, and the flat table cells of the views' stops and first lines."""
        borders = -(-self.views.lines // self.unit) + 1
        row = self.views.swath * borders
        begun = np.minimum(self.views.first // self.unit + 1, borders - 1)
        return borders, row - (-self.views.stop // self.unit), row + begun

    def tables(self, left: Floats) -> Tables:
        """Cumulate the remaining gain (patch,) over the lines of every swath."""
        borders, *places = self._cells
        weight, shape = left[self.views.patch_number], (len(self.views.swaths), borders)
        closed, begun = (np.bincount(at, weight, shape[0] * borders).reshape(shape) for at in places)
        length = int((self.views.stop - self.views.first).min(initial=self.views.lines))
        block = max(length // self.unit, LEAST_BLOCK)
        return Tables(np.cumsum(closed, axis=1), np.cumsum(begun, axis=1), self.unit, block)

    def shown(self, run: ScanRun) -> Ints:
        """Return the numbers of the views within a run, (view,)."""
        low, high = self.views.edges[run.swath : run.swath + 2]
        inside = (self.views.first[low:high] >= run.first) & (self.views.stop[low:high] <= run.stop)
        return np.asarray(low + np.flatnonzero(inside))

    def shown_patches(self, run: ScanRun) -> Ints:
        """Return the patches within a run, (patch,)."""
        return self.views.patch_number[self.shown(run)]

    def left(self, runs: Sequence[ScanRun]) -> Floats:
        """Return the gain of each patch that no run shows, 0 for the others, (patch,)."""
        left = self.expected_gain.copy()
        for run in runs:
            left[self.shown_patches(run)] = 0.0
        return left

    def cover(self, runs: Sequence[ScanRun]) -> Cover:
        """Return runs with their gain and additive time."""
        lines = sum(run.stop - run.first for run in runs)
        return Cover(tuple(runs), self._seen(runs, self.expected_gain), self.prices.even_seconds(lines, len(runs)))

    def net(self, runs: Sequence[ScanRun], left: Floats, rate: float) -> float:
        """Return gain less price of runs, for the remaining gain and a price of a second ``rate``."""
        lines = sum(run.stop - run.first for run in runs)
        return self._seen(runs, left) - rate * self.prices.even_seconds(lines, len(runs))

    def _seen(self, runs: Sequence[ScanRun], expected_gain: Floats) -> float:
        """Return the gain of all patches that runs show, each counted once."""
        patch_index = np.unique(np.concatenate([np.zeros(0, np.intp), *map(self.shown_patches, runs)]))
        return float(expected_gain[patch_index].sum())

    def trimmed(self, runs: Sequence[ScanRun], left: Floats) -> list[ScanRun]:
        """Shorten runs to the views that each adds to the remaining gain, in order; drop runs that add none."""
        left, kept = left.copy(), []
        for run in runs:
            views = self.shown(run)
            views = views[left[self.views.patch_number[views]] > 0]
            if len(views):
                first, stop = int(self.views.first[views].min()), int(self.views.stop[views].max())
                kept.append(replace(run, first=first, stop=stop))
                left[self.views.patch_number[views]] = 0.0
        return kept

    @cached_property
    def windows(self) -> tuple[Ints, ...]:
        """Return sets of windows, (window, swath) each, that hold every swath, without common columns in a set.

        A field of up to about three swaths' width has one window of all swaths.
        """
        low, high = self._spans
        count, width = len(low), int((high - low).max(initial=0)) + 1
        if count <= 2 * width + 2:
            return (np.arange(count)[None, :],)
        sets = []
        for start in range(0, 2 * width, width):
            rows, at = [], start
            while at < count:
                rows.append(np.minimum(np.arange(at, at + width), count - 1))
                at = max(int(np.searchsorted(low, high[rows[-1][-1]], side="right")), at + width)
            sets.append(np.stack(rows))
        return tuple(sets)

    @cached_property
    def side_by_side(self) -> Ints:
        """Return swaths without a common patch column, (window, 1) from the lower end up: the layout of a full scan."""
        low, high = self._spans
        found, last = [0], len(low) - 1
        while high[found[-1]] < high[-1]:
            found.append(min(max(int(np.searchsorted(low, high[found[-1]], side="right")), found[-1] + 1), last))
        return np.array(found)[:, None]

    @cached_property
    def _spans(self) -> tuple[Ints, Ints]:
        """Return the first and last column of the patches that each swath shows, made ascending."""
        column, count = self.column[self.views.patch_number], len(self.views.swaths)
        low, high = np.full(count, int(column.max(initial=0))), np.zeros(count, np.intp)
        np.minimum.at(low, self.views.swath, column)
        np.maximum.at(high, self.views.swath, column)
        return np.minimum.accumulate(low[::-1])[::-1], np.maximum.accumulate(high)


def best_cover(field: Field, start: Sequence[ScanRun], rate: float) -> Cover:
    """Return the runs with the most gain less price when a second costs ``rate`` of gain.

    The search starts from ``start``. Narrow fields, and a ``start`` without runs, also start from the swaths of a full
    scan. Each step improves the cover, and the search ends where no chain improves.
    """
    starts = [list(start)]
    if len(field.windows) == 1 or not start:
        side = best_chains(field.tables(field.expected_gain), field.side_by_side, *_priced(field, rate))
        starts.append(field.trimmed([run for chain in side for run in chain], field.expected_gain))
    found = [field.cover(_settle(field, runs, rate)) for runs in starts]
    return max(found, key=lambda cover: cover.expected_gain - rate * cover.even_s)


def _settle(field: Field, start: Sequence[ScanRun], rate: float) -> list[ScanRun]:
    """Choose chain after chain again until a round changes none."""
    runs = joined(start, field.gap)
    for _ in range(MOST_ROUNDS if len(field.windows) == 1 else WIDE_ROUNDS):
        before = runs
        for windows in field.windows:
            runs = _round(field, runs, windows, rate)
        if runs == before:
            break
    return runs


def _round(field: Field, runs: list[ScanRun], windows: Ints, rate: float) -> list[ScanRun]:
    """Choose each chain of each window again, and try one more chain."""
    members = [set(window.tolist()) for window in windows]
    layer, layers = 0, 1
    while layer < layers:
        chains = [_chains([run for run in runs if run.swath in swaths]) for swaths in members]
        layers = max(map(len, chains)) + 1
        chosen = [chain[layer] if layer < len(chain) else [] for chain in chains]
        runs = _again(field, runs, windows, chosen, rate)
        layer += 1
    return runs


def _chains(runs: Sequence[ScanRun]) -> list[list[ScanRun]]:
    """Divide runs among as few chains as possible."""
    chains: list[list[ScanRun]] = []
    for run in sorted(runs, key=lambda run: (run.first, run.swath)):
        home = next((chain for chain in chains if chain[-1].stop <= run.first), None)
        if home is None:
            chains.append(home := [])
        home.append(run)
    return chains


def _again(field: Field, runs: list[ScanRun], windows: Ints, chosen: list[list[ScanRun]], rate: float) -> list[ScanRun]:
    """Choose one chain of each window again, with the other runs fixed; keep the old one if it is as good."""
    old = {run for chain in chosen for run in chain}
    kept = [run for run in runs if run not in old]
    left = field.left(kept)
    found = best_chains(field.tables(left), windows, *_priced(field, rate))
    for new, chain in zip(found, chosen, strict=True):
        trimmed = field.trimmed(new, left)
        better = field.net(trimmed, left, rate) > field.net(chain, left, rate) + NEGLIGIBLE * field.total
        kept += trimmed if better else chain
    return joined(kept, field.gap)


def _priced(field: Field, rate: float) -> tuple[float, float]:
    """Return the price of a line and of a set-up in units of gain."""
    return rate * field.prices.even_line_s, rate * field.prices.run_s
