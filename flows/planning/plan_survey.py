"""Plan a survey of an opened field: its lines, what the network reads, and whether the machine can do both."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from spectralzoom.flows.field import Field
from spectralzoom.flows.opening.rig_field import check_rig
from spectralzoom.flows.plan import ReadingPlan, SecondPassRequest, SurveyPlan
from spectralzoom.flows.planning.capture_plan import (
    CapturePlan,
    PassLayout,
    ScanChoice,
    choose_uniform_scan,
    lay_out_passes,
)
from spectralzoom.flows.planning.extent_choice import ExtentChoice, choose_extent
from spectralzoom.flows.planning.patch_budget import PatchBudget, ReadingCosts
from spectralzoom.flows.settings.settings import Settings
from spectralzoom.flows.settings.values import NEVER, PART, RIG, WHOLE
from spectralzoom.flows.stages.field_work import FieldWork, WeightsFile
from spectralzoom.flows.stages.rectify import tile_budget
from spectralzoom.flows.stages.score import PatchGains, all_seen
from spectralzoom.models.network.spectral import LineSpec
from spectralzoom.models.policies.placement import CascadeTable
from spectralzoom.models.policies.policies import GLANCING_POLICIES
from spectralzoom.models.reading.prior_map import EVERY_PX
from spectralzoom.models.weights.files import BY_LAW, CASCADE
from spectralzoom.pipeline.capture.recorded_passes import recorded_fine_ms, recorded_fine_pass
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.pipeline.geometry.scan import Sweep
from spectralzoom.pipeline.planning.fine_pass import FinePlan, SecondPass
from spectralzoom.pipeline.planning.uniform_scans import ScanPerformance
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


def plan_survey(opened: Field) -> SurveyPlan:
    """Choose the lines of a survey, and check that machine and rig can do it. Nothing is written.

    Raises what `choose_extent`, `choose_uniform_scan`, `lay_out_passes` and `PatchBudget.asked` raise; SettingsError:
    the rig does not allow an exposure, or a tile of the mosaic exceeds the memory.
    """
    settings = opened.settings
    if opened.raster is not None:  # it has no sweeps
        nothing = CapturePlan("x", [], [], coarse_s=0.0, full_s=0.0, fine_s=0.0, margin_px=0.0, plain=True)
        return _plan_of(opened, settings, nothing, ScanChoice(), None, opened.notes)
    layout, extent, settings, notes = _extent(opened)
    scans = choose_uniform_scan(layout, opened.described, opened.model.path, len(opened.scene.wavelength_nm), settings)
    passes, scans, settings, plan_notes = lay_out_passes(layout, scans, opened.described, settings)
    if settings.source == RIG:
        check_rig(settings, (*passes.coarse, *passes.full))
    check_memory(opened.simulated, opened.grid, passes, settings.memory, pool_of(settings))
    return _plan_of(opened, settings, passes, scans, extent, (*opened.notes, *plan_notes, *notes))


def _plan_of(
    opened: Field,
    settings: Settings,
    passes: CapturePlan,
    scans: ScanChoice,
    extent: ExtentChoice | None,
    notes: tuple[str, ...],
) -> SurveyPlan:
    """Return the plan with these passes."""
    usual_ms = opened.camera.exposure_ms
    light = opened.light.light * (settings.scan_exposure_ms or usual_ms) / usual_ms
    step = max((sweep.step for sweep in passes.coarse), default=1)
    capture = LineSpec(light, step)
    part = settings.extent != WHOLE
    content = opened.described.scans(settings.law) if passes.by_record else None
    record = None if content is None else ScanPerformance.read(content, opened.scene.light_fraction)
    scanned = all_seen(opened.grid, passes.coarse if passes.plain else (), opened.camera, part=part)
    reading = _reading(opened, settings, passes, capture, extent, scanned)
    glances = (not passes.plain or reading.budget is not None) and settings.policy in GLANCING_POLICIES
    return SurveyPlan(
        field=opened,
        settings=settings,
        pool=pool_of(settings),
        passes=passes,
        capture=capture,
        step=step,
        typical=_typical(passes, opened, record),
        part=part,
        registers=settings.pointing_px > 0,
        request=SecondPassRequest(
            planner=None if passes.plain else _second_pass(opened, settings, passes),
            scan_record=record if settings.policy == "gain" else None,
            scanned=scanned,
            overview_first=glances,
        ),
        reading=reading,
        scans=scans,
        extent=extent,
        control=_control(opened, settings, passes, scans),
        notes=notes,
    )


def _reading(
    opened: Field,
    settings: Settings,
    passes: CapturePlan,
    capture: LineSpec,
    extent: ExtentChoice | None,
    scanned: FinePlan,
) -> ReadingPlan:
    """Return what the network reads, region by region."""
    described, grid, zones, kept = opened.described, opened.grid, opened.zones, opened.kept_patches
    # a plan assumes `SMOOTH` components; most mosaics have 11 to 33
    costs = ReadingCosts(described.config, grid, min(len(opened.scene.wavelength_nm), SMOOTH))
    shown = None if zones.fractions is None else zones.fractions > 0
    file = WeightsFile.of(opened.model.path.resolve(), described, settings.device)
    work = FieldWork(file, opened.regions, pool_of(settings), settings.memory)
    mask = None if settings.mask is None else load_labels_array(settings.mask)
    cascade = _cascade(opened, settings)
    return ReadingPlan(
        gains=PatchGains(opened.frame, zones, work, capture, settings.policy, settings.seed, mask),
        costs=costs,
        kept=kept,
        seen=np.intersect1d(kept, scanned.patch_index) if settings.extent != WHOLE else kept,
        one_pass=passes.plain,
        macs=settings.macs,
        expected_loss=settings.expected_loss,
        budget=None if settings.macs is None else PatchBudget.asked(costs, shown, settings.policy, settings.macs),
        cascade=cascade,
        least_gain=_least_gain(cascade, settings, with_prior=opened.prior is not None),
        reader=None if opened.prior is None else described.reader,
        compared_px=compared_px(grid, chosen=extent is not None),
    )


def compared_px(grid: SceneGrid, *, chosen: bool) -> int:
    """Return the pixels of a prior map that its reader compares: for the map, and where it has ``chosen`` the lines."""
    choice = -(-grid.height // EVERY_PX) * -(-grid.width // EVERY_PX)
    return grid.height * grid.width + chosen * choice


def _cascade(opened: Field, settings: Settings) -> CascadeTable | None:
    """Return the table of losses; None without an accepted loss, or where the weights have no table or network."""
    described = opened.described
    content = described.record.get(CASCADE) if settings.expected_loss and described.config.corrected else None
    return None if content is None else CascadeTable.read({**content, **content.get(BY_LAW, {}).get(settings.law, {})})


def _least_gain(cascade: CascadeTable | None, settings: Settings, *, with_prior: bool) -> float | None:
    """Return the least expected gain of patches that are read at full resolution; None where all are read.

    It follows from the accepted loss, unless the settings limit multiply-adds. A prior map leaves less to gain.
    """
    if cascade is None or settings.macs is not None or settings.policy != "gain":
        return None
    least = cascade.within(settings.expected_loss / 100)
    return PRIOR_MAP_GAIN * least if with_prior and least is not None else least


def _second_pass(opened: Field, settings: Settings, passes: CapturePlan) -> SecondPass:
    """Return the planner of the second pass; that over a recording takes lines that it has."""
    field = (opened.grid, opened.camera, settings.cost)
    planned = SecondPass(*field, passes.coarse, passes.full, passes.fine_s, passes.margin_px)
    if opened.recorded is None:
        return planned
    cut = partial(recorded_fine_pass, opened.recorded)
    recorded_ms, usual_ms = opened.recorded.exposures_ms, recorded_fine_ms(opened.recorded)
    return replace(planned, recorded=cut, recorded_ms=recorded_ms, usual_ms=usual_ms)


def _typical(passes: CapturePlan, opened: Field, record: ScanPerformance | None) -> tuple[Sweep, ...]:
    """Return the sweeps of a uniform scan, or of a first pass and of a second one in exposures that it may have."""
    if passes.plain:
        return tuple(passes.coarse)
    offered: list[float | None] = [None]
    if record is not None:
        offered = np.geomspace(*record.offered_ms(opened.camera), REPRESENTATIVE).tolist()
    return (*passes.coarse, *(replace(sweep, exposure_ms=ms) for ms in offered for sweep in passes.full))


def _control(opened: Field, settings: Settings, passes: CapturePlan, scans: ScanChoice) -> SurveyPlan | None:
    """Return the plan of the best uniform scan of the same seconds; None unless it is asked for and another plan.

    Only a simulated field with labels can be captured again as it was.
    """
    judged = settings.controls and settings.accuracy and opened.simulates and opened.scene.labelled
    scan = scans.best_in_time(passes.coarse_s + passes.fine_s) if judged else None
    if scan is None or (scan == scans.chosen and opened.prior is None):
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
    return plan_survey(replace(opened, settings=settings, prior=None))


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
