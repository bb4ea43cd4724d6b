"""The uniform scan of a survey: which one is best by the weights' record, and what its neighbours would give."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import nullcontext, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from flows.settings.survey_settings import Settings
from flows.settings.values import EXTENT_WHOLE, parse_goals
from flows.tasks.capture_plan import CapturePlan, PassLayout
from models.weights.files import Description
from pipeline.errors import BudgetError, NotRecordedError, SettingsError, WeightsError
from pipeline.geometry.scan import Sweep
from pipeline.planning.partial_scans import FIRST_STEP, FIRST_STEPS, every_nth, lines_between, merged_ms
from pipeline.planning.uniform_scans import (
    LOSS,
    MIOU,
    ScanLimits,
    ScanPerformance,
    UniformScan,
    choose_scan,
    exposures_between,
    frontier,
    longest_exposure,
    priced_scan,
    reference_scan,
    uniform_scans,
)


@dataclass(frozen=True)
class ScanChoice:
    """The scan that a survey takes, if it takes a plain one, and those that the weights' record tells of."""

    offered: tuple[UniformScan, ...] = ()  # none without a record
    chosen: UniformScan | None = None  # None of a zoomed survey, and of what the record does not tell of

    def best_within(self, seconds: float) -> UniformScan | None:
        """The scan that is likely to score most in so many seconds; None where there is none."""
        try:
            return choose_scan(self.offered, ScanLimits(seconds)) if self.offered else None
        except BudgetError:
            return None

    @property
    def reference(self) -> UniformScan | None:
        """The cheapest scan that is nearly as good as the best; None without a record."""
        return reference_scan(self.offered) if self.offered else None

    @property
    def frontier(self) -> list[UniformScan]:
        """Scans than which none is as cheap and better, by ascending seconds."""
        return frontier(self.offered)


def choose_uniform_scan(
    layout: PassLayout, weights: Description, path: Path, bands: int, settings: Settings
) -> ScanChoice:
    """Choose step and exposure of the uniform scan that is asked for, and say which choice there was.

    Where a plain scan is asked for without a step, the choice is `chosen`, within its seconds and bytes and by its
    goal. Where the capture is undecided it is the cheapest scan nearly as good as any, if there is a record. Of a
    recorded field the scans are those that its lines serve, as they were exposed. What was chosen once stands in the
    layout, and is kept when an archive is read again with other weights, of which ``path`` is the file.
    Raises WeightsError: the choice is left to weights without a record of scans; BudgetError: no scan costs as little,
    or reaches the goals; SettingsError: a goal of a class that the weights lack, or a camera that exposes shorter than
    the record knows; PoseError: the field is beyond the mirror's range.
    """
    plain, limits = settings.plain, ScanLimits(settings.seconds, settings.bytes_raw)
    content = weights.record.get("scans")
    if content is None:
        if layout.step is None and plain:
            raise WeightsError(
                f"the weights {path.name} have no record of uniform scans, by which one would be chosen: give the scan "
                "with --scan-step and --scan-exposure-ms, or train weights with --min-exposure-ms 3, some scenes "
                "kept for validation"
            )
        return ScanChoice()
    record = ScanPerformance.read(content, settings.sky.fraction_of_clear)
    goals = {} if settings.goal is None else parse_goals(settings.goal)
    for name in goals:
        if name not in record.scores:
            known = ", ".join(one for one in record.scores if one != MIOU)
            raise SettingsError(f"--goal {name}={100 * goals[name]:g}: the weights tell apart {known}")
    camera, cost = layout.camera, layout.cost
    sweeps: dict[int, list[Sweep]] = {}  # of the uniform scans of every step; of a recording those that its lines serve
    taken_ms = None if layout.recorded is None else [camera.exposure_ms]
    for step in record.steps:
        with nullcontext() if layout.recorded is None else suppress(NotRecordedError):
            sweeps[step] = layout.uniform(step, layout.exposure_ms).sweeps()[1]
    scans = uniform_scans(record, sweeps, camera, cost, bands, seconds=limits.seconds, exposures_ms=taken_ms)
    chosen, exposure_ms = None, layout.exposure_ms or camera.exposure_ms
    if layout.extent != EXTENT_WHOLE:  # of a part of a field the record says nothing
        pass
    elif layout.step in sweeps and layout.step in record.steps and record.knows(exposure_ms):
        chosen = priced_scan(record, sweeps[layout.step], camera, cost, bands, exposure_ms)
    elif plain and layout.step is None:
        if not scans:
            raise SettingsError(
                f"camera.exposure_ms = {camera.exposure_ms:g}: the weights' record tells of exposures from "
                f"{record.exposures_ms[0]:g} ms, so that it can choose no scan; take one by hand with --scan-step"
            )
        chosen = choose_scan(scans, replace(limits, goals=goals))
    elif settings.undecided and scans and not settings.zooms:
        chosen = reference_scan(scans)
    return ScanChoice(tuple(scans), chosen)


