"""The five cost columns of a row: samples, bytes, multiply-adds, seconds of the processor, seconds of capture.

Each is the mean over frames and stands beside the baseline's, capture beside a full scan.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flows.evaluate.controls import BUYS_SEATS, POLICY
from flows.evaluate.frames import Look
from flows.evaluate.pooled import is_pooled, own_policy
from flows.evaluate.rows import Trial, fine_samples, placings, wanted_rows
from flows.evaluate.series import Record, Row, mean_or_none
from flows.evaluate.timing import row_seconds
from models.weights.files import Weights
from pipeline.errors import PoseError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import CostModel
from pipeline.planning.coverage import cheapest_full, coarse_sweeps
from pipeline.planning.fine_pass import price_of_seats

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
    """Seconds of the coarse pass and these seats by runs of lines (or the full scan), and of a full scan alone.

    Raises
    ------
    PoseError : the field is beyond the mirror's range.
    """
    grid = look.seen.grid
    along, _, full_s = cheapest_full(grid, camera, cost)
    coarse_s = cost.seconds(coarse_sweeps(grid, camera, along), camera)
    return coarse_s + (price_of_seats(grid, camera, cost, along, seats).least[1] if len(seats) else 0.0), full_s
