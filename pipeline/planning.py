"""The fine pass: which line runs of which strips show the seats that matter most, within a budget of seconds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from math import ceil, isfinite

import numpy as np
from numpy.typing import NDArray

from pipeline.camera import LineCamera
from pipeline.coverage import ROUNDING_PX, TAPS_AFTER, TAPS_BEFORE, check_reach, field_px, reach_px
from pipeline.errors import BudgetError, SettingsError, ShapeError
from pipeline.grid import SceneGrid
from pipeline.runs import Plan, Prices, Wanted, plan_runs
from pipeline.scan import Axis, CostModel, Sweep, scene_to_sweep

LEAST_DIGITS = 4  # of the least budget that a refusal names
ROUNDING = 1e-9


@dataclass(frozen=True)
class FinePlan:
    """Sweeps of the fine pass, every valid seat that lies wholly in one of them, and the price.

    ``worth`` is the score that was bought. Seats that a sweep shows besides, because it overlaps another's strip,
    are in ``seats`` and not in ``worth``.
    """

    sweeps: list[Sweep]
    seats: NDArray[np.intp]  # ascending
    seconds: float
    worth: float


def least_budget(coarse_seconds: float, full_seconds: float) -> float:
    """Give the least budget that pays for the coarse pass alone, rounded up to four digits; above 1 none does."""
    return ceil(coarse_seconds / full_seconds * 10.0**LEAST_DIGITS - ROUNDING) / 10.0**LEAST_DIGITS


def check_budget(budget: float, coarse_seconds: float, full_seconds: float) -> float:
    """Give the seconds that ``budget`` leaves for the fine pass.

    Parameters
    ----------
    budget
        Seconds of coarse and fine capture over those of the full scan, above 0 and at most 1.

    Raises
    ------
    BudgetError : the budget is not a number in that range, or less than the coarse pass alone; names the least.
    """
    if not isfinite(budget) or not 0 < budget <= 1:
        raise BudgetError(f"--budget must be a share of the full scan's time above 0 and at most 1, got {budget}")
    if coarse_seconds > full_seconds:
        raise BudgetError(
            f"the coarse pass alone ({coarse_seconds:.1f} s) takes longer than the full scan ({full_seconds:.1f} s), "
            f"so no budget can be met, got {budget}; scan in full, or take a larger coarse factor"
        )
    left = budget * full_seconds - coarse_seconds
    if left < -ROUNDING * full_seconds:
        raise BudgetError(
            f"--budget {budget} gives {budget * full_seconds:.1f} s, but the coarse pass alone takes "
            f"{coarse_seconds:.1f} of the full scan's {full_seconds:.1f} s; "
            f"the least possible is {least_budget(coarse_seconds, full_seconds)}"
        )
    return max(left, 0.0)


def seat_lines(
    grid: SceneGrid, camera: LineCamera, sweep: Sweep, seats: NDArray[np.integer]
) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Give the lines of a fine sweep that each seat needs, resampling taps included.

    Parameters
    ----------
    sweep
        A ``step=1`` sweep; lines count from its first. They need not exist: compare with ``sweep.lines``.
    seats
        (seat,) numbers. Only their pixels on the scene count.

    Returns
    -------
    (seat, 2) first line and the one after the last; (seat,) whether the line's samples reach all pixels. A seat
    without a pixel on the scene is never reached.
    """
    if sweep.step != 1:
        raise ShapeError(f"seats are cut from fine sweeps of step 1, got {sweep.name} with step {sweep.step}")
    origin = grid.seat_origin(seats)
    size = np.array([grid.height, grid.width])
    low, high = origin - (size - 1) / 2, np.minimum(origin + grid.patch, size) - 1 - (size - 1) / 2
    along, scan = (1, 0) if sweep.along == "x" else (0, 1)
    # Line and sample of a point are monotone in either coordinate, so a rectangle's corners hold the extremes.
    corners_along = np.stack([low, low, high, high])[..., along]
    corners_scan = np.stack([low, high, low, high])[..., scan]
    at = scene_to_sweep(sweep, camera, corners_along, corners_scan)
    first = np.floor(at[..., 0].min(axis=0) + ROUNDING_PX).astype(np.intp) - TAPS_BEFORE
    stop = np.floor(at[..., 0].max(axis=0) + ROUNDING_PX).astype(np.intp) + TAPS_AFTER + 1
    reached = (at[..., 1].min(axis=0) >= -0.5) & (at[..., 1].max(axis=0) <= camera.samples - 0.5)
    return np.stack([first, stop], axis=-1), reached & np.all(origin < size, axis=-1)


