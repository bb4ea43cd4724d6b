"""What a row costs: samples, bytes, multiply-adds, seconds of the processor, seconds of capture.

Each is the mean over frames and stands beside the baseline's, capture beside a full scan. The processor's seconds are
of one thread: glance, scores and map, and the map of every control. All parts go in turn, round after round, so that
whatever slows the machine meets them alike.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flows.evaluate.frames import Look, Sight
from flows.evaluate.rows import (
    BUYS_SEATS,
    POLICY,
    Trial,
    control_shares,
    fine_samples,
    is_pooled,
    own_policy,
    placings,
    score_by_image,
    seats_of_control,
    wanted_rows,
)
from flows.evaluate.series import Record, Row, mean_or_none
from models.network.machine import one_thread
from models.policies.policies import score_seats
from models.reading.control_maps import draw_with_control
from models.reading.inference import CoarseLook, glance_of_columns, segment
from models.weights.files import AnyWeights, Weights
from pipeline.errors import PoseError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import CostModel
from pipeline.planning.coverage import cheapest_full, coarse_sweeps
from pipeline.planning.fine_pass import price_of_seats
from pipeline.planning.selection import frame_seats

Part = tuple[str, str]  # what it is, and of which policy, share or control
Works = dict[Part, Callable[[], object]]


def time_frame(
    trial: Trial, look: Look, weights: Weights, rounds: int, controls: Sequence[tuple[Sight, AnyWeights]] = ()
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


def cpu_seconds(works: Mapping[Part, Callable[[], object]], rounds: int, *, warm_up: int = 3) -> dict[Part, float]:
    """Median CPU time of the process that each part takes over so many rounds, after some that do not count [s]."""
    taken: dict[Part, list[float]] = {part: [] for part in works}
    for number in range(warm_up + rounds):
        for part, work in works.items():
            start = time.process_time()
            work()
            if number >= warm_up:
                taken[part].append(time.process_time() - start)
    return {part: statistics.median(seconds) for part, seconds in taken.items()}


def row_seconds(timed: dict[str, Any], policy: str, share: float) -> float | None:
    """Seconds of a row's glance, scores and map, None where not timed; `none`, `all` and controls are the map alone."""
    own = timed["control"].get(f"{policy} {share:g}")
    if own is not None:
        return float(own)
    segment_s = timed["segment"].get(f"{share:g}")
    if segment_s is None or policy in ("none", "all"):
        return None if segment_s is None else float(segment_s)
    if policy not in timed["score"] and policy != "oracle":
        return None
    return float(timed["glance"]) + float(timed["score"].get(policy, 0.0)) + float(segment_s)


ADDS = ("glance", "score", "encode", "decode")


@dataclass(frozen=True)
class Prices:
    """Records of `time_frame` and of `capture_seconds`."""

    timed: Sequence[Record] = ()
    captured: Sequence[Record] = ()


def row_cost(row: Row, base: Row, prices: Prices) -> dict[str, Any]:
    """Give the columns. Frame seconds: as if each seat took its share of the full scan; rig seconds: runs of lines."""

    def counted(part: str) -> Record:
        return _entry(*(mean_or_none([one[part] for one in some.parts]) for some in (row, base)))

    def seconds(some: Row) -> float | None:
        return mean_or_none([row_seconds(one, own_policy(some.policy), some.share) for one in prices.timed])

    full_s = mean_or_none([one["full"] for one in prices.captured])
    adds = {part: mean_or_none([one["adds"][part] for one in row.parts]) for part in ADDS}
    return {
        "samples": counted("samples"),
        "bytes": counted("bytes"),
        "multiply_adds": {**counted("multiply_adds"), **adds},
        "cpu_s": _entry(seconds(row), seconds(base)),
        "frame_s": _entry(_captured(row, prices.captured, "frame_s"), full_s),
        "rig_s": _entry(_captured(row, prices.captured, "rig_s"), full_s),
        "fine_lines": _captured(row, prices.captured, "lines"),
    }


def _entry(done: float | None, full: float | None) -> Record:
    return {"done": done, "full": full, "ratio": done / full if done is not None and full else None}


def _captured(row: Row, captured: Sequence[Record], what: str) -> float | None:
    """Mean over frames; `all` and the dense control are a full scan without a coarse pass, `none` that pass alone."""
    if row.policy in ("none", "all", "dense", "upsampled"):
        key = "full" if row.policy in ("all", "dense") else "none"
        return None if what == "lines" else mean_or_none([one[key] for one in captured])
    if is_pooled(row.policy) and what != "frame_s":  # its lines on these few frames say little of all of them
        return None
    bought_by = POLICY if row.policy == BUYS_SEATS else own_policy(row.policy)
    found = [
        part for one in captured for part in one["rows"] if (part["policy"], part["share"]) == (bought_by, row.share)
    ]
    return mean_or_none([part[what] for part in found])


def capture_seconds(
    trial: Trial, look: Look, weights: Weights, camera: LineCamera, cost: CostModel
) -> dict[str, Any] | None:
    """Price the seats of every row by the cost model, coarse pass included, beside a full scan without one.

    ``frame_s``: as if each seat took its share of the full scan. ``rig_s``: the same seats by runs of lines, or the
    full scan after the coarse pass where that is cheaper. None where the field is beyond the mirror's range.
    """
    grid = look.seen.grid
    try:
        along, _, full_s = cheapest_full(grid, camera, cost)
        coarse_s = cost.seconds(coarse_sweeps(grid, camera, along), camera)
        found = []
        for policy, draw, share, seats in wanted_rows(trial, placings(trial, look, weights), look):
            if draw or policy in ("none", "all"):
                continue
            lines, seconds = price_of_seats(grid, camera, cost, along, seats).least if len(seats) else (0, 0.0)
            frame_s = coarse_s + full_s * fine_samples(look, seats) / (grid.height * grid.width)
            found.append(
                {"policy": policy, "share": share, "lines": lines, "rig_s": coarse_s + seconds, "frame_s": frame_s}
            )
    except PoseError:
        return None
    return {"frame": look.name, "none": coarse_s, "full": full_s, "rows": found}


def plan_seconds(look: Look, camera: LineCamera, cost: CostModel, seats: NDArray[np.integer]) -> tuple[float, float]:
    """Seconds of coarse pass and seats by runs of lines, and of a full scan; PoseError beyond the mirror's range."""
    grid = look.seen.grid
    along, _, full_s = cheapest_full(grid, camera, cost)
    coarse_s = cost.seconds(coarse_sweeps(grid, camera, along), camera)
    return coarse_s + (price_of_seats(grid, camera, cost, along, seats).least[1] if len(seats) else 0.0), full_s
