"""Covers: seats count once, runs are no longer than they need be, and no chain can be bettered."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.geometry.scan import Sweep
from pipeline.planning.prices import ScanPrices
from pipeline.planning.scan_runs import Cover, Field, ScanRun, best_cover
from pipeline.planning.strips import Views

PRICES = ScanPrices(line_s=1.0, run_s=3.0, reload_s=0.0, lines_per_reload=1500)


def blocks(worth: np.ndarray, most: int, lines: int = 4, prices: ScanPrices = PRICES) -> Field:
    """A field of (row, column) seats of ``lines`` lines, seen ``most`` columns at a time from every offset."""
    rows, columns = worth.shape
    strips = range(max(columns - most, 0) + 1)
    seen = [np.argwhere(worth[:, s : s + most] > 0) + np.array([0, s]) for s in strips]
    row, column = np.concatenate(seen).T
    sweeps = tuple(Sweep(f"fine-{s:03d}", "fine", "x", float(s), 0.0, rows * lines) for s in strips)
    edges = np.cumsum([0, *map(len, seen)])
    views = Views(sweeps, rows * lines, edges, row * columns + column, row * lines, (row + 1) * lines)
    return Field(views, worth.ravel(), np.tile(np.arange(columns), rows), prices)


def drawn(rows: int, columns: int, seed: int) -> np.ndarray:
    """Worth with a few strong seats, one in four worth nothing."""
    rng = np.random.default_rng(seed)
    return rng.exponential(size=(rows, columns)) ** 2 * (rng.random((rows, columns)) > 0.25)


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 8), st.integers(1, 9), st.integers(2, 4), st.integers(0, 99), st.floats(0.01, 2))
def test_worth_and_price_are_those_of_the_runs(rows: int, columns: int, most: int, seed: int, rate: float):
    """Each seat that a run shows counts once; runs of a strip lie apart; the net is never below that of no runs."""
    field = blocks(drawn(rows, columns, seed), most)
    cover = best_cover(field, (), rate)
    shown = np.zeros(len(field.worth), bool)
    for run in cover.runs:
        shown[field.shown_seats(run)] = True
    assert cover.worth == pytest.approx(field.worth[shown].sum())
    assert cover.even_s == pytest.approx(PRICES.even_seconds(cover.lines, len(cover.runs)))
    assert field.left(cover.runs).sum() == pytest.approx(field.total - cover.worth)
    assert cover.worth - rate * cover.even_s >= 0


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 99), st.floats(0.02, 1), st.floats(0.02, 1))
def test_a_cheaper_second_buys_more(seed: int, one: float, other: float):
    """Begun from the cover of a dearer second, the cover of a cheaper one has as much worth or more."""
    field = blocks(drawn(8, 7, seed), 4)
    dear = best_cover(field, (), max(one, other))
    cheap = best_cover(field, dear.runs, min(one, other))
    rate = min(one, other)
    assert cheap.worth - rate * cheap.even_s >= dear.worth - rate * dear.even_s - 1e-9


def test_a_strip_between_two_layouts_is_found():
    """Worth in the middle columns takes one run at its own offset, which strips side by side would need two for."""
    worth = np.zeros((3, 8))
    worth[1, 2:6] = 5.0
    assert best_cover(blocks(worth, 4), (), 0.5) == Cover((ScanRun(2, 4, 8),), 20.0, 7.0)


def test_each_run_has_its_own_offset():
    """Two groups of seats below each other and apart in columns are shown by two runs at two offsets."""
    worth = np.zeros((9, 8))
    worth[0, :4], worth[8, 3:7] = 5.0, 5.0
    assert best_cover(blocks(worth, 4), (), 0.5).runs == (ScanRun(0, 0, 4), ScanRun(3, 32, 36))


def test_strips_overlap_where_the_field_is_no_multiple_of_them():
    """A field of 6 columns seen 4 at a time takes two strips; the seats that both show count once."""
    cover = best_cover(blocks(np.ones((5, 6)), 4), (), 0.01)
    assert cover.worth == 30.0
    assert [(run.first, run.stop) for run in cover.runs] == [(0, 20), (0, 20)]
    assert cover.lines == 40


def test_runs_are_cut_to_what_they_add():
    """Lines that show only what another run shows are dropped, and so are runs that add nothing."""
    field = blocks(np.ones((4, 6)), 4)
    left = field.left([ScanRun(0, 0, 8)])
    assert (
        field.trimmed([ScanRun(2, 0, 12), ScanRun(1, 0, 8), ScanRun(0, 0, 8)], left)
        == [ScanRun(2, 0, 12), ScanRun(1, 8, 12)][:1]
    )
    assert field.trimmed([ScanRun(0, 0, 16)], left) == [ScanRun(0, 8, 16)]


@pytest.mark.parametrize("columns", [13, 20, 41])
def test_wide_fields_are_searched_window_by_window(columns: int):
    """The windows of a set share no column, and all sets together hold every strip."""
    field = blocks(drawn(6, columns, 1), 4)
    held = np.unique(np.concatenate([windows.ravel() for windows in field.windows]))
    assert held.tolist() == list(range(columns - 3))
    for windows in field.windows:
        tops = [window.max() + 3 for window in windows]
        assert all(top < window.min() for top, window in zip(tops, windows[1:], strict=False))
    assert best_cover(field, (), 1e-3).worth == pytest.approx(field.total)


def test_strips_side_by_side_share_no_column():
    """The layout of a full scan holds every column, overlapping at the end alone."""
    field = blocks(np.ones((2, 10)), 4)
    assert field.side_by_side.ravel().tolist() == [0, 4, 6]


def test_nothing_wanted_gives_no_runs():
    """A field without views has an empty cover."""
    field = blocks(np.zeros((3, 5)), 2)
    assert best_cover(field, (), 1.0) == Cover()
    assert field.total == 0


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 99), st.integers(2, 5))
def test_coarser_tables_lose_little(seed: int, unit: int):
    """In a field too large for tables by the line, runs still show whole seats, and nearly as much is found."""
    worth = drawn(8, 7, seed)
    fine, coarse = blocks(worth, 4, lines=20), blocks(worth, 4, lines=20)
    coarse.__dict__["unit"] = unit
    rate = 0.1 * fine.total / PRICES.even_seconds(320, 4)
    one, other = best_cover(fine, (), rate), best_cover(coarse, (), rate)
    assert other.worth == pytest.approx(fine.cover(other.runs).worth)
    assert other.worth - rate * other.even_s >= 0.95 * (one.worth - rate * one.even_s)


def test_the_gap_that_is_scanned_through_costs_no_more_than_a_set_up():
    """Its lines, with their share of reloads, stay within a set-up; one more would not."""
    prices = ScanPrices(line_s=0.1, run_s=0.9, reload_s=1.6, lines_per_reload=150)
    gap = blocks(np.ones((2, 2)), 2, prices=prices).gap
    assert gap == 8
    assert gap * prices.even_line_s <= prices.run_s < (gap + 1) * prices.even_line_s
