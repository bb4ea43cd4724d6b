"""Scores and a budget in, patches out: stable, nested, and never led by a number that is not one."""

from __future__ import annotations

import operator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import BudgetError

GOLDEN = (5**0.5 - 1) / 2

Scores = NDArray[np.floating]
PatchIndex = NDArray[np.intp]


@dataclass(frozen=True)
class Selection:
    """Patches by rank, best first. ``spread`` says that no score could be ranked and patches were spread evenly instead."""

    patch_index: PatchIndex
    spread: bool = False


def patch_count(fraction: float, valid: int) -> int:
    """Turn a fraction of the valid patches into a number of patches, halves rounded up.

    Raises BudgetError: the fraction is not a number from 0 to 1.
    """
    if not 0 <= fraction <= 1:  # NaN too
        raise BudgetError(f"the fraction of patches to buy must be from 0 to 1, got {fraction} (of {valid} patches)")
    return min(int(np.floor(fraction * valid + 0.5)), valid)


def select_patches(
    score: Scores, count: int, valid: NDArray[np.bool_] | None = None, *, clip: bool = False
) -> Selection:
    """Choose the ``count`` valid patches with the highest ``score``, (patch,) of any float type.

    Equal scores go to the lowest number; +inf comes first, NaN and -inf last. The choice is nested: the first K of a
    larger choice are the choice of K. When no valid patch has a score to rank (all NaN or -inf), patches are spread evenly
    over the valid ones, nested too, and the result says so. ``clip`` takes all valid patches where ``count`` is larger.

    Raises BudgetError: ``count`` is not a whole number, below 0, or above the number of valid patches.
    """
    allowed = _allowed(score, valid)
    try:
        wanted = -1 if isinstance(count, bool | np.bool_) else operator.index(count)
    except TypeError:
        wanted = -1
    if wanted < 0 or (wanted > len(allowed) and not clip):
        raise BudgetError(f"expected a whole number of patches to buy from 0 to {len(allowed)}, got {count!r}")
    given = np.asarray(score, np.float64)[allowed]
    expected_gain = np.where(np.isnan(given), -np.inf, given)
    spread = bool(len(expected_gain)) and bool(np.all(np.isneginf(expected_gain)))
    # Multiples of the golden ratio leave gaps of at most three sizes, for every count and any row length.
    order = np.argsort((np.arange(len(expected_gain)) * GOLDEN) % 1.0 if spread else -expected_gain, kind="stable")
    return Selection(allowed[order[:wanted]], spread and wanted > 0)


def frame_patches(score: Scores, fraction: float, valid: NDArray[np.bool_] | None = None) -> Selection:
    """Choose a fraction of the valid patches as if each could be captured by itself (``frame`` mode: compares policies)."""
    return select_patches(score, patch_count(fraction, len(_allowed(score, valid))), valid)


def _allowed(score: Scores, valid: NDArray[np.bool_] | None) -> PatchIndex:
    """Numbers of the patches that may be chosen, ascending."""
    return np.arange(len(score)) if valid is None else np.flatnonzero(valid)
