"""Open the data of `spectralzoom train`: the built-in farm, a folder of labelled scenes, or one scene."""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spectralzoom.flows.opening.scene import scene_of_file
from spectralzoom.flows.terminal.figures import counted, format_percent
from spectralzoom.pipeline.errors import EmptySceneError, SceneError, SettingsError, list_some
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.grid import UNLABELLED
from spectralzoom.pipeline.simulator.scenes.built_in import built_in_scene
from spectralzoom.pipeline.simulator.scenes.laws import FARM_LAW, SCOUTING_LAW, TRIAL_LAW, built_in_laws
from spectralzoom.pipeline.simulator.scenes.scene import RasterScene
from spectralzoom.storage.addresses import split_variable
from spectralzoom.storage.readers.label_files import (
    MatchedFiles,
    classes_of_files,
    folders_within,
    image_folder,
    is_label_name,
    is_store,
    label_file,
    listed_names,
    match_folder,
    scene_entries,
    scene_number,
)
from spectralzoom.storage.readers.open_cubes import CUBE_ENDINGS
from spectralzoom.storage.readers.scene_files import SceneFile, load_scene_file
from spectralzoom.storage.readers.scene_toml import SETTINGS_NAME, ClassValue, SceneSettings, find_scene_settings

FARM_SCENES, FARM_VALIDATION = 48, 3
VALIDATED_SCENES = 8  # of files; from so many on some are kept to judge a network
FARM_SHAPE = (512, 640)  # of a scene [px]
FARM_TRAIN_SEED, FARM_VALIDATION_SEED = 100_000, 200_000  # examples use small seeds
FARM_TEST_SEED = 300_000  # of `evaluate`
SEASON_DAYS = (96, 304)  # of training scenes: April to October
SCOUTED_DAYS = (136, 200)  # of scouted fields and trials
SEASON_HOURS = (9, 15)  # true solar time
_PREFIXES = {FARM_LAW: "", SCOUTING_LAW: "scouting-", TRIAL_LAW: "trial-"}  # of the names of scenes
_SEASONS = {FARM_LAW: SEASON_DAYS, SCOUTING_LAW: SCOUTED_DAYS, TRIAL_LAW: SCOUTED_DAYS}
_GOLDEN, _SILVER = 0.6180339887, 0.4142135624  # steps that cover a circle evenly
Report = Callable[[str, float, str], None]  # activity, fraction done, figure


def check_out(out: Path) -> None:
    """Raise SettingsError unless weights can be written to ``out``, before minutes are spent."""
    if out.is_dir() or not (out.parent.is_dir() and os.access(out.parent, os.W_OK)):
        raise SettingsError(f"-o {out}: expected the name of a file in a folder that exists and can be written")


@dataclass(frozen=True)
class DataSet:
    """Named scene files, loaded one at a time."""

    path: Path
    files: dict[str, str]  # name -> file (or FILE:ARRAY)
    held_out: tuple[str, ...] = ()
    choices: Mapping[str, Any] = field(default_factory=dict)  # of `load_scene_file`
    label_files: Mapping[str, Path] = field(default_factory=dict)  # by name of the scene
    alone: tuple[Path, ...] = ()  # label files without a scene

    @property
    def unlabelled(self) -> tuple[str, ...]:
        """Return the scenes without a label file, if others have one."""
        return tuple(name for name in self.files if name not in self.label_files) if self.label_files else ()

    @property
    def notes(self) -> tuple[str, ...]:
        """Return notes on scenes without labels, and on labels without a scene."""
        bare = [Path(self.files[name]) for name in self.unlabelled]
        left_out = f"of {len(self.files)} scenes {len(bare)} without labels left out: {listed_names(bare)}"
        lone = f"label files without a scene, {len(self.alone)}: {listed_names(self.alone)}"
        return tuple(note for files, note in ((bare, left_out), (self.alone, lone)) if files)

    @cached_property
    def classes(self) -> dict[str, ClassValue]:
        """Return the classes of several label files together; empty if scene.toml names them."""
        settings = find_scene_settings(Path(next(iter(self.files.values()))))
        if len(self.label_files) < 2 or settings.classes:
            return {}
        return classes_of_files(tuple(self.label_files.values()), settings)

    def load(self, name: str) -> SceneFile:
        """Read one scene by its name. Raises SceneError, WavelengthError: as `load_scene_file`."""
        labels = {"labels": self.label_files.get(name), **self.choices}
        return load_scene_file(self.files[name], classes=self.classes, **labels)