def plan_fine(
    grid: SceneGrid, camera: LineCamera, cost: CostModel, along: Axis, scores: NDArray[np.floating], *, budget_s: float
) -> FinePlan:
    """Choose the line runs that show the most score for at most ``budget_s`` seconds.

    Strips are laid out in up to four ways that let no seat straddle two of them; for each the runs are chosen over all
    strips together, and the layout with the most score wins. The price counts lines, a set-up for each run and reloads
    of the vector memory, and never exceeds the budget; with the same scores a bigger budget never has less ``worth``.

    Parameters
    ----------
    scores
        (seat,) gain of each seat of ``grid``; NaN, -inf and negative ones are worth nothing, +inf more than all others.
    budget_s
        Seconds for the fine pass, 0 or more.

    Raises
    ------
    BudgetError : the budget is negative or not finite.
    ShapeError : the number of scores is not that of the seats.
    SettingsError : a patch is wider than a line.
    PoseError : the field is beyond the mirror's range.
    """
    if not isfinite(budget_s) or budget_s < 0:
        raise BudgetError(f"the fine pass needs a finite number of seconds, 0 or more, got {budget_s}")
    worth = _worth(grid, scores)
    prices = Prices(camera.frame_ms * 1e-3, cost.setup_seconds(camera), cost.reload_s, cost.vector_pairs)
    chosen: tuple[Plan, list[Sweep]] | None = None
    for layout in _layouts(grid, camera, along, worth):
        strips = [_strip(grid, camera, along, columns) for columns in layout]
        check_reach(strips, camera)
        wanted = [_wanted(grid, camera, *pair, worth) for pair in zip(strips, layout, strict=True)]
        plan = plan_runs(wanted, prices, budget_s)
        if chosen is None or plan.worth > chosen[0].worth:
            chosen = plan, strips
    assert chosen is not None
    plan, strips = chosen
    sweeps = [_cut(strip, run) for strip, runs in zip(strips, plan.runs, strict=True) for run in runs]
    return FinePlan(sweeps, covered_seats(grid, camera, sweeps), cost.seconds(sweeps, camera), plan.worth)


def covered_seats(grid: SceneGrid, camera: LineCamera, sweeps: Sequence[Sweep]) -> NDArray[np.intp]:
    """Give the valid seats that lie wholly, taps included, in one of the fine sweeps, ascending."""
    seats = grid.valid_seats()
    shown = np.zeros(len(seats), bool)
    for sweep in sweeps:
        lines, reached = seat_lines(grid, camera, sweep, seats)
        shown |= reached & (lines[:, 0] >= 0) & (lines[:, 1] <= sweep.lines)
    return seats[shown]


def _worth(grid: SceneGrid, scores: NDArray[np.floating]) -> NDArray[np.float64]:
    """Scores as worth: 0 for what is not worth buying, finite for +inf, (seat,)."""
    rows, columns = grid.seat_shape
    given = np.asarray(scores, np.float64)
    if given.shape != (rows * columns,):
        raise ShapeError(f"expected {rows * columns} scores, one a seat of {rows} x {columns}, got shape {given.shape}")
    worth = np.zeros_like(given)
    valid = grid.valid_seats()
    worth[valid] = np.where(given[valid] > 0, given[valid], 0.0)
    endless = np.isposinf(worth)
    if endless.any():
        worth[endless] = 0.0
        peak = worth.max(initial=0.0) or 1.0
        worth = np.where(endless, worth.sum() / peak + 1, worth / peak)
    return worth


