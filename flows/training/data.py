"""Open the data of `spectralzoom train`: the built-in farm, a folder of labelled scenes, or one scene with a mask."""

from __future__ import annotations

import base64
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flows.terminal.figures import counted
from pipeline.errors import SceneError, SettingsError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import UNLABELLED
from pipeline.simulator.scenes.built_in import SCOUTING_LAW, built_in_laws, built_in_scene
from pipeline.simulator.scenes.farm.farm_scene import FARM_LAW
from pipeline.simulator.scenes.scene import RasterScene, raster_from_values
from storage.readers.datasets import DataSet, load_data_set
from storage.readers.scene_files import SceneFile

FARM_SCENES, FARM_VALIDATION = 48, 3
FARM_SHAPE = (512, 640)  # of a scene [px]
FARM_TRAIN_SEED, FARM_VALIDATION_SEED = 100_000, 200_000  # examples use small seeds
FARM_TEST_SEED = 300_000  # of `evaluate`
SEASON_DAYS = (96, 304)  # of training scenes: April to October
SCOUTED_DAYS = (136, 200)  # of scouted fields
SEASON_HOURS = (9, 15)  # true solar time
_SCOUTED = "scouting-"  # prefix of the names of scouted fields
_GOLDEN, _SILVER = 0.6180339887, 0.4142135624  # steps that cover a circle evenly
Report = Callable[[str, float, str], None]  # activity, fraction done, figure


@dataclass(frozen=True)
class TrainingData:
    """Names of training, validation and held-out scenes, which are opened one at a time."""

    law: str
    train: tuple[str, ...]
    validation: tuple[str, ...]
    held_out: tuple[str, ...]
    camera: LineCamera
    files: DataSet | None = None
    notes: tuple[str, ...] = ()  # messages on left-out scenes

    def scene(self, name: str) -> RasterScene:
        """Open one scene. Raises SceneError: an invalid file; EmptySceneError: no value anywhere."""
        if self.files is None:
            seed, day, hour = read_farm_name(name)
            law = SCOUTING_LAW if name.startswith(_SCOUTED) else FARM_LAW
            return built_in_scene(law, seed, FARM_SHAPE, camera=self.camera, day=day, hour=hour)
        return scene_of_file(self.files.load(name, "train"), self.camera)


def scene_of_file(file: SceneFile, camera: LineCamera) -> RasterScene:
    """Turn a scene file into a scene of the simulator."""
    scene = raster_from_values(
        file.values,
        camera,
        name=file.name,
        wavelength_nm=file.wavelength_nm,
        fwhm_nm=file.fwhm_nm,
        labels=file.labels,
        class_names=file.class_names,
        class_colours=file.class_colours,
        key=file.light_hash,
        geobox=file.geobox,
    )
    return replace(scene, regridded=file.regridded, content=file.content, pixel_m=file.pixel_m)


def farm_test_data(scenes: int, camera: LineCamera, dataset: str = FARM_LAW) -> TrainingData:
    """Return built-in scenes to judge weights on, all in ``train``."""
    laws = built_in_laws(dataset)
    return TrainingData(",".join(laws), _built_in_days(laws, FARM_TEST_SEED, scenes, odd=True), (), (), camera)


def _built_in_days(laws: tuple[str, ...], first_seed: int, count: int, *, odd: bool = False) -> tuple[str, ...]:
    """Name ``count`` scenes, of each law in turn."""
    names: list[str] = []
    for number, law in enumerate(laws):
        own = len(range(number, count, len(laws)))
        if law == FARM_LAW:
            names += farm_days(first_seed, own, odd=odd)
        else:
            names += [_SCOUTED + name for name in farm_days(first_seed, own, odd=odd, season=SCOUTED_DAYS)]
    return tuple(names)


