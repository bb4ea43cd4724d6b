"""One survey's context: scene, source, weights, grid and archive, opened and checked before anything runs."""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flows.capture_plan import CapturePlan, check_memory, plan_capture
from flows.settings import BUILT_IN_SCENES, Settings
from flows.training_data import scene_of_file, unpack_mask
from models.weights import Description, Weights, describe_weights, load_weights
from pipeline.camera import LineCamera
from pipeline.errors import SceneError, SettingsError, WeightsError
from pipeline.grid import UNLABELLED, SceneGrid
from pipeline.ground import GroundView
from pipeline.ground_grid import ground_grid
from pipeline.once import Once
from pipeline.simulator.farm import farm_scene
from pipeline.simulator.instrument import ALL_EFFECTS
from pipeline.simulator.pointing import PointingErrors
from pipeline.simulator.raster import Light
from pipeline.simulator.scene import RasterScene
from pipeline.simulator.simulated import SimulatedSource
from storage.archive import Archive
from storage.layout import AngularGrid
from storage.raster_files import load_raster
from storage.scene_files import load_scene_file

SHIPPED = "farm.safetensors"
FARM_BYTES_PER_PX = 570  # peak of a survey of 2560 x 2560 px without controls, 3.76 GB

Report = Callable[[float], None]  # how far a stage is, 0..1


@dataclass(frozen=True)
class SurveyRun:
    """Everything a stage may look at. Made by `open_run`, which refuses what cannot work."""

    settings: Settings
    archive: Archive
    source: SimulatedSource
    scene: RasterScene
    described: Description  # what the weights say of themselves
    load: Once[Weights]
    weights_key: str
    grid: SceneGrid
    plan: CapturePlan
    notes: tuple[str, ...] = ()
    refused: str | None = None  # why this machine would refuse the survey; it is planned nevertheless
    report: Report = field(default=lambda done: None)

    @property
    def camera(self) -> LineCamera:
        """The camera of the settings."""
        return self.settings.camera

    @property
    def name(self) -> str:
        """What the survey is called: its scene."""
        return Path(self.scene.name).stem

    @property
    def weights(self) -> Weights:
        """The weights, read when they are first asked for."""
        return self.load()

    @cached_property
    def labels(self) -> NDArray[np.uint8] | None:
        """What to judge by, (y, x) in the weights' classes: trained pixels taken out. Draws the scene."""
        return _judged_labels(self.scene, self.described)

    @cached_property
    def mask(self) -> NDArray[np.generic] | None:
        """The mask of policy ``mask``, (y, x) or (y, x, channel)."""
        return None if self.settings.mask is None else load_raster(self.settings.mask, dims=2).values

    def angular_grid(self, factor: int = 1) -> AngularGrid:
        """Where pixels of ``factor`` fine px lie."""
        return AngularGrid(self.camera.ifov_rad, self.scene.shape, factor)

    def source_key(self) -> dict[str, Any]:
        """What the captured light depends on, beside the sweeps."""
        return {
            "scene": self.scene.key,
            "seed": self.settings.seed,
            "effects": sorted(self.source.effects),
            "camera": asdict(self.camera),
            "pointing_px": self.settings.pointing_px,
        }


def open_run(settings: Settings, *, planning: bool = False) -> SurveyRun:
    """Open everything that a survey needs; the archive last, so that bad input leaves no trace of itself.

    With ``planning`` a scene that this machine cannot hold is no error: ``refused`` of the run says so.

    Raises
    ------
    PipelineError : the first thing that cannot be used; see `pipeline.errors` for the kinds.
    """
    if settings.source != "sim":
        raise SettingsError(f"--source {settings.source}: this version has the simulated source only; use --source sim")
    path = weights_path(settings)
    described, load = describe_weights(path), Once(lambda: load_weights(path))
    if not planning:
        load()  # refuses tensors that do not fit
    refused = _refusal(settings)
    if refused is not None and not planning:
        raise SettingsError(refused)
    scene, notes = _open_scene(settings)
    if not planning:  # what the rig would find there: no stage's work
        scene.raster.drawn()
        scene.light()
    label_notes = _check_labels(scene, described)
    grid = SceneGrid(*scene.shape, described.config.patch, described.config.factor)
    plan = plan_capture(settings, grid)
    band_notes = _check_bands(scene, described, path)
    if settings.mask is not None:
        _check_mask(settings.mask, scene.shape)
    effects = _chosen_effects(settings.effects)
    source = SimulatedSource(scene, settings.camera, settings.seed, effects, pointing=_pointing(settings))
    check_memory(settings, source, grid, plan)
    _check_pose(settings, scene.shape)
    key = hashlib.sha256(path.read_bytes()).hexdigest()[:20]
    return SurveyRun(
        settings, Archive.open(settings.out), source, scene, described, load, key, grid, plan,
        (*notes, *band_notes, *label_notes), refused,
    )  # fmt: skip


def _pointing(settings: Settings) -> PointingErrors | None:
    """What the simulated mirror gets wrong, where the settings allow it to: nothing otherwise."""
    if not settings.pointing_px:
        return None
    return PointingErrors(offset_px=settings.pointing_px, jitter_px=0.0, seed=settings.seed)


def _check_pose(settings: Settings, shape: tuple[int, int]) -> None:
    """Refuse a pose from which there is no ground to map, before anything is captured."""
    if settings.pose is not None:
        view = GroundView(settings.pose, settings.camera.ifov_rad)
        ground_grid(view, shape, epsg=settings.map.epsg, resolution_m=settings.map.resolution_m)


