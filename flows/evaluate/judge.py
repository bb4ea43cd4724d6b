"""One frame judged by one set of weights: its map by every policy at each share of the patches, and by plans of lines.

A record holds plain lists and numbers: counts of labels and map, which add up over frames, and what each map costs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flows.evaluate.frames import COST, Look
from models.evaluation.metrics import confusion
from models.evaluation.placement import RANDOM_DRAWS, gain_sums, oracle_gain
from models.network.sizes import multiply_adds
from models.policies.policies import score_multiply_adds, score_seats
from models.reading.inference import segment
from models.weights.files import Weights
from pipeline.errors import BudgetError, PoseError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import Axis
from pipeline.planning.coverage import cheapest_full, coarse_sweeps
from pipeline.planning.fine_pass import plan_fine, price_of_seats
from pipeline.planning.line_blocks import WIDTHS, line_blocks, most_shown
from pipeline.planning.prices import BYTES_PER_SAMPLE, check_budget, count_lines
from pipeline.planning.selection import frame_seats

ORACLE = "oracle"
ENDS = ("none", "all")  # no patch, every patch
BUDGETS = (0.35, 0.4, 0.5, 0.65, 0.8)  # of the full scan's seconds, coarse pass included
PLANNED = ("gain", "entropy")
UNIFORM, RANDOM = "uniform lines", "random lines"
Record = dict[str, Any]
Seats = NDArray[np.intp]
Spend = Callable[[float], tuple[Seats, float, int]]  # seconds of the fine pass -> patches, seconds, lines


@dataclass(frozen=True)
class Trial:
    """Shares of the patches and policies to try on every frame; no patch, every patch and the oracle are always there.

    The oracle chooses by the labels.
    """

    shares: tuple[float, ...]  # of the valid patches, above 0 and below 1
    policies: tuple[str, ...]
    seed: int = 0
    rig: bool = True  # also plans of lines at equal seconds


def judge_frame(trial: Trial, look: Look, weights: Weights, camera: LineCamera) -> Record:
    """Judge the map of every row, with its costs."""
    grid = look.seen.grid
    gain = oracle_gain(weights, look.seen, look.fine, look.labels)
    seconds = _seconds_of_patches(look, camera)
    rows = []
    for policy, draw, share, seats in _placed(trial, look, gain):
        samples = float(np.prod(grid.coarse_shape)) + float(grid.valid_share().ravel()[seats].sum() * grid.patch**2)
        scored = 0 if policy in (*ENDS, ORACLE) else score_multiply_adds(policy, weights.config, grid)
        bought, best = gain_sums(gain, seats, grid.valid_seats())
        row = {
            **{"policy": policy, "draw": draw, "share": share, "seats": len(seats), "gain": bought, "best_gain": best},
            **{"counts": _counts(look, weights, seats), "samples": samples},
            "bytes": samples * look.bands * BYTES_PER_SAMPLE,
            "multiply_adds": multiply_adds(weights.config, grid, len(seats), look.bands, score=scored).total,
        }
        rows.append(row | seconds(policy, seats))
    plans = _judged_plans(trial, look, weights, camera) if trial.rig else []
    return {"frame": look.name, "shape": [grid.height, grid.width], "rows": rows, "plans": plans}


def _placed(trial: Trial, look: Look, gain: NDArray[np.float64]) -> Iterator[tuple[str, int, float, Seats]]:
    """Give (policy, draw, share, patches) of each row; chance is drawn several times."""
    allowed = look.seen.grid.valid_share().ravel() > 0
    yield "none", 0, 0.0, np.empty(0, np.intp)
    yield "all", 0, 1.0, np.flatnonzero(allowed)
    for policy in (*trial.policies, ORACLE):
        for draw in range(RANDOM_DRAWS if policy == "random" else 1):
            seed = trial.seed + 1000 * (draw + 1)
            scores = gain if policy == ORACLE else score_seats(policy, look.seen, seed=seed)
            for share in trial.shares:
                yield policy, draw, share, frame_seats(scores, share, allowed).seats


def _counts(look: Look, weights: Weights, seats: Seats) -> list[list[int]]:
    drawn = segment(weights, look.seen, look.fine[seats], seats).classes
    counts: list[list[int]] = confusion(look.labels, drawn, weights.config.classes).tolist()
    return counts


def _seconds_of_patches(look: Look, camera: LineCamera) -> Callable[[str, Seats], Record]:
    """Price patches by the cost model: coarse pass and runs of lines, or the full scan where that is cheaper.

    All patches are the full scan alone. None of each figure where the field is beyond the mirror's range.
    """
    grid = look.seen.grid
    try:
        along, _, full_s = cheapest_full(grid, camera, COST)
        coarse_s = COST.seconds(coarse_sweeps(grid, camera, along), camera)
    except PoseError:
        return lambda policy, seats: {"capture_s": None, "full_s": None}

    def priced(policy: str, seats: Seats) -> Record:
        seconds = full_s if policy == "all" else coarse_s
        if policy != "all" and len(seats):
            seconds += price_of_seats(grid, camera, COST, along, seats).least[1]
        return {"capture_s": seconds, "full_s": full_s}

    return priced


def _judged_plans(trial: Trial, look: Look, weights: Weights, camera: LineCamera) -> list[Record]:
    """Judge plans of lines at each budget that pays; none where the field is beyond the mirror's range."""
    grid, rows = look.seen.grid, []
    try:
        along, full, full_s = cheapest_full(grid, camera, COST)
        coarse = coarse_sweeps(grid, camera, along)
    except PoseError:
        return []
    coarse_s = COST.seconds(coarse, camera)
    spends = _plans(look, camera, along, trial.seed)
    for budget in BUDGETS:
        try:
            fine_s = check_budget(budget, coarse_s, full_s)
        except BudgetError:
            continue
        for plan, draw, spend in spends:
            seats, seconds, lines = spend(fine_s)
            row = {"policy": plan, "draw": draw, "share": budget, "seats": len(seats)}
            row |= {"capture_s": coarse_s + seconds, "full_s": full_s}
            row |= {"lines": count_lines(coarse) + lines, "full_lines": count_lines(full)}
            rows.append(row | {"counts": _counts(look, weights, seats)})
    return rows


def _plans(look: Look, camera: LineCamera, along: Axis, seed: int) -> list[tuple[str, int, Spend]]:
    """Give our plans and two without a model: lines that lie evenly, and lines by chance, several times."""
    grid = look.seen.grid
    options = [line_blocks(grid, camera, COST, along, rows) for rows in WIDTHS]

    def ours(policy: str) -> Spend:
        scores = score_seats(policy, look.seen, seed=seed)

        def spend(seconds: float) -> tuple[Seats, float, int]:
            plan = plan_fine(grid, camera, COST, along, scores, budget_s=seconds)
            return plan.seats, plan.seconds, plan.lines

        return spend

    def without_a_model(draw: int | None) -> Spend:
        def spend(seconds: float) -> tuple[Seats, float, int]:
            if draw is None:
                lines = most_shown(options, lambda blocks: blocks.evenly(seconds))
            else:
                seeds = [seed, 0xB10C, draw]
                lines = most_shown(options, lambda blocks: blocks.at_random(seconds, np.random.default_rng(seeds)))
            return lines.seats, COST.seconds(lines.sweeps, camera), count_lines(lines.sweeps)

        return spend

    found = [(policy, 0, ours(policy)) for policy in PLANNED]
    found.append((UNIFORM, 0, without_a_model(None)))
    return [*found, *((RANDOM, draw, without_a_model(draw)) for draw in range(RANDOM_DRAWS))]
