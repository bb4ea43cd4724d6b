"""Open a survey: scene, source, weights, grid, plan of captures and archive, all checked before anything runs."""

from __future__ import annotations

import time
import zlib
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spectralzoom.flows.settings.survey_settings import RECORDED, RIG, Settings
from spectralzoom.flows.settings.values import EXTENT_PART, EXTENT_WHOLE
from spectralzoom.flows.tasks.capture_plan import (
    CapturePlan,
    PassLayout,
    ScanChoice,
    choose_uniform_scan,
    lay_out_passes,
)
from spectralzoom.flows.tasks.extent_choice import ExtentChoice, choose_extent
from spectralzoom.flows.tasks.field_work import FieldWork, WeightsFile
from spectralzoom.flows.tasks.patch_budget import SHARD, PatchBudget, ReadingCosts
from spectralzoom.flows.tasks.prior_maps import AUTO, NONE, Prior, find_prior
from spectralzoom.flows.tasks.recorded_field import OpenedRecording, open_recorded
from spectralzoom.flows.tasks.scene import (
    FieldSource,
    SimulatedField,
    check_labels,
    check_scene_there,
    farm_refusal,
    for_rig,
    judged_labels,
    open_map,
    open_scene,
    scene_of_visit,
)
from spectralzoom.flows.tasks.stage import FieldFrame, Report
from spectralzoom.flows.tasks.stages.attention import PatchGains, all_seen
from spectralzoom.flows.tasks.stages.capture import SweepRecorder
from spectralzoom.flows.tasks.stages.placement import tile_budget
from spectralzoom.flows.tasks.survey_model import SurveyModel, beyond_training, other_unit, training_note, weights_path
from spectralzoom.flows.tasks.zones import SurveyZones, open_zones, place_of_field
from spectralzoom.models.evaluation.expected_scores import MapScores
from spectralzoom.models.network.machine import PROCESSOR, choose_device
from spectralzoom.models.network.sizes import MultiplyAdds
from spectralzoom.models.network.spectral import LineSpec
from spectralzoom.models.policies.placement import CascadeTable
from spectralzoom.models.reading.prior_map import EVERY_PX
from spectralzoom.models.reading.regions import plan_regions
from spectralzoom.models.weights.checksummed_files import SEAL
from spectralzoom.models.weights.files import CASCADE, Description, ReaderPart, Weights
from spectralzoom.pipeline.capture.recorded_passes import RecordedPasses
from spectralzoom.pipeline.errors import SceneError, SettingsError, WeightsError
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.pipeline.geometry.scan import Sweep
from spectralzoom.pipeline.ground.field_places import PosedField
from spectralzoom.pipeline.ground.map_grid import GroundGrid
from spectralzoom.pipeline.once import Once
from spectralzoom.pipeline.planning.fine_pass import FinePlan, SecondPass
from spectralzoom.pipeline.planning.uniform_scans import ScanPerformance
from spectralzoom.pipeline.rectify.placed import PixelGrid, place
from spectralzoom.pipeline.rectify.region import MosaicWork, plan_tiles
from spectralzoom.pipeline.signal.subspace import SMOOTH
from spectralzoom.pipeline.simulator.effects.pointing import PointingErrors
from spectralzoom.pipeline.simulator.scenes.farm.farm_scene import USUAL_DAY, USUAL_HOUR
from spectralzoom.pipeline.simulator.scenes.scene import DEFAULT_EXPOSURE_MS, RasterScene
from spectralzoom.pipeline.simulator.simulated import SimulatedSource, SimulatedSweep
from spectralzoom.pipeline.source import References
from spectralzoom.storage.arrays.layout import image_spec
from spectralzoom.storage.parallel.pool import WorkerPool
from spectralzoom.storage.readers.open_cubes import load_labels_array
from spectralzoom.storage.readers.scene_files import RasterPixels, SceneFile
from spectralzoom.storage.store import Archive, is_archive

