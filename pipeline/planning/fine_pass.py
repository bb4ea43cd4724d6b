"""The fine pass: the lines of the swaths that show the patches of most expected gain within a budget of seconds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import frexp, isfinite
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import BudgetError, PoseError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import Axis, CostModel, Sweep
from pipeline.planning.budget_search import cheapest_cover, spend
from pipeline.planning.coverage import check_reach, full_sweeps
from pipeline.planning.prices import count_lines, prices_of
from pipeline.planning.scan_runs import NEGLIGIBLE, Cover, Field
from pipeline.planning.swaths import covered_patches, edges_from, swaths_at_patches

MOST_GAIN = 1e100  # of one patch: larger scores are planned in a larger unit
MOST_FLOAT = float(np.finfo(np.float64).max)


@dataclass(frozen=True)
class FinePlan:
    """Sweeps of the fine pass, the valid patches they show, and the price.

    ``expected_gain`` is the score that was bought. Patches that a sweep shows besides are in ``patch_index``; what they
    add may not be in ``expected_gain``. ``kind`` says whether the sweeps are runs of lines, whose patches lie wholly in
    one of them, or those of the full scan, taken because it is cheaper or as cheap; with "scan" a uniform scan has
    shown every patch already, with "raster" all pixels were there; ``reason`` says so in a sentence. ``expected_gain``
    and ``wanted_gain`` are in a larger unit where a score is infinite, or the sum of all would be beyond float64.
    """

    sweeps: list[Sweep]
    patch_index: NDArray[np.intp]  # ascending
    seconds: float
    expected_gain: float
    kind: Literal["lines", "full", "scan", "raster"] = "lines"
    reason: str = ""
    wanted_gain: float = 0.0  # score of all patches that a line within the mirror's range shows
    full_seconds: float | None = None  # of the full scan with lines along the same axis; None beyond the mirror's range
    out_of_reach: int = 0  # patches worth something that no line within the mirror's range shows

    @property
    def lines(self) -> int:
        """Lines of all sweeps."""
        return count_lines(self.sweeps)

    @property
    def gain_per_second(self) -> float | None:
        """Score bought per second of the fine pass; None where nothing was."""
        return self.expected_gain / self.seconds if self.seconds else None


def plan_fine(
    grid: SceneGrid,
    camera: LineCamera,
    cost: CostModel,
    along: Axis,
    scores: NDArray[np.floating],
    *,
    budget_s: float,
    margin_px: float = 0.0,
    full: Sequence[Sweep] | None = None,
    swaths: Sequence[Sweep] | None = None,
) -> FinePlan:
    """Choose the line runs that show the most score for at most ``budget_s`` seconds.

    Each run lies at a strip offset of its own. The price counts lines, a set-up for each run and reloads of the vector
    memory, and never exceeds the budget; with the same scores a bigger budget never has less ``expected_gain``. Where
    no runs that take less than the full scan show all that is worth something and the budget pays for the full scan,
    its sweeps are the plan, and show every patch.

    Parameters
    ----------
    scores
        (patch,) gain of each patch of ``grid``, of any size; NaN, -inf and negative ones are worth nothing, +inf more
        than all others.
    margin_px
        How far beside the plan the mirror may look: every run shows its patches even so. [px]
    full
        Sweeps of the full scan; None lays the fewest strips that cover the field.
    strips
        Strips that runs may lie on, ascending along the line, from the field's first row on and without lines; None
        takes all that `swaths_at_patches` gives.

    Raises
    ------
    BudgetError : the budget is negative or not finite.
    ShapeError : the number of scores is not that of the patches.
    SettingsError : a patch is wider than a line.
    PoseError : no line within the mirror's range shows any of the patches that are worth something.
    """
    if not isfinite(budget_s) or budget_s < 0:
        raise BudgetError(f"the fine pass needs a finite number of seconds, 0 or more, got {budget_s}")
    scale = _scale(scores)
    expected_gain = _expected_gain(grid, np.asarray(scores, np.float64) / scale)
    field = _field(grid, camera, cost, along, expected_gain, margin_px, swaths)
    told = scale if scale <= 1 or field.total <= MOST_FLOAT / scale else 1.0
    missed = int(np.count_nonzero(expected_gain)) - len(np.unique(field.views.patch_number))
    whole = _full(grid, camera, cost, along) if full is None else (list(full), cost.seconds(list(full), camera))
    full_s = None if whole is None else whole[1]
    plan = spend(field, budget_s if full_s is None else min(budget_s, float(np.nextafter(full_s, 0.0))))
    everything, total = plan.expected_gain >= field.total * (1 - NEGLIGIBLE), field.total * told
    planned = partial(FinePlan, wanted_gain=total, full_seconds=full_s, out_of_reach=missed)
    if whole is not None and whole[1] <= budget_s and not everything:
        reason = (
            f"to show every place worth a second pass takes no less time than to scan everything in detail, "
            f"{whole[1]:.1f} s; the full scan is taken, which shows all of the field"
        )
        return planned(whole[0], grid.valid_patches(), whole[1], total, "full", reason)
    sweeps = _sweeps(field, plan)
    check_reach(sweeps, camera)
    seconds = cost.seconds(sweeps, camera)
    beside = "; a full scan is beyond the mirror's range"
    if full_s is not None:
        beside = f", less than the full scan's {full_s:.1f} s"
    reason = f"runs of lines take {seconds:.1f} s{beside}"
    patch_index = covered_patches(grid, camera, sweeps, margin_px=margin_px)
    return planned(sweeps, patch_index, seconds, plan.expected_gain * told, "lines", reason)


def _full(grid: SceneGrid, camera: LineCamera, cost: CostModel, along: Axis) -> tuple[list[Sweep], float] | None:
    """The full scan with lines along one axis and its seconds; None beyond the mirror's range."""
    try:
        sweeps = full_sweeps(grid, camera, along)
    except PoseError:
        return None
    return sweeps, cost.seconds(sweeps, camera)