def farm_days(
    first_seed: int, count: int, *, odd: bool = False, season: tuple[int, int] = SEASON_DAYS
) -> tuple[str, ...]:
    """Name scenes of the farm by consecutive seeds, each with a day of the season and an hour.

    Days follow the golden section, which covers the season evenly for any number of scenes. Training has even days,
    evaluation ``odd`` ones.
    """
    (first, last), (morning, evening) = season, SEASON_HOURS
    names = []
    for i in range(count):
        day = first + 2 * int((0.5 + i * _GOLDEN) % 1 * ((last - first) // 2)) + odd
        hour = morning + int((0.5 + i * _SILVER) % 1 * (evening - morning + 1))
        names.append(f"{first_seed + i}-day-{day}-hour-{hour}")
    return tuple(names)


def read_farm_name(name: str) -> tuple[int, int, float]:
    """Return seed, day and hour of a name of `farm_days`."""
    seed, _, day, _, hour = name.removeprefix(_SCOUTED).split("-")
    return int(seed), int(day), float(hour)


def file_data(files: DataSet, validation: int, camera: LineCamera) -> TrainingData:
    """Split the scenes of a data set; every n-th of those not held out is for validation.

    Scenes without labels are left out, with a note, where others have some.
    """
    names = _labelled_names(files)
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
        notes=files.notes,
    )


def _labelled_names(files: DataSet) -> tuple[str, ...]:
    names = tuple(name for name in files.train_names if name not in files.unlabelled)
    if not names:
        raise SceneError(f"{files.path}: {'; '.join(files.notes)}; held-out scenes cannot be trained on")
    return names


def open_training_data(
    dataset: str, validation: int | None, scenes: int | None, camera: LineCamera, **choices: object
) -> TrainingData:
    """Open built-in scenes, separated by commas, or a path with the choices of `load_data_set`.

    One scene in eight (at most 4) is for validation by default. Raises SettingsError: a choice of files for built-in
    scenes, or the other way round.
    """
    if laws := built_in_laws(dataset):
        for choice, value in choices.items():
            if value not in (None, ()):
                flag = "--" + choice.replace("_", "-")
                raise SettingsError(f"{flag} is for scene files; built-in scenes are drawn by seed and bring their own")
        train = _built_in_days(laws, FARM_TRAIN_SEED, FARM_SCENES if scenes is None else scenes)
        left = FARM_VALIDATION * len(laws) if validation is None else validation
        return TrainingData(
            ",".join(laws), train, _built_in_days(laws, FARM_VALIDATION_SEED, left, odd=True), (), camera
        )
    if scenes is not None:
        raise SettingsError(f"--scenes is for built-in scenes; {dataset} has its own scenes")
    files = load_data_set(Path(dataset), **choices)  # type: ignore[arg-type]
    fraction = min(4, len(_labelled_names(files)) // 8)
    return file_data(files, fraction if validation is None else validation, camera)


def pack_mask(mask: NDArray[np.bool_]) -> str:
    """Encode a mask for the record of weights: bits, deflated, base64."""
    return base64.b64encode(zlib.compress(np.packbits(mask).tobytes(), 9)).decode("ascii")


def unpack_mask(text: str, shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Decode a mask of `pack_mask`."""
    bits = np.frombuffer(zlib.decompress(base64.b64decode(text)), np.uint8)
    return np.unpackbits(bits, count=shape[0] * shape[1]).reshape(shape).astype(bool)


def only_class(scene: RasterScene) -> str | None:
    """Return the class of all labels of a scene; None for several classes, or no label."""
    if scene.labels is None:
        return None
    there = np.unique(scene.labels[scene.labels != UNLABELLED])
    return scene.class_names[there[0]] if len(there) == 1 else None


def alike_notes(alone: Mapping[str, str]) -> tuple[str, ...]:
    """Return notes on scenes with a single class, which may stand for unlabelled."""
    by_class: dict[str, list[str]] = {}
    for name, kind in alone.items():
        by_class.setdefault(kind, []).append(name)
    return tuple(
        f"all labels are {kind} in {listed_scenes(names)}; if its value in the label files stands for no class, write"
        " unlabelled = VALUE into the scene.toml"
        for kind, names in by_class.items()
    )


def listed_scenes(names: Sequence[str]) -> str:
    """Format the first of some names, and the number of the others."""
    return ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")


def scene_notes(empty: Sequence[str], regridded: Sequence[str]) -> tuple[str, ...]:
    """Return notes on scenes without any value, and on scenes whose labels have another grid."""
    left_out = f"{counted(len(empty), 'scene')} without any value left out: {listed_scenes(empty)}"
    moved = (
        f"labels of {listed_scenes(regridded)} have another place, CRS or pixels than their images: they are brought to"
        " the images' pixels by nearest neighbour"
    )
    return (*([left_out] if empty else []), *([moved] if regridded else []))


def trained_pixels(scene: RasterScene) -> NDArray[np.bool_]:
    """Return the labelled pixels of a scene. Raises SceneError: it has no labels."""
    if scene.labels is None:
        raise SceneError(
            f"scene {scene.name} has no labels; training needs them: give --labels, or call"
            f" its label file {scene.name}_mask.png or labels/{scene.name}.png (scene.toml: other names)"
        )
    mask: NDArray[np.bool_] = scene.labels != UNLABELLED
    return mask
