"""What the camera takes for the seats of an evaluation [s]: each seat by itself, and by the rig's runs of lines."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from flows.evaluate.frames import Look
from flows.evaluate.rows import Trial, fine_samples, placings, wanted_rows
from models.weights.files import Weights
from pipeline.errors import PoseError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import CostModel
from pipeline.planning.coverage import cheapest_full, coarse_sweeps
from pipeline.planning.fine_pass import price_of_seats


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
