"""Runs of lines: the dynamic programme against every choice there is, prices, and covers that no chain betters."""

from __future__ import annotations

from functools import partial
from itertools import combinations, pairwise, product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.planning.prices import ScanPrices
from pipeline.planning.scan_runs import Cover, ScanRun, Tables, best_chains, best_cover, joined
from tests.pipeline.planning.fields import blocks, drawn

LINES = 7
DUE = ScanPrices(line_s=1.0, run_s=1.5, reload_s=2.0, lines_per_reload=5)
Patch = tuple[int, int, float]  # first line, length, worth


def tables(swaths: list[list[Patch]], block: int = 1) -> Tables:
    """Cumulated worth of the patches of each strip, by its definition."""
    closed, begun = np.zeros((len(swaths), LINES + 1)), np.zeros((len(swaths), LINES + 1))
    for swath, patch_index in enumerate(swaths):
        for first, length, expected_gain in patch_index:
            closed[swath, min(first + length, LINES) :] += expected_gain
            begun[swath, first + 1 :] += expected_gain
    return Tables(closed, begun, 1, block)


def shown(swaths: list[list[Patch]], runs: tuple[ScanRun, ...]) -> float:
    """Worth of the patches that lie in one of the runs of their strip."""
    return sum(
        expected_gain
        for swath, patch_index in enumerate(swaths)
        for first, length, expected_gain in patch_index
        if any(r.swath == swath and r.first <= first and min(first + length, LINES) <= r.stop for r in runs)
    )


def every_chain(count: int) -> list[tuple[ScanRun, ...]]:
    """Every chain of up to two runs over some strips."""
    spans = list(combinations(range(LINES + 1), 2))
    single = [ScanRun(swath, a, b) for swath in range(count) for a, b in spans]
    pairs = [pair for pair in product(single, repeat=2) if all(x.stop <= y.first for x, y in pairwise(pair))]
    return [(), *((run,) for run in single), *pairs]


EVERY = every_chain(2)
patches_of_one_length = st.lists(st.tuples(st.integers(0, LINES - 2), st.just(2), st.floats(0.1, 9)), max_size=6)


@given(st.lists(patches_of_one_length, min_size=2, max_size=2), st.floats(0.3, 3), st.floats(0.5, 4), st.integers(1, 2))
def test_the_best_chain_beats_every_other(swaths: list[list[Patch]], line: float, run: float, block: int):
    """No chain of runs over two strips has more worth less price than the programme's, in blocks or not."""

    def net(runs: tuple[ScanRun, ...]) -> float:
        return shown(swaths, runs) - sum((r.stop - r.first) * line + run for r in runs)

    (found,) = best_chains(tables(swaths, block), np.array([[0, 1]]), line, run)
    assert net(tuple(found)) >= max(net(runs) for runs in EVERY) - 1e-9
    assert all(one.stop <= other.first for one, other in pairwise(found))


@given(st.floats(0, 60), st.integers(0, 6))
def test_most_lines_are_the_most_that_the_seconds_pay_for(seconds: float, runs: int):
    """One line more would cost more than the seconds; a budget below the set-ups pays for less than nothing."""
    lines = DUE.most_lines(seconds, runs)
    if lines >= 0:
        assert DUE.seconds(lines, runs) <= seconds
    assert DUE.seconds(max(lines, -1) + 1, runs) > seconds


@pytest.mark.parametrize(("lines", "reloads"), [(0, 0), (5, 1), (6, 2), (10, 2)])
def test_true_and_additive_prices(lines: int, reloads: int):
    """The additive price has the same line and run, is never above the true one and below it by less than a reload."""
    true = DUE.seconds(lines, 2)
    assert true == lines + 3.0 + 2.0 * reloads
    assert true - DUE.reload_s < DUE.even_seconds(lines, 2) <= true


def test_runs_that_meet_are_joined():
    """Runs of one strip that overlap, touch or lie within the gap become one; other strips and far runs stay."""
    runs = [ScanRun(1, 0, 4), ScanRun(0, 8, 9), ScanRun(0, 0, 4), ScanRun(0, 5, 6), ScanRun(0, 2, 3)]
    assert joined(runs, 1) == [ScanRun(0, 0, 6), ScanRun(0, 8, 9), ScanRun(1, 0, 4)]
    assert joined(runs, 0) == [ScanRun(0, 0, 4), ScanRun(0, 5, 6), ScanRun(0, 8, 9), ScanRun(1, 0, 4)]
    assert joined([], 3) == []


PRICES = ScanPrices(line_s=1.0, run_s=3.0, reload_s=0.0, lines_per_reload=1500)
patch_index = partial(blocks, prices=PRICES, lines=4)


