"""Which seats of a plain scan are kept and read in detail: those that promise most, as far as the budgets go."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flows.settings.survey_settings import Settings
from flows.settings.values import limit_of
from flows.tasks.reading_costs import ReadingCosts
from pipeline.errors import BudgetError
from pipeline.geometry.grid import SceneGrid

BYTES_A_VALUE = 4  # of patches and means, before compression
DIGITS = 2  # of the least share that a refusal names


@dataclass(frozen=True)
class SeatBudget:
    """What may be spent on seats, and which there are to spend it on.

    Shares are of reading every one of ``seats`` and choosing none, and of the bytes of all their pixels with the coarse
    means of the field. A memory that the map goes on from is weighed whatever is seen, and counts for neither.
    """

    costs: ReadingCosts
    seats: NDArray[np.intp]  # (seat,) that are worth anything at all
    policy: str
    compute: str | None = None
    bytes_kept: str | None = None
    least_gain: float | None = None

    @staticmethod
    def asked(settings: Settings, costs: ReadingCosts, shown: NDArray[np.bool_] | None) -> SeatBudget | None:
        """Take from the settings what may be spent; None where all of the scan is kept and read.

        ``shown`` (seat,) are the seats that zones leave; None: all. Raises BudgetError: not even the coarse look
        is paid for; names the least that is.
        """
        if not settings.sparing:
            return None
        seats = costs.grid.valid_seats()
        kept = seats if shown is None else seats[shown[seats]]
        limits = settings.compute, settings.bytes_kept, settings.least_gain
        budget = SeatBudget(costs, kept, settings.policy, *limits)
        for wrong in budget._too_little():
            raise BudgetError(wrong)
        return None if budget._pays_for_all else budget

    @property
    def grid(self) -> SceneGrid:
        """The grid of the field."""
        return self.costs.grid

    @cached_property
    def everything(self) -> int:
        """Multiply-adds of reading every seat."""
        return self.costs.of_map(self.seats).total

    @cached_property
    def every_byte(self) -> int:
        """Bytes of all seats and the coarse means, before compression."""
        return self.bytes_of(len(self.seats))

    def operations_of(self, seats: NDArray[np.integer]) -> int:
        """Multiply-adds of scoring all seats and reading these."""
        return self.costs.with_scores(seats, self.policy).total

    def bytes_of(self, count: int) -> int:
        """Bytes of so many seats and the coarse means, before compression."""
        pixels = math.prod(self.grid.coarse_shape) + count * self.grid.patch**2
        return pixels * self.costs.bands * BYTES_A_VALUE

    def choose(self, scores: NDArray[np.floating]) -> NDArray[np.intp]:
        """Seats that are bought, best first, by the scores (seat,) of the padded grid; equal ones by number.

        A smaller budget buys the first of what a larger one does. What promises nothing, or less than the least gain,
        is not bought; neither is what has no score (NaN).
        """
        worth = np.asarray(scores, np.float64)[self.seats]
        promising = (worth > 0) & (worth >= (self.least_gain or 0.0))
        ranked = self.seats[promising][np.argsort(-worth[promising], kind="stable")]
        counts = range(1, len(ranked) + 1)
        read = bisect_right(counts, self._most_operations, key=lambda count: self.operations_of(ranked[:count]))
        kept = bisect_right(counts, self._most_bytes, key=self.bytes_of)
        return ranked[: min(read, kept)]

    @property
    def most_seats(self) -> NDArray[np.intp]:
        """As many seats as the limits pay for, whatever they promise."""
        return self.choose(np.full(math.prod(self.grid.seat_shape), np.inf))

    def told(self, seats: NDArray[np.integer]) -> dict[str, Any]:
        """What these seats take beside reading and keeping everything, for a receipt."""
        whole = {"multiply_adds": self.everything, "bytes": self.every_byte}
        done = {"multiply_adds": self.operations_of(seats), "bytes": self.bytes_of(len(seats))}
        asked = {"compute": self.compute, "bytes_kept": self.bytes_kept, "least_gain": self.least_gain}
        costs = {name: {"done": done[name], "everything": whole[name]} for name in whole}
        return {"asked": asked, "seats": len(seats), "of_seats": len(self.seats), **costs}

    @property
    def _most_operations(self) -> float:
        return limit_of(self.compute, self.everything)

    @property
    def _most_bytes(self) -> float:
        return limit_of(self.bytes_kept, self.every_byte)

    @property
    def _pays_for_all(self) -> bool:
        """Whether nothing is to be chosen: then the scores are spared too."""
        return not self.least_gain and self._most_operations >= self.everything and self._most_bytes >= self.every_byte

    def _too_little(self) -> Iterator[str]:
        """Limits that do not pay for the coarse look, with the least that do."""
        none = self.seats[:0]
        look, means = self.operations_of(none), self.bytes_of(0)
        if self._most_operations < look:
            least = _least(self.compute, look, self.everything)
            yield (
                f"--compute {self.compute} does not pay for the coarse look and the scores of its seats, "
                f"{look:.4g} of {self.everything:.4g} multiply-adds; the least is --compute {least}"
            )
        if self._most_bytes < means:
            least = _least(self.bytes_kept, means, self.every_byte)
            yield (
                f"--bytes-kept {self.bytes_kept} does not hold the coarse means of the field, {means:.4g} of "
                f"{self.every_byte:.4g} bytes; the least is --bytes-kept {least}"
            )


def _least(asked: str | None, done: int, whole: int) -> str:
    """The least limit of the kind that was asked for: a share, rounded up, or a number."""
    if asked is None or not asked.endswith("%"):
        return str(done)
    return f"{math.ceil(10**DIGITS * 100 * done / whole) / 10**DIGITS:g}%"
