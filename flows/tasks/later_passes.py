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
from pipeline.planning.interlaced import lines_between, merged_ms
from pipeline.planning.uniform_scans import MIOU, ScanPerformance, format_scan, longest_exposure

LEAST_GAIN = 1e-3  # of mIoU that later lines are expected to add; for less none are captured
EXPOSURES = 7  # that are tried, evenly by their logarithm
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
            if self.recorded is not None:
                sweeps = self.recorded.fine_pass(sweeps)
            seconds = self.cost.seconds(sweeps, self.camera)
            if seconds <= plan.fine_s:
                return replace(found, sweeps=sweeps, seconds=seconds)
            budget_s *= 0.98 * plan.fine_s / seconds
        assert found is not None
        return replace(found, sweeps=[], patch_index=np.empty(0, np.intp), seconds=0.0, expected_gain=0.0)

    def best(
        self,
        errors: PatchExpectedErrors,
        record: ScanPerformance,
        class_names: tuple[str, ...],
        worth: Callable[[Scores], Scores],
    ) -> FinePlan:
        """Return the plan that is expected to add most to the mIoU, by the record of uniform scans.

        ``errors`` are those of the first pass's map; ``worth`` leaves of (patch,) gains what the survey is after.
        """
        first = exposing(self.camera, self.plan.coarse[0])
        shortest, longest = record.offered_ms(self.camera)
        tried = np.geomspace(shortest, longest, EXPOSURES).round(1).tolist()
        between = lines_between(self.plan.full, self.plan.coarse if self.interlaces else [])
        everything_ms = longest_exposure(self.plan.fine_s, between, self.camera, self.cost, shortest, longest)
        tried = sorted({*tried, *([] if everything_ms is None else [everything_ms])})
        known: dict[tuple[int, float, bool], FinePlan] = {}

        def plan_for(step: int, exposure_ms: float, own_swaths: bool) -> FinePlan:
            if (key := (step, exposure_ms, own_swaths)) not in known:
                again = step / self.plan.coarse[0].step if own_swaths and self.interlaces else 0.0
                mean_ms = merged_ms(first.exposure_ms, exposure_ms, again)  # of the lines that a run then has
                expected = record.expected(step, float(np.clip(mean_ms, shortest, longest)))
                iou = np.array([expected.get(name, expected[MIOU]) for name in class_names])
                gain = worth(errors.expected_gain((1 - iou) / (1 + iou)))
                known[key] = self.within(gain, step=step, exposure_ms=exposure_ms, own_swaths=own_swaths)
            return known[key]

        def longest_that_pays(step: int) -> float:
            """Return the best exposure: the gain rises with it, and falls again where too few lines are paid for."""
            low, high = 0, len(tried) - 1
            while low < high:
                middle = (low + high) // 2
                now, longer = (plan_for(step, tried[one], True).expected_gain for one in (middle, middle + 1))
                low, high = (low, middle) if now >= longer else (middle + 1, high)
            return float(tried[low])

        for step in (step for step in record.steps if step < self.plan.coarse[0].step):
            exposure_ms = longest_that_pays(step)
            if step == 1 and self.interlaces and self.recorded is None:
                plan_for(step, exposure_ms, False)
        (step, exposure_ms, _), plan = max(known.items(), key=lambda one: (one[1].expected_gain, -one[1].seconds))
        if plan.expected_gain < LEAST_GAIN:
            nothing = f"later lines are expected to add {100 * plan.expected_gain:.2f} points; none are captured"
            return replace(plan, sweeps=[], patch_index=np.empty(0, np.intp), seconds=0.0, reason=nothing)
        what = "the whole field" if plan.kind == "full" else f"{len(plan.patch_index)} patches"
        return replace(plan, reason=f"captured again: {what}, {format_scan(step, exposure_ms)}")