def lay_out_passes(
    layout: PassLayout, scans: ScanChoice, weights: Description, settings: Settings
) -> tuple[PassLayout, CapturePlan, Settings, tuple[str, ...]]:
    """Lay out the uniform scan that was chosen, or a first pass; the settings that ask for just these, and notes.

    Where neither settings nor a record decide, every line is captured. Raises what `PassLayout.plan` does.
    """
    chosen, content = scans.chosen, weights.record.get("scans")
    if settings.zooms:
        layout = replace(layout, first_step=settings.scan_step or FIRST_STEP, step=None)
        if content is not None and settings.seconds is not None and settings.coarse_exposure_ms is None:
            record = ScanPerformance.read(content, settings.sky.fraction_of_clear)
            first = choose_first_pass(layout, record, settings.seconds)
            if first is not None:
                layout = replace(layout, first_step=first.step, coarse_exposure_ms=first.exposure_ms)
                settings = replace(settings, coarse_exposure_ms=first.exposure_ms)
        settings = replace(settings, scan_step=None if settings.budget is not None else layout.first_step)
        return layout, layout.plan(settings.budget, settings.seconds), settings, ()
    if chosen is not None and layout.step is None:
        layout = replace(layout, step=chosen.step, exposure_ms=chosen.exposure_ms)
    settings = replace(settings, scan_step=layout.step, scan_exposure_ms=layout.exposure_ms)
    if layout.step is not None or settings.plain:
        return layout, layout.plan(None), settings, ()
    every = layout.uniform(1)
    note = "every line is captured: the weights have no record of scans by which fewer would be chosen"
    return every, every.plan(None), replace(settings, scan_step=1), (note,)


@dataclass(frozen=True)
class FirstPass:
    """Lines of a first pass, and the mIoU of a field of which every place is captured again."""

    step: int
    exposure_ms: float
    expected: float


def choose_first_pass(layout: PassLayout, record: ScanPerformance, seconds: float) -> FirstPass | None:
    """Choose the lines of a first pass that ends in time; None where none does.

    Any field is served so: one of which every place pays is scanned as by a uniform scan, whose lines come in turns.
    Of those that are nearly as good for that the closest lines are taken, and of these the longest exposure.
    """
    camera, cost, full = layout.camera, layout.cost, layout.sweeps()[2]
    shortest, longest = record.offered_ms(camera)
    found: list[FirstPass] = []
    for first_step in (step for step in FIRST_STEPS if step in record.steps):
        for first_ms in exposures_between(shortest, longest):
            first = every_nth(full, first_step, first_ms)
            left_s = seconds - cost.seconds(first, camera)
            if left_s < 0:
                break
            scores = [0.0]
            for step in (step for step in record.steps if step < first_step):
                rest = lines_between(full, first, step=step)
                rest_ms = longest_exposure(left_s, rest, camera, cost, shortest, longest)
                if rest_ms is not None:
                    scores.append(record.expected(step, merged_ms(first_ms, rest_ms, step / first_step))[MIOU])
            found.append(FirstPass(first_step, first_ms, max(scores)))
    best = max((one.expected for one in found), default=0.0)
    good = [one for one in found if one.expected >= best - LOSS]
    return max(good, key=lambda one: (-one.step, one.exposure_ms), default=None)


def as_figures(scan: UniformScan | None) -> dict[str, Any] | None:
    """A scan as receipts tell it, with its expected mIoU alone."""
    if scan is None:
        return None
    fields: Mapping[str, Any] = asdict(scan)
    figures = {"expected_miou": scan.expected[MIOU], "expected_spread": scan.spread}
    return {name: value for name, value in fields.items() if name not in ("expected", "spread")} | figures
