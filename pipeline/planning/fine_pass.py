"""Plan the fine pass: the runs of lines that show the patches of most expected gain within a budget of seconds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import PoseError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import Axis, CostModel, Sweep
from pipeline.planning.budget_search import spend
from pipeline.planning.coverage import check_reach
from pipeline.planning.prices import prices_of
from pipeline.planning.scan_runs import NEGLIGIBLE, Field
from pipeline.planning.swaths import covered_patches, edges_from, swaths_at_patches


@dataclass(frozen=True)
class FinePlan:
    """Sweeps of the fine pass, the valid patches that they show, and their capture time.

    ``patch_index`` also has patches that a sweep shows without being planned for them; ``expected_gain`` may not count
    these. ``kind`` is "lines" for runs of lines, each patch wholly in one of them, and "full" for the full scan where
    that costs no more. After a uniform scan it is "scan", and "raster" if all pixels were given. ``reason`` says it in
    a sentence.
    """

    sweeps: list[Sweep]
    patch_index: NDArray[np.intp]  # ascending
    seconds: float
    expected_gain: float
    kind: Literal["lines", "full", "scan", "raster"] = "lines"
    reason: str = ""
    wanted_gain: float = 0.0  # of all patches that a line within the mirror's range shows
    full_seconds: float | None = None  # of the full scan with lines along the same axis
    out_of_reach: int = 0  # patches with a gain that no line within the mirror's range shows

    @property
    def lines(self) -> int:
        """Return the number of lines of all sweeps."""
        return sum(sweep.lines for sweep in self.sweeps)

    @property
    def gain_per_second(self) -> float | None:
        """Return the expected gain per second of the fine pass; None without a sweep."""
        return self.expected_gain / self.seconds if self.seconds else None


def plan_fine(
    grid: SceneGrid,
    camera: LineCamera,
    cost: CostModel,
    along: Axis,
    scores: NDArray[np.floating],
    *,
    budget_s: float,
    full: Sequence[Sweep],
    margin_px: float = 0.0,
    swaths: Sequence[Sweep] | None = None,
) -> FinePlan:
    """Choose the line runs that show the most expected gain in at most ``budget_s`` seconds.

    The price counts lines, a set-up for each run and reloads of the vector memory, and never exceeds the budget. With
    the same scores a larger budget never has less ``expected_gain``. The full scan is taken if the budget pays for it
    and no cheaper runs show all patches with a gain.

    Parameters
    ----------
    scores
        (patch,) expected gain of each patch of ``grid``; NaN and negative ones count as 0.
    full
        Sweeps of the full scan.
    margin_px
        Distance beside the plan that the mirror may look: every run shows its patches even then. [px]
    swaths
        Swaths that runs may lie on, ascending along the line, from the field's first row on and without lines; None
        takes all that `swaths_at_patches` gives.

    Raises
    ------
    SettingsError : a patch is wider than a line.
    PoseError : no line within the mirror's range shows any of the patches with a gain.
    """
    given = np.asarray(scores, np.float64)
    expected_gain = np.where((given > 0) & (grid.valid_fraction().ravel() > 0), given, 0.0)
    field = _field(grid, camera, cost, along, expected_gain, margin_px, swaths)
    missed = int(np.count_nonzero(expected_gain)) - len(np.unique(field.views.patch_number))
    full_s = cost.seconds(list(full), camera)
    cover = spend(field, min(budget_s, float(np.nextafter(full_s, 0.0))))
    planned = partial(FinePlan, wanted_gain=field.total, full_seconds=full_s, out_of_reach=missed)
    if full_s <= budget_s and cover.expected_gain < field.total * (1 - NEGLIGIBLE):
        reason = (
            f"to show every place worth a second pass takes no less time than to scan everything in detail, "
            f"{full_s:.1f} s; the full scan is taken, which shows all of the field"
        )
        return planned(list(full), grid.valid_patches(), full_s, field.total, "full", reason)
    sweeps = []
    for run in sorted(cover.runs):  # a name holds swath and first line, so that names sort in the same order
        swath = field.views.swaths[run.swath]
        name, first = f"{swath.name}-{run.first:05d}", swath.start_px + run.first
        sweeps.append(replace(swath, name=name, start_px=first, lines=run.stop - run.first))
    check_reach(sweeps, camera)
    seconds = cost.seconds(sweeps, camera)
    reason = f"runs of lines take {seconds:.1f} s, less than the full scan's {full_s:.1f} s"
    patch_index = covered_patches(grid, camera, sweeps, margin_px=margin_px)
    return planned(sweeps, patch_index, seconds, cover.expected_gain, "lines", reason)


def _field(
    grid: SceneGrid,
    camera: LineCamera,
    cost: CostModel,
    along: Axis,
    expected_gain: NDArray[np.float64],
    margin_px: float,
    swaths: Sequence[Sweep] | None,
) -> Field:
    """Return which patches with a gain the swaths show: those given, or one at every offset."""
    if swaths is None:
        swaths = swaths_at_patches(grid, camera, along, margin_px=margin_px)
    views = edges_from(grid, camera, swaths, expected_gain > 0, margin_px=margin_px)
    if np.any(expected_gain > 0) and not len(views.patch_number):
        first = int(np.flatnonzero(expected_gain > 0)[0])
        raise PoseError(
            f"no line within the mirror's range shows any of the {np.count_nonzero(expected_gain > 0)} patches with an "
            f"expected gain (the first is {first}); use a smaller scene or a smaller angle per pixel"
        )
    row, column = np.divmod(np.arange(len(expected_gain)), grid.patch_shape[1])
    return Field(views, expected_gain, column if along == "x" else row, prices_of(camera, cost))
