"""One survey's context: scene, source, weights, grid, plan of captures and archive, checked before anything runs."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from flows.settings.survey_settings import RECORDED, RIG, MapChoice, Settings
from flows.settings.values import EXTENT_PART, EXTENT_WHOLE
from flows.tasks.capture_plan import CapturePlan, PassLayout
from flows.tasks.drawing import UnknownRule
from flows.tasks.extent_choice import ExtentChoice, choose_extent
from flows.tasks.field_work import FieldWork, WeightsFile
from flows.tasks.mosaic_work import tile_budget
from flows.tasks.patch_budget import SHARD, PatchBudget, ReadingCosts
from flows.tasks.prior_maps import AUTO, NONE, Prior, find_prior
from flows.tasks.recorded_field import OpenedRecording, open_recorded
from flows.tasks.scan_choice import ScanChoice, choose_uniform_scan, lay_out_passes
from flows.tasks.scene import (
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
from flows.tasks.stage import FieldFrame, Report
from flows.tasks.stages.capture import SweepRecorder
from flows.tasks.survey_model import SurveyModel, beyond_training, weights_path
from flows.tasks.zones import SurveyZones, open_zones, place_of_field
from models.evaluation.cascade import CascadeTable
from models.evaluation.expected_scores import MapScores
from models.network.machine import PROCESSOR, choose_device
from models.network.sizes import MultiplyAdds
from models.network.spectral import LineSpec
from models.reading.regions import plan_regions
from models.weights.checksummed_files import SEAL
from models.weights.files import CASCADE, Description, Weights
from models.weights.parts import OodPart, ReaderPart
from pipeline.capture.recorded_passes import RecordedPasses
from pipeline.errors import SceneError, SettingsError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import Sweep
from pipeline.ground.field_places import PosedField
from pipeline.ground.map_grid import GroundGrid
from pipeline.lazy import Once, deferred
from pipeline.planning.uniform_scans import ScanPerformance
from pipeline.rectify.placed import PixelGrid, place
from pipeline.rectify.region import MosaicWork, plan_tiles
from pipeline.signal.subspace import SMOOTH
from pipeline.simulator.effects.pointing import PointingErrors
from pipeline.simulator.scenes.scene import DEFAULT_EXPOSURE_MS, RasterScene
from pipeline.simulator.simulated import SimulatedSource, SimulatedSweep
from pipeline.source import References
from storage.archive.archive import Archive
from storage.arrays.layout import image_spec
from storage.parallel.pool import WorkerPool
from storage.readers.open_cubes import load_labels_array
from storage.readers.raster_fields import RasterPixels
from storage.readers.scene_files import SceneFile
from storage.remote.opening import is_archive, open_archive

if TYPE_CHECKING:
    import flows.tasks.rig_field as rig_field
else:
    rig_field = deferred("flows.tasks.rig_field")


USUAL_COMPONENTS = 32  # of condensed lines, before they are known


def check_memory(source: SimulatedSource, grid: SceneGrid, plan: CapturePlan, memory: int, pool: WorkerPool) -> None:
    """Refuse a memory below one tile of the mosaic before anything is captured (SettingsError, with the least)."""
    pixels = PixelGrid.of_scene(grid, 1)
    placed = [place(_PlannedSweep(source, sweep), source.camera) for sweep in plan.coarse]
    rows, columns = image_spec(("y", "x"), pixels.shape, "<f4").shard or pixels.shape
    tiles = plan_tiles(placed, source.camera, pixels, (rows, columns))
    work = MosaicWork(placed, source.camera, pixels)
    tile_budget(work, tiles, (rows, columns), memory=memory, pool=replace(pool, workers=1))


class _PlannedSweep(SimulatedSweep):
    """The path of a sweep and the size of its lines, which is all that memory depends on; no light is asked for."""

    @property
    def references(self) -> References:
        """Frames of a detector without a fault, as the simulated one is."""
        components = min(len(self.source.wavelength_nm), USUAL_COMPONENTS)
        white = np.ones((self.source.camera.samples // self.sweep.binning, components), np.float32)
        return References(dark=np.zeros_like(white), white=white, white_reference=white[0])


@dataclass(frozen=True, kw_only=True)
class CaptureRun:
    """Needs of deciding on effects and of capturing."""

    settings: Settings
    archive: Archive
    source: FieldSource  # who takes the lines
    simulated: SimulatedSource  # without effects; beside a rig it stands for the plan: sizes, paths and memory
    scene: RasterScene
    planned: tuple[Sweep, ...]  # that stand for all the rig may take: the coarse pass and the scan of everything
    report: Report = field(default=lambda done: None)

    @property
    def camera(self) -> LineCamera:
        """The camera of the settings."""
        return self.settings.camera

    @property
    def scene_key(self) -> str:
        """Names what the scene holds."""
        return self.scene.key

    @property
    def name(self) -> str:
        """Return what the survey is called: its field, or its scene."""
        return self.settings.name or Path(self.scene.name).stem

    @property
    def source_key(self) -> dict[str, Any]:
        """Return what the captured light depends on, beside the sweeps and the effects."""
        return {
            "source": self.source.name,
            "scene": self.scene.key,
            "seed": self.settings.seed,
            "camera": asdict(self.camera),
            "pointing_px": self.settings.pointing_px,
            **({} if self.settings.visit is None else {"visit": self.settings.visit}),
            **self.source.key(self.name),
        }

    @property
    def recorder(self) -> SweepRecorder:
        """Return what takes the sweeps into the archive."""
        scene, settings = self.scene, self.settings
        bands = scene.wavelength_nm, scene.fwhm_nm
        return SweepRecorder(
            self.archive, self.source, self.source_key, *bands, self.camera, settings.cost, settings.pool
        )


@dataclass(frozen=True, kw_only=True)
class SurveyRun(CaptureRun):
    """Everything a stage may look at. Made by `open_run`, which refuses what cannot work."""

    described: Description  # what the weights say of themselves
    load: Once[Weights]
    grid: SceneGrid
    costs: ReadingCosts  # multiply-adds of reading the field
    plan: CapturePlan
    scans: ScanChoice
    zones: SurveyZones  # what the survey keeps to, and plots
    recorded: RecordedPasses | None = None  # the recording whose lines the passes take
    raster: RasterPixels | None = None  # the pixels of a scene that is a map already: nothing is captured of it
    budget: PatchBudget | None = None  # of patches of a uniform scan, where a part of them alone is kept and read
    extent: ExtentChoice | None = None  # the part of a remembered field that is looked at, where one was chosen
    prior: Prior | None = None  # the run whose class probabilities the visit starts from
    ood_detector: OodPart | None = None  # what is familiar to the weights, where pixels may be called unknown
    notes: tuple[str, ...] = ()
    refused: str | None = None  # why this machine would refuse the survey; it is planned nevertheless

    @property
    def weights(self) -> Weights:
        """The weights, read when they are first asked for."""
        return self.load()

    @property
    def weights_key(self) -> str:
        """Names what the weights hold."""
        return self.described.key

    @property
    def reader(self) -> ReaderPart | None:
        """The reader of prior maps that the weights have, if any."""
        return self.described.reader

    @property
    def map_scores(self) -> MapScores | None:
        """Return how what maps expect of themselves came true, where that was measured."""
        return None if self.described.ood_detector is None else self.described.ood_detector.map_scores

    @property
    def device(self) -> str:
        """Return where the network computes."""
        return self.settings.device

    @property
    def model_key(self) -> dict[str, Any]:
        """Return the parameters of stages that use the weights: their key, and a device other than the processor."""
        return {"weights": self.weights_key, **({} if self.device == PROCESSOR else {"device": self.device})}

    @property
    def least_gain(self) -> float | None:
        """Expected gain from which on patches of a uniform scan or a raster are read in full; None where all are.

        It follows from the loss that the settings allow where they name neither gain nor multiply-adds.
        """
        settings, allowed = self.settings, self.cascade
        if settings.macs is not None or self.part:
            return None
        if settings.least_gain is not None:
            return settings.least_gain
        return None if allowed is None or settings.policy != "gain" else allowed[0]

    @property
    def cascade(self) -> tuple[float, float] | None:
        """Least gain and fraction of patches that lose what the settings allow; None without a table of losses."""
        content = self.described.record.get(CASCADE)
        return None if content is None else CascadeTable.read(content).within(self.settings.expected_loss / 100)

    @property
    def chooses(self) -> bool:
        """Return whether patches are chosen by their scores; where all are seen and read there is nothing to choose."""
        return not self.plan.plain or self.budget is not None or self.least_gain is not None

    @property
    def controls(self) -> bool:
        """Return whether other placements of patches are judged too; a uniform scan that is read whole places none."""
        return self.settings.controls and (self.chooses or self.raster is not None)

    @cached_property
    def labels(self) -> NDArray[np.uint8] | None:
        """Return what to judge by, (y, x) in the weights' classes: trained pixels taken out. Draws the scene."""
        return judged_labels(self.scene, self.described)

    @cached_property
    def mask(self) -> NDArray[np.generic] | None:
        """The mask of policy ``mask``, (y, x) or (y, x, channel)."""
        return None if self.settings.mask is None else load_labels_array(self.settings.mask)

    @property
    def frame(self) -> FieldFrame:
        """The frame of all images of the survey."""
        scene = self.scene
        bands = scene.wavelength_nm, scene.fwhm_nm
        return FieldFrame(self.grid, self.camera.ifov_rad, *bands, scene.missing, scene.geobox)

    @property
    def work(self) -> FieldWork:
        """The model over the field, region by region."""
        file = WeightsFile(weights_path(self.settings).resolve(), self.described.about[SEAL], self.device)
        return FieldWork(file, plan_regions(self.grid, SHARD), self.settings.pool, self.settings.memory)

    @property
    def part(self) -> bool:
        """Return whether a part of the field alone is looked at."""
        return self.settings.extent != EXTENT_WHOLE

    @property
    def capture(self) -> LineSpec:
        """Return how the pixels of the first pass, or of the uniform scan, were captured."""
        settings, light = self.settings, self.light.light
        exposure_ms, step = settings.scan_exposure_ms, settings.scan_step or 1
        if not self.plan.plain:
            exposure_ms, step = settings.coarse_exposure_ms, self.plan.coarse[0].step
        return LineSpec(light * (exposure_ms or self.camera.exposure_ms) / self.camera.exposure_ms, step)

    @property
    def light(self) -> LineSpec:
        """Return how every line in the camera's own exposure is captured."""
        return LineSpec(self.camera.exposure_ms * self.scene.light_fraction / DEFAULT_EXPOSURE_MS)

    @property
    def scan_record(self) -> ScanPerformance | None:
        """Return what the weights record of uniform scans, if anything."""
        content = self.described.record.get("scans")
        return None if content is None else ScanPerformance.read(content, self.scene.light_fraction)

    @property
    def unknown(self) -> UnknownRule | None:
        """Return which pixels are called unknown; None where the weights cannot tell, or the settings ask for none."""
        rate = self.settings.unknown_rate
        if self.ood_detector is None or rate is None:
            return None
        return UnknownRule(self.described.config.classes, rate)

    @property
    def ground_grid(self) -> GroundGrid:
        """The grid of the map on the ground, of a survey with a pose."""
        assert isinstance(self.zones.place, PosedField)
        return self.zones.place.grid

    @property
    def map_choice(self) -> MapChoice:
        """Return what map to draw on the ground."""
        return self.settings.map

    def work_done(self, patch_index: NDArray[np.integer]) -> MultiplyAdds:
        """Count the scores of the field, unless all is read, and the map with fine patches at these patches."""
        done = self.costs.of_map(patch_index)
        if self.least_gain is not None:  # as the map is drawn: the overview is read once
            done = replace(done, score=self.costs.score(self.settings.policy))
        elif self.chooses:
            done = self.costs.with_scores(patch_index, self.settings.policy)
        if self.prior is None or self.reader is None:
            return done
        return replace(done, detail=done.detail + self.reader.sizes.multiply_adds(self.grid.height * self.grid.width))

    def reading_figures(self, patch_index: NDArray[np.integer]) -> dict[str, Any]:
        """Return what was asked of a full reading, its patches, and its multiply-adds beside those of everything."""
        settings, everything = self.settings, self.kept_patches
        asked = {"macs": settings.macs, "least_gain": self.least_gain, "expected_loss": settings.expected_loss}
        costs = {"done": self.work_done(patch_index).total, "everything": self.costs.of_map(everything).total}
        figures = {"patches": len(patch_index), "of_patches": len(everything), "multiply_adds": costs}
        return {"asked": asked, **figures}

    @property
    def kept_patches(self) -> NDArray[np.intp]:
        """Numbers of the patches that zones leave."""
        valid, fractions = self.grid.valid_patches(), self.zones.fractions
        return valid if fractions is None else valid[fractions[valid] > 0]

    @property
    def likely_patches(self) -> NDArray[np.intp]:
        """Return how many patches are likely to be read in full, by the record of the weights.

        With a limit of multiply-adds these are the most that it pays for; with a gain that nothing is recorded of, all.
        """
        if self.budget is not None:
            return self.budget.most_patches
        allowed, every = self.cascade, self.kept_patches
        if allowed is None or self.least_gain is None or self.settings.least_gain is not None:
            return every
        return every[: round(allowed[1] * len(every))]


