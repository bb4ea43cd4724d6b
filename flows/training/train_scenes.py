"""Define the request of a training, and image its scenes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flows.training.data import (
    Report,
    TrainingData,
    alike_notes,
    listed_scenes,
    only_class,
    pack_mask,
    scene_notes,
    trained_pixels,
)
from flows.training.observed_scenes import observe_scene
from models.network.machine import PROCESSOR
from models.network.sizes import SegmenterConfig
from models.network.spectral import Normalisation, SpectralBasis
from models.training.examples import Example, normalised
from models.training.train import TrainingSettings
from pipeline.errors import EmptySceneError, SceneError, SettingsError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.simulator.scenes.built_in import built_in_laws
from pipeline.simulator.scenes.scene import RasterScene


@dataclass(frozen=True)
class TrainRequest:
    """Request of a training; a ``patch`` of None follows from the data."""

    dataset: str
    out: Path
    hold_out: tuple[str, ...] = ()
    validation: int | None = None
    scenes: int | None = None  # of a built-in farm; None: its default
    patch: int | None = None
    columns: int = 24
    width: int = 20
    overview_width: int = 8
    tokens: dict[str, Any] = field(default_factory=dict)  # dim, layers, heads, mlp_ratio
    choices: dict[str, Any] = field(default_factory=dict)  # of load_data_set: labels, bands, wavelengths, masks
    settings: TrainingSettings = field(default_factory=TrainingSettings)
    camera: LineCamera = field(default_factory=LineCamera)
    command: str = ""
    device: str = PROCESSOR  # or auto


@dataclass
class About:
    """Properties of all scenes of a data set, and the training pixels of each."""

    basis: SpectralBasis
    names: tuple[str, ...]
    colours: NDArray[np.uint8]
    patch: int
    wavelength_nm: NDArray[np.float64]
    keys: dict[str, str] = field(default_factory=dict)  # scene -> identity of its light
    content: list[str] = field(default_factory=list)  # hashes of the scenes' files
    pixels: dict[str, str] = field(default_factory=dict)  # identity -> trained pixels, where not all labelled ones
    alike: dict[str, str] = field(default_factory=dict)  # scene -> class, where all its labels are one
    empty: list[str] = field(default_factory=list)  # scenes left out, which have no value anywhere
    regridded: list[str] = field(default_factory=list)  # scenes whose labels came on another grid

    def notes(self, names: Sequence[str]) -> tuple[str, ...]:
        """Return `scene_notes` of some scenes."""
        empty, regridded = ([one for one in of if one in names] for of in (self.empty, self.regridded))
        return scene_notes(empty, regridded)


def observe_all(
    request: TrainRequest,
    data: TrainingData,
    names: tuple[str, ...],
    what: str,
    report: Report,
    about: About | None = None,
) -> tuple[list[Example], About]:
    """Image named scenes, and check that they have the bands and classes of earlier ones. Raises SceneError."""
    seen, empty = [], list[str]()
    for number, name in enumerate(names):
        report(what, number / len(names), name)
        try:
            scene = data.scene(name)
        except EmptySceneError:
            empty.append(name)
            continue
        known = about or _common(request, scene)
        if scene.class_names != known.names:
            raise SceneError(f"scene {scene.name} has classes {scene.class_names}, the scenes before it {known.names}")
        if not np.array_equal(scene.wavelength_nm, known.wavelength_nm):
            raise SceneError(
                f"scene {scene.name} has other bands than the scenes before it; train on scenes of one camera"
            )
        known.keys[name] = scene.key
        known.content += scene.content
        mask = trained_pixels(scene)
        if request.choices.get("train_mask") is not None:
            known.pixels[scene.key] = pack_mask(mask)
        about = known
        if (alone := only_class(scene)) is not None:
            known.alike[name] = alone
        if scene.regridded:
            known.regridded.append(name)
        grid = SceneGrid(*scene.shape, known.patch, 1)
        rng = np.random.default_rng([request.settings.seed, 0x0B5, number])
        seen.append(observe_scene(scene, request.camera, grid, known.basis, rng))
    if about is None:
        why = f": no value anywhere in {listed_scenes(empty)}" if empty else ""
        raise SceneError(f"{request.dataset} has no scene to train on{why}")
    about.empty += empty
    return seen, about


def as_read(seen: Sequence[Example], normalisation: Normalisation) -> list[Example]:
    """Normalise the scenes; their basis spans their bands and reaches every column."""
    reached = np.ones(len(normalisation.centre), np.bool_)
    return [normalised(one, normalisation, reached) for one in seen]


def _common(request: TrainRequest, scene: RasterScene) -> About:
    trained_pixels(scene)  # raises for a scene without labels
    if len(scene.class_names) < 2:
        notes = alike_notes({scene.name: scene.class_names[0]})
        raise SceneError(f"{request.dataset}: training needs two or more classes, and {notes[0]}")
    basis = SpectralBasis.spanning(scene.wavelength_nm, request.columns)
    patch = request.patch or suggested_patch(scene.shape, built_in=bool(built_in_laws(request.dataset)))
    about = About(basis, scene.class_names, scene.class_colours, patch, scene.wavelength_nm)
    network_config(request, about)  # raises for invalid sizes before the first scene is imaged
    return about


def suggested_patch(shape: tuple[int, int], *, built_in: bool) -> int:
    """Return the patch size for scenes of this shape: 16 for the farm, 32 for frames, less for small scenes."""
    if built_in:
        return 16
    return 32 if min(shape) >= 512 else 16 if min(shape) >= 256 else 8


def network_config(request: TrainRequest, about: About) -> SegmenterConfig:
    """Return the sizes of the network. Raises SettingsError where they do not fit each other."""
    try:
        return SegmenterConfig(
            classes=len(about.names),
            columns=about.basis.columns,
            patch=about.patch,
            width=request.width,
            overview_width=request.overview_width,
            **request.tokens,
        )
    except ValueError as error:
        raise SettingsError(f"{error}; choose another --patch, --dim or --heads") from error
