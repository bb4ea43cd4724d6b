"""Runs of lines: the dynamic programme against every choice there is, prices, and runs that meet."""

from __future__ import annotations

from itertools import combinations, pairwise, product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.planning.prices import ScanPrices
from pipeline.planning.scan_runs import ScanRun, Tables, best_chains, joined

LINES = 7
PRICES = ScanPrices(line_s=1.0, run_s=1.5, reload_s=2.0, lines_per_reload=5)
Seat = tuple[int, int, float]  # first line, length, worth


def tables(strips: list[list[Seat]], block: int = 1) -> Tables:
    """Cumulated worth of the seats of each strip, by its definition."""
    closed, begun = np.zeros((len(strips), LINES + 1)), np.zeros((len(strips), LINES + 1))
    for strip, seats in enumerate(strips):
        for first, length, worth in seats:
            closed[strip, min(first + length, LINES) :] += worth
            begun[strip, first + 1 :] += worth
    return Tables(closed, begun, 1, block)


def shown(strips: list[list[Seat]], runs: tuple[ScanRun, ...]) -> float:
    """Worth of the seats that lie in one of the runs of their strip."""
    return sum(
        worth
        for strip, seats in enumerate(strips)
        for first, length, worth in seats
        if any(r.strip == strip and r.first <= first and min(first + length, LINES) <= r.stop for r in runs)
    )


def every_chain(count: int) -> list[tuple[ScanRun, ...]]:
    """Every chain of up to two runs over some strips."""
    spans = list(combinations(range(LINES + 1), 2))
    single = [ScanRun(strip, a, b) for strip in range(count) for a, b in spans]
    pairs = [pair for pair in product(single, repeat=2) if all(x.stop <= y.first for x, y in pairwise(pair))]
    return [(), *((run,) for run in single), *pairs]


EVERY = every_chain(2)
seats_of_one_length = st.lists(st.tuples(st.integers(0, LINES - 2), st.just(2), st.floats(0.1, 9)), max_size=6)


@given(st.lists(seats_of_one_length, min_size=2, max_size=2), st.floats(0.3, 3), st.floats(0.5, 4), st.integers(1, 2))
def test_the_best_chain_beats_every_other(strips: list[list[Seat]], line: float, run: float, block: int):
    """No chain of runs over two strips has more worth less price than the programme's, in blocks or not."""

    def net(runs: tuple[ScanRun, ...]) -> float:
        return shown(strips, runs) - sum((r.stop - r.first) * line + run for r in runs)

    (found,) = best_chains(tables(strips, block), np.array([[0, 1]]), line, run)
    assert net(tuple(found)) >= max(net(runs) for runs in EVERY) - 1e-9
    assert all(one.stop <= other.first for one, other in pairwise(found))


def test_windows_are_chosen_apart():
    """Two windows give the chains that each gives by itself."""
    strips = [[(0, 2, 9.0)], [(3, 2, 9.0)], [(1, 2, 9.0)], [(5, 2, 0.1)]]
    both = best_chains(tables(strips), np.array([[0, 1], [2, 3]]), 1.0, 1.0)
    alone = [best_chains(tables(strips), np.array([pair]), 1.0, 1.0)[0] for pair in ([0, 1], [2, 3])]
    assert both == alone == [[ScanRun(0, 0, 2), ScanRun(1, 3, 5)], [ScanRun(2, 1, 3)]]


def test_near_runs_are_one_and_far_ones_are_not():
    """A gap shorter than a set-up is scanned through; a longer one is not."""
    near, far = [[(0, 2, 9.0), (3, 2, 9.0)]], [[(0, 2, 9.0), (5, 2, 9.0)]]
    assert best_chains(tables(near), np.array([[0]]), 1.0, 1.5) == [[ScanRun(0, 0, 5)]]
    assert best_chains(tables(far), np.array([[0]]), 1.0, 1.5) == [[ScanRun(0, 0, 2), ScanRun(0, 5, 7)]]


@given(st.floats(0, 60), st.integers(0, 6))
def test_most_lines_are_the_most_that_the_seconds_pay_for(seconds: float, runs: int):
    """One line more would cost more than the seconds; a budget below the set-ups pays for less than nothing."""
    lines = PRICES.most_lines(seconds, runs)
    if lines >= 0:
        assert PRICES.seconds(lines, runs) <= seconds
    assert PRICES.seconds(max(lines, -1) + 1, runs) > seconds


@pytest.mark.parametrize(("lines", "reloads"), [(0, 0), (5, 1), (6, 2), (10, 2)])
def test_true_and_additive_prices(lines: int, reloads: int):
    """The additive price has the same line and run, is never above the true one and below it by less than a reload."""
    true = PRICES.seconds(lines, 2)
    assert true == lines + 3.0 + 2.0 * reloads
    assert true - PRICES.reload_s < PRICES.even_seconds(lines, 2) <= true


def test_runs_that_meet_are_joined():
    """Runs of one strip that overlap, touch or lie within the gap become one; other strips and far runs stay."""
    runs = [ScanRun(1, 0, 4), ScanRun(0, 8, 9), ScanRun(0, 0, 4), ScanRun(0, 5, 6), ScanRun(0, 2, 3)]
    assert joined(runs, 1) == [ScanRun(0, 0, 6), ScanRun(0, 8, 9), ScanRun(1, 0, 4)]
    assert joined(runs, 0) == [ScanRun(0, 0, 4), ScanRun(0, 5, 6), ScanRun(0, 8, 9), ScanRun(1, 0, 4)]
    assert joined([], 3) == []