@settings(max_examples=12, deadline=None)
@given(st.integers(1, 8), st.integers(1, 9), st.integers(2, 4), st.integers(0, 99), st.floats(0.01, 2))
def test_worth_and_price_are_those_of_the_runs(rows: int, columns: int, most: int, seed: int, rate: float):
    """Each patch that a run shows counts once; runs of a strip lie apart; the net is never below that of no runs."""
    field = patch_index(drawn(rows, columns, seed), most)
    cover = best_cover(field, (), rate)
    shown = np.zeros(len(field.expected_gain), bool)
    for run in cover.runs:
        shown[field.shown_patches(run)] = True
    assert cover.expected_gain == pytest.approx(field.expected_gain[shown].sum())
    assert cover.even_s == pytest.approx(PRICES.even_seconds(cover.lines, len(cover.runs)))
    assert field.left(cover.runs).sum() == pytest.approx(field.total - cover.expected_gain)
    assert cover.expected_gain - rate * cover.even_s >= 0


@settings(max_examples=12, deadline=None)
@given(st.integers(0, 99), st.floats(0.02, 1), st.floats(0.02, 1))
def test_a_cheaper_second_buys_more(seed: int, one: float, other: float):
    """Begun from the cover of a dearer second, the cover of a cheaper one has as much worth or more."""
    field = patch_index(drawn(8, 7, seed), 4)
    dear = best_cover(field, (), max(one, other))
    cheap = best_cover(field, dear.runs, min(one, other))
    rate = min(one, other)
    assert cheap.expected_gain - rate * cheap.even_s >= dear.expected_gain - rate * dear.even_s - 1e-9


def test_a_swath_between_two_layouts_is_found():
    """Worth in the middle columns takes one run at its own offset, which strips side by side would need two for."""
    expected_gain = np.zeros((3, 8))
    expected_gain[1, 2:6] = 5.0
    assert best_cover(patch_index(expected_gain, 4), (), 0.5) == Cover((ScanRun(2, 4, 8),), 20.0, 7.0)


def test_runs_are_cut_to_what_they_add():
    """Lines that show only what another run shows are dropped, and so are runs that add nothing."""
    field = patch_index(np.ones((4, 6)), 4)
    left = field.left([ScanRun(0, 0, 8)])
    assert (
        field.trimmed([ScanRun(2, 0, 12), ScanRun(1, 0, 8), ScanRun(0, 0, 8)], left)
        == [ScanRun(2, 0, 12), ScanRun(1, 8, 12)][:1]
    )
    assert field.trimmed([ScanRun(0, 0, 16)], left) == [ScanRun(0, 8, 16)]


@pytest.mark.parametrize("columns", [13, 20, 41])
def test_wide_fields_are_searched_window_by_window(columns: int):
    """The windows of a set share no column, and all sets together hold every strip."""
    field = patch_index(drawn(6, columns, 1), 4)
    held = np.unique(np.concatenate([windows.ravel() for windows in field.windows]))
    assert held.tolist() == list(range(columns - 3))
    for windows in field.windows:
        tops = [window.max() + 3 for window in windows]
        assert all(top < window.min() for top, window in zip(tops, windows[1:], strict=False))
    assert best_cover(field, (), 1e-3).expected_gain == pytest.approx(field.total)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 99), st.integers(2, 5))
def test_coarser_tables_lose_little(seed: int, unit: int):
    """In a field too large for tables by the line, runs still show whole patches, and nearly as much is found."""
    expected_gain = drawn(8, 7, seed)
    fine, coarse = patch_index(expected_gain, 4, lines=20), patch_index(expected_gain, 4, lines=20)
    coarse.__dict__["unit"] = unit
    rate = 0.1 * fine.total / PRICES.even_seconds(320, 4)
    one, other = best_cover(fine, (), rate), best_cover(coarse, (), rate)
    assert other.expected_gain == pytest.approx(fine.cover(other.runs).expected_gain)
    assert other.expected_gain - rate * other.even_s >= 0.95 * (one.expected_gain - rate * one.even_s)


def test_the_gap_that_is_scanned_through_costs_no_more_than_a_set_up():
    """Its lines, with their fraction of reloads, stay within a set-up; one more would not."""
    prices = ScanPrices(line_s=0.1, run_s=0.9, reload_s=1.6, lines_per_reload=150)
    gap = patch_index(np.ones((2, 2)), 2, prices=prices).gap
    assert gap == 8
    assert gap * prices.even_line_s <= prices.run_s < (gap + 1) * prices.even_line_s
