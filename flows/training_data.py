"""What `spectralzoom train` learns from: the built-in farm, a folder of labelled scenes, or one scene with a mask."""

from __future__ import annotations

import base64
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.camera import LineCamera
from pipeline.errors import SceneError, SettingsError
from pipeline.grid import UNLABELLED
from pipeline.simulator.farm import FARM_LAW, farm_scene
from pipeline.simulator.scene import RasterScene, raster_from_values
from storage.datasets import DataSet, load_data_set
from storage.scene_files import SceneFile

FARM_SCENES, FARM_VALIDATION = 24, 3
FARM_SHAPE = (512, 640)  # of a training scene [px]
FARM_TRAIN_SEED, FARM_VALIDATION_SEED = 100_000, 200_000  # surveys are shown on small seeds


@dataclass(frozen=True)
class TrainingData:
    """Named scenes to train on and to validate on, made one at a time, and what the weights should say of them."""

    law: str
    train: tuple[str, ...]
    validation: tuple[str, ...]
    held_out: tuple[str, ...]
    camera: LineCamera
    files: DataSet | None = None

    def scenes(self, names: tuple[str, ...]) -> Iterator[RasterScene]:
        """Make the named scenes in order."""
        for name in names:
            yield self._farm(name) if self.files is None else self._file(name)

    def _farm(self, name: str) -> RasterScene:
        return farm_scene(int(name), shape=FARM_SHAPE, camera=self.camera)

    def _file(self, name: str) -> RasterScene:
        if self.files is None:
            raise SceneError(f"no file holds the scene {name}")
        wanted = dict(self.files.train()) if self.files.train_mask else {name: self.files.load(name)}
        return scene_of_file(wanted[name], self.camera)


def scene_of_file(file: SceneFile, camera: LineCamera) -> RasterScene:
    """Light a scene file as the simulator does."""
    return raster_from_values(
        file.values,
        camera,
        name=file.name,
        wavelength_nm=file.wavelength_nm,
        fwhm_nm=file.fwhm_nm,
        labels=file.labels,
        class_names=file.class_names,
        class_colours=file.class_colours,
        key=file.light_hash,
    )


def farm_data(scenes: int, validation: int, camera: LineCamera) -> TrainingData:
    """Farm scenes on seeds far from those that surveys are shown on."""
    return TrainingData(
        law=FARM_LAW,
        train=tuple(str(FARM_TRAIN_SEED + i) for i in range(scenes)),
        validation=tuple(str(FARM_VALIDATION_SEED + i) for i in range(validation)),
        held_out=(),
        camera=camera,
    )


def file_data(files: DataSet, validation: int, camera: LineCamera) -> TrainingData:
    """Scenes of a data set; every ``n``-th of those not held out goes to validation, split by scene, never by pixel."""
    names = files.train_names
    if validation >= len(names) and validation:
        raise SceneError(f"{validation} scenes for validation leave none of {len(names)} to train on; take fewer")
    kept = names[:: max(len(names) // validation, 1)][:validation] if validation else ()
    return TrainingData(
        law=files.path.stem,
        train=tuple(name for name in names if name not in kept),
        validation=kept,
        held_out=files.held_out,
        camera=camera,
        files=files,
    )


def open_training_data(
    dataset: str, validation: int | None, scenes: int | None, camera: LineCamera, **choices: object
) -> TrainingData:
    """Name the data: ``farm``, or a path with the choices of `load_data_set`.

    Without a number, one scene in eight (4 at most) goes to validation; a data set of one scene has none.

    Raises
    ------
    SettingsError : a choice that is for files was made for ``farm``, or the other way round.
    """
    if dataset == "farm":
        _refuse_choices(choices)
        count = FARM_SCENES if scenes is None else scenes
        return farm_data(count, FARM_VALIDATION if validation is None else validation, camera)
    if scenes is not None:
        raise SettingsError(f"--scenes is for the built-in farm; {dataset} has its own scenes")
    files = load_data_set(Path(dataset), **choices)  # type: ignore[arg-type]
    share = min(4, len(files.train_names) // 8)
    return file_data(files, share if validation is None else validation, camera)


def _refuse_choices(choices: Mapping[str, object]) -> None:
    for name, value in choices.items():
        if value not in (None, ()):
            flag = "--" + name.replace("_", "-")
            raise SettingsError(f"{flag} is for scene files; the farm's scenes are drawn by seed and bring their own")


def pack_mask(mask: NDArray[np.bool_]) -> str:
    """Pixels as text for the weights' record: bits, deflated, base64."""
    return base64.b64encode(zlib.compress(np.packbits(mask).tobytes(), 9)).decode("ascii")


def unpack_mask(text: str, shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Undo `pack_mask`."""
    bits = np.frombuffer(zlib.decompress(base64.b64decode(text)), np.uint8)
    return np.unpackbits(bits, count=shape[0] * shape[1]).reshape(shape).astype(bool)


def either_mask(one: str | None, other: str | None) -> str:
    """Pixels of either of two packed masks of one scene; None holds none."""
    bits = [np.frombuffer(zlib.decompress(base64.b64decode(mask)), np.uint8) for mask in (one, other) if mask]
    return base64.b64encode(zlib.compress(np.bitwise_or.reduce(bits).tobytes(), 9)).decode("ascii")


def trained_pixels(scene: RasterScene) -> NDArray[np.bool_]:
    """Pixels whose label training sees."""
    if scene.labels is None:
        raise SceneError(f"scene {scene.name} has no labels; training needs them: give --labels or a scene.toml")
    mask: NDArray[np.bool_] = scene.labels != UNLABELLED
    return mask