PRIOR_MAP_GAIN = 3.0  # least gain with a prior map over that without one: losses are then alike (prior-maps.md)
REPRESENTATIVE = 3  # exposures of a second pass, for which effects are chosen
USUAL_COMPONENTS = 32  # of condensed lines, before they are computed


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


@dataclass(frozen=True, kw_only=True)
class CaptureRun:
    """Opened scene, source and archive of a capture."""

    settings: Settings
    archive: Archive
    source: FieldSource
    simulated: SimulatedSource  # without effects; for a rig, a model of its sizes, paths and memory
    scene: RasterScene
    planned: tuple[Sweep, ...]  # they represent all sweeps of the capture
    report: Report = field(default=lambda done: None)

    @property
    def camera(self) -> LineCamera:
        """Return the camera of the settings."""
        return self.settings.camera

    @property
    def name(self) -> str:
        """Return the name of the field, or of its scene."""
        return self.settings.name or Path(self.scene.name).stem

    @property
    def source_key(self) -> dict[str, Any]:
        """Return the parameters of the captured light, without sweeps and effects."""
        return {
            "source": self.source.name,
            "scene": self.scene.key,
            "seed": noise_seed(self.settings),
            "camera": asdict(self.camera),
            "pointing_px": self.settings.pointing_px,
            **({} if self.settings.visit is None else {"visit": self.settings.visit}),
            **self.source.key(self.name),
        }

    @property
    def recorder(self) -> SweepRecorder:
        """Return the recorder of sweeps."""
        bands = self.scene.wavelength_nm, self.scene.fwhm_nm
        return SweepRecorder(
            self.archive, self.source, self.source_key, *bands, self.camera, self.settings.cost, self.settings.pool
        )


