"""Spending: laws of the budget, and the optimum of an integer programme on small fields."""

from __future__ import annotations

from functools import partial

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import sparse
from scipy.optimize import Bounds, LinearConstraint, milp

from pipeline.planning.budget_search import spend
from pipeline.planning.prices import ScanPrices
from tests.pipeline.planning.fields import blocks, drawn

PRICES = ScanPrices(line_s=0.1, run_s=0.9, reload_s=1.6, lines_per_reload=150)
LINES = 8  # of a patch
patch_index = partial(blocks, prices=PRICES, lines=LINES)


def optimum(expected_gain: np.ndarray, most: int, budget_s: float) -> float:
    """Most gain for a budget, by an integer programme.

    Unknowns: is a swath on in a row, does it start there, is a patch shown, loads of the memory.
    """
    rows, columns = expected_gain.shape
    swaths = columns - most + 1
    on = rows * swaths
    patch_index = np.flatnonzero(expected_gain)
    loads = 2 * on + len(patch_index)
    cells: list[tuple[int, int, float]] = []
    top: list[float] = []
    for s in range(swaths):
        for r in range(rows):
            cells += [(len(top), s * rows + r, 1), (len(top), on + s * rows + r, -1)]
            cells += [(len(top), s * rows + r - 1, -1)] if r else []
            top.append(0)
    for place, patch_number in enumerate(patch_index.tolist()):
        r, c = divmod(patch_number, columns)
        near = range(max(c - most + 1, 0), min(c, swaths - 1) + 1)
        cells += [(len(top), 2 * on + place, 1), *((len(top), s * rows + r, -1) for s in near)]
        top.append(0)
    cells += [(len(top), i, LINES) for i in range(on)] + [(len(top), loads, -PRICES.lines_per_reload)]
    top.append(0)
    seconds = np.zeros(loads + 1)
    seconds[:on], seconds[on : 2 * on], seconds[loads] = LINES * PRICES.line_s, PRICES.run_s, PRICES.reload_s
    value = np.zeros(loads + 1)
    value[2 * on : loads] = expected_gain.ravel()[patch_index]
    row, column, entry = zip(*cells, strict=True)
    limits = [
        LinearConstraint(sparse.csr_matrix((entry, (row, column)), (len(top), loads + 1)), -np.inf, top),
        LinearConstraint(seconds[None], -np.inf, budget_s),
    ]
    most_of, whole = np.ones(loads + 1), np.zeros(loads + 1)
    most_of[loads] = 99
    whole[:on] = whole[loads] = 1
    found = milp(
        -value,
        constraints=limits,
        bounds=Bounds(np.zeros(loads + 1), most_of),
        integrality=whole,
        options={"mip_rel_gap": 1e-6},
    )
    return float(-found.fun)


@settings(max_examples=15, deadline=None)
@given(st.integers(2, 9), st.integers(3, 12), st.integers(0, 99), st.floats(0, 30), st.floats(0, 30))
def test_a_bigger_budget_never_buys_less(rows: int, columns: int, seed: int, one: float, other: float):
    """The true price, reloads included, stays within the budget, and worth grows with it, in narrow fields and wide."""
    field = patch_index(drawn(rows, columns, seed), 3)
    small, large = (spend(field, budget) for budget in sorted((one, other)))
    assert small.seconds(PRICES) <= min(one, other)
    assert large.seconds(PRICES) <= max(one, other)
    assert large.expected_gain >= small.expected_gain - 1e-9
    for cover in (small, large):
        assert cover.expected_gain <= field.cover(cover.runs).expected_gain + 1e-9


def test_plans_are_near_the_optimum():
    """Over fields of 1.4 and 2.2 strips and three budgets the plan has 99 % of the integer programme's worth."""
    fractions = []
    for seed, columns in enumerate((7, 11)):
        expected_gain = drawn(9, columns, seed)
        for budget_s in (4.0, 7.0, 15.0):
            fractions.append(
                spend(patch_index(expected_gain, 5), budget_s).expected_gain / optimum(expected_gain, 5, budget_s)
            )
    assert min(fractions) > 0.95
    assert np.mean(fractions) > 0.99
    assert max(fractions) <= 1 + 1e-9


def test_worths_far_apart_are_all_bought_in_the_end():
    """A patch a million times weaker than another is bought by a budget for all."""
    expected_gain = np.zeros((9, 6))
    expected_gain[0, 0], expected_gain[4, 5], expected_gain[8, 2] = 1e6, 1.0, 1e3
    assert spend(patch_index(expected_gain, 3), 1e4).expected_gain == expected_gain.sum()
