"""Capture planning: free strip offsets against fixed strips, and its time."""

from __future__ import annotations

import time

import numpy as np
from measure import Row
from numpy.typing import NDArray

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import Axis, CostModel
from pipeline.planning.budget_search import spend
from pipeline.planning.coverage import cheapest_full, full_sweeps
from pipeline.planning.fine_pass import plan_fine
from pipeline.planning.partial_scans import every_nth
from pipeline.planning.prices import ScanPrices, check_budget, prices_of
from pipeline.planning.scan_runs import Field
from pipeline.planning.swaths import Views, edges_from, swaths_at_patches

CAMERA, COST = LineCamera(), CostModel()
ExpectedGain = NDArray[np.float64]


def rows() -> list[Row]:
    return [*_farm(), *_speed()]


def _real_field(grid: SceneGrid, along: Axis, expected_gain: ExpectedGain, prices: ScanPrices) -> Field:
    views = edges_from(grid, CAMERA, swaths_at_patches(grid, CAMERA, along), expected_gain > 0)
    return Field(views, expected_gain, _columns(grid, along), prices)


def _columns(grid: SceneGrid, along: Axis) -> NDArray[np.intp]:
    row, column = np.divmod(np.arange(int(np.prod(grid.patch_shape))), grid.patch_shape[1])
    return column if along == "x" else row


def _fixed(field: Field) -> Field:
    """The same field seen from the strips of a full scan alone, each patch from one: the exact optimum per strip."""
    views, swaths = field.views, field.side_by_side.ravel()
    taken: set[int] = set()
    parts = []
    for swath in swaths.tolist():
        own = np.arange(views.edges[swath], views.edges[swath + 1])
        own = own[[patch_number not in taken for patch_number in views.patch_number[own].tolist()]]
        taken |= set(views.patch_number[own].tolist())
        parts.append(own)
    kept = np.concatenate(parts)
    sweeps = tuple(views.swaths[swath] for swath in swaths)
    edges = np.cumsum([0, *map(len, parts)])
    few = Views(sweeps, views.lines, edges, views.patch_number[kept], views.first[kept], views.stop[kept])
    return Field(few, field.expected_gain, field.column, field.prices)


def _smooth(shape: tuple[int, int], *, seed: int, sigma: float) -> ExpectedGain:
    from scipy.ndimage import gaussian_filter

    drawn = gaussian_filter(np.random.default_rng(seed).normal(size=shape), sigma, mode="wrap")
    return np.exp(1.5 * drawn / drawn.std())


def _farm() -> list[Row]:
    """Budget 0.5 on 1280 x 1024 px: worth of free offsets over that of fixed strips."""
    grid = SceneGrid(1024, 1280, 16, 4)
    along, _, full_s = cheapest_full(grid, CAMERA, COST)
    left = check_budget(0.5, COST.seconds(every_nth(full_sweeps(grid, CAMERA, along)), CAMERA), full_s)
    gains, fractions = [], []
    for seed in range(6):
        scores = _smooth(grid.patch_shape, seed=seed, sigma=(1.5, 3.0)[seed % 2]).ravel()
        full = full_sweeps(grid, CAMERA, along)
        plan = plan_fine(grid, CAMERA, COST, along, scores, budget_s=left, full=full)
        fixed = spend(_fixed(_real_field(grid, along, scores, prices_of(CAMERA, COST))), left)
        gains.append(plan.expected_gain / fixed.expected_gain - 1)
        fractions.append(plan.expected_gain / scores.sum())
    text = f"{np.mean(fractions):.1%} of the score; {np.mean(gains):+.1%} over fixed strips (from {min(gains):+.1%})"
    return [Row("farm, budget 0.5, six smooth random score maps", text, "> fixed strips", min(gains) > 0)]


def _speed() -> list[Row]:
    found = []
    for size, patch, goal in (((1024, 1280), 16, 2.0), ((10_240, 10_240), 32, 20.0), ((10_240, 10_240), 320, 20.0)):
        grid = SceneGrid(*size, patch, 4)
        full = full_sweeps(grid, CAMERA, "x")
        full_s = COST.seconds(full, CAMERA)
        scores = _smooth(grid.patch_shape, seed=0, sigma=3.0).ravel()
        began = time.process_time()
        plan = plan_fine(grid, CAMERA, COST, "x", scores, budget_s=0.25 * full_s, full=full)
        took = time.process_time() - began
        what = f"planning {size[1]} x {size[0]} px, {patch} px patches, a quarter of the full scan's seconds"
        figure = f"{took:.2f} s of processor, {len(plan.sweeps)} runs"
        found.append(Row(what, figure, f"< {goal:.0f} s", took < goal))
    return found