def _layouts(
    grid: SceneGrid, camera: LineCamera, along: Axis, worth: NDArray[np.float64]
) -> list[tuple[tuple[int, int], ...]]:
    """Ways to share the seat columns among strips, each a tuple of half-open column ranges.

    Even shares; full strips from either end; a full strip where a strip's width holds the most worth. None looks at
    the budget.
    """
    across, _ = field_px(grid, along)
    most = camera.samples // grid.patch
    if most == 0:
        raise SettingsError(f"a patch of {grid.patch} px is wider than a line of {camera.samples}; take a smaller one")
    columns = -(-across // grid.patch)
    count = -(-columns // most)
    edges = [round(i * columns / count) for i in range(count + 1)]
    found = [_ranges(edges), _fill(0, columns, most), tuple(_fill_back(0, columns, most))]
    held = worth.reshape(grid.seat_shape).sum(axis=0 if along == "x" else 1)[:columns]
    if columns > most:
        windows = np.convolve(held, np.ones(most), mode="valid")
        peak = int(np.argmax(windows))
        found.append((*_fill_back(0, peak, most), (peak, peak + most), *_fill(peak + most, columns, most)))
    return list(dict.fromkeys(found))


def _ranges(edges: Sequence[int]) -> tuple[tuple[int, int], ...]:
    return tuple(pairwise(edges))


def _fill(low: int, high: int, most: int) -> tuple[tuple[int, int], ...]:
    """Ranges of ``most`` from the low end up."""
    return _ranges([*range(low, high, most), high])


def _fill_back(low: int, high: int, most: int) -> tuple[tuple[int, int], ...]:
    """Ranges of ``most`` from the high end down, ascending."""
    return _ranges([low, *sorted(range(high, low, -most))]) if high > low else ()


def _strip(grid: SceneGrid, camera: LineCamera, along: Axis, columns: tuple[int, int]) -> Sweep:
    """A sweep over a strip's whole length that shows a range of seat columns, kept on the scene where it can be."""
    across, scan = field_px(grid, along)
    low, high = columns[0] * grid.patch, min(columns[1] * grid.patch, across)
    room = max(across - camera.samples, 0) / 2
    middle = float(np.clip((low + high - across) / 2, -room, room))
    middle -= float(reach_px(middle, scan, camera, 1).sum()) / 2  # the line's image is longer on its outer side
    sweep = Sweep(f"fine-{columns[0]}", "fine", along, middle, -(scan - 1) / 2, 1)
    needs, _ = seat_lines(grid, camera, sweep, grid.valid_seats())
    first = int(needs[:, 0].min())
    return replace(sweep, start_px=sweep.start_px + first, lines=int(needs[:, 1].max()) - first)


def _wanted(
    grid: SceneGrid, camera: LineCamera, strip: Sweep, columns: tuple[int, int], worth: NDArray[np.float64]
) -> Wanted:
    """The seats of a strip's columns that are worth something, with the lines they need."""
    row, column = np.divmod(np.arange(len(worth)), grid.seat_shape[1])
    place = column if strip.along == "x" else row
    seats = np.flatnonzero((worth > 0) & (place >= columns[0]) & (place < columns[1]))
    lines, reached = seat_lines(grid, camera, strip, seats)
    return Wanted(lines[reached, 0], lines[reached, 1], worth[seats[reached]])


def _cut(strip: Sweep, run: tuple[int, int]) -> Sweep:
    first, stop = run
    name = f"{strip.name}-{first:05d}"
    return replace(strip, name=name, start_px=strip.start_px + first, lines=stop - first)


def price_seats(
    grid: SceneGrid, camera: LineCamera, cost: CostModel, along: Axis, seats: NDArray[np.integer]
) -> tuple[int, float]:
    """Lines and seconds that exactly these seats would take on the rig, in even strips; neighbours share their lines.

    What ``frame`` mode leaves out: it buys seats free of each other, the rig pays for the lines beneath them.
    """
    worth = np.zeros(int(np.prod(grid.seat_shape)))
    worth[np.asarray(seats, np.intp)] = 1.0
    sweeps = []
    for columns in _layouts(grid, camera, along, worth)[0]:
        strip = _strip(grid, camera, along, columns)
        wanted = _wanted(grid, camera, strip, columns, worth)
        needed = np.zeros(strip.lines + 1, np.int64)
        np.add.at(needed, wanted.first, 1)
        np.add.at(needed, wanted.stop, -1)
        held = np.concatenate([[False], np.cumsum(needed)[:-1] > 0, [False]])
        starts, stops = np.flatnonzero(held[1:] & ~held[:-1]), np.flatnonzero(held[:-1] & ~held[1:])
        sweeps += [_cut(strip, run) for run in zip(starts.tolist(), stops.tolist(), strict=True)]
    return sum(sweep.lines for sweep in sweeps), cost.seconds(sweeps, camera)
