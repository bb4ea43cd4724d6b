"""Runs of lines: the dynamic programme against every choice there is, and the laws of the budget."""

from __future__ import annotations

from itertools import combinations, pairwise, product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.runs import Plan, Prices, Run, Wanted, best_runs, plan_runs

LINES = 7
PRICES = Prices(line_s=1.0, run_s=1.5, reload_s=2.0, lines_per_reload=5)


def wanted(rows: list[tuple[int, int, float]]) -> Wanted:
    """Seats from (first, length, worth), kept within the strip's lines."""
    first = np.array([row[0] for row in rows], np.intp)
    stop = np.minimum(first + np.array([row[1] for row in rows], np.intp), LINES)
    return Wanted(first, stop, np.array([row[2] for row in rows], np.float64))


def shown(strip: Wanted, runs: tuple[Run, ...]) -> float:
    """Worth of the seats that lie in one of the runs."""
    seats = zip(strip.first, strip.stop, strip.worth, strict=True)
    return sum(w for a, b, w in seats if any(c <= a and b <= e for c, e in runs))


def all_runs() -> list[tuple[Run, ...]]:
    """Every set of up to three runs that do not meet."""
    single = list(combinations(range(LINES + 1), 2))
    apart = [pick for n in (2, 3) for pick in combinations(single, n) if all(x[1] < y[0] for x, y in pairwise(pick))]
    return [(), *((run,) for run in single), *apart]


EVERY = all_runs()
rows = st.tuples(st.integers(0, LINES - 1), st.integers(1, 4), st.floats(0.1, 9))
strips = st.lists(st.lists(rows, min_size=1, max_size=6).map(wanted), min_size=1, max_size=2)


def best_by_trying(parts: list[Wanted], budget_s: float) -> float:
    """The most worth within the budget, over every choice for every strip."""
    tables = [[(shown(part, runs), sum(e - c for c, e in runs), len(runs)) for runs in EVERY] for part in parts]
    best = 0.0
    for picks in product(*tables):
        if PRICES.seconds(sum(p[1] for p in picks), sum(p[2] for p in picks)) <= budget_s:
            best = max(best, sum(p[0] for p in picks))
    return best


@given(st.lists(rows, min_size=1, max_size=8).map(wanted), st.floats(0.05, 3), st.floats(0, 4))
def test_best_runs_beat_every_other_choice(strip: Wanted, line_price: float, run_price: float):
    """No set of runs has more worth less price than the programme's."""

    def net(runs: tuple[Run, ...]) -> float:
        return shown(strip, runs) - sum((e - c) * line_price + run_price for c, e in runs)

    found = best_runs(strip, line_price, run_price)
    assert net(found) == pytest.approx(max(net(runs) for runs in EVERY), abs=1e-9)
    assert list(found) == sorted(found)


@settings(max_examples=60, deadline=None)
@given(strips, st.floats(0, 30), st.floats(0, 30))
def test_price_stays_within_the_budget_and_more_never_buys_less(parts: list[Wanted], one: float, other: float):
    """The true price, reloads included, never exceeds the budget, and worth grows with it."""
    small, large = (plan_runs(parts, PRICES, budget) for budget in sorted((one, other)))
    assert small.seconds(PRICES) <= min(one, other)
    assert large.seconds(PRICES) <= max(one, other)
    assert large.worth >= small.worth - 1e-9
    for plan in (small, large):
        assert plan.worth == pytest.approx(sum(shown(p, r) for p, r in zip(parts, plan.runs, strict=True)), abs=1e-9)


@settings(max_examples=30, deadline=None)
@given(st.lists(rows, min_size=1, max_size=6).map(wanted), st.floats(0, 16))
def test_the_plan_misses_the_optimum_by_less_than_one_corner(strip: Wanted, budget_s: float):
    """The worth lies between the best at any cheaper corner of the hull and the best of all choices."""
    plan = plan_runs([strip], PRICES, budget_s)
    best = best_by_trying([strip], budget_s)
    rates = np.geomspace(1e-3, 1e2, 40)
    corners = [best_runs(strip, rate * PRICES.even_line_s, rate * PRICES.run_s) for rate in rates]
    prices = [PRICES.seconds(sum(e - c for c, e in runs), len(runs)) for runs in corners]
    floor = max([0.0, *(shown(strip, r) for r, price in zip(corners, prices, strict=True) if price <= budget_s)])
    assert floor - 1e-9 <= plan.worth <= best + 1e-9


def test_plans_are_near_the_optimum_on_the_whole():
    """Over 60 random cases of two strips the plan has at least 97 % of the best choice's worth, mostly all of it."""
    rng = np.random.default_rng(4)
    shares = []
    for _ in range(60):
        parts = [
            wanted([(int(a), 2, float(w)) for a, w in zip(rng.integers(0, 6, 4), rng.uniform(0, 9, 4), strict=True)])
        ]
        budget_s = float(rng.uniform(6, 14))
        best = best_by_trying(parts, budget_s)
        shares.append(plan_runs(parts, PRICES, budget_s).worth / best if best else 1.0)
    assert np.mean(shares) > 0.97
    assert np.mean(np.array(shares) > 1 - 1e-9) > 0.8


def test_near_runs_are_joined_and_far_ones_are_not():
    """A gap shorter than a set-up is scanned through; a longer one is not."""
    near = Wanted(np.array([0, 5]), np.array([4, 9]), np.array([9.0, 9.0]))
    far = Wanted(np.array([0, 50]), np.array([4, 54]), np.array([9.0, 9.0]))
    assert best_runs(near, 1.0, 1.5) == ((0, 9),)
    assert best_runs(far, 1.0, 1.5) == ((0, 4), (50, 54))


def test_equal_worth_everywhere_fills_the_budget():
    """With nothing to tell seats apart one run takes all lines that the budget allows."""
    strip = Wanted(np.arange(100), np.arange(100) + 4, np.ones(100))
    plan = plan_runs([strip], Prices(1.0, 1.5, 0.0, 1500), 41.7)
    assert plan.lines == 40
    assert plan.worth == 37


def test_nothing_wanted_costs_nothing():
    """No seats, seats without worth, or no seconds give an empty plan."""
    none = Wanted(np.zeros(0, np.intp), np.zeros(0, np.intp), np.zeros(0))
    assert plan_runs([none, none], PRICES, 100.0) == Plan(((), ()), 0.0, 0.0)
    assert plan_runs([], PRICES, 100.0).lines == 0
    assert plan_runs([wanted([(0, 2, 5.0)]), none], PRICES, 0.0).lines == 0


def test_a_full_budget_buys_all_seats():
    """Where everything fits everything is bought, also beside an empty strip and over very different worths."""
    none = Wanted(np.zeros(0, np.intp), np.zeros(0, np.intp), np.zeros(0))
    strip = wanted([(0, 2, 1e6), (3, 2, 1.0), (5, 2, 1e3)])
    assert plan_runs([none, strip], PRICES, 1000.0).worth == pytest.approx(1e6 + 1e3 + 1)
