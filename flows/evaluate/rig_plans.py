"""One frame judged as the rig would survey it: our plan beside lines spent without a model, at equal seconds."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from flows.evaluate.frames import Look
from flows.evaluate.rows import Seats
from models.evaluation.metrics import confusion
from models.evaluation.placement import RANDOM_DRAWS
from models.policies.policies import score_seats
from models.reading.inference import segment
from models.weights.files import Weights
from pipeline.errors import BudgetError, PoseError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import CostModel
from pipeline.planning.coverage import cheapest_full, coarse_sweeps
from pipeline.planning.fine_pass import check_budget, plan_fine
from pipeline.planning.line_blocks import WIDTHS, line_blocks, most_shown
from pipeline.planning.savings import count_lines

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
    """Judge the map of every plan at every budget that pays for the coarse pass; all plans read the same glance.

    ``left_out`` says why a budget is missing: it does not pay for the coarse pass, or the mirror does not reach.
    """
    grid, rows, left_out = look.seen.grid, [], []
    try:
        along, full, full_s = cheapest_full(grid, camera, cost)
        coarse = coarse_sweeps(grid, camera, along)
    except PoseError as error:
        return {"frame": look.name, "rows": [], "left_out": [{"budget": None, "why": str(error)}]}
    coarse_s = cost.seconds(coarse, camera)
    spends = _plans(look, camera, cost, seed)
    for number, budget in enumerate(BUDGETS):
        try:
            fine_s = check_budget(budget, coarse_s, full_s)
        except BudgetError as error:
            left_out.append({"budget": budget, "why": str(error)})
            continue
        for at, (plan, draw, spend) in enumerate(spends):
            seats, seconds, lines = spend(fine_s)
            drawn = segment(weights, look.seen, look.fine[seats], seats).classes
            counts = confusion(look.labels, drawn, weights.config.classes)
            rows.append(
                {
                    "policy": plan,
                    "share": budget,
                    "draw": draw,
                    "seats": len(seats),
                    "seconds": coarse_s + seconds,
                    "full_s": full_s,
                    "lines": count_lines(coarse) + lines,
                    "full_lines": count_lines(full),
                    "counts": counts.tolist(),
                }
            )
            report((number + (at + 1) / len(spends)) / len(BUDGETS))
    return {"frame": look.name, "rows": rows, "left_out": left_out}


def _plans(look: Look, camera: LineCamera, cost: CostModel, seed: int) -> list[tuple[str, int, Spend]]:
    """Every way to spend seconds, with its name and draw."""
    grid = look.seen.grid
    along = cheapest_full(grid, camera, cost)[0]
    options = [line_blocks(grid, camera, cost, along, rows) for rows in WIDTHS]

    def ours(policy: str) -> Spend:
        scores = score_seats(policy, look.seen, seed=seed)

        def spend(seconds: float) -> tuple[Seats, float, int]:
            plan = plan_fine(grid, camera, cost, along, scores, budget_s=seconds)
            return plan.seats, plan.seconds, plan.lines

        return spend

    def without_a_model(draw: int | None) -> Spend:
        """Blocks of lines evenly spread, or placed by a draw."""

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