def load_data_set(path: str | Path, *, hold_out: Sequence[str] = (), **choices: Any) -> DataSet:
    """List the scenes of a folder (``images/`` in it, or the files themselves) or of one file, without reading them.

    ``choices`` are labels, bands and wavelengths of `load_scene_file`; None is no choice.
    """
    choices = {name: value for name, value in choices.items() if value is not None}
    files, label_files, alone = _scenes(path)
    if unknown := [name for name in hold_out if name not in files]:
        raise SceneError(f"{path} has no scene {', '.join(unknown)} to hold out; it has {', '.join(files)}")
    if len(set(hold_out)) == len(files):
        raise SceneError(f"{path}: all {len(files)} scenes are held out, which leaves none to train on; hold out fewer")
    if len(files) > 1 and "labels" in choices:
        raise SceneError(f"{path} has {len(files)} scenes; one file of labels fits a single scene only")
    return DataSet(
        path=Path(path),
        files=files,
        held_out=tuple(name for name in files if name in set(hold_out)),
        choices=choices,
        label_files={} if "labels" in choices else label_files,
        alone=alone,
    )


def _scenes(path: str | Path) -> tuple[dict[str, str], dict[str, Path], tuple[Path, ...]]:
    """Return the files and the label files of scenes by their names, and label files without a scene."""
    file, _ = split_variable(path)
    if not file.is_dir() or is_store(file):
        if not file.exists():
            raise SceneError(f"there is no file or folder {file}; check the name (seen from {Path.cwd()})")
        return {file.stem: str(path)}, {}, ()
    folder = image_folder(file)
    settings = find_scene_settings(folder / SETTINGS_NAME)
    found = match_folder(folder) if settings.labels is None else _match_by_settings(folder, settings)
    if not found.images:
        raise SceneError(
            f"{folder} holds no scene ({', '.join(CUBE_ENDINGS)}); give a folder of images, or with images/ in it"
            f"{folders_within(folder)}"
        )
    names = _names(found.images)
    return (
        {name: str(image) for name, image in names.items()},
        {name: found.labels[image] for name, image in names.items() if image in found.labels},
        found.alone,
    )


def _match_by_settings(folder: Path, settings: SceneSettings) -> MatchedFiles:
    """Return the images of a folder and their labels by ``labels`` in scene.toml."""
    entries = scene_entries(folder)
    matched = {entry: address for entry in entries if (address := label_file(entry, settings)[0]) is not None}
    labels = {split_variable(address)[0].resolve() for address in matched.values()}
    images = tuple(entry for entry in entries if entry.resolve() not in labels and not is_label_name(entry))
    return MatchedFiles(images, {image: matched[image] for image in images if image in matched}, ())


def _names(images: Sequence[Path]) -> dict[str, Path]:
    """Return the names of scenes: their first numbers if these are unique, else the names of their files.

    Names keep their endings only if they are not unique without.
    """
    for names in ([scene_number(image) or "" for image in images], [image.stem for image in images]):
        if all(names) and len(set(names)) == len(images):
            return dict(zip(names, images, strict=True))
    return {image.name: image for image in images}


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
            return built_in_scene(law_of(name), seed, FARM_SHAPE, camera=self.camera, day=day, hour=hour)
        return scene_of_file(self.files.load(name), self.camera)


