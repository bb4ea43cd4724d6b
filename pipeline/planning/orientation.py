"""What the other orientation of the line would have shown for the same seconds: a report, since mountings are fixed."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import PoseError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import Axis, CostModel
from pipeline.planning.coverage import coarse_sweeps, with_margin
from pipeline.planning.crop_rows import CropRows
from pipeline.planning.fine_pass import FinePlan, plan_fine

WORDS: dict[Axis, str] = {"x": "across the picture", "y": "down the picture"}  # for people, where lines lie


@dataclass(frozen=True)
class OrientationOutcome:
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

    taken: OrientationOutcome
    other: OrientationOutcome | None
    rows: CropRows | None
    why_not: str = ""

    @property
    def sentence(self) -> str:
        """The comparison in words."""
        return "; ".join(part for part in (self._here, self._there, self._rows) if part)

    @property
    def _here(self) -> str:
        if self.taken.worth_share is None:
            return "no place is worth a second look"
        words, share = WORDS[self.taken.along], _percent(self.taken.worth_share)
        return f"with camera lines {words} the fine sweeps show {share} of what is worth a second look"

    @property
    def _there(self) -> str:
        words = WORDS[_turned(self.taken.along)]
        if self.other is None:
            return f"with lines {words} it could not be done: {self.why_not}"
        if self.other.worth_share is None:
            return ""
        return (
            f"with lines {words} they would show {_percent(self.other.worth_share)} in no more time "
            f"({self.other.coarse_s:.1f} s coarse and {self.other.fine_s:.1f} s fine, here "
            f"{self.taken.coarse_s:.1f} s and {self.taken.fine_s:.1f} s)"
        )

    @property
    def _rows(self) -> str:
        if self.rows is None:
            return ""
        if self.rows.angle_deg is None or self.rows.nearest_axis is None:
            return "no crop rows are seen"
        off = abs((self.rows.angle_deg + 45) % 90 - 45)
        return f"crop rows run {WORDS[self.rows.nearest_axis]}, to within {ceil(off)} degrees"


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
    margin_px: float = 0,
    threshold: float | None = None,
) -> OrientationReport:
    """Plan the same scores with lines along the other axis, for the seconds that both passes have here.

    Parameters
    ----------
    scores, budget_s, threshold
        As for :func:`pipeline.planning.fine_pass.plan_fine`.
    plan
        The plan with lines along ``along`` where it is made already.
    rows
        Crop rows of the coarse image, for the sentence.
    overlap_px
        Of the coarse pass, as of :func:`pipeline.planning.coverage.coarse_sweeps`.
    margin_px
        By which its sweeps begin earlier and end later, as of :func:`pipeline.planning.coverage.with_margin`; and what
        the fine pass allows for, as of :func:`pipeline.planning.fine_pass.plan_fine`.

    Raises
    ------
    PoseError : the field is beyond the mirror's range with lines along ``along``; the other axis is only reported.
    """
    here = plan or plan_fine(
        grid, camera, cost, along, scores, budget_s=budget_s, margin_px=margin_px, threshold=threshold
    )

    def coarse_seconds(axis: Axis) -> float:
        sweeps = coarse_sweeps(grid, camera, axis, overlap_px=overlap_px)
        return cost.seconds(with_margin(sweeps, camera, margin_px), camera)

    coarse_s = coarse_seconds(along)
    taken = _outcome(along, coarse_s, here)
    other = _turned(along)
    try:
        other_coarse_s = coarse_seconds(other)
        spent = budget_s if here.spared_s is None else here.seconds  # what a threshold left is not there to be spent
        left = coarse_s + spent - other_coarse_s
        if left < 0:
            reason = f"the coarse pass alone takes {other_coarse_s:.1f} s"
            return OrientationReport(taken, None, rows, reason)
        turned = plan_fine(grid, camera, cost, other, scores, budget_s=left, margin_px=margin_px, threshold=threshold)
    except PoseError as error:
        return OrientationReport(taken, None, rows, str(error))
    return OrientationReport(taken, _outcome(other, other_coarse_s, turned), rows)


def _turned(along: Axis) -> Axis:
    return "y" if along == "x" else "x"


def _outcome(along: Axis, coarse_s: float, plan: FinePlan) -> OrientationOutcome:
    share = plan.worth / plan.wanted_worth if plan.wanted_worth else None
    return OrientationOutcome(along, coarse_s, plan.seconds, plan.lines, share)


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"