def _chosen_effects(text: str) -> frozenset[str]:
    """Effects to simulate: ``auto`` and ``all`` are those built, ``none``, or names with commas."""
    if text in ("auto", "all"):
        return ALL_EFFECTS
    return frozenset() if text == "none" else frozenset(name.strip() for name in text.split(","))


def _open_scene(settings: Settings) -> tuple[RasterScene, tuple[str, ...]]:
    if settings.scene in BUILT_IN_SCENES:
        return _open_farm(settings), ()
    file = load_scene_file(
        settings.scene, labels=settings.labels, bands=settings.bands, wavelengths=settings.wavelengths
    )
    scene = scene_of_file(file, settings.camera)
    filled = (f"{scene.filled_px} pixels without a value were given their band's median",) if scene.filled_px else ()
    return scene, (*file.provenance, *filled)


def _open_farm(settings: Settings) -> RasterScene:
    for name, value in {"labels": settings.labels, "wavelengths": settings.wavelengths}.items():
        if value is not None:
            raise SettingsError(f"--{name} is for scene files; the scene 'farm' brings its own")
    if settings.shape is None:
        farm = farm_scene(settings.seed, camera=settings.camera)
    else:
        farm = farm_scene(settings.seed, shape=settings.shape, camera=settings.camera)
    return farm if settings.bands is None else _some_bands(farm, settings.bands)


def _refusal(settings: Settings) -> str | None:
    """Why this machine cannot hold the farm of the settings, before it tries; None where it can."""
    if settings.scene not in BUILT_IN_SCENES or settings.shape is None:
        return None
    height, width = settings.shape
    needed = height * width * FARM_BYTES_PER_PX
    there = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if needed <= there:
        return None
    return (
        f"--size {width}x{height}: a survey of such a farm takes about {needed / 1e9:.0f} GB of memory,"
        f" this machine has {there / 1e9:.0f}; take a smaller one"
    )


def _some_bands(scene: RasterScene, bands: tuple[int, ...]) -> RasterScene:
    """The same field seen by a camera with some of the bands."""
    count, chosen = len(scene.wavelength_nm), list(bands)
    if not all(0 <= band < count for band in bands):
        raise SettingsError(f"--bands {bands}: the scene 'farm' has bands 0 to {count - 1}")
    return replace(
        scene,
        key=f"{scene.key}/only={','.join(map(str, bands))}",
        light=Once(lambda: Light(scene.electrons[:, chosen], scene.panel_electrons[chosen])),
        panel=scene.panel[chosen],
        wavelength_nm=scene.wavelength_nm[chosen],
        fwhm_nm=None if scene.fwhm_nm is None else scene.fwhm_nm[chosen],
    )


def weights_path(settings: Settings) -> Path:
    """Where the weights of a survey lie: those that come with the house for its own scenes.

    Raises
    ------
    SettingsError : none were given for a scene of one's own.
    """
    if settings.weights is not None:
        return Path(settings.weights)
    if settings.scene not in BUILT_IN_SCENES:
        raise SettingsError(
            f"--weights is missing: the weights that come with SpectralZoom know the scene 'farm' only;"
            f" train some for {settings.scene} with: spectralzoom train DATASET -o my.safetensors"
        )
    return Path(str(resources.files("models") / "shipped" / SHIPPED))


def _check_bands(scene: RasterScene, weights: Description, path: Path) -> tuple[str, ...]:
    _, reached = weights.basis.matrix(scene.wavelength_nm)
    if not reached.any():
        low, high = weights.basis.low_nm, weights.basis.high_nm
        raise WeightsError(
            f"the weights {path.name} are for {low:.0f}-{high:.0f} nm; the scene's bands lie at"
            f" {scene.wavelength_nm.min():.0f}-{scene.wavelength_nm.max():.0f} nm: use weights trained on such data"
        )
    if reached.all():
        return ()
    return (f"the bands reach {reached.sum()} of the weights' {len(reached)} spectral columns: expect a poorer map",)


def _check_mask(mask: str, shape: tuple[int, int]) -> None:
    values = load_raster(mask, dims=2).values
    if values.shape[:2] != shape:
        raise SceneError(f"--mask {mask} is {values.shape[:2]} px (y, x), the scene is {shape}; give one of its size")


def _check_labels(scene: RasterScene, weights: Description) -> tuple[str, ...]:
    """Refuse labels of classes that the weights do not know, and say what judging by the others is worth."""
    if not scene.labelled:
        return ()
    missing = [name for name in scene.class_names if name not in weights.class_names]
    if missing:
        known = ", ".join(weights.class_names)
        raise SceneError(f"the labels have the class {missing[0]!r}, the weights know {known}; use weights for these")
    split = weights.record.get("split", {})
    if scene.key in split.get("pixels", {}):
        return ("accuracy is counted on the labelled pixels that the weights were not trained on",)
    if scene.key in split.get("train", {}).values():
        return ("the weights were trained on this scene: its accuracy says nothing of other fields",)
    return ()


def _judged_labels(scene: RasterScene, weights: Description) -> NDArray[np.uint8] | None:
    """Labels in the order of the weights' classes, without the pixels that the weights were trained on."""
    if scene.labels is None:
        return None
    order = np.full(256, UNLABELLED, np.uint8)
    order[: len(scene.class_names)] = [weights.class_names.index(name) for name in scene.class_names]
    labels = order[scene.labels]
    trained = weights.record.get("split", {}).get("pixels", {}).get(scene.key)
    if trained is not None:
        labels[unpack_mask(trained, scene.shape)] = UNLABELLED
    return labels


def now() -> str:
    """The time in ISO 8601, UTC."""
    return time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
