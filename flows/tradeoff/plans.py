"""The trade-off of the whole: what a map is worth against the camera's seconds, for plain scans and for two passes.

Parts of a scan take the seconds of all of it, and less of the network's multiply-adds, which stand beside.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flows.settings.load import CHEAP_POLICY
from flows.tasks.reading_costs import ReadingCosts
from flows.tasks.seat_budget import SeatBudget
from flows.tasks.stages.accuracy import columns_of_all_seats
from flows.tasks.survey_model import PLAIN_STEPS, shipped_weights
from flows.tradeoff.entries import Setting, Tradeoff, register_all
from models.evaluation.metrics import confusion, mean_iou
from models.network.sizes import multiply_adds
from models.policies.policies import score_seats
from models.reading.inference import DrawnMap, Glance, glance, glance_of_columns, segment
from models.weights.files import Weights, load_weights
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import Axis, CostModel, Sweep
from pipeline.planning.coverage import cheapest_full, coarse_sweeps, plain_sweeps
from pipeline.planning.fine_pass import plan_fine
from pipeline.planning.plain_scans import scan_words
from pipeline.planning.prices import raw_bytes
from pipeline.rectify.region import mosaic_rows
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scenes.farm.farm_scene import farm_scene
from pipeline.simulator.simulated import SimulatedSource, SimulatedSweep

SHAPE = (384, 512)
SCANS = {scan_words(step, ms): (step, ms) for step in (1, 2, 4) for ms in (100.0, 50.0, 25.0, 12.0, 6.0)}
BUDGETS = {f"two passes, budget {budget:g}": budget for budget in (0.8, 0.65, 0.5, 0.4)}
PART_OF = (1, 25.0)  # step and exposure [ms] of the scan of which parts are read in detail
PARTS = {f"{scan_words(*PART_OF)} in part, {share} of the multiply-adds": share for share in ("50%", "35%", "25%")}
MEMORY = 2**30  # bytes that rectifying may take
Columns = NDArray[np.float32]


@dataclass(frozen=True)
class PlannedLook:
    """What a plan showed of the field: the coarse look, seats with their columns, and what it cost."""

    seen: Glance
    seats: NDArray[np.intp]
    columns: Columns  # (seat, p, p, column)
    seconds: float
    bytes_raw: int
    weights: Weights  # that read it


@dataclass(frozen=True)
class PlannedField:
    """A farm that training never saw, by every plan."""

    labels: NDArray[np.uint8]
    bands: int
    looks: Mapping[Setting, PlannedLook]


def plain_look(
    weights: Weights, source: SimulatedSource, sweeps: list[Sweep], grid: SceneGrid, cost: CostModel
) -> PlannedLook:
    """A plain scan read whole; its coarse look are the means of its own pixels, on a field of whole cells."""
    columns = columns_of_all_seats(source, sweeps, grid, weights, memory=MEMORY, kernel="catmull-rom")
    down, across = grid.seat_shape
    p, s, camera = grid.patch, grid.factor, source.camera
    cells = columns.reshape(down, across, p // s, s, p // s, s, -1).mean(axis=(3, 5), dtype=np.float32)
    small = cells.swapaxes(1, 2).reshape(down * p // s, across * p // s, -1)
    seats, size = grid.valid_seats(), raw_bytes(sweeps, camera, len(source.wavelength_nm))
    return PlannedLook(
        glance_of_columns(weights, small, grid), seats, columns[seats], cost.seconds(sweeps, camera), size, weights
    )


def part_of(look: PlannedLook, bands: int, compute: str) -> PlannedLook:
    """The same scan with the seats alone that edges promise most of, for a share of the multiply-adds."""
    costs = ReadingCosts(look.weights.config, look.seen.grid, bands)
    budget = SeatBudget(costs, look.seats, CHEAP_POLICY, compute)
    kept = np.sort(budget.choose(score_seats(CHEAP_POLICY, look.seen)))
    return replace(look, seats=kept, columns=look.columns[np.searchsorted(look.seats, kept)])


def _prepare(seed: int) -> PlannedField:
    camera, cost = LineCamera(), CostModel()
    scene = farm_scene(seed, SHAPE, camera=camera)
    weights, of_scans = load_weights(shipped_weights()), load_weights(shipped_weights(plain=True))
    grid, finer = (SceneGrid(*SHAPE, read.config.patch, read.config.factor) for read in (weights, of_scans))
    source, bands = SimulatedSource(scene, Rig(camera), seed), len(scene.wavelength_nm)
    along, full, full_s = cheapest_full(grid, camera, cost)
    looks: dict[Setting, PlannedLook] = {}
    for words, (step, exposure_ms) in SCANS.items():
        read_with, on = (of_scans, finer) if step in PLAIN_STEPS else (weights, grid)
        looks[words] = plain_look(read_with, source, _sweeps_of(on, camera, along, step, exposure_ms), on, cost)
    whole = looks[scan_words(*PART_OF)]
    looks |= {words: part_of(whole, bands, share) for words, share in PARTS.items()}
    coarse = coarse_sweeps(grid, camera, along)
    every = plain_look(weights, source, _sweeps_of(grid, camera, along, 1, camera.exposure_ms), grid, cost)
    rows = mosaic_rows([SimulatedSweep(source, sweep) for sweep in coarse], camera, grid, rows=64)
    seen = glance(weights, np.concatenate([values for _, values, _ in rows]), scene.wavelength_nm, grid)
    coarse_s, scores = cost.seconds(coarse, camera), score_seats("gain", seen)
    for words, budget in BUDGETS.items():
        plan = plan_fine(grid, camera, cost, along, scores, budget_s=budget * full_s - coarse_s, full=full)
        columns = every.columns[np.searchsorted(every.seats, plan.seats)]
        size = raw_bytes([*coarse, *plan.sweeps], camera, bands)
        looks[words] = PlannedLook(seen, plan.seats, columns, coarse_s + plan.seconds, size, weights)
    return PlannedField(np.asarray(scene.labels, np.uint8), bands, looks)


def _sweeps_of(grid: SceneGrid, camera: LineCamera, along: Axis, step: int, exposure_ms: float) -> list[Sweep]:
    return plain_sweeps(grid, camera, along, step=step, exposure_ms=exposure_ms)


def _read(field: PlannedField, plan: Setting) -> DrawnMap:
    look = field.looks[plan]
    return segment(look.weights, look.seen, look.columns, look.seats)


def _miss(field: PlannedField, plan: Setting, drawn: DrawnMap) -> float:
    return 1 - mean_iou(confusion(field.labels, drawn.classes, field.looks[plan].weights.config.classes))


def _billion_operations(field: PlannedField, plan: Setting, _drawn: DrawnMap) -> float:
    look = field.looks[plan]
    return multiply_adds(look.weights.config, look.seen.grid, len(look.seats), field.bands).total / 1e9


PLAN = Tradeoff(
    stage="survey",
    knob="plan",
    error="1 - mIoU",
    unit="scene px",
    reference=f"labels of a farm of {SHAPE[1]} x {SHAPE[0]} px; two passes by policy gain, parts by edges",
    settings=(*SCANS, *PARTS, *BUDGETS),
    prepare=_prepare,
    run=_read,
    judge=_miss,
    work=lambda field, _plan: float(field.labels.size),
    families=True,
    modelled_s=lambda field, plan, _drawn: field.looks[plan].seconds,
    beside={
        "MB raw": lambda field, plan, _drawn: field.looks[plan].bytes_raw / 1e6,
        "billion multiply-adds": _billion_operations,
    },
)
register_all(PLAN)
