"""Open a field: scene, source, weights, grid, zones and prior map. Bad input is refused here, before anything runs."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from spectralzoom.flows.frame import FieldFrame, FieldLabels, FieldView
from spectralzoom.flows.settings.settings import Settings
from spectralzoom.flows.settings.values import BUILT_IN_SCENES, RECORDED, RIG
from spectralzoom.flows.tasks.observer import current_observer
from spectralzoom.flows.tasks.patch_budget import SHARD
from spectralzoom.flows.tasks.prior_maps import AUTO, NONE, Prior, find_prior, inherited_warning
from spectralzoom.flows.tasks.recorded_field import open_recorded, recorded_scene
from spectralzoom.flows.tasks.rig_field import RigHold, rig_source
from spectralzoom.flows.tasks.scene import (
    check_labels,
    check_scene_there,
    darkness,
    farm_refusal,
    for_rig,
    judged_labels,
    open_map,
    open_scene,
    scene_of_visit,
)
from spectralzoom.flows.tasks.survey_model import (
    SurveyModel,
    beyond_training,
    other_unit,
    training_warning,
    weights_path,
)
from spectralzoom.flows.tasks.zones import SurveyZones, open_zones, place_of_field
from spectralzoom.models.network.machine import choose_device
from spectralzoom.models.network.spectral import LineSpec
from spectralzoom.models.reading.regions import Region, plan_regions
from spectralzoom.models.weights.files import Description, ReaderPart, Weights
from spectralzoom.pipeline.capture.recorded import Recording
from spectralzoom.pipeline.errors import SceneError, SettingsError, WeightsError
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.pipeline.ground.field_places import PosedField
from spectralzoom.pipeline.ground.map_grid import GroundGrid
from spectralzoom.pipeline.once import Once
from spectralzoom.pipeline.simulator.effects.pointing import PointingErrors
from spectralzoom.pipeline.simulator.scenes.farm.farm_scene import USUAL_DAY, USUAL_HOUR
from spectralzoom.pipeline.simulator.scenes.scene import DEFAULT_EXPOSURE_MS, RasterScene
from spectralzoom.pipeline.simulator.simulated import SimulatedSource
from spectralzoom.pipeline.source import Source
from spectralzoom.pipeline.words import moment_of
from spectralzoom.storage.readers.open_cubes import load_labels_array
from spectralzoom.storage.readers.scene_files import RasterPixels, SceneFile
from spectralzoom.storage.runs import dated
from spectralzoom.storage.store import Archive


@dataclass(frozen=True, kw_only=True)
class Field:
    """Opened field of a survey."""

    settings: Settings
    scene: RasterScene
    source: Source | None  # None of a raster, which needs no capture
    simulated: SimulatedSource  # without effects; for a rig, a model of its sizes, paths and memory
    model: SurveyModel
    grid: SceneGrid
    zones: SurveyZones
    labels: FieldLabels
    hold: RigHold  # keeps other surveys from the rig
    raster: RasterPixels | None  # of a scene that needs no capture
    prior: Prior | None  # prior map
    notes: tuple[str, ...]
    warnings: tuple[str, ...]  # about the map, before it is drawn
    refused: str | None  # why this machine cannot run a survey that is only planned

    @property
    def name(self) -> str:
        """Return the name of the field, or of its scene."""
        return self.settings.name or Path(self.scene.name).stem

    @property
    def acquired(self) -> str | None:
        """Return the day or moment of acquisition by the visit, else by the scene's file; None if neither states it."""
        return dated(self.settings.visit, self.scene.acquired)

    @property
    def camera(self) -> LineCamera:
        """Return the camera of the settings, or of the recording."""
        return self.settings.camera

    @property
    def recorded(self) -> Recording | None:
        """Return the source of lines where it is a recording."""
        return self.source if isinstance(self.source, Recording) else None

    @property
    def simulates(self) -> bool:
        """Return whether a scene is simulated, so that effects are chosen for it."""
        return self.source is not None and bool(self.source.effects)

    @property
    def described(self) -> Description:
        """Return the record of the weights."""
        return self.model.described

    @property
    def weights(self) -> Weights:
        """Return the weights, which are read on first use."""
        return self.model.load()

    @property
    def reader(self) -> ReaderPart | None:
        """Return the temporal reader of the weights, where there is a prior map; None where they have none."""
        return None if self.prior is None else self.described.reader

    @property
    def mapped_px(self) -> int:
        """Return the pixels that can have a class: those with data within the zones."""
        without = [one for one in (self.scene.missing, self.zones.left_out) if one is not None]
        return int(np.count_nonzero(~np.logical_or.reduce([np.zeros(self.scene.shape, np.bool_), *without])))

    @property
    def view(self) -> FieldView:
        """Return what the camera sees. A raster has no camera."""
        assert self.source is not None
        return view_of(self.settings, self.scene, self.source)

    @property
    def frame(self) -> FieldFrame:
        """Return the frame of all images of the survey."""
        bands = self.scene.wavelength_nm, self.scene.fwhm_nm
        return FieldFrame(self.grid, self.camera.ifov_rad, *bands, self.scene.missing, self.scene.geobox)

    @property
    def ground_grid(self) -> GroundGrid | None:
        """Return the grid of the map on the ground; None without a pose."""
        return self.zones.place.grid if isinstance(self.zones.place, PosedField) else None

    @property
    def light(self) -> LineSpec:
        """Return line spacing and light of a full scan in the camera's exposure."""
        return LineSpec(self.camera.exposure_ms * self.scene.light_fraction / DEFAULT_EXPOSURE_MS)

    @property
    def regions(self) -> list[Region]:
        """Return the regions of the field that the network reads at a time."""
        return plan_regions(self.grid, SHARD, halo=self.described.config.halo_px)

    @property
    def kept_patches(self) -> NDArray[np.intp]:
        """Return the patches that zones leave."""
        fractions = self.zones.fractions
        return self.grid.every_patch() if fractions is None else np.flatnonzero(fractions > 0)


