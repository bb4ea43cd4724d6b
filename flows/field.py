"""An opened field: scene, source, weights, grid, zones and prior map, as a survey takes them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spectralzoom.flows.frame import FieldFrame, FieldLabels, FieldView, Prior
from spectralzoom.flows.opening.rig_field import RigHold
from spectralzoom.flows.opening.survey_model import SurveyModel
from spectralzoom.flows.settings.settings import Settings
from spectralzoom.flows.zones import SurveyZones
from spectralzoom.models.network.spectral import LineSpec
from spectralzoom.models.reading.regions import Region
from spectralzoom.models.weights.files import Description
from spectralzoom.pipeline.capture.recorded import Recording
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.pipeline.ground.field_places import FieldPlace
from spectralzoom.pipeline.ground.map_grid import GroundGrid
from spectralzoom.pipeline.simulator.scenes.scene import RasterScene
from spectralzoom.pipeline.simulator.simulated import SimulatedSource
from spectralzoom.pipeline.source import Source
from spectralzoom.storage.arrays.raster_pixels import RasterPixels


@dataclass(frozen=True, kw_only=True)
class Field:
    """Opened field of a survey."""

    settings: Settings
    name: str  # of the field, or of its scene
    scene: RasterScene
    acquired: str | None  # day or moment by the visit, else by the scene's file; None if neither states it
    grid: SceneGrid
    frame: FieldFrame  # of all images of the survey
    regions: list[Region]  # that the network reads at a time
    place: FieldPlace
    ground_grid: GroundGrid | None  # of the map on the ground; None without a pose
    zones: SurveyZones
    kept_patches: NDArray[np.intp]  # that zones leave
    camera: LineCamera  # of the settings, or of the recording
    light: LineSpec  # line spacing and light of a full scan in the camera's exposure
    source: Source | None  # None of a raster, which needs no capture
    simulated: SimulatedSource  # without effects; for a rig, a model of its sizes, paths and memory
    raster: RasterPixels | None  # of a scene that needs no capture
    hold: RigHold  # keeps other surveys from the rig
    model: SurveyModel
    described: Description  # record of the weights
    labels: FieldLabels
    prior: Prior | None  # prior map
    notes: tuple[str, ...]
    warnings: tuple[str, ...]  # about the map, before it is drawn
    refused: str | None  # why this machine cannot run a survey that is only planned

    @property
    def recorded(self) -> Recording | None:
        """Return the source of lines where it is a recording."""
        return self.source if isinstance(self.source, Recording) else None

    @property
    def simulates(self) -> bool:
        """Return whether a scene is simulated, so that effects are chosen for it."""
        return self.source is not None and bool(self.source.effects)

    @property
    def view(self) -> FieldView:
        """Return what the camera sees. A raster has no camera."""
        assert self.source is not None
        return view_of(self.settings, self.scene, self.source)


def view_of(settings: Settings, scene: RasterScene, source: Source) -> FieldView:
    """Return what the camera sees of a scene, or of the field before the source."""
    light = {"source": source.name, "scene": scene.key, "visit": settings.visit, **source.key}
    return FieldView(settings.camera, scene.wavelength_nm, scene.fwhm_nm, light)
