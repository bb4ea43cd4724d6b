"""Compute the costs of reading a field, and choose the patches that a MAC budget pays for."""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import astuple, dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from spectralzoom.models.network.sizes import MultiplyAdds, SegmenterConfig, multiply_adds
from spectralzoom.models.policies.policies import GLANCING_POLICIES, score_multiply_adds
from spectralzoom.models.reading.regions import Region, plan_regions
from spectralzoom.pipeline.errors import BudgetError
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.storage.arrays.layout import SHARD_COLUMNS, SHARD_ROWS

SHARD = (SHARD_ROWS, SHARD_COLUMNS)  # written at once: a region consists of whole shards
DIGITS = 2  # of the least percentage in an error


@dataclass(frozen=True)
class ReadingCosts:
    """Multiply-adds of reading one field by one network, region by region as surveys do."""

    config: SegmenterConfig
    grid: SceneGrid
    bands: int

    @cached_property
    def _regions(self) -> list[Region]:
        return plan_regions(self.grid, SHARD, halo=self.config.halo_px)

    def of_map(self, patch_index: NDArray[np.integer]) -> MultiplyAdds:
        """Count the map with fine patches at these patches of the field."""
        counts = [int(np.count_nonzero(region.numbers_here(patch_index) >= 0)) for region in self._regions]
        parts = [
            astuple(multiply_adds(self.config, region.grid, count, self.bands))
            for region, count in zip(self._regions, counts, strict=True)
        ]
        return MultiplyAdds(*(sum(part) for part in zip(*parts, strict=True)))

    def with_scores(
        self, patch_index: NDArray[np.integer], policy: str, changed: NDArray[np.integer] | None = None
    ) -> MultiplyAdds:
        """Count the map and the scores of all patches by the policy.

        The overview by which patches are scored is computed again around ``changed`` (patch,) patches.
        """
        done = replace(self.of_map(patch_index), score=self.score(policy))
        if changed is None or policy not in GLANCING_POLICIES:
            return done
        again = [part for region in self._regions for part in region.parts(changed, self.config.halo_px)]
        more = sum(multiply_adds(self.config, part.grid, 0, self.bands).overview for part in again)
        return replace(done, overview=done.overview + more)

    def score(self, policy: str) -> int:
        """Count the scores of all patches by the policy, without the overview."""
        return sum(score_multiply_adds(policy, self.config, region.grid) for region in self._regions)


@dataclass(frozen=True)
class PatchBudget:
    """MAC budget for reading patches at full resolution.

    A fraction refers to reading all of ``patch_index`` without scores. The prior map does not count.
    """

    costs: ReadingCosts
    patch_index: NDArray[np.intp]  # (patch,) that zones leave
    policy: str
    macs: str  # a fraction such as 50%, or a number

    @staticmethod
    def asked(costs: ReadingCosts, shown: NDArray[np.bool_] | None, policy: str, macs: str) -> PatchBudget | None:
        """Return the budget; None where it pays for all patches.

        ``shown`` (patch,) are the patches that zones leave; None: all. Raises BudgetError: it does not pay for the
        overview, and names the least that does; or the weights have no full network that could be left out.
        """
        patch_index = costs.grid.every_patch() if shown is None else np.flatnonzero(shown)
        budget = PatchBudget(costs, patch_index, policy, macs)
        if not costs.config.corrected and budget._most < budget.everything:
            raise BudgetError(
                f"--macs {macs}: the weights have no full network to leave out, and any map takes "
                f"{budget.everything:.4g} multiply-adds; leave out --macs"
            )
        coarse = budget.operations_of(patch_index[:0])
        if budget._most < coarse:
            least = str(coarse)
            if macs.endswith("%"):
                least = f"{math.ceil(10**DIGITS * 100 * coarse / budget.everything) / 10**DIGITS:g}%"
            raise BudgetError(
                f"--macs {macs} does not pay for the overview and the scores of its patches, {coarse:.4g} of "
                f"{budget.everything:.4g} multiply-adds; the least is --macs {least}"
            )
        return None if budget._most >= budget.everything else budget

    @cached_property
    def everything(self) -> int:
        """Return the multiply-adds of reading every patch."""
        return self.costs.of_map(self.patch_index).total

    def operations_of(self, patch_index: NDArray[np.integer]) -> int:
        """Return the multiply-adds of scoring all patches and reading these."""
        return self.costs.with_scores(patch_index, self.policy).total

    def choose(self, scores: NDArray[np.floating]) -> NDArray[np.intp]:
        """Return the patches that the budget pays for, best first, by the scores (patch,); equal ones by number.

        A smaller budget pays for the first patches of a larger one. Patches without a positive score (or NaN) are
        left out.
        """
        expected_gain = np.asarray(scores, np.float64)[self.patch_index]
        ranked = self.patch_index[expected_gain > 0][np.argsort(-expected_gain[expected_gain > 0], kind="stable")]
        counts = range(1, len(ranked) + 1)
        return ranked[: bisect_right(counts, self._most, key=lambda count: self.operations_of(ranked[:count]))]

    @property
    def _most(self) -> float:
        number = float(self.macs.removesuffix("%"))
        return number / 100 * self.everything if self.macs.endswith("%") else number
