"""Which frames `spectralzoom evaluate` judges weights on, and what the weights see of them: what training saw."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flows.survey.scene import check_labels, judged_labels
from flows.training.data import TrainingData, farm_test_data, open_training_data
from flows.training.look import observe_scene
from models.network.spectral import patches_of
from models.reading.inference import CoarseLook, Glance, glance_of_columns
from models.training.examples import normalised
from models.weights.files import AnyWeights, Description, Weights, content_key, describe_weights, load_any_weights
from pipeline.errors import PipelineError, SceneError, SettingsError, WeightsError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.simulator.scenes.farm.farm_scene import FARM_NAMES
from pipeline.simulator.scenes.scene import RasterScene

FARM_TEST_SCENES = 4


@dataclass(frozen=True)
class Candidate:
    """Weights to judge: the file's name, what it says of itself, and a hash of its bytes."""

    path: Path
    described: Description
    key: str

    def load(self) -> AnyWeights:
        """Read the tensors."""
        return load_any_weights(self.path)

    @property
    def camera(self) -> LineCamera:
        """The camera that training looked through."""
        known = self.described.record.get("camera")
        try:
            return LineCamera(**known) if isinstance(known, dict) else LineCamera()
        except (TypeError, PipelineError) as error:
            raise WeightsError(f"{self.path}: its camera is damaged ({error}); copy or train the file again") from error

    def trained_on(self, scene: RasterScene, name: str, law: str, *, bands_chosen: bool = False) -> bool:
        """Whether labels of the scene taught these weights; not so where a mask kept some of its pixels out.

        Seen in other bands a scene has another identity: where bands or wavelengths were given, here or to the
        training, a frame of the data set ``law`` is also told by its name.
        """
        train, record = self._split.get("train", {}), self.described.record
        if scene.key in train.values():
            return self.pixels_of(scene) is None
        chosen = bands_chosen or any(flag in record.get("command", "") for flag in ("--bands", "--wavelengths"))
        return chosen and record.get("data") == law and name in train

    def pixels_of(self, scene: RasterScene) -> str | None:
        """Those pixels of a scene that taught these weights, packed; None where a mask kept none of them out."""
        pixels: str | None = self._split.get("pixels", {}).get(scene.key)
        return pixels

    @property
    def held_out(self) -> tuple[str, ...]:
        """Frames of its data set that were kept from training by name."""
        return tuple(self._split.get("held_out", ()))

    def validated_on(self, name: str, law: str) -> bool:
        """Whether a frame of the data set ``law`` was kept for the figures that training ends with."""
        return self.described.record.get("data") == law and name in self._split.get("validation", ())

    @property
    def _split(self) -> dict[str, Any]:
        split: dict[str, Any] = self.described.record.get("split", {})
        return split


@dataclass(frozen=True)
class Sight:
    """One frame in the columns of certain weights of any design."""

    name: str
    seen: CoarseLook
    fine: NDArray[np.float32]  # (seat, p, p, column) normalised, every seat of the padded grid
    labels: NDArray[np.uint8]  # (y, x) in the weights' classes
    bands: int
    picture: NDArray[np.float32]  # (y, x, column) as seen, not normalised


@dataclass(frozen=True)
class Look(Sight):
    """One frame as certain weights see it, with their glance."""

    seen: Glance


