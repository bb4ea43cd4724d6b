"""What the other orientation of the line would have shown for the same seconds: a report, since mountings are fixed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.camera import LineCamera
from pipeline.coverage import coarse_sweeps
from pipeline.crop_rows import CropRows
from pipeline.errors import PoseError
from pipeline.grid import SceneGrid
from pipeline.planning import FinePlan, plan_fine
from pipeline.scan import Axis, CostModel


@dataclass(frozen=True)
class Mounting:
    """Both passes with lines along one axis: seconds of either, fine lines, and the share of the score bought."""

    along: Axis
    coarse_s: float
    fine_s: float
    fine_lines: int
    worth_share: float | None  # None where no seat is worth anything


@dataclass(frozen=True)
class OrientationReport:
    """The plan as it is and as it would be with the line turned by 90 deg, for the same seconds of both passes.

    ``other`` is None where that is not possible: ``why_not`` says why.
    """

    taken: Mounting
    other: Mounting | None
    rows: CropRows | None
    why_not: str = ""

    @property
    def sentence(self) -> str:
        """The comparison in words."""
        here = f"lines lie along {self.taken.along} and show {_percent(self.taken.worth_share)} of the score"
        if self.other is None:
            there = f"along {_turned(self.taken.along)} they could not: {self.why_not}"
        else:
            there = (
                f"along {self.other.along} they would show {_percent(self.other.worth_share)} in the same time "
                f"({self.other.coarse_s:.1f} s coarse and {self.other.fine_s:.1f} s fine, here "
                f"{self.taken.coarse_s:.1f} s and {self.taken.fine_s:.1f} s)"
            )
        return f"{here}; {there}{self._rows_clause()}"

    def _rows_clause(self) -> str:
        if self.rows is None:
            return ""
        if self.rows.angle_deg is None:
            return "; the field shows no crop rows"
        lie = f"at {self.rows.angle_deg:.0f} deg, nearest to {self.rows.nearest_axis}"
        return f"; crop rows run {lie} (strength {self.rows.strength:.2f})"


def compare_orientations(
    grid: SceneGrid,
    camera: LineCamera,
    cost: CostModel,
    along: Axis,
    scores: NDArray[np.floating],
    *,
    budget_s: float,
    plan: FinePlan | None = None,
    rows: CropRows | None = None,
    overlap_px: float = 0,
) -> OrientationReport:
    """Plan the same scores with lines along the other axis, for the seconds that both passes have here.

    Parameters
    ----------
    scores, budget_s
        As for :func:`pipeline.planning.plan_fine`.
    plan
        The plan with lines along ``along`` where it is made already.
    rows
        Crop rows of the coarse image, for the sentence.
    overlap_px
        Of the coarse pass, as of :func:`pipeline.coverage.coarse_sweeps`.

    Raises
    ------
    PoseError : the field is beyond the mirror's range with lines along ``along``; the other axis is only reported.
    """
    here = plan or plan_fine(grid, camera, cost, along, scores, budget_s=budget_s)
    coarse_s = cost.seconds(coarse_sweeps(grid, camera, along, overlap_px=overlap_px), camera)
    taken = _mounting(along, coarse_s, here)
    other = _turned(along)
    try:
        other_coarse_s = cost.seconds(coarse_sweeps(grid, camera, other, overlap_px=overlap_px), camera)
        left = coarse_s + budget_s - other_coarse_s
        if left < 0:
            reason = f"the coarse pass alone takes {other_coarse_s:.1f} s"
            return OrientationReport(taken, None, rows, reason)
        turned = plan_fine(grid, camera, cost, other, scores, budget_s=left)
    except PoseError as error:
        return OrientationReport(taken, None, rows, str(error))
    return OrientationReport(taken, _mounting(other, other_coarse_s, turned), rows)


def _turned(along: Axis) -> Axis:
    return "y" if along == "x" else "x"


def _mounting(along: Axis, coarse_s: float, plan: FinePlan) -> Mounting:
    share = plan.worth / plan.wanted_worth if plan.wanted_worth else None
    return Mounting(along, coarse_s, plan.seconds, plan.lines, share)


def _percent(share: float | None) -> str:
    return "none" if share is None else f"{share:.1%}"
