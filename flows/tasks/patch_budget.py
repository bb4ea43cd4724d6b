"""Costs of reading a field, and the patches of a uniform scan that are read: the best within budgets."""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import astuple, dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from flows.settings.values import limit_of
from models.network.sizes import MultiplyAdds, SegmenterConfig, multiply_adds
from models.policies.policies import GLANCING_POLICIES, score_multiply_adds
from models.reading.regions import Region, plan_regions
from pipeline.errors import BudgetError
from pipeline.geometry.grid import SceneGrid
from storage.arrays.layout import SHARD_COLUMNS, SHARD_ROWS

SHARD = (SHARD_ROWS, SHARD_COLUMNS)  # of what is written at once: regions hold whole ones
DIGITS = 2  # of the least fraction that a refusal names


@dataclass(frozen=True)
class ReadingCosts:
    """Multiply-adds of reading one field by one network, region by region as surveys do."""

    config: SegmenterConfig
    grid: SceneGrid
    bands: int

    @cached_property
    def _regions(self) -> list[Region]:
        return plan_regions(self.grid, SHARD)

    def of_map(self, patch_index: NDArray[np.integer]) -> MultiplyAdds:
        """Count the map drawn with fine patches at these patches of the field."""
        counts = [int(np.count_nonzero(region.numbers_here(patch_index) >= 0)) for region in self._regions]
        parts = [
            astuple(multiply_adds(self.config, region.grid, count, self.bands))
            for region, count in zip(self._regions, counts, strict=True)
        ]
        return MultiplyAdds(*(sum(part) for part in zip(*parts, strict=True)))

    def with_scores(self, patch_index: NDArray[np.integer], policy: str) -> MultiplyAdds:
        """Count the same and what the policy takes to score all patches.

        Stages keep nothing of the model for each other, so that each reads the overview anew: ``overview`` holds what
        map and scores took for it.
        """
        drawn = self.of_map(patch_index)
        readings = 2 if policy in GLANCING_POLICIES else 1
        return replace(drawn, overview=readings * drawn.overview, score=self.score(policy))

    def score(self, policy: str) -> int:
        """Count what the policy takes to score all patches, once the overview is read."""
        return sum(score_multiply_adds(policy, self.config, region.grid) for region in self._regions)


@dataclass(frozen=True)
class PatchBudget:
    """Budget of patches, and the patches there are to spend it on.

    Fractions are of reading every one of ``patch_index`` and choosing none. A prior map of the survey is
    weighed whatever is seen, and does not count.
    """

    costs: ReadingCosts
    patch_index: NDArray[np.intp]  # (patch,) that are worth anything at all
    policy: str
    macs: str | None = None
    least_gain: float | None = None

    @staticmethod
    def asked(
        costs: ReadingCosts,
        shown: NDArray[np.bool_] | None,
        policy: str,
        macs: str | None = None,
        least_gain: float | None = None,
    ) -> PatchBudget | None:
        """Say what may be spent; None where all of the scan is read in detail.

        ``shown`` (patch,) are the patches that zones leave; None: all. Raises BudgetError: not even the overview is
        paid for; names the least that is.
        """
        if macs is None and least_gain is None:
            return None
        patch_index = costs.grid.valid_patches()
        kept = patch_index if shown is None else patch_index[shown[patch_index]]
        budget = PatchBudget(costs, kept, policy, macs, least_gain)
        coarse = budget.operations_of(patch_index[:0])
        if budget._most < coarse:
            least = str(coarse)
            if macs is not None and macs.endswith("%"):
                least = f"{math.ceil(10**DIGITS * 100 * coarse / budget.everything) / 10**DIGITS:g}%"
            raise BudgetError(
                f"--macs {macs} does not pay for the overview and the scores of its patches, {coarse:.4g} of "
                f"{budget.everything:.4g} multiply-adds; the least is --macs {least}"
            )
        return None if not least_gain and budget._most >= budget.everything else budget

    @property
    def grid(self) -> SceneGrid:
        """The grid of the field."""
        return self.costs.grid

    @cached_property
    def everything(self) -> int:
        """Multiply-adds of reading every patch."""
        return self.costs.of_map(self.patch_index).total

    def operations_of(self, patch_index: NDArray[np.integer]) -> int:
        """Multiply-adds of scoring all patches and reading these."""
        return self.costs.with_scores(patch_index, self.policy).total

    def choose(self, scores: NDArray[np.floating]) -> NDArray[np.intp]:
        """Patches that are bought, best first, by the scores (patch,) of the padded grid; equal ones by number.

        A smaller budget buys the first of what a larger one does. What gains nothing, or less than the least gain,
        is not bought; neither is what has no score (NaN).
        """
        expected_gain = np.asarray(scores, np.float64)[self.patch_index]
        promising = (expected_gain > 0) & (expected_gain >= (self.least_gain or 0.0))
        ranked = self.patch_index[promising][np.argsort(-expected_gain[promising], kind="stable")]
        counts = range(1, len(ranked) + 1)
        return ranked[: bisect_right(counts, self._most, key=lambda count: self.operations_of(ranked[:count]))]

    @property
    def most_patches(self) -> NDArray[np.intp]:
        """Return the number of patches that the limits pay for, whatever gain they promise."""
        return self.choose(np.full(math.prod(self.grid.patch_shape), np.inf))

    @property
    def _most(self) -> float:
        return limit_of(self.macs, self.everything)
