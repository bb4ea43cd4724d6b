"""Plan a survey of an opened field: which lines are captured, what the network reads, and what both cost."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spectralzoom.flows.field import Field
from spectralzoom.flows.settings.settings import Settings
from spectralzoom.flows.settings.values import NEVER, PART, RIG, WHOLE
from spectralzoom.flows.stages.rectify import tile_budget
from spectralzoom.flows.stages.score import PatchGains, all_seen
from spectralzoom.flows.tasks.capture_plan import (
    CapturePlan,
    PassLayout,
    ScanChoice,
    choose_uniform_scan,
    lay_out_passes,
)
from spectralzoom.flows.tasks.extent_choice import ExtentChoice, choose_extent
from spectralzoom.flows.tasks.field_work import FieldWork, WeightsFile
from spectralzoom.flows.tasks.patch_budget import PatchBudget, ReadingCosts
from spectralzoom.flows.tasks.rig_field import check_rig
from spectralzoom.models.network.sizes import MultiplyAdds
from spectralzoom.models.network.spectral import LineSpec
from spectralzoom.models.policies.placement import CascadeTable
from spectralzoom.models.policies.policies import GLANCING_POLICIES
from spectralzoom.models.reading.prior_map import EVERY_PX
from spectralzoom.models.weights.files import BY_LAW, CASCADE
from spectralzoom.pipeline.capture.recorded_passes import recorded_fine_ms, recorded_fine_pass
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.pipeline.geometry.scan import Sweep
from spectralzoom.pipeline.planning.coverage import patches_shown
from spectralzoom.pipeline.planning.fine_pass import FinePlan, SecondPass
from spectralzoom.pipeline.planning.uniform_scans import MIOU, ScanPerformance
from spectralzoom.pipeline.rectify.placed import PixelGrid, place
from spectralzoom.pipeline.rectify.region import MosaicWork, plan_tiles
from spectralzoom.pipeline.signal.subspace import SMOOTH
from spectralzoom.pipeline.simulator.simulated import SimulatedSource, SimulatedSweep
from spectralzoom.pipeline.source import References
from spectralzoom.storage.arrays.layout import image_spec
from spectralzoom.storage.parallel.pool import WorkerPool
from spectralzoom.storage.readers.open_cubes import load_labels_array

PRIOR_MAP_GAIN = 3.0  # least gain with a prior map over that without one: losses are then alike (prior-maps.md)
REPRESENTATIVE = 3  # exposures of a second pass, for which effects are chosen
USUAL_COMPONENTS = 32  # of condensed lines, before they are computed


@dataclass(frozen=True, kw_only=True)
class SurveyPlan:
    """Planned survey of a field."""

    field: Field
    settings: Settings  # they request exactly these lines
    passes: CapturePlan
    costs: ReadingCosts  # multiply-adds of reading the field
    scans: ScanChoice = dataclasses.field(default_factory=ScanChoice)
    budget: PatchBudget | None = None  # None: no limit of multiply-adds
    extent: ExtentChoice | None = None  # of a partial scan
    notes: tuple[str, ...] = ()

    @property
    def least_gain(self) -> float | None:
        """Return the least expected gain of patches that are read at full resolution; None where all are read.

        It follows from the accepted loss, unless the settings limit multiply-adds. A prior map leaves less to gain.
        """
        cascade = self.cascade
        if cascade is None or self.settings.macs is not None or self.settings.policy != "gain":
            return None
        least = cascade.within(self.settings.expected_loss / 100)
        return least if least is None or self.field.prior is None else PRIOR_MAP_GAIN * least

    @property
    def cascade(self) -> CascadeTable | None:
        """Return the table of losses; None without an accepted loss, or where the weights have no table or network."""
        described = self.field.described
        content = described.record.get(CASCADE) if self.settings.expected_loss and described.config.corrected else None
        if content is None:
            return None
        return CascadeTable.read({**content, **content.get(BY_LAW, {}).get(self.settings.law, {})})

    @property
    def chooses(self) -> bool:
        """Return whether scores choose patches; not where all are captured and read at full resolution."""
        return not self.passes.plain or self.budget is not None or self.least_gain is not None

    @property
    def control(self) -> SurveyPlan | None:
        """Return the plan of the best uniform scan of the same seconds; None unless it is asked for and another plan.

        Only a simulated field with labels can be captured again as it was.
        """
        scan = self.scans.best_in_time(self.passes.coarse_s + self.passes.fine_s)
        settings = self.settings
        judged = settings.controls and settings.accuracy and self.field.simulates and self.field.scene.labelled
        if not judged or scan is None or (scan == self.scans.chosen and self.field.prior is None):
            return None
        settings = settings.but(
            zoom=NEVER,
            scan_step=scan.step,
            scan_exposure_ms=scan.exposure_ms,
            seconds=None,
            budget=None,
            extent=WHOLE,
            max_age=None,
            prior="none",
            controls=False,
        )
        return plan_survey(replace(self.field, settings=settings, prior=None))

    @property
    def part(self) -> bool:
        """Return whether the capture is a partial scan."""
        return self.settings.extent != WHOLE

    @property
    def registers(self) -> bool:
        """Return whether sweeps are registered to correct pointing errors."""
        return self.settings.pointing_px > 0

    @property
    def step(self) -> int:
        """Return the line spacing of the first pass or of the uniform scan [px]; 1 of a raster."""
        return max((sweep.step for sweep in self.passes.coarse), default=1)

    @property
    def capture(self) -> LineSpec:
        """Return line spacing and light of the first pass or of the uniform scan."""
        usual_ms = self.field.camera.exposure_ms
        return LineSpec(self.field.light.light * (self.settings.scan_exposure_ms or usual_ms) / usual_ms, self.step)

    @property
    def pool(self) -> WorkerPool:
        """Return the worker pool."""
        return pool_of(self.settings)

    @property
    def work(self) -> FieldWork:
        """Return the computation of the model over the field, region by region."""
        settings = self.settings
        file = WeightsFile.of(self.field.model.path.resolve(), self.field.described, settings.device)
        return FieldWork(file, self.field.regions, self.pool, settings.memory)

    @property
    def gains(self) -> PatchGains:
        """Return the expected gain of patches by the policy of the settings."""
        settings = self.settings
        mask = None if settings.mask is None else load_labels_array(settings.mask)
        zones = self.field.zones
        return PatchGains(self.field.frame, zones, self.work, self.capture, settings.policy, settings.seed, mask)

    @property
    def second_pass(self) -> SecondPass | None:
        """Return the planner of the second pass; None for a uniform scan or a raster."""
        passes = self.passes
        if passes.plain:
            return None
        field = (self.field.grid, self.field.camera, self.settings.cost)
        recorded = self.field.recorded
        planned = SecondPass(*field, passes.coarse, passes.full, passes.fine_s, passes.margin_px)
        if recorded is None:
            return planned
        cut = partial(recorded_fine_pass, recorded)
        usual_ms = recorded_fine_ms(recorded)
        return replace(planned, recorded=cut, recorded_ms=recorded.exposures_ms, usual_ms=usual_ms)

    @property
    def scan_record(self) -> ScanPerformance | None:
        """Return the scan performance table by which a second pass is chosen; None without one."""
        content = self.field.described.scans(self.settings.law)
        if content is None or not self.passes.by_record or self.settings.policy != "gain":
            return None
        return ScanPerformance.read(content, self.field.scene.light_fraction)

    @property
    def scanned(self) -> FinePlan:
        """Return the plan of a uniform scan, or of a raster, which has no second pass."""
        sweeps = self.passes.coarse if self.passes.plain else ()
        return all_seen(self.field.grid, sweeps, self.field.camera, part=self.part)

    @property
    def typical(self) -> tuple[Sweep, ...]:
        """Return the sweeps of a uniform scan, or of a first pass and of a second one in exposures that it may have."""
        if self.passes.plain:
            return tuple(self.passes.coarse)
        content = self.field.described.scans(self.settings.law)
        exposures = [None]
        if content is not None and self.passes.by_record:
            record = ScanPerformance.read(content, self.field.scene.light_fraction)
            exposures = np.geomspace(*record.offered_ms(self.field.camera), REPRESENTATIVE).tolist()
        full = self.passes.full
        return (*self.passes.coarse, *(replace(sweep, exposure_ms=ms) for ms in exposures for sweep in full))

    @property
    def reads_overview(self) -> bool:
        """Return whether the overview is read before the map is drawn: to score patches."""
        return (not self.passes.plain or self.budget is not None) and self.settings.policy in GLANCING_POLICIES

    def work_done(self, patch_index: NDArray[np.integer], changed: NDArray[np.integer] | None = None) -> MultiplyAdds:
        """Count multiply-adds of the map with these patches at full resolution, and of the scores if used.

        ``changed`` (patch,) are those of which a second pass shows a part, by default all.
        """
        done = self.costs.of_map(patch_index)
        if self.least_gain is not None and self.passes.plain:  # while drawn, which reads the overview once
            done = replace(done, score=self.costs.score(self.settings.policy))
        elif self.chooses:
            changed = None if self.passes.plain else self.field.grid.every_patch() if changed is None else changed
            done = self.costs.with_scores(patch_index, self.settings.policy, changed)
        if self.field.reader is None:
            return done
        grid = self.field.grid
        pixels = grid.height * grid.width
        if self.extent is not None:  # its lines were chosen by the prior map
            pixels += -(-grid.height // EVERY_PX) * -(-grid.width // EVERY_PX)
        return replace(done, detail=done.detail + self.field.reader.sizes.multiply_adds(pixels))

    def reading_figures(self, read: NDArray[np.intp], changed: NDArray[np.intp] | None = None) -> dict[str, Any]:
        """Return limits, patches and multiply-adds of the full network, for receipts."""
        settings = self.settings
        everything = self.field.kept_patches
        return {
            "asked": {"macs": settings.macs, "least_gain": self.least_gain, "expected_loss": settings.expected_loss},
            "patches": len(read),
            "of_patches": len(everything),
            "multiply_adds": {
                "done": self.work_done(read, changed).total,
                "everything": self.costs.of_map(everything).total,
            },
        }

    @property
    def likely_readings(self) -> tuple[NDArray[np.intp], ...]:
        """Return as many patches as are expected to be read at full resolution, or as the budget pays for.

        Those that other scenes need are followed by the fewest and the most that one of them needs.
        """
        if self.budget is not None:  # all gain the same
            return (self.budget.choose(np.full(self.budget.costs.grid.patch_shape, np.inf).ravel()),)
        cascade = self.cascade
        least = self.least_gain
        kept = self.field.kept_patches
        every = np.intersect1d(kept, self.scanned.patch_index) if self.part else kept
        if cascade is None or least is None:
            return (every,)
        return tuple(every[: round(one * len(every))] for one in cascade.fractions_at(least))

    @property
    def likely_changed(self) -> NDArray[np.intp] | None:
        """Return the patches of which a second pass shows a part if all of them gain alike; None for a uniform scan."""
        second, record, patches = self.second_pass, self.scan_record, self.field.grid.every_patch()
        if second is None:
            return None
        alike = np.isin(patches, self.field.kept_patches) / len(patches)
        fine = second.by_score(alike)
        if record is not None:
            fine = second.best(record, lambda *scan: alike * record.expected(*scan)[MIOU])
        return np.flatnonzero(patches_shown(fine.sweeps, self.field.grid, second.camera))


def plan_survey(opened: Field) -> SurveyPlan:
    """Choose the lines of a survey, and check that machine and rig can do it. Nothing is written.

    Raises what `choose_extent`, `choose_uniform_scan`, `lay_out_passes` and `PatchBudget.asked` raise; SettingsError:
    the rig does not allow an exposure, or a tile of the mosaic exceeds the memory.
    """
    settings, described, zones = opened.settings, opened.described, opened.zones
    # a plan assumes `SMOOTH` components; most mosaics have 11 to 33
    costs = ReadingCosts(described.config, opened.grid, min(len(opened.scene.wavelength_nm), SMOOTH))
    shown = None if zones.fractions is None else zones.fractions > 0
    budget = None if settings.macs is None else PatchBudget.asked(costs, shown, settings.policy, settings.macs)
    if opened.raster is not None:  # it has no sweeps
        nothing = CapturePlan("x", [], [], coarse_s=0.0, full_s=0.0, fine_s=0.0, margin_px=0.0, plain=True)
        return SurveyPlan(
            field=opened, settings=settings, passes=nothing, costs=costs, budget=budget, notes=opened.notes
        )
    layout, extent, settings, notes = _extent(opened)
    scans = choose_uniform_scan(layout, described, opened.model.path, len(opened.scene.wavelength_nm), settings)
    passes, scans, settings, plan_notes = lay_out_passes(layout, scans, described, settings)
    if settings.source == RIG:
        check_rig(settings, (*passes.coarse, *passes.full))
    check_memory(opened.simulated, opened.grid, passes, settings.memory, pool_of(settings))
    return SurveyPlan(
        field=opened,
        settings=settings,
        passes=passes,
        costs=costs,
        scans=scans,
        budget=budget,
        extent=extent,
        notes=(*opened.notes, *plan_notes, *notes),
    )


def _extent(opened: Field) -> tuple[PassLayout, ExtentChoice | None, Settings, tuple[str, ...]]:
    """Return the layout of the passes, the partial scan that the settings ask for, settings, and notes."""
    settings, zones = opened.settings, opened.zones
    is_part = settings.extent == PART
    notes: tuple[str, ...] = ()
    if is_part and opened.prior is None:
        settings = settings.but(extent=WHOLE, max_age=None)
        notes = ("there is no prior map: the whole field is captured",)
    layout = PassLayout.of(settings, opened.grid, None if zones.kept is None else zones.shown_patches, opened.recorded)
    if not is_part or opened.prior is None:
        return layout, None, settings, notes
    masks = [one for one in (zones.left_out, opened.scene.missing) if one is not None]
    assert settings.seconds is not None
    layout, extent, note = choose_extent(
        *(layout, opened.prior, opened.described, opened.model.path, settings.law, settings.sky.fraction_of_clear),
        seconds=settings.seconds,
        max_age=settings.max_age,
        left_out=np.logical_or.reduce(masks) if masks else None,
        scored=not opened.warnings,
    )
    return layout, extent, settings, (note,)


def pool_of(settings: Settings) -> WorkerPool:
    """Return the worker pool of the settings."""
    return WorkerPool(settings.scheduler, settings.workers, settings.bucket)


def check_memory(source: SimulatedSource, grid: SceneGrid, plan: CapturePlan, memory: int, pool: WorkerPool) -> None:
    """Check that one tile of the mosaic fits the memory. Raises SettingsError: it does not; names the least memory."""
    pixels = PixelGrid.of_scene(grid)
    placed = [place(_PlannedSweep(source, sweep), source.camera) for sweep in plan.coarse]
    rows, columns = image_spec(("y", "x"), pixels.shape, "<f4").shard or pixels.shape
    tiles = plan_tiles(placed, source.camera, pixels, (rows, columns))
    tile_budget(
        MosaicWork(placed, source.camera, pixels), tiles, (rows, columns), memory=memory, pool=replace(pool, workers=1)
    )


class _PlannedSweep(SimulatedSweep):
    """Path of a sweep and size of its lines, without light: they determine the memory."""

    @property
    def references(self) -> References:
        """Return frames of a detector without faults."""
        components = min(len(self.source.wavelength_nm), USUAL_COMPONENTS)
        white = np.ones((self.source.camera.samples // self.sweep.binning, components), np.float32)
        return References(dark=np.zeros_like(white), white=white, white_reference=white[0])
