"""Multiply-adds of reading a field: of its map with fine patches at some patches, and of the scores of its patches."""

from __future__ import annotations

from dataclasses import astuple, dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from models.network.sizes import MultiplyAdds, SegmenterConfig, multiply_adds
from models.policies.policies import GLANCING_POLICIES, score_multiply_adds
from models.reading.regions import Region, plan_regions
from pipeline.geometry.grid import SceneGrid
from storage.arrays.layout import SHARD_COLUMNS, SHARD_ROWS

SHARD = (SHARD_ROWS, SHARD_COLUMNS)  # of what is written at once: regions hold whole ones


@dataclass(frozen=True)
class ReadingCosts:
    """What it takes to read one field by one network, region by region as surveys do."""

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

        Stages keep nothing of the model for each other, so that each reads the coarse pass anew: ``coarse_prediction``
        holds what map and scores took for it.
        """
        drawn = self.of_map(patch_index)
        readings = 2 if policy in GLANCING_POLICIES else 1
        score = sum(score_multiply_adds(policy, self.config, region.grid) for region in self._regions)
        return replace(drawn, coarse_prediction=readings * drawn.coarse_prediction, score=score)