@dataclass(frozen=True, kw_only=True)
class SurveyRun(CaptureRun):
    """Opened survey, as stages take their arguments from it; see `open_run`."""

    described: Description  # record of the weights
    load: Once[Weights]
    grid: SceneGrid
    costs: ReadingCosts  # multiply-adds of reading the field
    plan: CapturePlan
    scans: ScanChoice
    zones: SurveyZones
    recorded: RecordedPasses | None = None  # of recorded sweeps
    raster: RasterPixels | None = None  # of a scene that needs no capture
    budget: PatchBudget | None = None  # None: no limit of multiply-adds
    extent: ExtentChoice | None = None  # of a partial scan
    prior: Prior | None = None  # prior map
    notes: tuple[str, ...] = ()
    refused: str | None = None  # why this machine cannot run a survey that is only planned
    outside: bool = False  # of the conditions of the training

    @property
    def weights(self) -> Weights:
        """Return the weights, which are read on first use."""
        return self.load()

    @property
    def reader(self) -> ReaderPart | None:
        """Return the temporal reader of the weights; None where they have none."""
        return self.described.reader

    @property
    def map_scores(self) -> MapScores | None:
        """Return the calibration of expected scores; None where the weights have none, or outside of their training."""
        return None if self.outside else self.described.map_scores

    @property
    def model_key(self) -> dict[str, Any]:
        """Return the parameters of stages that use the weights."""
        return {
            "weights": self.described.key,
            **({} if self.settings.device == PROCESSOR else {"device": self.settings.device}),
        }

    @property
    def least_gain(self) -> float | None:
        """Return the least expected gain of patches that are read at full resolution; None where all are read.

        It follows from the accepted loss, unless the settings limit multiply-adds. A prior map leaves less to gain.
        """
        cascade = self.cascade
        if cascade is None or self.settings.macs is not None or self.settings.policy != "gain":
            return None
        least = cascade.within(self.settings.expected_loss / 100)
        return least if least is None or self.prior is None else PRIOR_MAP_GAIN * least

    @property
    def cascade(self) -> CascadeTable | None:
        """Return the table of losses; None without an accepted loss, or where the weights have no table."""
        content = self.described.record.get(CASCADE) if self.settings.expected_loss else None
        return None if content is None else CascadeTable.read(content)

    @property
    def chooses(self) -> bool:
        """Return whether scores choose patches; not where all are captured and read at full resolution."""
        return not self.plan.plain or self.budget is not None or self.least_gain is not None

    @property
    def controls(self) -> bool:
        """Return whether the evaluation also judges the small network alone and the full one everywhere."""
        return self.settings.controls and (self.chooses or self.raster is not None)

    @cached_property
    def labels(self) -> NDArray[np.uint8] | None:
        """Return labels (y, x) in the classes of the weights, without pixels of their training. Draws the scene."""
        return judged_labels(self.scene, self.described)

    @property
    def frame(self) -> FieldFrame:
        """Return the frame of all images of the survey."""
        bands = self.scene.wavelength_nm, self.scene.fwhm_nm
        return FieldFrame(self.grid, self.camera.ifov_rad, *bands, self.scene.missing, self.scene.geobox)

    @property
    def work(self) -> FieldWork:
        """Return the computation of the model over the field, region by region."""
        file = WeightsFile(weights_path(self.settings).resolve(), self.described.about[SEAL], self.settings.device)
        return FieldWork(file, plan_regions(self.grid, SHARD), self.settings.pool, self.settings.memory)

    @property
    def part(self) -> bool:
        """Return whether the capture is a partial scan."""
        return self.settings.extent != EXTENT_WHOLE

    @property
    def step(self) -> int:
        """Return the line spacing of the first pass or of the uniform scan [px]; 1 of a raster."""
        return max((sweep.step for sweep in self.plan.coarse), default=1)

    @property
    def capture(self) -> LineSpec:
        """Return line spacing and light of the first pass or of the uniform scan."""
        chosen_ms = self.settings.scan_exposure_ms if self.plan.plain else self.settings.coarse_exposure_ms
        exposure_ms = chosen_ms or self.camera.exposure_ms
        return LineSpec(
            self.light.light * (exposure_ms or self.camera.exposure_ms) / self.camera.exposure_ms, self.step
        )

    @property
    def light(self) -> LineSpec:
        """Return line spacing and light of a full scan in the camera's exposure."""
        return LineSpec(self.camera.exposure_ms * self.scene.light_fraction / DEFAULT_EXPOSURE_MS)

    @property
    def gains(self) -> PatchGains:
        """Return the expected gain of patches by the policy of the settings."""
        settings = self.settings
        mask = None if settings.mask is None else load_labels_array(settings.mask)
        return PatchGains(self.frame, self.zones, self.work, self.capture, settings.policy, settings.seed, mask)

    @property
    def second_pass(self) -> SecondPass | None:
        """Return the planner of the second pass; None for a uniform scan or a raster."""
        plan = self.plan
        if plan.plain:
            return None
        field = (self.grid, self.camera, self.settings.cost)
        of_recording = () if (one := self.recorded) is None else (one.fine_pass, one.exposures_ms, one.fine_ms)
        return SecondPass(*field, plan.coarse, plan.full, plan.fine_s, plan.margin_px, *of_recording)

    @property
    def scan_record(self) -> ScanPerformance | None:
        """Return the scan performance table by which a second pass is chosen; None without one."""
        content = self.described.record.get("scans")
        if content is None or not self.plan.by_record or self.settings.policy != "gain":
            return None
        return ScanPerformance.read(content, self.scene.light_fraction)

    @property
    def scanned(self) -> FinePlan:
        """Return the plan of a uniform scan, or of a raster, which has no second pass."""
        return all_seen(self.grid, self.plan.coarse if self.plan.plain else (), self.camera, part=self.part)

    @property
    def ground_grid(self) -> GroundGrid:
        """Return the grid of the map on the ground; the survey has a pose."""
        assert isinstance(self.zones.place, PosedField)
        return self.zones.place.grid

    def work_done(self, patch_index: NDArray[np.integer]) -> MultiplyAdds:
        """Count multiply-adds of the map with these patches at full resolution, and of the scores if used."""
        done = self.costs.of_map(patch_index)
        if self.least_gain is not None and self.plan.plain:  # while drawn, which reads the overview once
            done = replace(done, score=self.costs.score(self.settings.policy))
        elif self.chooses:
            done = self.costs.with_scores(patch_index, self.settings.policy)
        if self.prior is None or self.reader is None:
            return done
        pixels = self.grid.height * self.grid.width
        if self.extent is not None:  # its lines were chosen by the prior map
            pixels += -(-self.grid.height // EVERY_PX) * -(-self.grid.width // EVERY_PX)
        return replace(done, detail=done.detail + self.reader.sizes.multiply_adds(pixels))

    def reading_figures(self, patch_index: NDArray[np.integer]) -> dict[str, Any]:
        """Return limits, patches and multiply-adds of the full network, for receipts."""
        settings = self.settings
        everything = self.kept_patches
        return {
            "asked": {"macs": settings.macs, "least_gain": self.least_gain, "expected_loss": settings.expected_loss},
            "patches": len(patch_index),
            "of_patches": len(everything),
            "multiply_adds": {
                "done": self.work_done(patch_index).total,
                "everything": self.costs.of_map(everything).total,
            },
        }

    @property
    def kept_patches(self) -> NDArray[np.intp]:
        """Return the patches that zones leave."""
        fractions = self.zones.fractions
        return self.grid.every_patch() if fractions is None else np.flatnonzero(fractions > 0)

    @property
    def likely_patches(self) -> NDArray[np.intp]:
        """Return as many patches as are expected to be read at full resolution, or as the budget pays for."""
        if self.budget is not None:
            return self.budget.choose(np.full(self.budget.costs.grid.patch_shape, np.inf).ravel())  # all gain the same
        cascade = self.cascade
        least = self.least_gain
        every = np.intersect1d(self.kept_patches, self.scanned.patch_index) if self.part else self.kept_patches
        return every if cascade is None or least is None else every[: round(cascade.fraction_at(least) * len(every))]


def open_run(settings: Settings, *, planning: bool = False, archive: Archive | None = None) -> SurveyRun:
    """Open and check everything that a survey needs; the archive last, so that bad input creates none.

    With ``planning``, no pixels are drawn, and a scene that exceeds the memory is no error but ``refused`` of the run.
    ``archive`` is that of the settings by default. Raises PipelineError: the first error.
    """
    settings = scene_of_visit(for_rig(settings), datetime.now().astimezone())
    check_scene_there(settings.scene)
    recorded = open_recorded(settings) if settings.source == RECORDED else None
    settings = settings if recorded is None else recorded.settings
    settings = replace(settings, device=choose_device(settings.device))
    model = SurveyModel.open(weights_path(settings), settings.device, planning=planning)
    described = model.described
    refused = farm_refusal(settings)
    if refused is not None and not planning:
        raise SettingsError(refused)
    pixels, scene, notes, label_notes = _scene_for(model, settings, recorded, planning=planning)
    grid = SceneGrid(*scene.shape, described.config.patch)
    zones = open_zones(settings.zones, place_of_field(settings, scene), grid)
    outside = beyond_training(settings, scene, described, model.trained_on)
    name = settings.name or Path(scene.name).stem
    found = None
    if settings.extent == EXTENT_PART:  # the prior map chooses the lines
        archive = Archive.open(settings.out) if archive is None and is_archive(settings.out) else archive
        found = (
            (None, ()) if archive is None else find_prior(archive, settings, name, grid, described.class_names, scene)
        )
    passes = None if recorded is None else RecordedPasses(recorded.field.source)
    planned = _PlannedCapture(settings)
    if pixels is None:
        prior = None if found is None else found[0]
        planned = _plan_capture(settings, scene, zones, model.path, described, prior, passes)
    settings = planned.settings
    # a plan assumes `SMOOTH` components; most mosaics have 11 to 33
    costs = ReadingCosts(described.config, grid, min(len(scene.wavelength_nm), SMOOTH))
    shown = None if zones.fractions is None else zones.fractions > 0
    budget = None if settings.macs is None else PatchBudget.asked(costs, shown, settings.policy, settings.macs)
    source, simulated, raster = _open_source(settings, scene, grid, planned.plan, recorded, pixels)
    archive = Archive.open(settings.out) if archive is None else archive
    if raster is not None and not planning:
        outside += other_unit(raster, scene.wavelength_nm, model.load())
    prior, prior_notes = found or find_prior(archive, settings, name, grid, described.class_names, scene)
    if settings.prior != AUTO:  # a receipt names the run
        settings = replace(settings, prior=NONE if prior is None else prior.run)
    return SurveyRun(
        settings=settings,
        archive=archive,
        source=source,
        simulated=simulated,
        scene=scene,
        planned=_representative_sweeps(planned.plan, settings, scene, described),
        described=described,
        load=model.load,
        grid=grid,
        costs=costs,
        plan=planned.plan,
        recorded=passes,
        scans=planned.scans,
        zones=zones,
        raster=raster,
        budget=budget,
        extent=planned.extent,
        prior=prior,
        notes=(*notes, *zones.notes, *planned.notes, *prior_notes, *training_note(outside, model.path), *label_notes),
        refused=refused,
        outside=bool(outside),
    )


def _representative_sweeps(
    plan: CapturePlan, settings: Settings, scene: RasterScene, described: Description
) -> tuple[Sweep, ...]:
    """Return the sweeps of a uniform scan, or of a first pass and full scans of exposures that a second may have."""
    if plan.plain:
        return tuple(plan.coarse)
    record = described.record.get("scans")
    exposures = [None]
    if record is not None and plan.by_record:
        ends = ScanPerformance.read(record, scene.light_fraction).offered_ms(settings.camera)
        exposures = np.geomspace(*ends, REPRESENTATIVE).tolist()
    return (*plan.coarse, *(replace(sweep, exposure_ms=ms) for ms in exposures for sweep in plan.full))


def _open_source(
    settings: Settings,
    scene: RasterScene,
    grid: SceneGrid,
    plan: CapturePlan,
    recorded: OpenedRecording | None,
    pixels: SceneFile | None,
) -> tuple[FieldSource, SimulatedSource, RasterPixels | None]:
    """Return the source of lines, the simulated rig, and the pixels of a raster; all fit the memory."""
    simulated = make_source(scene, settings)
    source: FieldSource = SimulatedField(simulated)
    if recorded is not None:
        source = recorded.field
    elif settings.is_map:
        source = FieldSource()
    elif settings.source == RIG:
        from spectralzoom.flows.tasks.rig_field import rig_field

        source = rig_field(scene, settings, (*plan.coarse, *plan.full), simulated)
    if pixels is None:
        check_memory(simulated, grid, plan, settings.memory, settings.pool)
        return source, simulated, None
    raster = RasterPixels(pixels.read, pixels.missing, len(scene.wavelength_nm), grid)
    raster.rows_at_once(settings.memory)  # raises an error where one row of patches does not fit
    return source, simulated, raster


@dataclass(frozen=True)
class _PlannedCapture:
    """Planned lines of a survey, the choices behind them, and settings that request exactly these lines."""

    settings: Settings
    plan: CapturePlan = field(  # a raster has no sweeps
        default_factory=lambda: CapturePlan(
            "x", coarse=[], full=[], coarse_s=0.0, full_s=0.0, fine_s=0.0, margin_px=0.0, plain=True
        )
    )
    scans: ScanChoice = field(default_factory=ScanChoice)
    extent: ExtentChoice | None = None
    notes: tuple[str, ...] = ()


def _plan_capture(
    settings: Settings,
    scene: RasterScene,
    zones: SurveyZones,
    path: Path,
    described: Description,
    prior: Prior | None,
    passes: RecordedPasses | None,
) -> _PlannedCapture:
    """Choose the extent, then the uniform scan or two passes, for the weights of the file ``path``.

    Raises what `choose_extent`, `choose_uniform_scan` and `lay_out_passes` raise.
    """
    extent = None
    extent_notes: tuple[str, ...] = ()
    is_part = settings.extent == EXTENT_PART
    if is_part and prior is None:
        settings = replace(settings, extent=EXTENT_WHOLE, max_age=None)
        extent_notes = ("there is no prior map: the whole field is captured",)
    shown = None if zones.kept is None else zones.shown_patches
    layout = PassLayout.of(settings, zones.grid, shown, passes)
    if is_part and prior is not None:
        masks = [one for one in (zones.left_out, scene.missing) if one is not None]
        assert settings.seconds is not None
        layout, extent, note = choose_extent(
            *(layout, prior, described, path, settings.sky.fraction_of_clear),
            seconds=settings.seconds,
            max_age=settings.max_age,
            left_out=np.logical_or.reduce(masks) if masks else None,
        )
        extent_notes = (note,)
    scans = choose_uniform_scan(layout, described, path, len(scene.wavelength_nm), settings)
    plan, scans, settings, plan_notes = lay_out_passes(layout, scans, described, settings)
    return _PlannedCapture(settings, plan, scans, extent, (*plan_notes, *extent_notes))


def _scene_for(
    model: SurveyModel, settings: Settings, recorded: OpenedRecording | None, *, planning: bool
) -> tuple[SceneFile | None, RasterScene, tuple[str, ...], tuple[str, ...]]:
    """Open a scene that the weights can read; drawn unless for ``planning``.

    Returns the file of a raster or None, the scene, notes on it, and notes on its labels.
    """
    pixels = None
    if recorded is not None:
        scene, notes = recorded.scene()
        scene = scene.in_light(settings.sky.fraction_of_clear)
    elif settings.is_map:
        pixels, scene, notes = open_map(settings)
    else:
        scene, notes = open_scene(settings)
    if not planning:  # before the stages, whose time is measured
        scene.raster.drawn()
        scene.light()
    basis = model.described.basis
    if not basis.matrix(scene.wavelength_nm)[1].any():
        raise WeightsError(
            f"the weights {model.path.name} are for {basis.low_nm:.0f}-{basis.high_nm:.0f} nm; the scene's bands lie at"
            f" {scene.wavelength_nm.min():.0f}-{scene.wavelength_nm.max():.0f} nm: use weights trained on such data"
        )
    label_notes = check_labels(scene, model.described)
    size = None if settings.mask is None else load_labels_array(settings.mask).shape[:2]
    if size not in (None, scene.shape):
        raise SceneError(
            f"--mask {settings.mask} is {size} px (y, x), the scene is {scene.shape}; give one of its size"
        )
    return pixels, scene, notes, label_notes


def noise_seed(settings: Settings) -> int:
    """Return the seed of noise, clouds and pointing errors: each visit, day and hour has its own."""
    moment = "" if settings.moment in (None, (USUAL_DAY, USUAL_HOUR)) else settings.moment
    return zlib.crc32(f"{settings.visit or ''}{moment}".encode()) << 64 | settings.seed


def make_source(scene: RasterScene, settings: Settings) -> SimulatedSource:
    """Return the simulated rig in front of a scene, without effects."""
    pointing = None
    seed = noise_seed(settings)
    if settings.source == "sim" and settings.pointing_px:
        pointing = PointingErrors(offset_px=settings.pointing_px, seed=seed)
    return SimulatedSource(scene, settings.simulated_rig, seed, {}, name=settings.source, pointing=pointing)


def now() -> str:
    """Return the present time in ISO 8601, UTC."""
    return time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
