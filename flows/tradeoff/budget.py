"""Trade-off of the patch budget: capture seconds of coarse and fine sweeps against the error of the map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flows.survey.full_look import columns_of_all_seats
from flows.tradeoff.entries import Setting, Tradeoff, register
from flows.tradeoff.farm import FarmLook, look_at_farm
from models.evaluation.metrics import confusion, mean_iou
from models.policies.policies import score_seats
from models.reading.inference import DrawnMap, Glance, glance, segment
from pipeline.geometry.scan import CostModel
from pipeline.planning.fine_pass import FinePlan, plan_fine

SHAPE = (768, 960)
BUDGETS = (1.0, 0.8, 0.65, 0.5, 0.4, 0.33)


@dataclass(frozen=True)
class FarmToSpendOn:
    """A farm seen coarsely and, for whatever the plan will ask, finely."""

    farm: FarmLook
    seen: Glance
    columns: NDArray[np.float32]  # (seat, p, p, column) of every seat


@dataclass(frozen=True)
class SpentSurvey:
    """The map at one budget and what was captured for it."""

    plan: FinePlan
    drawn: DrawnMap


def _prepare(seed: int) -> FarmToSpendOn:
    farm = look_at_farm(seed, SHAPE)
    columns = columns_of_all_seats(farm.source, farm.full, farm.grid, farm.weights, memory=2**31, kernel="catmull-rom")
    return FarmToSpendOn(farm, glance(farm.weights, farm.mosaic, farm.scene.wavelength_nm, farm.grid), columns)


def _run(state: FarmToSpendOn, budget: Setting) -> SpentSurvey:
    farm, scores = state.farm, score_seats("entropy", state.seen)
    left = max(float(budget) * farm.full_s - farm.coarse_s, 0.0)
    plan = plan_fine(farm.grid, farm.source.camera, CostModel(), farm.along, scores, budget_s=left)
    return SpentSurvey(plan, segment(farm.weights, state.seen, state.columns[plan.seats], plan.seats))


def _judge(state: FarmToSpendOn, _budget: Setting, made: SpentSurvey) -> float:
    return 1 - mean_iou(confusion(state.farm.labels, made.drawn.classes, state.farm.weights.config.classes))


BUDGET = register(
    Tradeoff(
        stage="plan",
        knob="budget",
        error="1 - mIoU",
        unit="scene px",
        reference=f"labels of a farm of {SHAPE[1]} x {SHAPE[0]} px; policy entropy, line blocks",
        settings=BUDGETS,
        prepare=_prepare,
        run=_run,
        judge=_judge,
        work=lambda state, _budget: float(state.farm.labels.size),
        modelled_s=lambda state, _budget, made: state.farm.coarse_s + made.plan.seconds,
    )
)