def open_candidates(paths: tuple[Path, ...]) -> list[Candidate]:
    """Describe the weights; none of their tensors is read yet.

    Raises
    ------
    SettingsError : none given, or weights that are not seeds of one another: other sizes or classes.
    WeightsError : a file that cannot be read.
    """
    if not paths:
        raise SettingsError("evaluate needs --weights FILE; train some with: spectralzoom train DATASET -o FILE")
    found = [Candidate(path, describe_weights(path), file_key(path)) for path in paths]
    first = found[0].described
    for one in found:
        if one.described.config.preset != "two-scale":
            raise SettingsError(
                f"{one.path} holds the control {one.described.config.preset!r}; give it as --control, beside --weights "
                "of two scales"
            )
    for other in found[1:]:
        if other.camera != found[0].camera:
            raise SettingsError(
                f"{other.path} was trained through another camera than {found[0].path}; evaluate them one by one"
            )
        described = other.described
        if (described.config, described.class_names) != (first.config, first.class_names):
            raise SettingsError(
                f"{other.path} differs from {found[0].path} in sizes or classes; several --weights are seeds of one "
                "training: evaluate different ones one by one"
            )
    keys = [one.key for one in found]
    if len(set(keys)) < len(keys):
        raise SettingsError("the same weights are given twice in --weights, which would count as two seeds")
    return found


def file_key(path: Path) -> str:
    """Name weights by what they hold; WeightsError where they cannot be read."""
    return content_key(path)[:16]


def open_frames(
    dataset: str, frames: tuple[str, ...], scenes: int | None, camera: LineCamera, choices: dict[str, Any]
) -> TrainingData:
    """Name the frames to judge on; ``train`` of what comes holds them all, whoever was trained on them.

    Raises
    ------
    SettingsError : a choice that does not go with the data set.
    SceneError : no scene, or a name that it has not.
    """
    if dataset not in FARM_NAMES:
        data = open_training_data(dataset, 0, scenes, camera, **choices)
        return _only(dataset, data, frames)
    open_training_data(dataset, 0, 1, camera, **choices)  # refuses choices that are for files
    count = FARM_TEST_SCENES if scenes is None else scenes
    if count < 1:
        raise SettingsError(f"--scenes must be at least 1, got {count}")
    return _only(dataset, farm_test_data(count, camera), frames)


def _only(dataset: str, data: TrainingData, frames: tuple[str, ...]) -> TrainingData:
    unknown = [name for name in frames if name not in data.train]
    if unknown:
        raise SceneError(f"{dataset} has no frame {', '.join(unknown)}; it has {', '.join(data.train)}")
    names = tuple(name for name in data.train if not frames or name in frames)
    return TrainingData(data.law, names, (), (), data.camera, data.files)


def check_frame(scene: RasterScene, described: Description) -> None:
    """Refuse a frame that these weights cannot be judged on.

    Raises
    ------
    SceneError : no labels, or of a class that the weights do not know.
    """
    if scene.labels is None:
        raise SceneError(
            f"frame {scene.name} has no labels, and a map is judged by labels: give --labels or a scene.toml"
        )
    check_labels(scene, described)


def look_at(scene: RasterScene, name: str, weights: Weights, camera: LineCamera, seed: int) -> Look:
    """Look at a frame with the camera of the training, and glance at it with the weights."""
    sight = sight_of(scene, name, weights, camera, seed)
    seen = glance_of_columns(weights, sight.seen.columns, sight.seen.grid)
    return Look(name, seen, sight.fine, sight.labels, sight.bands, sight.picture)


def sight_of(scene: RasterScene, name: str, weights: AnyWeights, camera: LineCamera, seed: int) -> Sight:
    """Give a frame in the columns of weights; the noise follows from the seed and the frame's name."""
    config = weights.config
    grid = SceneGrid(*scene.shape, config.patch, config.factor)
    rng = np.random.default_rng([seed, 0xE7A1, zlib.crc32(name.encode())])
    observed = observe_scene(scene, camera, grid, weights.basis, rng)
    _, reached = weights.basis.matrix(scene.wavelength_nm)
    example = normalised(observed, weights.normalisation, reached)
    labels = judged_labels(scene, Description(config, weights.basis, weights.class_names, weights.record))
    assert labels is not None  # check_frame
    return Sight(
        name,
        CoarseLook(grid, np.ascontiguousarray(example.coarse, np.float32)),
        patches_of(example.fine, config.patch).astype(np.float32),
        labels,
        len(scene.wavelength_nm),
        observed.fine[: grid.height, : grid.width],
    )
