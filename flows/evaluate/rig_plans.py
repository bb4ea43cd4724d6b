"""One frame judged as the rig would survey it: plans of lines at equal seconds, and rows at equal time.

A plan that is done early may expose for longer. At equal time the exposure changes until coarse pass and lines take
what the full scan takes at the usual exposure; the light then clips at the same full well.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from flows.evaluate.costs import plan_seconds
from flows.evaluate.frames import Look, look_at
from flows.evaluate.rows import Seats, Trial
from models.evaluation.metrics import confusion
from models.evaluation.placement import RANDOM_DRAWS
from models.policies.policies import score_seats
from models.reading.inference import segment
from models.weights.files import Weights
from pipeline.errors import BudgetError, PoseError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import Axis, CostModel
from pipeline.planning.coverage import cheapest_full, coarse_sweeps
from pipeline.planning.fine_pass import plan_fine
from pipeline.planning.line_blocks import WIDTHS, line_blocks, most_shown
from pipeline.planning.prices import check_budget, count_lines
from pipeline.planning.selection import frame_seats
from pipeline.simulator.scenes.scene import RasterScene

BUDGETS = (0.35, 0.4, 0.5, 0.65, 0.8)  # of the full scan's seconds, coarse pass included
PLANNED = ("gain", "entropy")
UNIFORM, RANDOM = "uniform lines", "random lines"
Spend = Callable[[float], tuple[Seats, float, int]]  # seconds of the fine pass -> seats, seconds, lines


def judge_rig(
    look: Look,
    weights: Weights,
    camera: LineCamera,
    cost: CostModel,
    seed: int,
    report: Callable[[float], None] = lambda done: None,
) -> dict[str, Any]:
    """Judge each plan at each budget by one glance; ``left_out``: which budgets do not pay, or what is out of reach."""
    grid, rows, left_out = look.seen.grid, [], []
    try:
        along, full, full_s = cheapest_full(grid, camera, cost)
        coarse = coarse_sweeps(grid, camera, along)
    except PoseError as error:
        return {"frame": look.name, "rows": [], "left_out": [{"budget": None, "why": str(error)}]}
    coarse_s = cost.seconds(coarse, camera)
    spends = _plans(look, camera, cost, along, seed)
    for number, budget in enumerate(BUDGETS):
        try:
            fine_s = check_budget(budget, coarse_s, full_s)
        except BudgetError as error:
            left_out.append({"budget": budget, "why": str(error)})
            continue
        for at, (plan, draw, spend) in enumerate(spends):
            seats, seconds, lines = spend(fine_s)
            row = {"policy": plan, "share": budget, "seconds": coarse_s + seconds, "full_s": full_s}
            row |= {"lines": count_lines(coarse) + lines, "full_lines": count_lines(full)}
            rows.append(row | _judged(look, weights, seats) | {"draw": draw})
            report((number + (at + 1) / len(spends)) / len(BUDGETS))
    return {"frame": look.name, "rows": rows, "left_out": left_out}


def _plans(look: Look, camera: LineCamera, cost: CostModel, along: Axis, seed: int) -> list[tuple[str, int, Spend]]:
    grid = look.seen.grid
    options = [line_blocks(grid, camera, cost, along, rows) for rows in WIDTHS]

    def ours(policy: str) -> Spend:
        scores = score_seats(policy, look.seen, seed=seed)

        def spend(seconds: float) -> tuple[Seats, float, int]:
            plan = plan_fine(grid, camera, cost, along, scores, budget_s=seconds)
            return plan.seats, plan.seconds, plan.lines

        return spend

    def without_a_model(draw: int | None) -> Spend:
        """What shows the most of those lines that lie evenly, or by chance where a draw is numbered."""

        def spend(seconds: float) -> tuple[Seats, float, int]:
            if draw is None:
                lines = most_shown(options, lambda blocks: blocks.evenly(seconds))
            else:
                seeds = [seed, 0xB10C, draw]
                lines = most_shown(options, lambda blocks: blocks.at_random(seconds, np.random.default_rng(seeds)))
            return lines.seats, cost.seconds(lines.sweeps, camera), count_lines(lines.sweeps)

        return spend

    found = [(policy, 0, ours(policy)) for policy in PLANNED]
    found.append((UNIFORM, 0, without_a_model(None)))
    return [*found, *((RANDOM, draw, without_a_model(draw)) for draw in range(RANDOM_DRAWS))]


ROUNDS = 3  # set-ups do not grow with the exposure, so that one step falls short; three settle it


def judge_equal_time(
    trial: Trial,
    scene: RasterScene,
    look: Look,
    weights: Weights,
    camera: LineCamera,
    cost: CostModel,
    report: Callable[[float], None] = lambda done: None,
) -> dict[str, Any] | None:
    """Judge each policy at each share, and plans of lines, with the exposure of equal time; None beyond the mirror.

    Glance, scores and seats are those of the longer exposure. Of random placements the first draw stands for all. Where
    the rig takes longer for the seats than for the full scan, the exposure is shorter.
    """
    wanted = [(policy, share) for policy in trial.policies for share in trial.shares]
    rows = []
    try:
        full_s = plan_seconds(look, camera, cost, np.empty(0, np.intp))[1]
        for number, (policy, share) in enumerate(wanted):
            exposed = camera_of_equal_time(look, camera, cost, _seats(trial, look, policy, share))
            longer = look_at(scene, look.name, weights, exposed, trial.seed)
            seats = _seats(trial, longer, policy, share)
            seconds = plan_seconds(longer, exposed, cost, seats)[0]
            row = {"policy": policy, "share": share, "seconds": seconds, "full_s": full_s}
            rows.append(row | _judged(longer, weights, seats) | {"exposure": exposed.exposure_ms / camera.exposure_ms})
            report(0.8 * (number + 1) / len(wanted))
        rows += _longer_plans(trial, scene, look, weights, camera, cost, full_s)
    except PoseError:
        return None
    return {"frame": look.name, "rows": rows}


def _longer_plans(
    trial: Trial, scene: RasterScene, look: Look, weights: Weights, camera: LineCamera, cost: CostModel, full_s: float
) -> list[dict[str, Any]]:
    grid = look.seen.grid
    along = cheapest_full(grid, camera, cost)[0]
    coarse = coarse_sweeps(grid, camera, along)
    rows = []
    for budget in BUDGETS:
        exposed = replace(camera, exposure_ms=camera.exposure_ms / budget)
        fine_s = full_s - cost.seconds(coarse, exposed)
        if fine_s < 0:
            continue
        longer = look_at(scene, look.name, weights, exposed, trial.seed)
        for policy in (name for name in PLANNED if name in trial.policies):
            plan = plan_fine(grid, exposed, cost, along, score_seats(policy, longer.seen), budget_s=fine_s)
            seconds = full_s - fine_s + plan.seconds
            row = {"policy": plan_name(policy), "share": budget, "seconds": seconds, "full_s": full_s}
            rows.append(row | _judged(longer, weights, plan.seats) | {"exposure": 1 / budget})
    return rows


def plan_name(policy: str) -> str:
    """What a policy's plan of lines is called beside its seats."""
    return f"{policy} lines"


def _judged(look: Look, weights: Weights, seats: Seats) -> dict[str, Any]:
    drawn = segment(weights, look.seen, look.fine[seats], seats).classes
    counts = confusion(look.labels, drawn, weights.config.classes)
    return {"draw": 0, "seats": len(seats), "counts": counts.tolist()}


def camera_of_equal_time(look: Look, camera: LineCamera, cost: CostModel, seats: Seats) -> LineCamera:
    """The camera whose exposure lets coarse pass and seats take a full scan's seconds (PoseError beyond the mirror)."""
    exposed = camera
    for _ in range(ROUNDS):
        seconds = plan_seconds(look, exposed, cost, seats)[0]
        full_s = plan_seconds(look, camera, cost, seats[:0])[1]
        exposed = replace(exposed, exposure_ms=exposed.exposure_ms * full_s / seconds)
    return exposed


def _seats(trial: Trial, look: Look, policy: str, share: float) -> Seats:
    valid = look.seen.grid.valid_share().ravel() > 0
    return frame_seats(score_seats(policy, look.seen, seed=trial.seed + 1000), share, valid).seats