def open_run(settings: Settings, *, planning: bool = False, archive: Archive | None = None) -> SurveyRun:
    """Open everything that a survey needs; the archive last, so that bad input leaves no trace of itself.

    With ``planning`` a scene that this machine cannot hold is no error: ``refused`` of the run says so. Without an
    ``archive`` that of the settings is opened. Raises PipelineError: the first thing that cannot be used; see
    `pipeline.errors` for the kinds; NothingToMend: what is remembered is sure enough.
    """
    settings = scene_of_visit(for_rig(settings), datetime.now().astimezone())
    check_scene_there(settings.scene, is_map=settings.is_map)
    recorded = open_recorded(settings) if settings.source == RECORDED else None
    settings = settings if recorded is None else recorded.settings
    settings = replace(settings, device=choose_device(settings.device))
    path = weights_path(settings)
    model = SurveyModel.open(path, settings.device, settings.unknown, planning=planning)
    described = model.described
    refused = farm_refusal(settings)
    if refused is not None and not planning:
        raise SettingsError(refused)
    pixels, scene, notes, label_notes = _scene_for(model, settings, recorded, planning=planning)
    grid = SceneGrid(*scene.shape, described.config.patch, 1)
    bands = len(scene.wavelength_nm)
    zones = open_zones(settings.zones, place_of_field(settings, scene), grid)
    outside = beyond_training(settings, scene, described, model.trained_on, path)
    ood_detector = model.asked_ood(settings.unknown)
    name, found = settings.name or Path(scene.name).stem, None
    if planning:  # what a look would be, were there one
        settings = replace(settings, skip_below_error=None)
    if settings.extent == EXTENT_PART:  # what is remembered says where to look: nothing else is asked for so early
        archive = open_archive(settings.out) if archive is None and is_archive(settings.out) else archive
        found = (None, ()) if archive is None else find_prior(archive, settings, name, grid, described.class_names)
    passes = None if recorded is None else recorded.passes
    planned = _PlannedCapture(settings)
    if pixels is None:
        prior = None if found is None else found[0]
        planned = _plan_capture(settings, grid, bands, path, described, prior, shown=zones.shown, passes=passes)
    settings, plan = planned.settings, planned.plan
    read = min(bands, SMOOTH)  # the network reads components, as many as smooth directions or fewer
    costs = ReadingCosts(described.config, grid, read)
    spending = settings.policy, settings.macs, settings.least_gain
    shown = None if zones.fractions is None else zones.fractions > 0
    budget = None if settings.macs is None else PatchBudget.asked(costs, shown, *spending)
    simulated, sweeps = make_source(scene, settings), (*plan.coarse, *plan.full)
    source = field_source(scene, settings, simulated, sweeps) if recorded is None else recorded.field
    raster = None if pixels is None else RasterPixels(pixels.read, pixels.missing, bands, grid)
    if raster is None:
        check_memory(simulated, grid, plan, settings.memory, settings.pool)
    else:
        raster.rows_at_once(settings.memory)  # refuses memory for not one row of patches
    archive = open_archive(settings.out) if archive is None else archive
    prior, prior_notes = found or find_prior(archive, settings, name, grid, described.class_names)
    if settings.prior != AUTO:  # what is meant when it is asked for again
        settings = replace(settings, prior=NONE if prior is None else prior.run)
    return SurveyRun(
        settings=settings,
        archive=archive,
        source=source,
        simulated=simulated,
        scene=scene,
        planned=sweeps,
        described=described,
        load=model.load,
        grid=grid,
        costs=costs,
        plan=plan,
        recorded=passes,
        scans=planned.scans,
        zones=zones,
        raster=raster,
        budget=budget,
        extent=planned.extent,
        prior=prior,
        ood_detector=ood_detector,
        notes=(*notes, *zones.notes, *planned.notes, *prior_notes, *outside, *label_notes),
        refused=refused,
    )


