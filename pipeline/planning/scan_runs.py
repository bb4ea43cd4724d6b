"""Runs of lines, what they cost, and the best chains of them: a dynamic programme over all strip offsets at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]


@dataclass(frozen=True, order=True)
class ScanRun:
    """Lines ``first`` to ``stop`` (half open) of one strip."""

    strip: int
    first: int
    stop: int


@dataclass(frozen=True)
class ScanPrices:
    """Seconds of a line, of opening a run, and of a reload that is due once every ``lines_per_reload`` lines."""

    line_s: float
    run_s: float
    reload_s: float
    lines_per_reload: int

    @property
    def even_line_s(self) -> float:
        """A line with its share of a reload: with this the price is additive, and below the true one by < a reload."""
        return self.line_s + self.reload_s / self.lines_per_reload

    def seconds(self, lines: int, runs: int) -> float:
        """True price of so many lines in so many runs [s]."""
        return lines * self.line_s + runs * self.run_s + -(-lines // self.lines_per_reload) * self.reload_s

    def even_seconds(self, lines: int, runs: int) -> float:
        """Additive price [s]."""
        return lines * self.even_line_s + runs * self.run_s

    def most_lines(self, seconds: float, runs: int) -> int:
        """Most lines that so many runs may have for a true price of at most ``seconds``; below 0 where none may."""
        left = seconds - runs * self.run_s
        load = self.lines_per_reload * self.line_s + self.reload_s
        loads = int(left // load)
        rest = max(int((left - loads * load - self.reload_s) / self.line_s), 0)
        lines = loads * self.lines_per_reload + rest
        while lines >= 0 and self.seconds(lines, runs) > seconds:  # rounding
            lines -= 1
        return lines


@dataclass(frozen=True)
class Tables:
    """Worth of views by line, cumulated: (strip, border) each, borders ``unit`` lines apart from line 0.

    ``closed`` counts views that end at or before a border, ``begun`` those that begin before it, hence
    closed(e) - begun(c) is the worth of the run c..e where no view is longer than the run, and never more than it.
    """

    closed: Floats
    begun: Floats
    unit: int
    block: int  # borders closer than this hold no view between them


def best_chains(tables: Tables, windows: Ints, line_price: float, run_price: float) -> list[list[ScanRun]]:
    """Find, for each window of strips, the chain of runs with the most worth less price, one run after the other.

    best(e) = max(best(e - 1), max over strips and c of best(c) + closed(e) - begun(c) - (e - c) line - run), a block
    of borders at a time: no run opens and closes within one.

    Parameters
    ----------
    windows
        (window, strip) numbers of strips.
    line_price, run_price
        Of one line and of one run, in units of worth.

    Returns
    -------
    A chain for each window, ascending. A seat that two runs of a chain show, which only lines turned far apart allow,
    was counted twice: the caller has to check.
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


def _traced(strips: Ints, pick: Ints, since: Ints, unit: int) -> list[ScanRun]:
    """Runs of a chain, found from the last one back."""
    closes = np.maximum.accumulate(np.where(pick >= 0, np.arange(len(pick)), 0))
    runs, at = [], int(closes[-1])
    while at > 0:
        first = int(since[at])
        runs.append(ScanRun(int(strips[pick[at]]), first * unit, at * unit))
        at = int(closes[first])
    return runs[::-1]


def joined(runs: Sequence[ScanRun], gap: int) -> list[ScanRun]:
    """Join runs of one strip that meet or lie at most ``gap`` lines apart, sorted."""
    found: list[ScanRun] = []
    for run in sorted(runs):
        if found and found[-1].strip == run.strip and run.first <= found[-1].stop + gap:
            last = found.pop()
            run = ScanRun(last.strip, last.first, max(last.stop, run.stop))
        found.append(run)
    return found
