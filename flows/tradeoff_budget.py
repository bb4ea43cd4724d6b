"""Trade-off of the patch budget: capture seconds of coarse and fine sweeps against the error of the map."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flows.full_look import columns_of_all_seats
from flows.run import SHIPPED
from flows.tradeoff import Setting, Tradeoff, register
from models.inference import ClassMap, Glance, glance, segment
from models.metrics import confusion, mean_iou
from models.policies import score_seats
from models.weights import Weights, load_weights
from pipeline.camera import LineCamera
from pipeline.coverage import cheapest_full, coarse_sweeps
from pipeline.grid import SceneGrid
from pipeline.planning import FinePlan, plan_fine
from pipeline.rectify.region import mosaic_rows
from pipeline.scan import Axis, CostModel
from pipeline.simulator.farm import farm_scene
from pipeline.simulator.simulated import SimulatedSource, SimulatedSweep

SHAPE = (768, 960)
BUDGETS = (1.0, 0.8, 0.65, 0.5, 0.4, 0.33)


@dataclass(frozen=True)
class Field:
    """A farm seen coarsely and, for whatever the plan will ask, finely."""

    weights: Weights
    grid: SceneGrid
    camera: LineCamera
    along: Axis
    coarse_s: float
    full_s: float
    seen: Glance
    columns: NDArray[np.float32]  # (seat, p, p, column) of every seat
    labels: NDArray[np.uint8]


@dataclass(frozen=True)
class Surveyed:
    """The map at one budget and what was captured for it."""

    plan: FinePlan
    drawn: ClassMap


def _prepare(seed: int) -> Field:
    weights = load_weights(Path(str(resources.files("models") / "shipped" / SHIPPED)))
    camera, scene = LineCamera(), farm_scene(seed, shape=SHAPE)
    grid = SceneGrid(*SHAPE, weights.config.patch, weights.config.factor)
    source = SimulatedSource(scene, camera, seed)
    along, full, full_s = cheapest_full(grid, camera, CostModel())
    coarse = coarse_sweeps(grid, camera, along)
    rows = mosaic_rows([SimulatedSweep(source, sweep) for sweep in coarse], camera, grid, rows=64)
    mosaic = np.concatenate([values for _, values, _ in rows])
    columns = columns_of_all_seats(source, full, grid, weights, memory=2**31, kernel="catmull-rom")
    seen = glance(weights, mosaic, scene.wavelength_nm, grid)
    labels = np.asarray(scene.labels)
    return Field(weights, grid, camera, along, CostModel().seconds(coarse, camera), full_s, seen, columns, labels)


def _run(state: Field, budget: Setting) -> Surveyed:
    scores = score_seats("entropy", state.seen)
    left = max(float(budget) * state.full_s - state.coarse_s, 0.0)
    plan = plan_fine(state.grid, state.camera, CostModel(), state.along, scores, budget_s=left)
    return Surveyed(plan, segment(state.weights, state.seen, state.columns[plan.seats], plan.seats))


def _judge(state: Field, _budget: Setting, made: Surveyed) -> float:
    return 1 - mean_iou(confusion(state.labels, made.drawn.classes, state.weights.config.classes))


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
        work=lambda state, _budget: float(state.labels.size),
        modelled_s=lambda state, _budget, made: state.coarse_s + made.plan.seconds,
    )
)