@dataclass(frozen=True)
class _PlannedCapture:
    """The lines of a survey, the choices that led to them, and the settings that ask for just these."""

    settings: Settings
    plan: CapturePlan = field(default_factory=CapturePlan.of_map)
    scans: ScanChoice = field(default_factory=ScanChoice)
    extent: ExtentChoice | None = None
    notes: tuple[str, ...] = ()


def _plan_capture(
    settings: Settings,
    grid: SceneGrid,
    bands: int,
    path: Path,
    described: Description,
    prior: Prior | None,
    *,
    shown: NDArray[np.bool_] | None,
    passes: RecordedPasses | None,
) -> _PlannedCapture:
    """Choose the part of the field, then the uniform scan or two passes, for the weights of the file ``path``.

    Raises what `choose_extent`, `choose_uniform_scan` and `lay_out_passes` raise.
    """
    extent, extent_notes, is_part = None, tuple[str, ...](), settings.extent == EXTENT_PART
    if is_part and prior is None:  # as it can be asked for again
        settings = replace(settings, extent=EXTENT_WHOLE, max_age=None, skip_below_error=None)
        extent_notes = ("nothing is remembered: the whole field is looked at",)
    layout = PassLayout.of(settings, grid, shown, passes)
    if is_part and prior is not None:
        assert settings.seconds is not None  # checked with the settings
        limits = {"max_age": settings.max_age, "skip_below_error": settings.skip_below_error}
        light = settings.sky.fraction_of_clear
        layout, extent, words = choose_extent(layout, prior, described, path, light, seconds=settings.seconds, **limits)
        extent_notes = (words,)
    scans = choose_uniform_scan(layout, described, path, bands, settings)
    layout, plan, settings, plan_notes = lay_out_passes(layout, scans, described, settings)
    settings = replace(settings, extent=layout.extent)
    return _PlannedCapture(settings, plan, scans, extent, (*plan_notes, *extent_notes))


