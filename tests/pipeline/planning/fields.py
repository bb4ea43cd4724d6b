"""Fields of patches that strips show whole, for what plans over them have to hold."""

from __future__ import annotations

import numpy as np

from pipeline.errors import PoseError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import Axis, CostModel, Sweep
from pipeline.planning.coverage import full_sweeps
from pipeline.planning.fine_pass import FinePlan, plan_fine
from pipeline.planning.prices import ScanPrices
from pipeline.planning.scan_runs import Field
from pipeline.planning.swaths import Views


def blocks(expected_gain: np.ndarray, most: int, prices: ScanPrices, lines: int) -> Field:
    """A field of (row, column) patches of ``lines`` lines, seen ``most`` columns at a time from every offset."""
    rows, columns = expected_gain.shape
    swaths = range(max(columns - most, 0) + 1)
    seen = [np.argwhere(expected_gain[:, s : s + most] > 0) + np.array([0, s]) for s in swaths]
    row, column = np.concatenate(seen).T
    sweeps = tuple(Sweep(f"fine-{s:03d}", "fine", "x", float(s), 0.0, rows * lines) for s in swaths)
    edges = np.cumsum([0, *map(len, seen)])
    views = Views(sweeps, rows * lines, edges, row * columns + column, row * lines, (row + 1) * lines)
    return Field(views, expected_gain.ravel(), np.tile(np.arange(columns), rows), prices)


def planned(
    grid: SceneGrid, camera: LineCamera, cost: CostModel, along: Axis, scores: np.ndarray, *, budget_s: float
) -> FinePlan:
    """The fine plan beside the full scan of the field, or beside one without end where that is out of reach."""
    try:
        full = full_sweeps(grid, camera, along)
    except PoseError:
        full = [Sweep("full-0", "fine", along, 0.0, 0.0, 10**8)]
    return plan_fine(grid, camera, cost, along, scores, budget_s=budget_s, full=full)


def drawn(rows: int, columns: int, seed: int) -> np.ndarray:
    """Worth with a few strong patches, one in four worth nothing."""
    rng = np.random.default_rng(seed)
    return rng.exponential(size=(rows, columns)) ** 2 * (rng.random((rows, columns)) > 0.25)
