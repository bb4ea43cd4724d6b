"""What reading a frame costs the processor on one thread: glance, scores and map, and the map of every control.

All parts go in turn, round after round, so that whatever slows the machine meets them alike; ratios are of one run.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from flows.evaluate.controls import BUYS_SEATS, control_shares, score_by_image, seats_of_control
from flows.evaluate.frames import Look, Sight
from flows.evaluate.rows import Trial
from models.network.process import one_thread
from models.policies.policies import score_seats
from models.reading.control_maps import draw_with_control
from models.reading.inference import CoarseLook, glance_of_columns, segment
from models.weights.files import AnyWeights, Weights
from pipeline.planning.selection import frame_seats

Part = tuple[str, str]  # what it is, and of which policy, share or control
Works = dict[Part, Callable[[], object]]


@dataclass(frozen=True)
class Rounds:
    """How often each part is timed, after so many rounds that are not counted."""

    counted: int = 10
    warm_up: int = 3


def time_frame(
    trial: Trial, look: Look, weights: Weights, rounds: Rounds, controls: Sequence[tuple[Sight, AnyWeights]] = ()
) -> dict[str, Any]:
    """CPU seconds of a frame from its spectral columns: glance, each policy's scores, the map at each share.

    The map at a share goes on from the glance. `none` and `all` need neither glance nor scores: they read the coarse
    pass for themselves, and that is their fastest path. A control's map has its own policy's scores in it.
    """
    with one_thread():
        works = _own_works(trial, look, weights)
        for sight, control in controls:
            works |= _control_works(trial, sight, control)
        taken = cpu_seconds(works, rounds)
    found: dict[str, Any] = {"frame": look.name, "glance": taken["glance", ""]}
    for kind in ("score", "segment", "control"):
        found[kind] = {name: seconds for (what, name), seconds in taken.items() if what == kind}
    return found


def _own_works(trial: Trial, look: Look, weights: Weights) -> Works:
    seen, grid = look.seen, look.seen.grid
    alone = CoarseLook(grid, seen.columns)
    valid = grid.valid_share().ravel() > 0
    scores = score_seats("random", seen, seed=trial.seed)
    works: Works = {("glance", ""): lambda: glance_of_columns(weights, seen.columns, grid)}
    for policy in trial.policies:
        works["score", policy] = lambda name=policy: score_seats(name, seen, seed=trial.seed)  # type: ignore[misc]
    for share in (0.0, *trial.shares, 1.0):
        seats = frame_seats(scores, share, valid).seats
        fine, read = np.ascontiguousarray(look.fine[seats]), seen if 0 < share < 1 else alone
        works["segment", f"{share:g}"] = lambda f=fine, s=seats, r=read: segment(weights, r, f, s)  # type: ignore[misc]
    return works


def _control_works(trial: Trial, sight: Sight, weights: AnyWeights) -> Works:
    works: Works = {}
    design = weights.config.preset
    for share in control_shares(design, trial.shares):
        seats = seats_of_control(sight, design, share)
        fine = np.ascontiguousarray(sight.fine[seats])

        def draw(fine: Any = fine, seats: Any = seats) -> None:
            if design == BUYS_SEATS:
                score_by_image(sight)
            draw_with_control(weights, sight.seen, fine, seats)

        works["control", f"{design} {share:g}"] = draw
    return works


def cpu_seconds(works: Mapping[Part, Callable[[], object]], rounds: Rounds) -> dict[Part, float]:
    """Median CPU time of the process that each part takes, all parts in turn in every round [s]."""
    taken: dict[Part, list[float]] = {part: [] for part in works}
    for number in range(rounds.warm_up + rounds.counted):
        for part, work in works.items():
            start = time.process_time()
            work()
            if number >= rounds.warm_up:
                taken[part].append(time.process_time() - start)
    return {part: statistics.median(seconds) for part, seconds in taken.items()}


def row_seconds(timed: dict[str, Any], policy: str, share: float) -> float | None:
    """Glance, scores and map of a row [s]; None where it was not timed.

    `none`, `all` and a control are the map alone; the oracle's scores cost nothing.
    """
    own = timed["control"].get(f"{policy} {share:g}")
    if own is not None:
        return float(own)
    segment_s = timed["segment"].get(f"{share:g}")
    if segment_s is None or policy in ("none", "all"):
        return None if segment_s is None else float(segment_s)
    if policy not in timed["score"] and policy != "oracle":
        return None
    return float(timed["glance"]) + float(timed["score"].get(policy, 0.0)) + float(segment_s)
