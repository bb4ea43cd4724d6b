"""The fine pass: which line runs at which strip offsets show the seats that matter most, within a budget of seconds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from math import frexp, isfinite
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import BudgetError, PoseError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import Axis, CostModel, Sweep
from pipeline.planning.budget_search import cheapest_cover, full_scan_pays, spend
from pipeline.planning.coverage import check_reach, full_sweeps
from pipeline.planning.prices import count_lines, prices_of
from pipeline.planning.scan_runs import NEGLIGIBLE, Cover, Field, cut_strip
from pipeline.planning.strips import covered_seats, look_from, strips_at_seats

MOST_WORTH = 1e100  # of one seat: larger scores are planned in a larger unit
MOST_FLOAT = float(np.finfo(np.float64).max)


@dataclass(frozen=True)
class FinePlan:
    """Sweeps of the fine pass, the valid seats they show, and the price.

    ``worth`` is the score that was bought. Seats that a sweep shows besides are in ``seats``; what they add may not be
    in ``worth``. ``kind`` says whether the sweeps are runs of lines, whose seats lie wholly in one of them, or those of
    the full scan, taken because it is cheaper or as cheap; with "scan" a plain scan has shown every seat
    already, with "raster" all pixels were there; ``reason`` says so in a sentence. ``worth`` and
    ``wanted_worth`` are in a larger unit where a score is infinite, or the sum of all would be beyond float64.
    """

    sweeps: list[Sweep]
    seats: NDArray[np.intp]  # ascending
    seconds: float
    worth: float
    kind: Literal["lines", "full", "scan", "raster"] = "lines"
    reason: str = ""
    wanted_worth: float = 0.0  # score of all seats that a line within the mirror's range shows
    full_seconds: float | None = None  # of the full scan with lines along the same axis; None beyond the mirror's range
    out_of_reach: int = 0  # seats worth something that no line within the mirror's range shows
    threshold: float | None = None  # least score per second that was bought; None where there was no such limit
    spared_s: float | None = None  # of the budget, left because nothing more pays by the threshold

    @property
    def lines(self) -> int:
        """Lines of all sweeps."""
        return count_lines(self.sweeps)

    @property
    def worth_per_second(self) -> float | None:
        """Score bought per second of the fine pass; None where nothing was."""
        return self.worth / self.seconds if self.seconds else None


@dataclass(frozen=True)
class SeatsPrice:
    """What certain seats cost by runs of lines, and what the full scan does, which shows them too."""

    lines: int
    seconds: float
    full_lines: int | None  # None where the full scan is beyond the mirror's range
    full_seconds: float | None

    @property
    def least(self) -> tuple[int, float]:
        """Lines and seconds of the cheaper way."""
        if self.full_lines is not None and self.full_seconds is not None and self.full_seconds <= self.seconds:
            return self.full_lines, self.full_seconds
        return self.lines, self.seconds


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
    threshold: float | None = None,
    strips: Sequence[Sweep] | None = None,
) -> FinePlan:
    """Choose the line runs that show the most score for at most ``budget_s`` seconds.

    Each run lies at a strip offset of its own. The price counts lines, a set-up for each run and reloads of the vector
    memory, and never exceeds the budget; with the same scores a bigger budget never has less ``worth``. Where no runs
    that take less than the full scan show all that is worth something and the budget pays for the full scan, its sweeps
    are the plan, and show every seat.

    Parameters
    ----------
    scores
        (seat,) gain of each seat of ``grid``, of any size; NaN, -inf and negative ones are worth nothing, +inf more
        than all others.
    margin_px
        How far beside the plan the mirror may look: every run shows its seats even so. [px]
    full
        Sweeps of the full scan; None lays the fewest strips that cover the field.
    threshold
        Buy no run, and nothing of a run, that shows less score per second than this: a floor under the price of a
        second, a line priced with its share of a reload and a run with its set-up. None, like 0, spends the budget.
        With the same scores a lower threshold never has less ``worth``.
    strips
        Strips that runs may lie on, ascending along the line, from the field's first row on and without lines; None
        takes all that `strips_at_seats` gives.

    Raises
    ------
    BudgetError : the budget or the threshold is negative or not finite.
    ShapeError : the number of scores is not that of the seats.
    SettingsError : a patch is wider than a line.
    PoseError : no line within the mirror's range shows any of the seats that are worth something.
    """
    if not isfinite(budget_s) or budget_s < 0:
        raise BudgetError(f"the fine pass needs a finite number of seconds, 0 or more, got {budget_s}")
    limit = 0.0 if threshold is None else threshold
    if not (isfinite(limit) and limit >= 0):
        raise BudgetError(f"the threshold must be a finite score of 0 or more, got {threshold}")
    scale = _scale(scores)
    worth, unit = _worth(grid, np.asarray(scores, np.float64) / scale, min(limit / scale * budget_s, MOST_WORTH))
    floor = limit / scale / unit
    field = _field(grid, camera, cost, along, worth, margin_px, strips)
    told = scale if scale <= 1 or field.total <= MOST_FLOAT / scale else 1.0
    missed = int(np.count_nonzero(worth)) - len(np.unique(field.views.seat))
    whole = _full(grid, camera, cost, along) if full is None else (list(full), cost.seconds(list(full), camera))
    full_s = None if whole is None else whole[1]
    plan = spend(field, budget_s if full_s is None else min(budget_s, float(np.nextafter(full_s, 0.0))), floor)
    everything, total = plan.worth >= field.total * (1 - NEGLIGIBLE), field.total * told
    planned = partial(FinePlan, wanted_worth=total, full_seconds=full_s, out_of_reach=missed, threshold=threshold)
    if whole is not None and whole[1] <= budget_s and not everything and full_scan_pays(field, whole[1], floor):
        reason = (
            f"to show every place worth a second look takes no less time than to scan everything in detail, "
            f"{whole[1]:.1f} s; the full scan is taken, which shows all of the field"
        )
        return planned(whole[0], grid.valid_seats(), whole[1], total, "full", reason)
    sweeps = _sweeps(field, plan)
    check_reach(sweeps, camera)
    seconds = cost.seconds(sweeps, camera)
    beside = "; a full scan is beyond the mirror's range"
    if full_s is not None:
        beside = f", less than the full scan's {full_s:.1f} s"
    reason = f"runs of lines take {seconds:.1f} s{beside}"
    seats = covered_seats(grid, camera, sweeps, margin_px=margin_px)
    spared = budget_s - seconds if floor and not everything else None
    return planned(sweeps, seats, seconds, plan.worth * told, "lines", reason, spared_s=spared)


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
    worth: NDArray[np.float64],
    margin_px: float,
    strips: Sequence[Sweep] | None = None,
) -> Field:
    """What strips at every offset, or those given, show of the seats that are worth something."""
    if strips is None:
        strips = strips_at_seats(grid, camera, along, margin_px=margin_px)
    views = look_from(grid, camera, strips, worth > 0, margin_px=margin_px)
    if np.any(worth > 0) and not len(views.seat):
        first = int(np.flatnonzero(worth > 0)[0])
        raise PoseError(
            f"none of the {np.count_nonzero(worth > 0)} seats worth something (the first is {first}) is shown by a "
            f"line within the mirror's range; use a smaller scene or a smaller angle per pixel"
        )
    row, column = np.divmod(np.arange(len(worth)), grid.seat_shape[1])
    return Field(views, worth, column if along == "x" else row, prices_of(camera, cost))


def _sweeps(field: Field, cover: Cover) -> list[Sweep]:
    """Runs as sweeps, strip by strip; a name holds strip and first line, so that names sort in the same order."""
    strips = field.views.strips
    return [cut_strip(strips[run.strip], run, strips[run.strip].name) for run in sorted(cover.runs)]


def _scale(scores: NDArray[np.floating]) -> float:
    """What very large and very small scores are divided by, a power of two: their plan is that of usual ones, exactly.

    1 for scores of any usual size. Products of two worths and sums over seats then stay within float64.
    """
    given = np.asarray(scores, np.float64)
    peak = float(given.max(initial=0.0, where=np.isfinite(given) & (given > 0)))
    usual = not peak or 1 / MOST_WORTH <= peak <= MOST_WORTH
    return 1.0 if usual else 2.0 ** (frexp(peak)[1] - 1)


def _worth(grid: SceneGrid, scores: NDArray[np.floating], most: float) -> tuple[NDArray[np.float64], float]:
    """Scores as worth, (seat,), and the score that is a worth of 1.

    0 for what is not worth buying; finite for +inf, above all others together and above ``most``, which is the score
    that the whole budget has to show.
    """
    given = np.asarray(scores, np.float64)
    worth = np.zeros_like(given)
    valid = grid.valid_seats()
    worth[valid] = np.where(given[valid] > 0, given[valid], 0.0)
    endless, peak = np.isposinf(worth), 1.0
    if endless.any():
        worth[endless] = 0.0
        peak = float(worth.max(initial=0.0)) or 1.0
        worth = np.where(endless, (worth.sum() + most) / peak + 1, worth / peak)
    return worth, peak


def price_of_seats(
    grid: SceneGrid, camera: LineCamera, cost: CostModel, along: Axis, seats: NDArray[np.integer]
) -> SeatsPrice:
    """Price exactly these seats by runs of lines, strip offsets free, beside the full scan.

    What ``frame`` mode leaves out: it buys seats free of each other, the rig pays for the lines beneath them.

    Raises PoseError: a seat is shown by no line within the mirror's range.
    """
    worth = np.zeros(int(np.prod(grid.seat_shape)))
    worth[np.asarray(seats, np.intp)] = 1.0
    field = _field(grid, camera, cost, along, worth, 0.0)
    missed = np.setdiff1d(np.flatnonzero(worth), field.views.seat)
    if len(missed):
        raise PoseError(
            f"seat {missed[0]} and {len(missed) - 1} more of {np.count_nonzero(worth)} are shown by no line within "
            f"the mirror's range; leave them out"
        )
    sweeps = _sweeps(field, cheapest_cover(field))
    full = _full(grid, camera, cost, along)
    whole = (None, None) if full is None else (count_lines(full[0]), full[1])
    return SeatsPrice(count_lines(sweeps), cost.seconds(sweeps, camera), *whole)
