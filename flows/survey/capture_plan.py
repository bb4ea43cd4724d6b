"""What every survey of a field has in common: orientation, coarse and full sweeps, their seconds and their memory."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from flows.settings.survey_settings import Settings
from pipeline.errors import SettingsError
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import Axis, Sweep
from pipeline.planning.coverage import cheapest_full, coarse_sweeps, with_margin
from pipeline.planning.prices import check_budget
from pipeline.rectify.placed import PixelGrid, place
from pipeline.rectify.region import plan_tiles
from pipeline.rectify.registration.overlaps import LEAST_OVERLAP_PX
from pipeline.simulator.simulated import SimulatedSource, SimulatedSweep
from pipeline.source import References
from storage.arrays.layout import image_spec
from storage.arrays.tile_work import MosaicWork, tile_budget


@dataclass(frozen=True)
class CapturePlan:
    """What every survey of this field has in common: orientation, coarse and full sweeps, and their seconds."""

    along: Axis
    coarse: list[Sweep]
    full: list[Sweep]
    coarse_s: float
    full_s: float
    fine_s: float  # left by the budget for the fine pass
    overlap_px: float  # of neighbouring coarse strips, at least
    margin_px: float  # by which sweeps begin earlier and end later


def plan_capture(settings: Settings, grid: SceneGrid) -> CapturePlan:
    """Lay out coarse and full sweeps; where the mirror may look beside the plan, with overlaps and margins.

    Either pass overlaps by what its own registration needs. Its map lies as the sweep that is held does, which another
    may lie beside by twice the mirror's error: so much earlier sweeps begin, and later they end. Raises SettingsError:
    the mirror may be so far off that overlaps take whole lines; BudgetError: the budget does not pay for the coarse
    pass; PoseError: the field is beyond the mirror's range.
    """
    camera, cost = settings.camera, settings.cost
    along, coarse, full = lay_out_sweeps(settings, grid)
    full_s, coarse_s = cost.seconds(full, camera), cost.seconds(coarse, camera)
    fine_s = check_budget(settings.budget, coarse_s, full_s)
    overlap = _overlap(settings, grid.factor)
    return CapturePlan(along, coarse, full, coarse_s, full_s, fine_s, overlap, 2 * settings.pointing_px)


def lay_out_sweeps(settings: Settings, grid: SceneGrid) -> tuple[Axis, list[Sweep], list[Sweep]]:
    """Give the axis that lines lie along, the coarse sweeps, and those of the full scan.

    Raises SettingsError: the mirror may be so far off that overlaps take whole lines; PoseError: the field is beyond
    the mirror's range.
    """
    camera, cost, apart = settings.camera, settings.cost, 2 * settings.pointing_px
    coarse_overlap = _overlap(settings, grid.factor)
    along, full, _ = cheapest_full(grid, camera, cost, overlap_px=_overlap(settings, 1))
    coarse = with_margin(coarse_sweeps(grid, camera, along, overlap_px=coarse_overlap), camera, apart)
    return along, coarse, with_margin(full, camera, apart)


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


def check_memory(settings: Settings, source: SimulatedSource, grid: SceneGrid, plan: CapturePlan) -> None:
    """Refuse memory for not one tile of the mosaic, before anything is captured (SettingsError, with the least)."""
    pixels = PixelGrid.of_scene(grid, grid.factor)
    placed = [place(_PlannedSweep(source, sweep), settings.camera) for sweep in plan.coarse]
    rows, columns = image_spec(("y", "x"), pixels.shape, "<f4").shard or pixels.shape
    tiles = plan_tiles(placed, settings.camera, pixels, (rows, columns))
    work = MosaicWork(placed, settings.camera, pixels)
    tile_budget(work, tiles, (rows, columns), memory=settings.memory, crew=replace(settings.crew, workers=1))


class _PlannedSweep(SimulatedSweep):
    """The path of a sweep and the size of its lines, which is all that memory depends on; no light is asked for."""

    @property
    def references(self) -> References:
        """Frames of a detector without a fault, as the simulated one is."""
        white = np.ones((self.source.camera.samples // self.sweep.binning, len(self.source.wavelength_nm)), np.float32)
        return References(dark=np.zeros_like(white), white=white, panel=white[0])