def farm_test_data(scenes: int, camera: LineCamera, dataset: str = FARM_LAW, **choices: object) -> TrainingData:
    """Return built-in scenes to judge weights on, all in ``train``. Raises SettingsError: a choice of files."""
    _refuse_choices(choices)
    laws = built_in_laws(dataset)
    return TrainingData(",".join(laws), farm_days(FARM_TEST_SEED, scenes, laws, odd=True), (), (), camera)


def farm_days(first_seed: int, count: int, laws: Sequence[str] = (FARM_LAW,), *, odd: bool = False) -> tuple[str, ...]:
    """Name scenes of each law in turn by consecutive seeds, each with a day of the season and an hour.

    Days follow the golden section, which covers the season evenly for any number of scenes. Training has even days,
    evaluation ``odd`` ones.
    """
    morning, evening = SEASON_HOURS
    names = []
    for number, law in enumerate(laws):
        first, last = _SEASONS[law]
        for i in range(len(range(number, count, len(laws)))):
            day = first + 2 * int((0.5 + i * _GOLDEN) % 1 * ((last - first) // 2)) + odd
            hour = morning + int((0.5 + i * _SILVER) % 1 * (evening - morning + 1))
            names.append(f"{_PREFIXES[law]}{first_seed + i}-day-{day}-hour-{hour}")
    return tuple(names)


def read_farm_name(name: str) -> tuple[int, int, float]:
    """Return seed, day and hour of a name of `farm_days`."""
    seed, _, day, _, hour = name.removeprefix(_PREFIXES[law_of(name)]).split("-")
    return int(seed), int(day), float(hour)


def _refuse_choices(choices: Mapping[str, object]) -> None:
    """Raise SettingsError for a choice of files."""
    for choice, value in choices.items():
        if value not in (None, ()):
            flag = "--" + choice.replace("_", "-")
            raise SettingsError(f"{flag} is for scene files; built-in scenes are drawn by seed and bring their own")


def law_of(name: str) -> str:
    """Return the law of a built-in scene by its name."""
    return next((law for law, prefix in _PREFIXES.items() if prefix and name.startswith(prefix)), FARM_LAW)


def open_training_data(
    dataset: str, validation: int | None, scenes: int | None, camera: LineCamera, **choices: object
) -> TrainingData:
    """Open built-in scenes, separated by commas, or a path with the choices of `load_data_set`.

    Every n-th scene that is not held out is for validation: by default a quarter of eight or more scenes (at most 4).
    Scenes without labels are left out, with a note, where others have some. Raises SettingsError: a choice of files
    for built-in scenes, or the other way round.
    """
    if laws := built_in_laws(dataset):
        _refuse_choices(choices)
        train = farm_days(FARM_TRAIN_SEED, FARM_SCENES if scenes is None else scenes, laws)
        left = FARM_VALIDATION * len(laws) if validation is None else validation
        judged = farm_days(FARM_VALIDATION_SEED, left, laws, odd=True)
        return TrainingData(",".join(laws), train, judged, (), camera)
    if scenes is not None:
        raise SettingsError(f"--scenes is for built-in scenes; {dataset} has its own scenes")
    files = load_data_set(Path(dataset), **choices)  # type: ignore[arg-type]
    names = tuple(name for name in files.files if name not in (*files.held_out, *files.unlabelled))
    if not names:
        raise SceneError(f"{files.path}: {'; '.join(files.notes)}; held-out scenes cannot be trained on")
    if validation is None:
        validation = min(4, len(names) // 4) if len(names) >= VALIDATED_SCENES else 0
    if validation >= len(names) and validation:
        of = counted(len(names), "scene")
        raise SceneError(f"--validation {validation} leaves none of {of} to train on; take fewer")
    kept = names[:: max(len(names) // validation, 1)][:validation] if validation else ()
    train = tuple(name for name in names if name not in kept)
    return TrainingData(files.path.stem, train, kept, files.held_out, camera, files, files.notes)


def untaught_note(names: Sequence[str]) -> str:
    """Return the note on classes without a training pixel."""
    if len(names) == 1:
        return f"class {names[0]} has no pixel in the training frames; it will never be drawn"
    return f"classes {', '.join(names)} have no pixel in the training frames; they will never be drawn"


def check_taught(dataset: str, taught: Sequence[str], frames: Sequence[str]) -> None:
    """Raise SceneError for fewer than two classes that frames have."""
    if len(taught) < 2:
        note = f"no pixel of {list_some(frames)} has a class; correct the labels, or 'unlabelled' in scene.toml"
        note = filled(alike_note(taught[0]), frames) if taught else note
        raise SceneError(f"{dataset}: training needs two or more classes, and {note}")


UNNAMED_ZERO = {"class_0": "0", "colour_000000": "[0, 0, 0]"}  # class without a name of its own -> its label


def zero_cure(kind: str) -> str:
    """Return how to say that the label 0 is no class; empty for another class, or one that a scene.toml names."""
    value = UNNAMED_ZERO.get(kind)
    return f"if it means unlabelled, write unlabelled = {value} into a {SETTINGS_NAME} beside the scene" * bool(value)


def zero_sentence(name: str = "", fraction: float = 0.0) -> str:
    """Return what label 0 stands for: a class of that name, or unlabelled; empty where all labels are others."""
    share = f"{format_percent(fraction)} of the pixels"
    if name:
        return "; ".join(filter(None, (f"label 0 is the class {name}: {share}", zero_cure(name))))
    way = f"a table [classes] in a {SETTINGS_NAME} can name it: NAME = 0"
    return f"label 0 is no class, {share} are unlabelled; {way}" if fraction else ""


EMPTY = "{scenes} without any value left out: {names}"
MOVED = (
    "labels of {names} have another place, CRS or pixels than their images: they are brought to the images' pixels by"
    " nearest neighbour"
)
DARK = "most values of {names} are negative, thus without light; add an offset to the scene.toml"


def alike_note(kind: str) -> str:
    """Return the note on scenes with a single class, which may stand for unlabelled."""
    return (
        f"all labels are {kind} in {{names}}; if its value in the label files stands for no class, write"
        " unlabelled = VALUE into the scene.toml"
    )


def filled(note: str, names: Sequence[str]) -> str:
    """Return a note with the names of its scenes, and their number."""
    for kind in ("scene", "validation scene"):
        note = note.replace(f"{{{kind}s}}", counted(len(names), kind))
    return note.replace("{names}", list_some(names))


class SceneNotes(defaultdict[str, list[str]]):
    """Names of scenes by the note on them."""

    def __init__(self) -> None:
        super().__init__(list)

    def scenes(
        self, data: TrainingData, names: Sequence[str], what: str, report: Report
    ) -> Iterator[tuple[int, str, RasterScene]]:
        """Open scenes with a value; yield number, name and scene."""
        for number, name in enumerate(names):
            report(what, number / len(names), name)
            try:
                yield number, name, data.scene(name)
            except EmptySceneError:
                self[EMPTY].append(name)

    def add(self, name: str, scene: RasterScene) -> None:
        """Note labels of a single class or another grid, and values without light."""
        if scene.labels is not None:
            there = np.unique(scene.labels[scene.labels != UNLABELLED])
            if len(there) == 1:
                self[alike_note(scene.class_names[there[0]])].append(name)
        if scene.regridded:
            self[MOVED].append(name)
        if scene.content and 2 * np.count_nonzero(scene.planes < 0) > scene.planes.size:
            self[DARK].append(name)

    @property
    def texts(self) -> list[str]:
        """Return the notes."""
        return [filled(note, names) for note, names in self.items()]


def trained_pixels(scene: RasterScene) -> NDArray[np.bool_]:
    """Return the labelled pixels of a scene. Raises SceneError: it has no labels."""
    if scene.labels is None:
        raise SceneError(
            f"scene {scene.name} has no labels; training needs them: give --labels, or call"
            f" its label file {scene.name}_mask.png or labels/{scene.name}.png (scene.toml: other names)"
        )
    return np.asarray(scene.labels != UNLABELLED)
