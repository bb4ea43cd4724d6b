"""Lay the two passes of a zoomed survey, and choose the lines of the second one by expected gain.

Lines of the second pass never repeat a line of the first one. For both the mirror holds one position a line, and line
numbers count the positions of the full scan, 1 px apart.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.pipeline.geometry.scan import CostModel, Floats, Sweep, exposing, merged_ms
from spectralzoom.pipeline.planning.coverage import some_lines
from spectralzoom.pipeline.planning.partial_scans import LineRun, PatchRows, RunTimes, choose_runs
from spectralzoom.pipeline.planning.uniform_scans import MIOU, ScanPerformance, format_scan, longest_exposure

FIRST_STEP = 4  # positions of the full scan from line to line of the first pass
FIRST_STEPS = (4, 8)  # allowed values
LEAST_GAIN = 1e-3  # of mIoU; below it there is no second pass
AHEAD = 3e-3  # of mIoU; runs that are expected to gain so much more than all of the lines are captured instead of them
MOST_AGAIN = 0.6  # of the field; larger runs give way to lines of the whole field
EXPOSURES = 7  # that are tried, equally spaced by logarithm


@dataclass(frozen=True)
class FinePlan:
    """Sweeps of the second pass, the patches that they show, and their capture time.

    ``kind`` is "lines" for runs of lines, and "full" for the whole field, which completes a uniform scan. Without a
    second pass it is "scan", and "raster" if all pixels were given. ``reason`` says it in a sentence.
    """

    sweeps: list[Sweep]
    patch_index: NDArray[np.intp]  # ascending
    seconds: float
    expected_gain: float
    kind: Literal["lines", "full", "scan", "raster"] = "lines"
    reason: str = ""
    changed: NDArray[np.intp] = field(
        default_factory=lambda: np.empty(0, np.intp)
    )  # patches of which lines show a part

    @property
    def lines(self) -> int:
        """Return the number of lines of all sweeps."""
        return sum(sweep.lines for sweep in self.sweeps)


def no_pass(reason: str, expected_gain: float = 0.0) -> FinePlan:
    """Return a second pass without lines."""
    return FinePlan([], np.empty(0, np.intp), 0.0, expected_gain, reason=reason)


@dataclass(frozen=True)
class SecondPass:
    """Planner of the second pass in the time that the first one leaves.

    New lines lie between those of the first pass. With pointing errors, ``margin_px`` above 0, they are all lines of
    runs of the full scan, which are so much longer at either end.
    """

    grid: SceneGrid
    camera: LineCamera
    cost: CostModel
    first_pass: Sequence[Sweep]
    full: Sequence[Sweep]
    seconds: float
    margin_px: float = 0.0
    recorded: Callable[[list[Sweep]], list[Sweep]] | None = None  # cuts sweeps to the lines of a recording
    recorded_ms: Sequence[float] = ()  # exposures of that recording
    usual_ms: float | None = None  # exposure of new lines; None: the camera's

    @property
    def key(self) -> dict[str, Any]:
        """Return the parameters of the planner, without the first pass."""
        known = {"fine_s": self.seconds, "margin_px": self.margin_px, "full": [asdict(sweep) for sweep in self.full]}
        return {**known, "camera": asdict(self.camera), "cost": asdict(self.cost)}

    @property
    def interlaces(self) -> bool:
        """Return whether new lines lie between those of the first pass."""
        return not self.margin_px

    @cached_property
    def swaths(self) -> list[Sweep]:
        """Return the sweeps of every line that runs are parts of."""
        found = self.full
        if self.interlaces:
            found = [replace(one, step=1, held=None, lines=(one.lines - 1) * one.step + 1) for one in self.first_pass]
        return [replace(one, name=f"fine-{number:03d}", kind="fine") for number, one in enumerate(found)]

    @cached_property
    def rows(self) -> PatchRows:
        """Return the rows of patches of the field in these sweeps: with the margin, from old line to old line."""
        found = PatchRows.of(self.swaths, self.grid, self.camera)
        margin = math.ceil(self.margin_px)
        apart = self._apart
        lines = np.array([sweep.lines for sweep in self.swaths])[:, None]
        first = np.maximum(found.first - margin, 0) // apart * apart
        stop = np.minimum(-(-(found.stop + margin - 1) // apart) * apart + 1, lines)
        return replace(found, first=np.where(found.there, first, 0), stop=np.where(found.there, stop, 0))

    def plan(
        self, gain: Floats, *, step: int = 1, exposure_ms: float | None = None, seconds: float | None = None
    ) -> FinePlan:
        """Return the runs of lines ``step`` px apart that have the highest sum of (patch,) ``gain`` in the time.

        NaN and negative gains count as 0. Lines have ``exposure_ms``, by default the usual exposure of new lines.
        ``seconds`` are by default those that the first pass leaves.
        """
        seconds = self.seconds if seconds is None else seconds
        exposure_ms = self.usual_ms if exposure_ms is None else exposure_ms
        exposed = self.camera if exposure_ms is None else replace(self.camera, exposure_ms=exposure_ms)
        times = RunTimes(
            exposed.frame_ms * 1e-3 * (1 / step - (1 / self._apart if self.interlaces else 0)),  # of the new lines
            self.cost.setup_seconds(exposed) * (math.log2(self._apart / step) if self.interlaces else 1),
            lambda runs: self.cost.seconds(self._sweeps(runs, step, exposure_ms), self.camera),
        )
        chosen = choose_runs(self.rows, np.where(gain > 0, gain, 0.0), times, seconds=seconds, several=True)
        return self._plan_of(() if chosen is None else chosen.runs, gain, step, exposure_ms)

    def whole(self, gain: Floats, *, step: int = 1, exposure_ms: float | None = None) -> FinePlan:
        """Return the lines of the whole field that complete a uniform scan of ``step`` px, however long they take."""
        shown = zip(self.rows.first, self.rows.stop, self.rows.there, strict=True)
        runs = [
            (number, int(first[there].min()), int(stop[there].max()))
            for number, (first, stop, there) in enumerate(shown)
            if there.any()
        ]
        return self._plan_of(runs, gain, step, self.usual_ms if exposure_ms is None else exposure_ms)

    def _sweeps(self, runs: Sequence[LineRun], step: int, exposure_ms: float | None) -> list[Sweep]:
        """Return the sweeps of runs of lines."""
        found = [
            replace(some_lines(self.swaths[number], first, stop), name=f"{self.swaths[number].name}-{first:05d}")
            for number, first, stop in sorted(runs)  # in the order of their names
        ]
        return lines_between(found, self._between, step=step, exposure_ms=exposure_ms)

    def _plan_of(self, runs: Sequence[LineRun], gain: Floats, step: int, exposure_ms: float | None) -> FinePlan:
        """Return the plan of runs of lines; of those of a recording that it has."""
        sweeps = self._sweeps(runs, step, exposure_ms)
        if self.recorded is not None:
            sweeps = self.recorded(sweeps)
        if not sweeps:
            return no_pass("no run of lines with a gain fits the time")
        patch_index = self.rows.patches(runs)
        share = len(patch_index) / np.count_nonzero(self.rows.row >= 0)
        what = "the whole field" if share == 1 else f"{100 * share:.2g} % of the field"
        taken_ms = sorted({exposing(self.camera, sweep).exposure_ms for sweep in sweeps})
        reason = f"captured again: {what}, {format_scan(step, *taken_ms)}"
        gained = float(np.sum(gain[patch_index], where=gain[patch_index] > 0))
        kind: Literal["full", "lines"] = "full" if share == 1 else "lines"
        return FinePlan(sweeps, patch_index, self.cost.seconds(sweeps, self.camera), gained, kind, reason)

    def by_score(self, gain: Floats) -> FinePlan:
        """Return the runs with the highest sum of (patch,) ``gain``.

        Where they are more than `MOST_AGAIN` of the field, every second line of the whole field is captured instead.
        """
        runs = self.plan(gain)
        if runs.kind == "full" or len(runs.patch_index) <= MOST_AGAIN * np.count_nonzero(self.rows.row >= 0):
            return runs
        even = self.whole(gain, step=2)
        return even if even.seconds <= self.seconds else runs

    def best(self, record: ScanPerformance, gain_of: Callable[[int, float], Floats]) -> FinePlan:
        """Return the runs of lines with the highest expected gain, or complete the uniform scan.

        Runs take at most `MOST_AGAIN` of the time of the lines that complete the scan, and are expected to gain `AHEAD`
        more. Line spacings and exposures are chosen for both; a recording offers its own exposures. ``gain_of`` returns
        the (patch,) gains of lines of a spacing, for the mean exposure [ms] of old and new lines.
        """
        found: list[FinePlan] = []
        for step, exposure_ms, mean_ms in self._offered(record):
            gain = gain_of(step, mean_ms)
            whole = self.whole(gain, step=step, exposure_ms=exposure_ms)
            limit_s = min(MOST_AGAIN * whole.seconds, self.seconds)
            found += [whole, self.plan(gain, step=step, exposure_ms=exposure_ms, seconds=limit_s)]
        found = [plan for plan in found if plan.seconds <= self.seconds]  # recorded lines may have longer exposures
        if not found:
            return no_pass("no second pass in the time would score more than the first one")
        runs, whole = (
            max(some, key=lambda plan: (plan.expected_gain, -plan.seconds), default=no_pass(""))
            for some in ([one for one in found if one.kind != "full"], [one for one in found if one.kind == "full"])
        )
        ahead = runs.expected_gain - whole.expected_gain
        plan = runs if ahead >= AHEAD or not whole.sweeps else whole
        if plan.expected_gain < LEAST_GAIN:
            why = f"no second pass: its expected gain is {100 * plan.expected_gain:.2f} points"
            return no_pass(why, plan.expected_gain) if plan.sweeps else plan
        if not (runs.sweeps and whole.sweeps):
            return plan
        other = "the whole field in the same time" if plan is runs else "the best part of it"
        more = f"expected gain {100 * abs(ahead):.1f} points {'above' if (plan is runs) == (ahead > 0) else 'below'}"
        return replace(plan, reason=f"{plan.reason}; {more} that of {other}")

    def _offered(self, record: ScanPerformance) -> Iterator[tuple[int, float, float]]:
        """Yield line spacing and exposure of new lines, and the mean exposure of old and new ones."""
        first = self.first_pass[0]
        shortest, longest = record.offered_ms(self.camera)
        first_ms = exposing(self.camera, first).exposure_ms
        # Lines that score less than those of the first pass would replace better ones.
        known = first.step in record.steps
        least = record.expected(first.step, float(np.clip(first_ms, shortest, longest)))[MIOU] if known else 0.0
        for step in (step for step in record.steps if step < first.step):
            every = lines_between(self.full, self._between, step=step)
            last = longest_exposure(self.seconds, every, self.camera, self.cost, shortest, longest)
            tried = {*np.geomspace(shortest, longest, EXPOSURES).round(1).tolist(), *([] if last is None else [last])}
            for exposure_ms in self.recorded_ms or sorted(tried):
                of_first = step / first.step if self.interlaces else 0.0
                mean_ms = merged_ms((first_ms, exposure_ms), (of_first, 1 - of_first))
                mean_ms = float(np.clip(mean_ms, shortest, longest))
                if record.expected(step, mean_ms)[MIOU] >= least:
                    yield step, exposure_ms, mean_ms

    @property
    def _between(self) -> Sequence[Sweep]:
        """Return the sweeps whose lines are not captured again."""
        return self.first_pass if self.interlaces else []

    @property
    def _apart(self) -> int:
        """Return the distance of the lines that new ones lie between; 1 with pointing errors."""
        return self.first_pass[0].step if self.interlaces else 1


def every_nth(full: Sequence[Sweep], step: int = FIRST_STEP, exposure_ms: float | None = None) -> list[Sweep]:
    """Return the first pass: every ``step``-th line of the sweeps of a full scan, to its last line or just beyond."""
    shared: dict[str, Any] = {"kind": "coarse", "step": step, "held": 1, "exposure_ms": exposure_ms}
    return [
        replace(sweep, name=f"coarse-{number}", lines=-(-(sweep.lines - 1) // step) + 1, **shared)
        for number, sweep in enumerate(full)
    ]


def lines_between(
    runs: Sequence[Sweep], first_pass: Sequence[Sweep], *, step: int = 1, exposure_ms: float | None = None
) -> list[Sweep]:
    """Return the sweeps that complete runs of a full scan's lines to a distance of ``step``.

    A run on the swath of a sweep of the first pass begins and ends at lines of that sweep, and takes the lines between.
    After a first pass of every fourth line these are the lines halfway, then the odd ones. Any other run takes all of
    its own lines.
    """
    taken = {(sweep.along, sweep.swath_px): sweep for sweep in first_pass}
    found: list[Sweep] = []
    for run in runs:
        coarse = taken.get((run.along, run.swath_px))
        if coarse is None:
            held = None if step == 1 else 1
            found.append(replace(run, lines=-(-run.lines // step), step=step, held=held, exposure_ms=exposure_ms))
            continue
        low = round(run.start_px - coarse.start_px)
        first = max(low // coarse.step, 0)
        stop = min(-(-(low + run.lines - 1) // coarse.step), coarse.lines - 1)  # the coarse line that the run ends at
        apart = coarse.step
        spaces = stop - first
        while apart > step and spaces > 0:  # each sweep halves the distance of the lines
            start = coarse.start_px + first * coarse.step + apart / 2
            name = f"{run.name}-{apart // 2}"
            found.append(
                replace(run, name=name, start_px=start, lines=spaces, step=apart, held=1, exposure_ms=exposure_ms)
            )
            apart //= 2
            spaces *= 2
    return found
