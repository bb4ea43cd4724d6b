"""Scores and a budget in, patches out: stable, nested, and never led by a number that is not one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import BudgetError

GOLDEN = (5**0.5 - 1) / 2

Scores = NDArray[np.floating]
PatchIndex = NDArray[np.intp]


def select_patches(score: Scores, count: int, valid: NDArray[np.bool_] | None = None) -> PatchIndex:
    """Return the ``count`` valid patches with the highest ``score``, (patch,) of any float type, best first.

    Equal scores go to the lowest number; +inf comes first, NaN and -inf last. The choice is nested: the first K of a
    larger choice are the choice of K. When no valid patch has a score to rank (all NaN or -inf), patches are spread
    evenly over the valid ones, nested too.

    Raises BudgetError: ``count`` is not a whole number, below 0, or above the number of valid patches.
    """
    allowed = np.arange(len(score)) if valid is None else np.flatnonzero(valid)
    if count not in range(len(allowed) + 1):
        raise BudgetError(f"expected a whole number of patches to buy from 0 to {len(allowed)}, got {count!r}")
    given = np.asarray(score, np.float64)[allowed]
    expected_gain = np.where(np.isnan(given), -np.inf, given)
    spread = bool(np.all(np.isneginf(expected_gain)))
    # Multiples of the golden ratio leave gaps of at most three sizes, for every count and any row length.
    order = np.argsort((np.arange(len(expected_gain)) * GOLDEN) % 1.0 if spread else -expected_gain, kind="stable")
    return allowed[order[:count]]


def frame_patches(score: Scores, fraction: float, valid: NDArray[np.bool_] | None = None) -> PatchIndex:
    """Choose a fraction of the valid patches as if each could be captured by itself (``frame`` mode).

    Halves of a patch are rounded up. Raises BudgetError: the fraction is not a number from 0 to 1.
    """
    number = len(score) if valid is None else int(np.count_nonzero(valid))
    if not 0 <= fraction <= 1:  # NaN too
        raise BudgetError(f"the fraction of patches to buy must be from 0 to 1, got {fraction} (of {number} patches)")
    return select_patches(score, min(int(np.floor(fraction * number + 0.5)), number), valid)
