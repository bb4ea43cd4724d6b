"""Capture planning: free strip offsets against fixed strips and one sweep per patch."""

from __future__ import annotations

import time

import numpy as np
from measure import Row
from numpy.typing import NDArray

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import Axis, CostModel
from pipeline.planning.budget_search import _completed, _least_rate, covers, spend
from pipeline.planning.coverage import cheapest_full, full_sweeps
from pipeline.planning.fine_pass import plan_fine
from pipeline.planning.partial_scans import every_nth
from pipeline.planning.prices import ScanPrices, check_budget, prices_of
from pipeline.planning.scan_runs import Cover, Field, best_cover
from pipeline.planning.swaths import Views, edges_from, swaths_at_patches

CAMERA, COST = LineCamera(), CostModel()
ExpectedGain = NDArray[np.float64]


def rows() -> list[Row]:
    return [*_patches(), *_farm(), *_speed()]


def _real_field(grid: SceneGrid, along: Axis, expected_gain: ExpectedGain, prices: ScanPrices) -> Field:
    views = edges_from(grid, CAMERA, swaths_at_patches(grid, CAMERA, along), expected_gain > 0)
    return Field(views, expected_gain, _columns(grid, along), prices)


def _columns(grid: SceneGrid, along: Axis) -> NDArray[np.intp]:
    row, column = np.divmod(np.arange(int(np.prod(grid.patch_shape))), grid.patch_shape[1])
    return column if along == "x" else row


def _cheapest_cover(field: Field) -> Cover:
    """The fewest seconds found that show all patches: from side by side, from each patch, and by falling prices."""
    rate, starts = _least_rate(field), ((), tuple(_completed(field, ())))
    *_, (last, _) = covers(field)
    ends = [best_cover(field, start, rate) for start in starts]
    found = [field.cover(_completed(field, cover.runs)) for cover in (last, *ends, field.cover(starts[1]))]
    return min(found, key=lambda cover: cover.seconds(field.prices))


def _lines_showing(grid: SceneGrid, patch_index: NDArray[np.integer]) -> int:
    """Lines of the cheapest runs found that show these patches."""
    expected_gain = np.zeros(int(np.prod(grid.patch_shape)))
    expected_gain[patch_index] = 1
    return _cheapest_cover(_real_field(grid, "x", expected_gain, prices_of(CAMERA, COST))).lines


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


def _patches() -> list[Row]:
    grid = SceneGrid(10_240, 10_240, 320, 4)
    full = sum(sweep.lines for sweep in full_sweeps(grid, CAMERA, "x"))
    coarse = sum(sweep.lines for sweep in every_nth(full_sweeps(grid, CAMERA, "x")))
    patch_index = np.random.default_rng(0).choice(1024, 100, replace=False)
    began = time.process_time()
    lines = _lines_showing(grid, patch_index)
    took = time.process_time() - began
    expected_gain = np.zeros(1024)
    expected_gain[patch_index] = 1
    field = _real_field(grid, "x", expected_gain, prices_of(CAMERA, COST))
    need = field.views.stop - field.views.first
    single = sum(int(need[field.views.patch_number == patch_number].min()) for patch_number in patch_index)
    swaths = _cheapest_cover(_fixed(field))
    fraction, alone, fixed = ((coarse + count) / full for count in (lines, single, swaths.lines))
    met = fraction <= min(alone, 0.498, 1.0) and lines <= 1.02 * swaths.lines
    text = f"{fraction:.1%} of {full} lines with the coarse pass ({lines} fine), {took:.1f} s"
    goal = "<= one sweep per patch (49.8 %), <= exact per-strip optimum + 2 %, <= 100 %"
    peers = f"one sweep per patch {alone:.1%} ({single}); exact per-strip optimum {fixed:.1%} ({swaths.lines})"
    what = "100 patches of 320 px, seed 0, s = 4, rotated footprints"
    return [Row(what, text, goal, met, peers), *_many_patches(grid, coarse, full)]


def _many_patches(grid: SceneGrid, coarse: int, full: int) -> list[Row]:
    """Where one sweep per patch costs more than scanning everything, and where runs of lines do too."""
    patch_index = np.random.default_rng(0).choice(1024, 400, replace=False)
    expected_gain = np.zeros(1024)
    expected_gain[patch_index] = 1
    views = _real_field(grid, "x", expected_gain, prices_of(CAMERA, COST)).views
    alone = sum(
        int((views.stop - views.first)[views.patch_number == patch_number].min()) for patch_number in patch_index
    )
    fraction = (coarse + _lines_showing(grid, patch_index)) / full
    return [
        Row(
            "400 patches of 320 px, with the coarse pass",
            f"{fraction:.1%} of the full scan's lines",
            "<= 100 %",
            fraction <= 1,
            f"one sweep per patch {(coarse + alone) / full:.1%}",
        )
    ]


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