def _field(
    grid: SceneGrid,
    camera: LineCamera,
    cost: CostModel,
    along: Axis,
    expected_gain: NDArray[np.float64],
    margin_px: float,
    swaths: Sequence[Sweep] | None = None,
) -> Field:
    """Return what strips at every offset, or those given, show of the patches that are worth something."""
    if swaths is None:
        swaths = swaths_at_patches(grid, camera, along, margin_px=margin_px)
    views = edges_from(grid, camera, swaths, expected_gain > 0, margin_px=margin_px)
    if np.any(expected_gain > 0) and not len(views.patch_number):
        first = int(np.flatnonzero(expected_gain > 0)[0])
        raise PoseError(
            f"none of the {np.count_nonzero(expected_gain > 0)} patches worth something (the first is {first}) is "
            f"shown by a line within the mirror's range; use a smaller scene or a smaller angle per pixel"
        )
    row, column = np.divmod(np.arange(len(expected_gain)), grid.patch_shape[1])
    return Field(views, expected_gain, column if along == "x" else row, prices_of(camera, cost))


def _sweeps(field: Field, cover: Cover) -> list[Sweep]:
    """Runs as sweeps, strip by strip; a name holds strip and first line, so that names sort in the same order."""
    found = []
    for run in sorted(cover.runs):
        swath = field.views.swaths[run.swath]
        name, first = f"{swath.name}-{run.first:05d}", swath.start_px + run.first
        found.append(replace(swath, name=name, start_px=first, lines=run.stop - run.first))
    return found


def _scale(scores: NDArray[np.floating]) -> float:
    """Return the divisor of very large and very small scores, a power of two, so that plans stay the same exactly.

    1 for scores of any usual size. Products of two worths and sums over patches then stay within float64.
    """
    given = np.asarray(scores, np.float64)
    peak = float(given.max(initial=0.0, where=np.isfinite(given) & (given > 0)))
    usual = not peak or 1 / MOST_GAIN <= peak <= MOST_GAIN
    return 1.0 if usual else 2.0 ** (frexp(peak)[1] - 1)


def _expected_gain(grid: SceneGrid, scores: NDArray[np.floating]) -> NDArray[np.float64]:
    """Scores as worth, (patch,): 0 for what is not worth buying; finite for +inf, and above all others together."""
    given = np.asarray(scores, np.float64)
    expected_gain = np.zeros_like(given)
    valid = grid.valid_patches()
    expected_gain[valid] = np.where(given[valid] > 0, given[valid], 0.0)
    endless = np.isposinf(expected_gain)
    if endless.any():
        expected_gain[endless] = 0.0
        peak = float(expected_gain.max(initial=0.0)) or 1.0
        expected_gain = np.where(endless, expected_gain.sum() / peak + 1, expected_gain / peak)
    return expected_gain


def runs_showing(
    grid: SceneGrid, camera: LineCamera, cost: CostModel, along: Axis, patch_index: NDArray[np.integer]
) -> list[Sweep]:
    """Return the cheapest runs of lines found that show exactly these patches, strip offsets free.

    What ``frame`` mode leaves out: it buys patches free of each other, the rig pays for the lines beneath them.

    Raises PoseError: a patch is shown by no line within the mirror's range.
    """
    expected_gain = np.zeros(int(np.prod(grid.patch_shape)))
    expected_gain[np.asarray(patch_index, np.intp)] = 1.0
    field = _field(grid, camera, cost, along, expected_gain, 0.0)
    missed = np.setdiff1d(np.flatnonzero(expected_gain), field.views.patch_number)
    if len(missed):
        raise PoseError(
            f"patch {missed[0]} and {len(missed) - 1} more of {np.count_nonzero(expected_gain)} are shown by no line "
            f"within the mirror's range; leave them out"
        )
    return _sweeps(field, cheapest_cover(field))
