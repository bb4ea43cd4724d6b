"""Image the scenes of a training."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spectralzoom.flows.settings.model_flags import NO_TRAIN_FLAGS, TrainFlags
from spectralzoom.flows.training.data import Report, SceneNotes, TrainingData, check_taught, trained_pixels
from spectralzoom.models.evaluation.taught_labels import pack_mask
from spectralzoom.models.network.sizes import SegmenterConfig
from spectralzoom.models.network.spectral import Normalisation, SpectralBasis
from spectralzoom.models.training.capture_augmentation import REFERENCE_MS
from spectralzoom.models.training.examples import Example, normalised, observe_scene, untaught_classes
from spectralzoom.pipeline.errors import SceneError, list_some
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.grid import UNLABELLED, SceneGrid
from spectralzoom.pipeline.simulator.scenes.laws import built_in_laws
from spectralzoom.pipeline.simulator.scenes.scene import RasterScene

DEEP_PATCH_PX = 32  # of frames of 512 px and more, whose objects are larger than a token
COLUMNS = 24  # spectral features of built-in scenes
COLUMNS_OF_FILES = 48, 256  # least and most of files: one a band, if the memory has room
COLUMN_BYTES = 1 << 30  # of all scenes
CAMERA = LineCamera()
UNFIT = "{validation scenes} left out, without a labelled pixel or with the image of a training scene: {names}"


@dataclass(frozen=True)
class TrainRequest:
    """Request of a training."""

    dataset: str
    out: Path
    flags: TrainFlags = NO_TRAIN_FLAGS
    command: str = ""

    @property
    def captured(self) -> bool:
        """Return whether the simulated camera captures scenes of files, in shorter exposures too."""
        return self.flags.min_exposure_ms < REFERENCE_MS


@dataclass(frozen=True)
class Common:
    """Properties that all scenes of a data set share."""

    basis: SpectralBasis
    names: tuple[str, ...]
    colours: NDArray[np.uint8]
    patch: int
    wavelength_nm: NDArray[np.float64]
    values: tuple[int, ...] = ()  # numbers of the classes in the label files, where maps can have them
    zero_class: str = ""  # class of the number 0, or of black, in the label files

    def check(self, scene: RasterScene) -> None:
        """Raise SceneError where a scene has other classes or bands."""
        if scene.class_names != self.names:
            raise SceneError(f"scene {scene.name} has classes {scene.class_names}, the scenes before it {self.names}")
        if not np.array_equal(scene.wavelength_nm, self.wavelength_nm):
            raise SceneError(
                f"scene {scene.name} has other bands than the scenes before it; train on scenes of one camera"
            )


@dataclass(frozen=True)
class Imaged:
    """Imaged scenes, and entries of the record of weights about them."""

    examples: list[Example] = field(default_factory=list)
    keys: dict[str, str] = field(default_factory=dict)  # scene -> identity of its light
    content: dict[str, NDArray[np.bool_]] = field(default_factory=dict)  # hash of a file -> its labelled pixels


@dataclass(frozen=True)
class Scenes:
    """Training and validation scenes."""

    common: Common
    train: Imaged
    validation: Imaged

    @property
    def untaught(self) -> tuple[int, ...]:
        """Return the classes without a training pixel, ascending."""
        return untaught_classes(self.train.examples, len(self.common.names))

    @property
    def label_zero(self) -> dict[str, Any]:
        """Return the class of label 0, empty if it is none, and its fraction of the pixels, else the unlabelled one."""
        zero = self.common.zero_class
        number = self.common.names.index(zero) if zero else UNLABELLED
        labels = [one.labels[: one.shape[0], : one.shape[1]] for one in self.train.examples]
        count = sum(np.count_nonzero(one == number) for one in labels)
        return {"name": zero, "fraction": count / sum(one.size for one in labels)}

    @property
    def joined(self) -> Scenes:
        """Return all scenes as those of a training."""
        one, other = self.train, self.validation
        every = Imaged([*one.examples, *other.examples], one.keys | other.keys, one.content | other.content)
        return Scenes(self.common, every, Imaged())

    @property
    def split(self) -> dict[str, Any]:
        """Return the record by which an evaluation tells scenes and pixels that were taught."""
        taught = {name: pack_mask(mask) for name, mask in self.train.content.items()}
        return {"train": self.train.keys, "taught": taught}

    def normalised(self, normalisation: Normalisation) -> Scenes:
        """Normalise the scenes; their basis spans their bands and reaches every column."""
        reached = np.ones(len(normalisation.centre), np.bool_)
        train, validation = (
            replace(one, examples=[normalised(example, normalisation, reached) for example in one.examples])
            for one in (self.train, self.validation)
        )
        return Scenes(self.common, train, validation)


def observe_all(
    request: TrainRequest, data: TrainingData, report: Report, tell: Callable[[str], None] = lambda note: None
) -> Scenes:
    """Image training and validation scenes. Raises SceneError: none, a single class, or other bands or classes."""
    common, train = _imaged(request, data, data.train, "imaging scenes", report, tell)
    if common is None:
        raise SceneError(f"{request.dataset} has no scene to train on: no value anywhere in {list_some(data.train)}")
    _, validation = _imaged(request, data, data.validation, "imaging validation scenes", report, tell, common, train)
    return Scenes(common, train, validation)


def _imaged(
    request: TrainRequest,
    data: TrainingData,
    names: tuple[str, ...],
    what: str,
    report: Report,
    tell: Callable[[str], None],
    common: Common | None = None,
    trained: Imaged | None = None,
) -> tuple[Common | None, Imaged]:
    """Image named scenes, and check that they have the bands and classes of earlier ones. Raises SceneError.

    With ``trained`` scenes, these are for validation: those without a label, or of a trained image, are left out.
    """
    found = Imaged()
    notes = SceneNotes()
    stream = 0x0B5 if trained is None else 0x0B6  # validation has noise of its own
    for number, name, scene in notes.scenes(data, names, what, report):
        mask = trained_pixels(scene)  # raises for a scene without labels
        common = common or _common(request, scene, len(names))
        common.check(scene)
        if trained is not None and (scene.key in trained.keys.values() or not mask.any()):
            notes[UNFIT].append(name)
            continue
        found.keys[name] = scene.key
        found.content.update({one: mask | found.content.get(one, mask) for one in scene.content})  # equal in copies
        notes.add(name, scene)
        grid = SceneGrid(*scene.shape, common.patch)
        rng = np.random.default_rng([request.flags.seed, stream, number])
        found.examples.append(observe_scene(scene, CAMERA, grid, common.basis, rng, captured=request.captured))
    for note in notes.texts:
        tell(note)
    return common, found


def _common(request: TrainRequest, scene: RasterScene, scenes: int) -> Common:
    check_taught(request.dataset, scene.class_names, [scene.name])
    built_in = bool(built_in_laws(request.dataset))
    most = (
        COLUMNS
        if built_in
        else int(np.clip(COLUMN_BYTES / (2 * scenes * scene.planes[..., 0].size), *COLUMNS_OF_FILES))
    )
    basis = SpectralBasis.spanning(scene.wavelength_nm, most)
    patch = patch_of(scene.shape, built_in=built_in)
    classes = scene.class_names, scene.class_colours
    return Common(basis, *classes, patch, scene.wavelength_nm, scene.class_values, scene.zero_class)


def patch_of(shape: tuple[int, int], *, built_in: bool) -> int:
    """Return the patch size for scenes of this shape: 16 for the farm, 32 for frames, less for small scenes."""
    return 16 if built_in or 256 <= min(shape) < 512 else DEEP_PATCH_PX if min(shape) >= 512 else 8


def network_config(common: Common) -> SegmenterConfig:
    """Return the sizes of the network."""
    deep = common.patch >= DEEP_PATCH_PX
    return SegmenterConfig(
        classes=len(common.names),
        columns=common.basis.columns,
        patch=common.patch,
        deep=deep,
        layers=1 if deep else SegmenterConfig.layers,
    )
