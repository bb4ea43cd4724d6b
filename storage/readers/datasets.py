"""List the scenes of a folder, or one scene with a training mask, for training."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SceneError
from pipeline.geometry.grid import UNLABELLED
from storage.readers.label_files import (
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
from storage.readers.labels import load_codes
from storage.readers.open_cubes import CUBE_ENDINGS, split_variable
from storage.readers.scene_files import SceneFile, load_scene_file
from storage.readers.scene_toml import SETTINGS_NAME, ClassValue, SceneSettings, find_scene_settings


@dataclass(frozen=True)
class DataSet:
    """Named scene files, loaded one at a time."""

    path: Path
    files: dict[str, str]  # name -> file (or FILE:ARRAY)
    held_out: tuple[str, ...] = ()
    choices: Mapping[str, Any] = field(default_factory=dict)  # of `load_scene_file`
    train_mask: str | Path | None = None
    mask_classes: tuple[int, ...] | None = None
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
        notes = (
            [f"of {len(self.files)} scenes {len(bare)} without labels left out: {listed_names(bare)}"] if bare else []
        )
        lone = [f"label files without a scene, {len(self.alone)}: {listed_names(self.alone)}"] if self.alone else []
        return (*notes, *lone)

    @cached_property
    def classes(self) -> dict[str, ClassValue]:
        """Return the classes of several label files together; empty if scene.toml names them."""
        settings = find_scene_settings(Path(next(iter(self.files.values()))))
        if len(self.label_files) < 2 or settings.classes:
            return {}
        return classes_of_files(tuple(self.label_files.values()), settings)

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of all scenes, in the order of their files."""
        return tuple(self.files)

    @property
    def train_names(self) -> tuple[str, ...]:
        """Return the names of the scenes to train on."""
        return tuple(name for name in self.files if name not in self.held_out)

    def load(self, name: str, part: Literal["train", "test"] | None = None) -> SceneFile:
        """Read one scene by its name with all labels, or with those inside or outside of the training mask.

        Raises SceneError, WavelengthError: as `load_scene_file`.
        """
        if name not in self.files:
            raise SceneError(f"{self.path} has no scene {name}; it has {', '.join(self.files)}")
        labels = {"labels": self.label_files.get(name), **self.choices}
        scene = load_scene_file(self.files[name], classes=self.classes, **labels)
        if part is None or self.train_mask is None:
            return scene
        train, rest = split_labels(scene, self.train_mask, self.mask_classes)
        if part == "train":
            chosen, note = train, f"labels inside {self.train_mask}: training"
        else:
            chosen, note = rest, f"labels outside {self.train_mask}: test"
        return replace(scene, labels=chosen, provenance=(*scene.provenance, note))


def load_data_set(
    path: str | Path,
    *,
    hold_out: Sequence[str] = (),
    train_mask: str | Path | None = None,
    mask_classes: Sequence[int] | None = None,
    **choices: Any,
) -> DataSet:
    """List the scenes of a folder (``images/`` in it, or the files themselves) or of one file, without reading them.

    ``choices`` are labels, bands and wavelengths of `load_scene_file`; None is no choice.
    """
    choices = {name: value for name, value in choices.items() if value is not None}
    files, label_files, alone = _scenes(path, train_mask)
    unknown = [name for name in hold_out if name not in files]
    if unknown:
        raise SceneError(f"{path} has no scene {', '.join(unknown)} to hold out; it has {', '.join(files)}")
    if len(set(hold_out)) == len(files):
        raise SceneError(f"{path}: all {len(files)} scenes are held out, which leaves none to train on; hold out fewer")
    if len(files) > 1 and (train_mask is not None or "labels" in choices):
        raise SceneError(f"{path} has {len(files)} scenes; one file of labels or one mask fits a single scene only")
    if mask_classes is not None and train_mask is None:
        raise SceneError("mask classes are given without a training mask; give both or neither")
    return DataSet(
        path=Path(path),
        files=files,
        held_out=tuple(name for name in files if name in set(hold_out)),
        choices=choices,
        train_mask=train_mask,
        mask_classes=None if mask_classes is None else tuple(mask_classes),
        label_files={} if "labels" in choices else label_files,
        alone=alone,
    )


def split_labels(
    scene: SceneFile, train_mask: str | Path, mask_classes: Sequence[int] | None
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Return the labels with the mask's class, to train on, and all other labels, (y, x) each, 255 elsewhere."""
    if scene.labels is None:
        raise SceneError(f"{scene.path} has no labels, which a training mask needs; give --labels")
    mask = load_codes(train_mask, scene.geobox, by_number=True).values
    if mask.shape != scene.labels.shape:
        sizes = [f"{image.shape[0]} x {image.shape[1]} px" for image in (mask, scene.labels)]
        raise SceneError(f"mask {train_mask} is {sizes[0]}, the scene is {sizes[1]} (y x x)")
    highest = int(mask.max(initial=0))
    numbers = {value: index for index, value in enumerate(scene.class_values) if isinstance(value, int)}
    if not numbers:
        raise SceneError(f"{scene.path} has classes by colour; a training mask needs classes by number")
    classes = range(1, highest + 1) if mask_classes is None else mask_classes  # a range: a stray number may be huge
    if highest > len(classes):
        raise SceneError(f"mask {train_mask} goes up to {highest}, but only {len(classes)} mask classes are given")
    unknown = next((number for number in classes[:highest] if number not in numbers), None)
    if unknown is not None:
        raise SceneError(
            f"mask {train_mask}: class {unknown} is none of the labels' {sorted(numbers)}; correct the mask classes"
        )
    index = np.array([UNLABELLED, *(numbers[number] for number in classes[:highest])], np.uint8)
    wanted = index[np.maximum(mask, 0)]
    trains = (wanted == scene.labels) & (wanted != UNLABELLED)
    return (np.where(trains, scene.labels, np.uint8(UNLABELLED)), np.where(trains, np.uint8(UNLABELLED), scene.labels))


def _scenes(
    path: str | Path, train_mask: str | Path | None
) -> tuple[dict[str, str], dict[str, Path], tuple[Path, ...]]:
    """Return the files and the label files of scenes by their names, and label files without a scene."""
    file, _ = split_variable(path)
    if not file.is_dir() or is_store(file):
        if not file.exists():
            raise SceneError(f"there is no file or folder {file}; check the name (seen from {Path.cwd()})")
        return {file.stem: str(path)}, {}, ()
    folder = image_folder(file)
    settings = find_scene_settings(folder / SETTINGS_NAME)
    masks = () if train_mask is None else (split_variable(train_mask)[0].resolve(),)
    found = match_folder(folder) if settings.labels is None else _match_by_settings(folder, settings)
    images = [image for image in found.images if image.resolve() not in masks]
    if not images:
        raise SceneError(
            f"{folder} holds no scene ({', '.join(CUBE_ENDINGS)}); give a folder of images, or with images/ in it"
            f"{folders_within(folder)}"
        )
    names = _names(images)
    labels = {image: label for image, label in found.labels.items() if label.resolve() not in masks}
    return (
        {name: str(image) for name, image in names.items()},
        {name: labels[image] for name, image in names.items() if image in labels},
        tuple(one for one in found.alone if one.resolve() not in masks),
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
    numbers = [scene_number(image) or "" for image in images]
    stems = [image.stem for image in images]
    for names in (numbers, stems):
        if all(names) and len(set(names)) == len(images):
            return dict(zip(names, images, strict=True))
    return {image.name: image for image in images}
