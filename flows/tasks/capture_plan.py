"""Captures that every survey of a field plans: its first pass, the scan of everything, and their seconds."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flows.settings.survey_settings import RECORDED, Settings
from flows.settings.values import EXTENT_WHOLE, parse_extent_runs
from pipeline.capture.recorded_passes import RecordedPasses
from pipeline.errors import BudgetError, SettingsError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import Axis, CostModel, Sweep
from pipeline.planning.coverage import cheapest_full, full_sweeps, sweeps_over, uniform_sweeps, with_margin
from pipeline.planning.partial_scans import FIRST_STEP, every_nth, sweeps_of_runs
from pipeline.planning.prices import check_budget
from pipeline.rectify.registration.overlaps import LEAST_OVERLAP_PX


@dataclass(frozen=True)
class CapturePlan:
    """Plan that every survey of this field has in common: orientation, coarse and full sweeps, and their seconds.

    ``coarse`` are the sweeps of the first pass; of a uniform scan they are all that is captured.
    """

    along: Axis
    coarse: list[Sweep]
    full: list[Sweep]
    coarse_s: float
    full_s: float
    fine_s: float  # left for later passes
    overlap_px: float  # of neighbouring coarse strips, at least
    margin_px: float  # by which sweeps begin earlier and end later
    plain: bool = False  # one uniform scan, or a raster
    by_record: bool = False  # later lines are chosen by the weights' record of scans

    @staticmethod
    def of_map() -> CapturePlan:
        """Return the plan of a raster: no sweeps and no seconds, since all of its pixels are there."""
        return CapturePlan("x", [], [], 0.0, 0.0, 0.0, 0.0, 0.0, plain=True)


@dataclass(frozen=True)
class PassLayout:
    """Lays out the passes over a field: its grid, the camera, and what was asked of their lines."""

    grid: SceneGrid
    camera: LineCamera
    cost: CostModel
    pointing_px: float = 0.0  # by which the mirror may look beside the plan
    step: int | None = None  # pixels from line to line of a uniform scan; None: several passes
    exposure_ms: float | None = None  # of a uniform scan; None: the camera's
    coarse_exposure_ms: float | None = None
    extent: str = EXTENT_WHOLE  # the lines of a uniform scan that are looked at
    first_step: int = FIRST_STEP  # pixels from line to line of the first of several passes
    as_taken: bool = False  # the uniform scan that a recording is
    shown: NDArray[np.bool_] | None = None  # (patch,) that lines show; None: all
    recorded: RecordedPasses | None = None  # whose lines the passes take

    @classmethod
    def of(
        cls,
        settings: Settings,
        grid: SceneGrid,
        shown: NDArray[np.bool_] | None = None,
        recorded: RecordedPasses | None = None,
    ) -> PassLayout:
        """Take from the settings what they ask of the passes."""
        return cls(
            grid,
            settings.camera,
            settings.cost,
            settings.pointing_px,
            None if settings.zooms else settings.scan_step,
            settings.scan_exposure_ms,
            settings.coarse_exposure_ms,
            settings.extent,
            FIRST_STEP if settings.scan_step is None else settings.scan_step,
            settings.scan == RECORDED,
            shown,
            recorded,
        )

    def uniform(self, step: int, exposure_ms: float | None = None) -> PassLayout:
        """Return the layout of a uniform scan of the whole field."""
        return replace(self, step=step, exposure_ms=exposure_ms, extent=EXTENT_WHOLE, as_taken=False)

    def plan(self, budget: float | None, seconds: float | None = None) -> CapturePlan:
        """Lay out the first pass and the full scan; where the mirror may look beside the plan, overlapping and longer.

        All passes may take ``seconds``, or ``budget``, a fraction of the full scan's; without either there is one
        uniform scan. Raises as `sweeps`; BudgetError: the first pass is not paid for.
        """
        along, coarse, full = self.sweeps()
        full_s, coarse_s = self.cost.seconds(full, self.camera), self.cost.seconds(coarse, self.camera)
        fine_s, by_record = 0.0, budget is None and seconds is not None
        if budget is not None:
            fine_s = check_budget(budget, coarse_s, full_s)
        elif seconds is not None:
            if seconds < coarse_s:
                raise BudgetError(
                    f"--seconds {seconds:g} does not pay for the first pass of every {self.first_step}th line, "
                    f"{coarse_s:.1f} s; give more, a shorter --coarse-exposure-ms, or --zoom never"
                )
            fine_s = seconds - coarse_s
        overlap = self._overlap(self.step or self.first_step)
        margin = 2 * self.pointing_px
        plain = budget is None and seconds is None
        return CapturePlan(
            along, coarse, full, coarse_s, full_s, fine_s, overlap, margin, plain=plain, by_record=by_record
        )

    def sweeps(self) -> tuple[Axis, list[Sweep], list[Sweep]]:
        """Give the axis that lines lie along, the coarse sweeps or those of a uniform scan, and those of the full scan.

        Lines that show none of the ``shown`` patches are left out, but for a mirror that may look beside the plan: its
        sweeps are tied together by what they share. Raises SettingsError: the mirror may be so far off that overlaps
        take whole lines, or lines are named that the scan does not have; PoseError: the field is beyond the mirror's
        range; NotRecordedError: a line of a recording was never taken.
        """
        grid, camera, cost, apart = self.grid, self.camera, self.cost, 2 * self.pointing_px
        shown, recorded = self.shown, self.recorded

        def cut(sweeps: list[Sweep]) -> list[Sweep]:
            return sweeps if shown is None or apart else sweeps_over(sweeps, grid, camera, shown)

        axes: tuple[Axis, ...] = ("x", "y") if recorded is None else recorded.axes
        along, full, _ = cheapest_full(grid, camera, cost, overlap_px=self._overlap(1), cut=cut, axes=axes)
        if self.step is not None:
            step, overlap, exposure_ms = self.step, self._overlap(self.step), self.exposure_ms
            scan_passes = uniform_sweeps(grid, camera, along, step=step, exposure_ms=exposure_ms, overlap_px=overlap)
        else:
            overlap, exposure_ms = self._overlap(self.first_step), self.coarse_exposure_ms
            scan_passes = every_nth(full_sweeps(grid, camera, along, overlap_px=overlap), self.first_step, exposure_ms)
        scan_passes = cut(scan_passes)
        if self.extent != EXTENT_WHOLE:
            scan_passes = sweeps_of_runs(scan_passes, parse_extent_runs(self.extent))
        scan_passes, full = with_margin(scan_passes, camera, apart), with_margin(full, camera, apart)
        if recorded is None:
            return along, scan_passes, full
        taken = recorded.uniform_scan() if self.as_taken else recorded.first_pass(scan_passes)
        return along, taken, recorded.full_scan(full)

    def _overlap(self, step: int) -> float:
        """Return what neighbouring sweeps have to share, so that 64 pixels are left when they lie apart [px]."""
        off, samples = self.pointing_px, self.camera.samples
        if not off:
            return 0.0
        rest, line = LEAST_OVERLAP_PX * step, samples // step * step
        overlap = 2 * off + rest
        if overlap >= line:
            raise SettingsError(
                f"--pointing-px {off:g}: sweeps would have to overlap by {overlap:g} px (twice that, and "
                f"{LEAST_OVERLAP_PX:.0f} pixels of {step} px), all of a line of {line} px; "
                f"give less than {(line - rest) / 2:g}"
            )
        return overlap
