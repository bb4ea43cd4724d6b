"""Choice of the lines that are captured after a first pass: where, how close, and how long each is exposed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flows.tasks.capture_plan import CapturePlan
from models.reading.expected_errors import PatchExpectedErrors
from pipeline.capture.recorded_passes import RecordedPasses
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import CostModel, Sweep, exposing
from pipeline.planning.coverage import field_px
from pipeline.planning.fine_pass import FinePlan, plan_fine
from pipeline.planning.partial_scans import lines_between, merged_ms, most_within
from pipeline.planning.uniform_scans import MIOU, ScanPerformance, format_scan, longest_exposure

LEAST_GAIN = 1e-3  # of mIoU that later lines are expected to add; for less none are captured
EXPOSURES = 7  # that are tried, evenly by their logarithm
PLANNED = 2  # of the kinds of lines that could gain most
TRIES = 5  # to fit runs into the seconds that are left
Scores = NDArray[np.float64]


@dataclass(frozen=True)
class LaterPasses:
    """Plans the lines after a first pass within the seconds that are left."""

    grid: SceneGrid
    camera: LineCamera
    cost: CostModel
    plan: CapturePlan
    recorded: RecordedPasses | None = None

    @property
    def interlaces(self) -> bool:
        """Return whether lines can lie between others: not where the mirror may look beside the plan."""
        return not self.plan.margin_px

    @property
    def _apart(self) -> int:
        """Return the distance of the first pass's lines [px]."""
        return self.plan.coarse[0].step

    def _exposures(self, record: ScanPerformance, step: int) -> list[float]:
        """Return the exposures to try, that which takes all of the field in time among them [ms]."""
        shortest, longest = record.offered_ms(self.camera)
        tried = np.geomspace(shortest, longest, EXPOSURES).round(1).tolist()
        between = lines_between(self.plan.full, self.plan.coarse if self.interlaces else [], step=step)
        last = longest_exposure(self.plan.fine_s, between, self.camera, self.cost, shortest, longest)
        return sorted({*tried, *([] if last is None else [last])})

    def _most_gain(self, gain: Scores, step: int, exposure_ms: float) -> float:
        """Return what lines of a distance and an exposure could gain at most in the seconds left."""
        field = self.grid, self.plan.coarse, self.camera, self.cost
        return most_within(
            self.plan.fine_s, gain, *field, step=step, exposure_ms=exposure_ms, interlaced=self.interlaces
        )

    def within(
        self, gain: Scores, *, step: int = 1, exposure_ms: float | None = None, own_swaths: bool = True
    ) -> FinePlan:
        """Return the runs of lines ``step`` px apart that show most of the (patch,) ``gain`` in the seconds left.

        With ``own_swaths`` runs lie on the swaths of the first pass, and take the lines that are missing there; else
        swaths are free, and runs take all of their lines.
        """
        plan, interlaced = self.plan, own_swaths and self.interlaces
        exposed = self.camera if exposure_ms is None else replace(self.camera, exposure_ms=exposure_ms)
        start = -(field_px(self.grid, plan.along)[1] - 1) / 2
        first_pass = plan.coarse if interlaced else []
        swaths = [
            Sweep(f"fine-{number:03d}", "fine", plan.along, place, start, 0)
            for number, place in enumerate(sorted({sweep.swath_px for sweep in first_pass}))
        ]
        missing = 1 / step - 1 / first_pass[0].step if first_pass else 1 / step  # lines to a line of the full scan
        budget_s, found = plan.fine_s / missing, None
        for _ in range(TRIES):
            found = plan_fine(
                self.grid,
                exposed,
                self.cost,
                plan.along,
                gain,
                budget_s=budget_s,
                margin_px=plan.margin_px,
                full=plan.full,
                swaths=swaths or None,
            )
            sweeps = lines_between(found.sweeps, first_pass, step=step, exposure_ms=exposure_ms)
            seconds = self.cost.seconds(sweeps, self.camera)
            if seconds <= plan.fine_s:
                if self.recorded is not None:  # of its lines, those that there are
                    sweeps = self.recorded.fine_pass(sweeps)
                    seconds = self.cost.seconds(sweeps, self.camera)
                return replace(found, sweeps=sweeps, seconds=seconds)
            budget_s *= 0.98 * plan.fine_s / seconds
        assert found is not None
        return replace(found, sweeps=[], patch_index=np.empty(0, np.intp), seconds=0.0, expected_gain=0.0)

    def best(
        self,
        errors: PatchExpectedErrors,
        record: ScanPerformance,
        class_names: tuple[str, ...],
        value: Callable[[Scores], Scores],
    ) -> FinePlan:
        """Return the plan that is expected to add most to the mIoU, by the record of uniform scans.

        ``errors`` are those of the first pass's map; ``value`` leaves of (patch,) gains what the survey is after.
        """
        first, steps = exposing(self.camera, self.plan.coarse[0]), [one for one in record.steps if one < self._apart]
        gains: dict[tuple[int, float], Scores] = {}
        for step in steps:
            for exposure_ms in self._exposures(record, step):
                again = step / self._apart if self.interlaces else 0.0
                mean_ms = merged_ms(first.exposure_ms, exposure_ms, again)  # of the lines that a run then has
                expected = record.expected(step, float(np.clip(mean_ms, *record.offered_ms(self.camera))))
                iou = np.array([expected.get(name, expected[MIOU]) for name in class_names])
                gains[step, exposure_ms] = value(errors.expected_gain((1 - iou) / (1 + iou)))
        ranked = sorted(gains, key=lambda one: -self._most_gain(gains[one], *one))
        plans: list[tuple[tuple[int, float], FinePlan]] = []
        for one in ranked[:PLANNED]:
            plans.append((one, self.within(gains[one], step=one[0], exposure_ms=one[1])))
        if self.recorded is None and ranked and plans[0][1].kind != "full":
            one = max(plans, key=lambda made: made[1].expected_gain)[0]
            plans.append((one, self.within(gains[one], step=one[0], exposure_ms=one[1], own_swaths=False)))
        (step, exposure_ms), plan = max(plans, key=lambda made: (made[1].expected_gain, -made[1].seconds))
        if plan.expected_gain < LEAST_GAIN:
            nothing = f"later lines are expected to add {100 * plan.expected_gain:.2f} points; none are captured"
            return replace(plan, sweeps=[], patch_index=np.empty(0, np.intp), seconds=0.0, reason=nothing)
        what = "the whole field" if plan.kind == "full" else f"{len(plan.patch_index)} patches"
        return replace(plan, reason=f"captured again: {what}, {format_scan(step, exposure_ms)}")
