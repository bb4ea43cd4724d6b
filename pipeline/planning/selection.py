"""Scores and a budget in, seats out: stable, nested, and never led by a number that is not one."""

from __future__ import annotations

import operator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import BudgetError

GOLDEN = (5**0.5 - 1) / 2

Scores = NDArray[np.floating]
Seats = NDArray[np.intp]


@dataclass(frozen=True)
class Selection:
    """Seats by rank, best first. ``spread`` says that no score could be ranked and seats were spread evenly instead."""

    seats: Seats
    spread: bool = False


def seat_count(share: float, valid: int) -> int:
    """Turn a share of the valid seats into a number of seats, halves rounded up.

    Raises BudgetError: the share is not a number from 0 to 1.
    """
    if not 0 <= share <= 1:  # NaN too
        raise BudgetError(f"the share of seats to buy must be from 0 to 1, got {share} (of {valid} seats)")
    return min(int(np.floor(share * valid + 0.5)), valid)


def select_seats(score: Scores, count: int, valid: NDArray[np.bool_] | None = None, *, clip: bool = False) -> Selection:
    """Choose the ``count`` valid seats with the highest ``score``, (seat,) of any float type.

    Equal scores go to the lowest number; +inf comes first, NaN and -inf last. The choice is nested: the first K of a
    larger choice are the choice of K. When no valid seat has a score to rank (all NaN or -inf), seats are spread evenly
    over the valid ones, nested too, and the result says so. ``clip`` takes all valid seats where ``count`` is larger.

    Raises BudgetError: ``count`` is not a whole number, below 0, or above the number of valid seats.
    """
    allowed = _allowed(score, valid)
    try:
        wanted = -1 if isinstance(count, bool | np.bool_) else operator.index(count)
    except TypeError:
        wanted = -1
    if wanted < 0 or (wanted > len(allowed) and not clip):
        raise BudgetError(f"expected a whole number of seats to buy from 0 to {len(allowed)}, got {count!r}")
    given = np.asarray(score, np.float64)[allowed]
    worth = np.where(np.isnan(given), -np.inf, given)
    spread = bool(len(worth)) and bool(np.all(np.isneginf(worth)))
    # Multiples of the golden ratio leave gaps of at most three sizes, for every count and any row length.
    order = np.argsort((np.arange(len(worth)) * GOLDEN) % 1.0 if spread else -worth, kind="stable")
    return Selection(allowed[order[:wanted]], spread and wanted > 0)


def frame_seats(score: Scores, share: float, valid: NDArray[np.bool_] | None = None) -> Selection:
    """Choose a share of the valid seats as if each could be captured by itself (``frame`` mode: compares policies)."""
    return select_seats(score, seat_count(share, len(_allowed(score, valid))), valid)


def _allowed(score: Scores, valid: NDArray[np.bool_] | None) -> Seats:
    """Numbers of the seats that may be chosen, ascending."""
    return np.arange(len(score)) if valid is None else np.flatnonzero(valid)
