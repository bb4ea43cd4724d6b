"""Open a field: scene, source, weights, grid, zones and prior map. Bad input is refused here, before anything runs."""

from __future__ import annotations

import zlib
from datetime import datetime
from pathlib import Path

import numpy as np

from spectralzoom.flows.field import Field
from spectralzoom.flows.frame import FieldFrame, FieldLabels
from spectralzoom.flows.observer import current_observer
from spectralzoom.flows.opening.prior_maps import AUTO, NONE, find_prior, inherited_warning
from spectralzoom.flows.opening.recorded_field import open_recorded, recorded_scene
from spectralzoom.flows.opening.rig_field import RigHold, rig_source
from spectralzoom.flows.opening.scene import (
    check_scene_there,
    darkness,
    farm_refusal,
    for_rig,
    open_map,
    open_scene,
    scene_of_visit,
)
from spectralzoom.flows.opening.survey_model import SurveyModel, weights_path
from spectralzoom.flows.opening.training_ranges import beyond_training, other_unit, training_warning
from spectralzoom.flows.opening.zones import open_zones, place_of_field
from spectralzoom.flows.planning.patch_budget import SHARD
from spectralzoom.flows.settings.settings import Settings
from spectralzoom.flows.settings.values import BUILT_IN_SCENES, RECORDED, RIG
from spectralzoom.models.evaluation.taught_labels import check_labels, judged_labels
from spectralzoom.models.network.machine import choose_device
from spectralzoom.models.network.spectral import LineSpec
from spectralzoom.models.reading.regions import plan_regions
from spectralzoom.pipeline.capture.recorded import Recording
from spectralzoom.pipeline.errors import SceneError, SettingsError, WeightsError
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.pipeline.ground.field_places import PosedField
from spectralzoom.pipeline.once import Once
from spectralzoom.pipeline.simulator.effects.pointing import PointingErrors
from spectralzoom.pipeline.simulator.scenes.laws import USUAL_DAY, USUAL_HOUR
from spectralzoom.pipeline.simulator.scenes.scene import DEFAULT_EXPOSURE_MS, RasterScene
from spectralzoom.pipeline.simulator.simulated import SimulatedSource
from spectralzoom.pipeline.source import Source
from spectralzoom.pipeline.words import moment_of
from spectralzoom.storage.arrays.raster_pixels import RasterPixels
from spectralzoom.storage.readers.open_cubes import load_labels_array
from spectralzoom.storage.readers.scene_files import SceneFile
from spectralzoom.storage.runs import dated
from spectralzoom.storage.store import Archive


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
    model = SurveyModel.unread()
    if not settings.ends_unread:
        model = SurveyModel.open(weights_path(settings), settings.device, planning=planning)
    refused = farm_refusal(settings)
    if refused is not None and not planning:
        raise SettingsError(refused)
    pixels, scene, notes = _scene_for(model, settings, recording, planning=planning)
    grid = SceneGrid(*scene.shape, model.described.config.patch)
    place = place_of_field(settings, scene)
    zones = open_zones(settings, place, grid)
    raster = None if pixels is None else RasterPixels(pixels.read, pixels.missing, len(scene.wavelength_nm), grid)
    if raster is not None and not planning:
        raster.rows_at_once(settings.memory)  # raises an error where one row of patches does not fit
    archive = Archive(Path(settings.out).absolute())
    name = settings.name or Path(scene.name).stem
    label_notes = check_labels(scene, model.described) if model.reads else ()
    prior, prior_notes = find_prior(archive, settings, name, grid, model.described.class_names, scene)
    if settings.prior != AUTO:  # a receipt names the run
        settings = settings.but(prior=NONE if prior is None else prior.run)
    simulated = make_source(scene, settings)
    hold = RigHold(settings.rig.port if settings.on_hardware else None, current_observer().note)
    camera, fractions = settings.camera, zones.fractions
    return Field(
        settings=settings,
        name=name,
        scene=scene,
        acquired=dated(settings.visit, scene.acquired),
        grid=grid,
        frame=FieldFrame(grid, camera.ifov_rad, scene.wavelength_nm, scene.fwhm_nm, scene.missing, scene.geobox),
        regions=plan_regions(grid, SHARD, halo=model.described.config.halo_px),
        place=place,
        ground_grid=place.grid if isinstance(place, PosedField) else None,
        zones=zones,
        kept_patches=grid.every_patch() if fractions is None else np.flatnonzero(fractions > 0),
        camera=camera,
        light=LineSpec(camera.exposure_ms * scene.light_fraction / DEFAULT_EXPOSURE_MS),
        source=open_source(settings, name, simulated, recording, hold),
        simulated=simulated,
        raster=raster,
        hold=hold,
        model=model,
        described=model.described,
        labels=FieldLabels(
            Once(lambda: judged_labels(scene, model.described)),
            scene.key if settings.scene in BUILT_IN_SCENES and recording is None else None,
        ),
        prior=prior,
        notes=(*notes, *_other_day(settings, scene), *zones.notes, *prior_notes, *label_notes),
        warnings=(
            *darkness(settings),
            *_beyond_training(settings, scene, model, raster),
            *inherited_warning(prior, settings),
        ),
        refused=refused,
    )


def _beyond_training(
    settings: Settings, scene: RasterScene, model: SurveyModel, raster: RasterPixels | None
) -> tuple[str, ...]:
    """Return the warning about what lies outside of the training of the weights, if something does."""
    if not model.reads:
        return ()
    outside = beyond_training(settings, scene, model.described, model.trained_on)
    outside += [] if raster is None else other_unit(raster, scene.wavelength_nm, model.load())
    return training_warning(outside, model.path)


def _other_day(settings: Settings, scene: RasterScene) -> tuple[str, ...]:
    """Return a note where visit and file state different days."""
    stated, known = moment_of(settings.visit), moment_of(scene.acquired)
    if stated is None or known is None or stated.date() == known.date():
        return ()
    return (f"--visit {settings.visit} is kept, though the file says that it was acquired {scene.acquired}",)


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