def open_field(settings: Settings, *, planning: bool = False) -> Field:
    """Open and check what a survey looks at. Nothing is written.

    With ``planning``, no pixels are drawn, and a scene that exceeds the memory is no error but ``refused`` of the
    field. Raises PipelineError: the first error.
    """
    settings = scene_of_visit(for_rig(settings), datetime.now().astimezone())
    check_scene_there(settings.scene)
    recording = None
    if settings.source == RECORDED:
        settings, recording = open_recorded(settings)
    settings = settings.but(device=choose_device(settings.device))
    model = (
        SurveyModel.unread()
        if settings.ends_unread
        else SurveyModel.open(weights_path(settings), settings.device, planning=planning)
    )
    refused = farm_refusal(settings)
    if refused is not None and not planning:
        raise SettingsError(refused)
    pixels, scene, notes = _scene_for(model, settings, recording, planning=planning)
    grid = SceneGrid(*scene.shape, model.described.config.patch)
    zones = open_zones(settings, place_of_field(settings, scene), grid)
    raster = None if pixels is None else RasterPixels(pixels.read, pixels.missing, len(scene.wavelength_nm), grid)
    outside = beyond_training(settings, scene, model.described, model.trained_on) if model.reads else []
    if raster is not None:
        outside += other_unit(raster, scene.wavelength_nm, model.load()) if model.reads else []
        if not planning:
            raster.rows_at_once(settings.memory)  # raises an error where one row of patches does not fit
    archive = Archive(Path(settings.out).absolute())
    name = settings.name or Path(scene.name).stem
    label_notes = check_labels(scene, model.described) if model.reads else ()
    stated, known = moment_of(settings.visit), moment_of(scene.acquired)
    if stated is not None and known is not None and stated.date() != known.date():
        notes += (f"--visit {settings.visit} is kept, though the file says that it was acquired {scene.acquired}",)
    prior, prior_notes = find_prior(archive, settings, name, grid, model.described.class_names, scene)
    if settings.prior != AUTO:  # a receipt names the run
        settings = settings.but(prior=NONE if prior is None else prior.run)
    simulated = make_source(scene, settings)
    hold = RigHold(settings.rig.port if settings.on_hardware else None, current_observer().note)
    return Field(
        settings=settings,
        scene=scene,
        source=open_source(settings, name, simulated, recording, hold),
        simulated=simulated,
        model=model,
        grid=grid,
        zones=zones,
        labels=FieldLabels(
            Once(lambda: judged_labels(scene, model.described)),
            scene.key if settings.scene in BUILT_IN_SCENES and recording is None else None,
        ),
        hold=hold,
        raster=raster,
        prior=prior,
        notes=(*notes, *zones.notes, *prior_notes, *label_notes),
        warnings=(*darkness(settings), *training_warning(outside, model.path), *inherited_warning(prior, settings)),
        refused=refused,
    )


def _scene_for(
    model: SurveyModel, settings: Settings, recording: Recording | None, *, planning: bool
) -> tuple[SceneFile | None, RasterScene, tuple[str, ...]]:
    """Open a scene that the weights can read; drawn unless for ``planning``.

    Returns the file of a raster or None, the scene, and notes on it.
    """
    pixels = None
    if recording is not None:
        scene, notes = recorded_scene(settings, recording)
    elif settings.is_map:
        pixels, scene, notes = open_map(settings)
    else:
        scene, notes = open_scene(settings)
    if not planning:  # before the stages, whose time is measured
        scene.raster.drawn()
        scene.light()
    basis = model.described.basis
    if model.reads and not basis.matrix(scene.wavelength_nm)[1].any():
        raise WeightsError(
            f"the weights {model.path.name} are for {basis.low_nm:.0f}-{basis.high_nm:.0f} nm; the scene's bands lie at"
            f" {scene.wavelength_nm.min():.0f}-{scene.wavelength_nm.max():.0f} nm: use weights trained on such data"
        )
    size = None if settings.mask is None else load_labels_array(settings.mask).shape[:2]
    if size not in (None, scene.shape):
        raise SceneError(
            f"--mask {settings.mask} is {size} px (y, x), the scene is {scene.shape}; give one of its size"
        )
    return pixels, scene, notes


def open_source(
    settings: Settings, name: str, simulated: SimulatedSource, recording: Recording | None, hold: RigHold
) -> Source | None:
    """Return the source of the lines of the field ``name``, which is not opened; None of a raster."""
    if settings.is_map:
        return None
    if settings.source == RIG:
        return rig_source(settings, name, simulated, hold)
    return simulated if recording is None else recording


def view_of(settings: Settings, scene: RasterScene, source: Source) -> FieldView:
    """Return what the camera sees of a scene, or of the field before the source."""
    light = {"source": source.name, "scene": scene.key, "visit": settings.visit, **source.key}
    return FieldView(settings.camera, scene.wavelength_nm, scene.fwhm_nm, light)


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
    return SimulatedSource(scene, settings.simulated_rig, seed, {}, pointing=pointing)
