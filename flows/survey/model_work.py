"""Multiply-adds of a survey's model as its stages compute them, one region of the field after the other."""

from __future__ import annotations

from dataclasses import astuple, replace

import numpy as np
from numpy.typing import NDArray

from flows.survey.field_work import SHARD
from flows.survey.run import SurveyRun
from models.network.cost import MultiplyAdds, multiply_adds
from models.policies.policies import IMAGE_POLICIES, NETWORK_POLICIES, SEEING_POLICIES
from models.reading.regions import Region, plan_regions, whole_field


def work_done(run: SurveyRun, seats: NDArray[np.integer]) -> MultiplyAdds:
    """Count the scores of the field, and the map drawn with fine patches at these seats.

    Stages keep nothing of the model for each other, so that each reads the coarse look anew: ``glance`` holds what map
    and scores took for it.
    """
    policy, regions = run.settings.policy, plan_regions(run.grid, SHARD)
    drawn = work_of_map(run, seats)
    looks = 2 if policy in SEEING_POLICIES and policy not in NETWORK_POLICIES else 1
    scored = [whole_field(run.grid)] if policy in IMAGE_POLICIES else regions
    score = sum(_of_region(run, region, 0, policy).score for region in scored)
    return replace(drawn, glance=looks * drawn.glance, score=score)


def work_of_map(run: SurveyRun, seats: NDArray[np.integer]) -> MultiplyAdds:
    """Count the map drawn with fine patches at these seats of the field."""
    regions = plan_regions(run.grid, SHARD)
    parts = [astuple(_of_region(run, region, _count(region, seats), None)) for region in regions]
    return MultiplyAdds(*(sum(part) for part in zip(*parts, strict=True)))


def _count(region: Region, seats: NDArray[np.integer]) -> int:
    return int(np.count_nonzero(region.numbers_here(seats) >= 0))


def _of_region(run: SurveyRun, region: Region, seats: int, policy: str | None) -> MultiplyAdds:
    channels = 3 if run.vgg is None else run.vgg.channels
    bands = len(run.scene.wavelength_nm)
    return multiply_adds(run.described.config, region.grid, seats, bands, policy, channels=channels)