def _scene_for(
    model: SurveyModel, settings: Settings, recorded: OpenedRecording | None, *, planning: bool
) -> tuple[SceneFile | None, RasterScene, tuple[str, ...], tuple[str, ...]]:
    """Open a scene that the weights can read, drawn unless for ``planning``; what to say of it and of its labels.

    The first value is the scene's file where its pixels are taken as they are.
    """
    pixels = None
    if recorded is not None:
        scene, notes = recorded.scene()
        scene = scene.in_light(settings.sky.fraction_of_clear)
    elif settings.is_map:
        pixels, scene, notes = open_map(settings, model.described.class_names)
    else:
        scene, notes = open_scene(settings, model.described.class_names)
    if not planning:  # what the rig would find there: no stage's work
        scene.raster.drawn()
        scene.light()
    model.check_bands(scene.wavelength_nm)
    label_notes = check_labels(scene, model.described)
    size = None if settings.mask is None else load_labels_array(settings.mask).shape[:2]
    if size not in (None, scene.shape):
        raise SceneError(
            f"--mask {settings.mask} is {size} px (y, x), the scene is {scene.shape}; give one of its size"
        )
    return pixels, scene, notes, label_notes


def field_source(
    scene: RasterScene, settings: Settings, simulated: SimulatedSource, planned: Sequence[Sweep]
) -> FieldSource:
    """Give who looks, as the settings say; raises what `flows.tasks.rig_field.rig_field` does."""
    if settings.is_map:
        return FieldSource()
    if settings.source != RIG:
        return SimulatedField(simulated)
    return rig_field.rig_field(scene, settings, planned)


def make_source(scene: RasterScene, settings: Settings) -> SimulatedSource:
    """The simulated rig before a scene, without effects; beside a rig it stands for the plan: sizes, paths, memory."""
    pointing = None
    if settings.source == "sim" and settings.pointing_px:
        pointing = PointingErrors(offset_px=settings.pointing_px, jitter_px=0.0, seed=settings.seed)
    return SimulatedSource(scene, settings.simulated_rig, settings.seed, {}, name=settings.source, pointing=pointing)


def now() -> str:
    """The time in ISO 8601, UTC."""
    return time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
