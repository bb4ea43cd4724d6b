"""What a survey captures whatever it sees: its first look, the scan of everything, and what they cost in seconds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flows.settings.survey_settings import RECORDED, Settings
from flows.settings.values import EXTENT_WHOLE, parse_extent_runs
from pipeline.capture.recorded_passes import RecordedPasses
from pipeline.errors import SettingsError
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import Axis, Sweep
from pipeline.planning.coverage import cheapest_full, coarse_sweeps, sweeps_over, uniform_sweeps, with_margin
from pipeline.planning.partial_scans import sweeps_of_runs
from pipeline.planning.prices import check_budget
from pipeline.rectify.registration.overlaps import LEAST_OVERLAP_PX


@dataclass(frozen=True)
class CapturePlan:
    """What every survey of this field has in common: orientation, coarse and full sweeps, and their seconds.

    Of a uniform scan ``coarse`` are the sweeps of that, and there is nothing to go back for.
    """

    along: Axis
    coarse: list[Sweep]
    full: list[Sweep]
    coarse_s: float
    full_s: float
    fine_s: float  # left by the budget for the fine pass
    overlap_px: float  # of neighbouring coarse strips, at least
    margin_px: float  # by which sweeps begin earlier and end later
    plain: bool = False  # one scan of everything, read whole

    @staticmethod
    def of_map() -> CapturePlan:
        """Nothing is captured of a raster: all of its pixels are there, and no second is spent on them."""
        return CapturePlan("x", [], [], 0.0, 0.0, 0.0, 0.0, 0.0, plain=True)


def plan_capture(
    settings: Settings, grid: SceneGrid, shown: NDArray[np.bool_] | None = None, recorded: RecordedPasses | None = None
) -> CapturePlan:
    """Lay out coarse and full sweeps; where the mirror may look beside the plan, with overlaps and margins.

    Either pass overlaps by what its own registration needs. Its map lies as the sweep that is held does, which another
    may lie beside by twice the mirror's error: so much earlier sweeps begin, and later they end. Lines show the
    ``shown`` (patch,) patches, all of them where it is None. Of a recording they are ``recorded`` ones. Raises
    SettingsError: the mirror may be so far off that overlaps take whole lines; BudgetError: the budget does not pay for
    the coarse pass; PoseError: the field is beyond the mirror's range; NotRecordedError: a line was never taken.
    """
    camera, cost = settings.camera, settings.cost
    along, coarse, full = lay_out_sweeps(settings, grid, shown, recorded)
    full_s, coarse_s = cost.seconds(full, camera), cost.seconds(coarse, camera)
    fine_s = 0.0 if settings.plain else check_budget(settings.budget, coarse_s, full_s)
    overlap = _overlap(settings, settings.scan_step or grid.factor)
    return CapturePlan(along, coarse, full, coarse_s, full_s, fine_s, overlap, 2 * settings.pointing_px, settings.plain)


def lay_out_sweeps(
    settings: Settings, grid: SceneGrid, shown: NDArray[np.bool_] | None = None, recorded: RecordedPasses | None = None
) -> tuple[Axis, list[Sweep], list[Sweep]]:
    """Give the axis that lines lie along, the coarse sweeps or those of a uniform scan, and those of the full scan.

    Lines that show none of the ``shown`` (patch,) patches are left out, but for a mirror that may look beside the plan:
    its sweeps are tied together by what they share. Of the looks those lines are left that the settings name. Of a
    recording they are ``recorded`` lines. Raises SettingsError: the mirror may be so far off that overlaps take whole
    lines, or lines are named that the scan does not have; PoseError: the field is beyond the mirror's range;
    NotRecordedError: a line of a recording was never taken.
    """
    camera, cost, apart = settings.camera, settings.cost, 2 * settings.pointing_px

    def cut(sweeps: list[Sweep]) -> list[Sweep]:
        return sweeps if shown is None or apart else sweeps_over(sweeps, grid, camera, shown)

    axes: tuple[Axis, ...] = ("x", "y") if recorded is None else recorded.axes
    along, full, _ = cheapest_full(grid, camera, cost, overlap_px=_overlap(settings, 1), cut=cut, axes=axes)
    if settings.scan_step is not None:
        step, overlap = settings.scan_step, _overlap(settings, settings.scan_step)
        exposure_ms = settings.scan_exposure_ms
        scan_passes = uniform_sweeps(grid, camera, along, step=step, exposure_ms=exposure_ms, overlap_px=overlap)
    else:
        overlap, exposure_ms = _overlap(settings, grid.factor), settings.coarse_exposure_ms
        scan_passes = coarse_sweeps(grid, camera, along, overlap_px=overlap, exposure_ms=exposure_ms)
    scan_passes = cut(scan_passes)
    if settings.extent != EXTENT_WHOLE:
        scan_passes = sweeps_of_runs(scan_passes, parse_extent_runs(settings.extent))
    scan_passes, full = with_margin(scan_passes, camera, apart), with_margin(full, camera, apart)
    if recorded is None:
        return along, scan_passes, full
    own = settings.scan == RECORDED
    return along, recorded.uniform_scan() if own else recorded.first_pass(scan_passes), recorded.full_scan(full)


def _overlap(settings: Settings, step: int) -> float:
    """What neighbouring sweeps of a pass have to share, so that 64 of its pixels are left when they lie apart [px]."""
    off, samples = settings.pointing_px, settings.camera.samples
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
