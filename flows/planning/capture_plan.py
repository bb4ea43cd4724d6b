"""Plan the captures of a survey: the uniform scan, or the first of two passes, and their time."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spectralzoom.flows.settings.settings import Settings
from spectralzoom.flows.settings.values import ALWAYS, AUTO, NEVER, RECORDED, WHOLE, parse_extent_runs
from spectralzoom.models.weights.files import Description
from spectralzoom.pipeline.capture.recorded import Recording
from spectralzoom.pipeline.capture.recorded_passes import (
    recorded_fine_ms,
    recorded_first_pass,
    recorded_full_scan,
    sweeps_as_taken,
)
from spectralzoom.pipeline.errors import BudgetError, NotRecordedError, PoseError, SettingsError, WeightsError
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.pipeline.geometry.scan import Axis, CostModel, Sweep, exposing, memory_loads, merged_ms
from spectralzoom.pipeline.planning.coverage import cheapest_full, full_sweeps, sweeps_over, uniform_sweeps, with_margin
from spectralzoom.pipeline.planning.fine_pass import FIRST_STEP, FIRST_STEPS, every_nth, lines_between
from spectralzoom.pipeline.planning.partial_scans import sweeps_of_runs
from spectralzoom.pipeline.planning.uniform_scans import (
    LOSS,
    MIOU,
    ScanPerformance,
    UniformScan,
    choose_scan,
    exposures_between,
    format_scan,
    longest_exposure,
    priced_scan,
    reference_scan,
    uniform_scans,
)
from spectralzoom.pipeline.rectify.registration.overlaps import LEAST_OVERLAP_PX

LEAST_SWATHS = 8  # of a field on which two passes pay (docs/measurements/accuracy.md)
NEARLY = 0.003  # of mIoU: expected scores that differ by less count as equal


@dataclass(frozen=True)
class CapturePlan:
    """Sweeps of the first pass, or of the uniform scan, and of the full scan, with their time."""

    along: Axis
    coarse: list[Sweep]  # first pass, or uniform scan
    full: list[Sweep]
    coarse_s: float
    full_s: float
    fine_s: float  # left for the second pass
    margin_px: float  # extension of sweeps at both ends
    plain: bool = False  # one uniform scan, or a raster
    by_record: bool = False  # scan performance chooses the lines of the second pass


@dataclass(frozen=True)
class PassLayout:
    """Layout of passes over a field: grid, camera, line spacing and exposure."""

    grid: SceneGrid
    camera: LineCamera
    cost: CostModel
    pointing_px: float = 0.0  # maximum pointing error
    step: int | None = None  # line spacing of a uniform scan; None: two passes
    exposure_ms: float | None = None  # of a uniform scan, or of the first pass; None: the camera's
    extent: str = WHOLE  # of a uniform scan
    first_step: int = FIRST_STEP  # line spacing of the first of two passes
    as_taken: bool = False  # use all lines of a recording
    shown: NDArray[np.bool_] | None = None  # (patch,) to capture; None: all, also of a scan that is used as taken
    recorded: Recording | None = None  # recording that has the lines

    @classmethod
    def of(
        cls,
        settings: Settings,
        grid: SceneGrid,
        shown: NDArray[np.bool_] | None = None,
        recorded: Recording | None = None,
    ) -> PassLayout:
        """Return the layout that the settings request."""
        as_taken = None if recorded is None or not settings.as_taken else sweeps_as_taken(recorded)
        step = None if settings.zooms else settings.scan_step
        return cls(
            grid,
            settings.camera,
            settings.cost,
            settings.pointing_px,
            step if as_taken is None else max(sweep.step for sweep in as_taken),
            settings.scan_exposure_ms,
            settings.extent,
            FIRST_STEP if settings.scan_step is None else settings.scan_step,
            as_taken is not None,
            shown if as_taken is None else None,
            recorded,
        )

    def uniform(self, step: int, exposure_ms: float | None = None) -> PassLayout:
        """Return the layout of a uniform scan of the whole field."""
        return replace(self, step=step, exposure_ms=exposure_ms, extent=WHOLE, as_taken=False)

    def plan(self, budget: float | None, seconds: float | None = None) -> CapturePlan:
        """Return the first pass and the full scan; with pointing errors, sweeps overlap and are longer.

        Both passes together take ``seconds``, or ``budget``, a fraction of the full scan; that of a recording has the
        recorded exposure. Without either there is one uniform scan. Raises as `sweeps`; BudgetError: the first pass
        takes longer.
        """
        along, coarse, full = self.sweeps()
        full_s, coarse_s = self.cost.seconds(full, self.camera), self.cost.seconds(coarse, self.camera)
        fine_s = 0.0
        usual_ms = None if self.recorded is None else recorded_fine_ms(self.recorded)
        whole_s = self.cost.seconds([replace(one, exposure_ms=usual_ms) for one in full], self.camera)
        limit_s = seconds if budget is None else budget * whole_s
        if limit_s is not None:
            fine_s = limit_s - coarse_s
            if fine_s < 0:
                limit = f"--seconds {seconds:g}" if budget is None else f"a --budget of {budget:g}, {limit_s:.2f} s,"
                fixed = self.cost.seconds([replace(one, lines=0) for one in coarse], self.camera)
                ways = ["give more"] if budget is None or coarse_s <= whole_s else []
                longer = budget is not None or self.exposure_ms is None  # than the shortest, for --seconds
                ways += ["give a shorter --scan-exposure-ms"] * (longer and self.recorded is None and fixed < limit_s)
                left_out = "--zoom never" if budget is None else "without --budget and --policy"
                raise BudgetError(
                    f"{limit} is below the time of the first pass of every {self.first_step}th line, "
                    f"{coarse_s + 0.01:.2f} s of the full scan's {whole_s:.2f} s; "
                    f"{', '.join([*ways, f'or take one uniform scan ({left_out})'])}"
                )
        margin_px = 2 * self.pointing_px
        by_record = budget is None and seconds is not None
        return CapturePlan(
            along, coarse, full, coarse_s, full_s, fine_s, margin_px, plain=limit_s is None, by_record=by_record
        )

    def sweeps(self) -> tuple[Axis, list[Sweep], list[Sweep]]:
        """Return the axis of the lines, the sweeps of the first pass or uniform scan, and those of the full scan.

        Lines that show none of the ``shown`` patches are left out, except with pointing errors: registration needs
        whole sweeps. Raises SettingsError: overlaps would take whole lines, or the extent names lines that do not
        exist; PoseError: the field exceeds the mirror's range; NotRecordedError: a recording lacks a line.
        """
        grid = self.grid
        camera = self.camera
        apart = 2 * self.pointing_px

        def cut(sweeps: list[Sweep]) -> list[Sweep]:
            return sweeps if self.shown is None or apart else sweeps_over(sweeps, grid, camera, self.shown)

        axes: tuple[Axis, ...] = ("x", "y") if self.recorded is None else self.recorded.axes
        along, full, _ = cheapest_full(grid, camera, self.cost, overlap_px=self._overlap(1), cut=cut, axes=axes)
        if self.step is not None:
            scan_passes = uniform_sweeps(
                grid, camera, along, step=self.step, exposure_ms=self.exposure_ms, overlap_px=self._overlap(self.step)
            )
        else:
            swept = full_sweeps(grid, camera, along, overlap_px=self._overlap(self.first_step))
            scan_passes = every_nth(swept, self.first_step, self.exposure_ms)
        scan_passes = cut(scan_passes)
        if self.extent != WHOLE:
            scan_passes = sweeps_of_runs(scan_passes, parse_extent_runs(self.extent))
        scan_passes, full = with_margin(scan_passes, camera, apart), with_margin(full, camera, apart)
        if self.recorded is None:
            return along, scan_passes, full
        taken = sweeps_as_taken(self.recorded) if self.as_taken else recorded_first_pass(self.recorded, scan_passes)
        return along, taken, recorded_full_scan(self.recorded, full)

    def _overlap(self, step: int) -> float:
        """Return the overlap of neighbouring sweeps that leaves 64 pixels at the greatest pointing error [px]."""
        off = self.pointing_px
        if not off:
            return 0.0
        rest = LEAST_OVERLAP_PX * step
        line = self.camera.samples // step * step
        overlap = 2 * off + rest
        if overlap >= line:
            raise SettingsError(
                f"--pointing-px {off:g}: sweeps would have to overlap by {overlap:g} px of a line of {line} px; "
                + (f"give less than {(line - rest) / 2:g}" if line > rest else "lines are too short to register them")
            )
        return overlap


@dataclass(frozen=True)
class ScanChoice:
    """Uniform scans of the scan performance table, and the one that the survey takes."""

    offered: tuple[UniformScan, ...] = ()  # empty without a table
    chosen: UniformScan | None = None  # None of two passes, or beyond the table
    two_passes: FirstPass | None = None  # considered or taken, with an expected score

    @property
    def reference(self) -> UniformScan | None:
        """Return the reference: the cheapest scan that is nearly as good as the best; None without a table."""
        return reference_scan(self.offered) if self.offered else None

    def best_in_time(self, seconds: float) -> UniformScan | None:
        """Return the scan with the highest expected mIoU that ends in time; None where none does."""
        in_time = [one for one in self.offered if one.seconds <= seconds + 1e-6]
        return max(in_time, key=lambda one: one.expected[MIOU], default=None)


def choose_uniform_scan(
    layout: PassLayout, weights: Description, path: Path, bands: int, settings: Settings
) -> ScanChoice:
    """Choose line spacing and exposure of the uniform scan, by the scan performance of the weights in ``path``.

    With a time it is the best within it. Without any setting it is the reference scan. A line spacing in the layout is
    kept. A recording offers the scans that its lines contain, with their exposure.
    Raises WeightsError: the weights lack the table; BudgetError: no scan ends in time; SettingsError: the table
    starts at longer exposures than the camera's; PoseError: the field exceeds the mirror's range.
    """
    content = weights.scans(settings.law)
    if content is None:
        if layout.step is None and settings.plain:
            by_hand = "--scan-step" + ("" if settings.source == RECORDED else " and --scan-exposure-ms")
            raise WeightsError(
                f"the weights {path.name} have no record of uniform scans to choose by: give {by_hand} instead of "
                "--seconds, or train weights with --min-exposure-ms 3 and validation scenes"
            )
        return ScanChoice()
    record = ScanPerformance.read(content, settings.sky.fraction_of_clear)
    camera = layout.camera
    sweeps: dict[int, list[Sweep]] = {}  # by line spacing: those that fit the field, or that recorded lines contain
    for step in (one for one in record.steps if one <= camera.samples):
        others = (SettingsError, PoseError) if step != (layout.step or min(record.steps)) else ()
        with suppress(*others if layout.recorded is None else (NotRecordedError,)):
            found = layout.uniform(step, layout.exposure_ms).sweeps()[1]
            memory_loads(found, layout.cost.vector_pairs)  # raises where the mirror cannot hold a line
            sweeps[step] = found
    recorded_ms = None  # by line spacing: recorded lines have exposures of their own
    if layout.recorded is not None:
        recorded_ms = {step: exposing(camera, found[0]).exposure_ms for step, found in sweeps.items()}
    scans = uniform_scans(record, sweeps, camera, layout.cost, bands, seconds=settings.seconds, recorded_ms=recorded_ms)
    chosen = None
    exposure_ms = (recorded_ms or {}).get(layout.step or 0) or layout.exposure_ms or camera.exposure_ms
    if layout.extent != WHOLE:  # the table is for whole fields
        pass
    elif layout.step in sweeps and record.knows(exposure_ms):
        chosen = priced_scan(record, sweeps[layout.step], camera, layout.cost, bands, exposure_ms)
    elif settings.seconds is not None and settings.plain and layout.step is None:
        if not scans:
            start = f"the scan performance of the weights starts at {record.exposures_ms[0]:g} ms"
            advice = "--scan-step instead of --seconds"
            if recorded_ms is None:
                offered = f"camera.exposure_ms = {camera.exposure_ms:g}"
                raise SettingsError(f"{offered}: {start}; give longer exposures, or {advice}")
            exposures = ", ".join(f"{one:g}" for one in sorted({*recorded_ms.values()}))
            raise SettingsError(f"recorded lines of {exposures} ms: {start}; give {advice}")
        chosen = choose_scan(scans, settings.seconds)
    elif scans and not settings.plain and not settings.zooms:
        chosen = reference_scan(scans)
    return ScanChoice(tuple(scans), chosen)


def lay_out_passes(
    layout: PassLayout, scans: ScanChoice, weights: Description, settings: Settings
) -> tuple[CapturePlan, ScanChoice, Settings, tuple[str, ...]]:
    """Lay out the chosen uniform scan, or the first of two passes.

    Returns plan, scans with the two passes that were considered, settings that request exactly this plan, and notes.
    Without settings or a table, every line is captured. Raises what `PassLayout.plan` raises.
    """
    chosen = scans.chosen
    content = weights.scans(settings.law)
    first = None
    may_pay = (
        settings.may_zoom
        and chosen is not None
        and chosen.expected[MIOU] < max(one.expected[MIOU] for one in scans.offered) - NEARLY
        and len(layout.sweeps()[2]) >= LEAST_SWATHS
    )
    seconds = settings.seconds if settings.scan_exposure_ms is None else None
    if content is not None and seconds is not None and (settings.zooms or may_pay):
        record = ScanPerformance.read(content, settings.sky.fraction_of_clear)
        first = choose_first_pass(layout, record, seconds, (settings.scan_step,) if settings.scan_step else FIRST_STEPS)
    scans = replace(scans, two_passes=first if first is not None and first.expected else None)
    notes = tuple[str, ...]()
    if settings.zoom == AUTO:
        pays = first is not None and chosen is not None and first.expected >= chosen.expected[MIOU] - NEARLY
        settings = settings.but(zoom=ALWAYS if pays and not settings.zooms else NEVER)
        if pays and first is not None and chosen is not None:
            notes = (
                f"two passes: {format_scan(first.step, first.exposure_ms)} first, then lines of the highest expected "
                f"gain; by the weights' record one uniform scan, {chosen.summary}, scores no more (--zoom never)",
            )
    if settings.zooms:
        layout = replace(layout, first_step=settings.scan_step or FIRST_STEP, step=None)
        if first is not None:
            exposure_ms = first.exposure_ms if layout.recorded is None else None  # recorded lines have their own
            layout = replace(layout, first_step=first.step, exposure_ms=exposure_ms)
            settings = settings.but(scan_exposure_ms=exposure_ms)
        settings = settings.but(scan_step=layout.first_step if settings.zoom == ALWAYS else None)
        return layout.plan(settings.budget, settings.seconds), replace(scans, chosen=None), settings, notes
    if chosen is not None and (layout.step is None or (layout.recorded is not None and not layout.as_taken)):
        layout = replace(layout, step=chosen.step, exposure_ms=chosen.exposure_ms)
    step = None if layout.as_taken else layout.step
    settings = settings.but(scan_step=step, scan_exposure_ms=layout.exposure_ms, extent=layout.extent)
    if layout.step is not None or settings.plain:
        return layout.plan(None), scans, settings, ()
    why = "have no record of scans to choose by" if content is None else "know no scan of this exposure or shorter"
    note = f"every line is captured: the weights {why}"
    return layout.uniform(1).plan(None), scans, settings.but(scan_step=1), (note,)


@dataclass(frozen=True)
class FirstPass:
    """Lines of a first pass, and the expected mIoU if the second pass covers the whole field."""

    step: int
    exposure_ms: float
    expected: float


def choose_first_pass(
    layout: PassLayout, record: ScanPerformance, seconds: float, steps: tuple[int, ...]
) -> FirstPass | None:
    """Choose the lines of a first pass within the time, or the fastest where none fits; None: the table has none.

    The criterion is the expected mIoU if the second pass covers the whole field. Among nearly equal choices, the
    closest lines are taken, then the longest exposure. Recorded lines have their own exposure.
    """
    full = layout.sweeps()[2]
    shortest, longest = record.offered_ms(layout.camera)
    offered_ms = exposures_between(shortest, longest)
    if layout.recorded is not None:
        taken_ms = layout.recorded.exposures_ms
        shortest, longest = taken_ms[0], taken_ms[-1]
        offered_ms = taken_ms[:1]
    found: list[FirstPass] = []
    fastest: FirstPass | None = None
    for first_step in (step for step in steps if step in record.steps):
        for first_ms in offered_ms:
            first = every_nth(full, first_step, first_ms)
            if layout.recorded is not None:
                first = recorded_first_pass(layout.recorded, first)
                first_ms = exposing(layout.camera, first[0]).exposure_ms
            left_s = seconds - layout.cost.seconds(first, layout.camera)
            if left_s < 0:
                fastest = FirstPass(first_step, first_ms, 0.0)
                break
            scores = [0.0]
            for step in (step for step in record.steps if step < first_step):
                rest = lines_between(full, first, step=step)
                rest_ms = longest_exposure(left_s, rest, layout.camera, layout.cost, shortest, longest)
                if rest_ms is not None:
                    mean_ms = merged_ms((first_ms, rest_ms), (step, first_step - step))
                    scores.append(record.expected(step, mean_ms)[MIOU])
            found.append(FirstPass(first_step, first_ms, max(scores)))
    best = max((one.expected for one in found), default=0.0)
    good = [one for one in found if one.expected >= best - LOSS]
    return max(good, key=lambda one: (-one.step, one.exposure_ms), default=fastest)


def as_figures(scan: UniformScan | None, *, scored: bool, **more: int) -> dict[str, Any] | None:
    """Return a scan for receipts and plans, with ``more`` figures; its expected mIoU is None unless ``scored``."""
    if scan is None:
        return None
    expected = (scan.expected[MIOU], scan.spread) if scored else (None, None)
    figures = dict(zip(("expected_miou", "expected_spread"), expected, strict=True))
    return {name: value for name, value in asdict(scan).items() if name not in ("expected", "spread")} | figures | more
