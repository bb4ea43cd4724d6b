"""Data sets: scenes in a folder, or one scene with a training mask, loaded one at a time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SceneError
from pipeline.geometry.grid import UNLABELLED
from storage.readers.label_files import (
    MatchedFiles,
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
from storage.readers.labels import found_classes, load_codes
from storage.readers.open_cubes import CUBE_ENDINGS, split_variable
from storage.readers.polygons import is_polygon_file, polygon_classes
from storage.readers.scene_files import SceneFile, load_scene_file
from storage.readers.scene_toml import SETTINGS_NAME, ClassValue, SceneSettings, find_scene_settings


@dataclass(frozen=True)
class DataSet:
    """Named scene files, loaded one at a time."""

    path: Path
    files: dict[str, str]  # name -> file (or FILE:ARRAY)
    held_out: tuple[str, ...] = ()
    labels: str | Path | None = None
    bands: tuple[int, ...] | None = None
    wavelengths: tuple[float, ...] | None = None
    train_mask: str | Path | None = None
    mask_classes: tuple[int, ...] | None = None
    label_files: Mapping[str, Path] = field(default_factory=dict)  # of scenes of a folder, by their names
    alone: tuple[Path, ...] = ()  # label files that belong to no scene

    @property
    def unlabelled(self) -> tuple[str, ...]:
        """Scenes without a label file, where others have one."""
        return tuple(name for name in self.files if name not in self.label_files) if self.label_files else ()

    @property
    def notes(self) -> tuple[str, ...]:
        """Return notes on what was left out: scenes without labels, and labels without a scene."""
        bare = [Path(self.files[name]) for name in self.unlabelled]
        told = [f"of {len(self.files)} scenes {len(bare)} without labels left out: {listed_names(bare)}"]
        lone = [f"label files without a scene, {len(self.alone)}: {listed_names(self.alone)}"]
        return (*(told if bare else ()), *(lone if self.alone else ()))

    @cached_property
    def classes(self) -> dict[str, ClassValue]:
        """Every class that any of the label files holds, by its value; none where scene.toml names them, or one is."""
        if len(self.label_files) < 2:
            return {}
        settings = find_scene_settings(Path(next(iter(self.files.values()))))
        if settings.classes:
            return {}
        polygons = [file for file in self.label_files.values() if is_polygon_file(file)]
        if polygons and len(polygons) < len(self.label_files):
            raise SceneError(
                f"{self.path}: some labels are polygons ({listed_names(polygons)}) and some are pictures; name their"
                f" classes in a {SETTINGS_NAME}, or use one kind"
            )
        if polygons:
            return dict(polygon_classes(polygons, settings))
        return found_classes(self.label_files.values(), settings.unlabelled)

    @property
    def names(self) -> tuple[str, ...]:
        """Every scene, in the order of the files' names."""
        return tuple(self.files)

    @property
    def train_names(self) -> tuple[str, ...]:
        """Scenes to train on."""
        return tuple(name for name in self.files if name not in self.held_out)

    def load(self, name: str, part: Literal["train", "test"] | None = None) -> SceneFile:
        """Read one scene with its labels: all, or those that a training mask takes or leaves for a test.

        Its ``name`` is the data set's. Errors as load_scene_file.
        """
        if name not in self.files:
            raise SceneError(f"{self.path} has no scene {name}; it has {', '.join(self.files)}")
        scene = load_scene_file(
            self.files[name],
            labels=self.labels or self.label_files.get(name),
            bands=self.bands,
            wavelengths=self.wavelengths,
            classes=self.classes,
        )
        if part is None or self.train_mask is None:
            return scene
        train, rest = split_labels(scene, self.train_mask, self.mask_classes)
        if part == "train":
            chosen, note = train, f"labels only where {self.train_mask} says so: training"
        else:
            chosen, note = rest, f"labels only where {self.train_mask} does not train: test"
        return replace(scene, labels=chosen, provenance=(*scene.provenance, note))


def load_data_set(
    path: str | Path,
    *,
    hold_out: Sequence[str] = (),
    labels: str | Path | None = None,
    bands: Sequence[int] | None = None,
    wavelengths: Sequence[float] | None = None,
    train_mask: str | Path | None = None,
    mask_classes: Sequence[int] | None = None,
) -> DataSet:
    """List the scenes of a folder (``images/`` in it, or the files themselves) or of one file, without reading them."""
    files, label_files, alone = _scenes(path, train_mask)
    unknown = [name for name in hold_out if name not in files]
    if unknown:
        raise SceneError(f"{path} has no scene {', '.join(unknown)} to hold out; it has {', '.join(files)}")
    if len(set(hold_out)) == len(files):
        raise SceneError(f"{path}: all {len(files)} scenes are held out, which leaves none to train on; hold out fewer")
    if len(files) > 1 and (train_mask is not None or labels is not None):
        raise SceneError(f"{path} has {len(files)} scenes; one file of labels or one mask fits a single scene only")
    if mask_classes is not None and train_mask is None:
        raise SceneError("mask classes are given without a training mask; give both or neither")
    return DataSet(
        path=Path(path),
        files=files,
        held_out=tuple(name for name in files if name in set(hold_out)),
        labels=labels,
        bands=None if bands is None else tuple(bands),
        wavelengths=None if wavelengths is None else tuple(wavelengths),
        train_mask=train_mask,
        mask_classes=None if mask_classes is None else tuple(mask_classes),
        label_files={} if labels is not None else label_files,
        alone=alone,
    )


def split_labels(
    scene: SceneFile, train_mask: str | Path, mask_classes: Sequence[int] | None
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Return the labels to train on (where the mask's class is the label's) and the labelled rest.

    Both are (y, x) and 255 elsewhere.
    """
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
    """Return the files of scenes, their label files, both by name, and label files without a scene."""
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
    """Return the images of a folder and their labels by ``labels`` in scene.toml; label files are no images."""
    entries = scene_entries(folder)
    told: dict[Path, Path] = {}
    for entry in entries:
        if "{number}" in str(settings.labels) and scene_number(entry) is None:
            continue  # reading the scene reports it
        address = label_file(entry, settings)[0]
        if address is not None:
            told[entry] = address
    labels = {split_variable(address)[0].resolve() for address in told.values()}
    others = [entry for entry in entries if entry.resolve() not in labels]
    images = tuple(entry for entry in others if not is_label_name(entry)) or tuple(others)
    apart = {address.parent for address in told.values()} - {folder}
    beside = [entry for place in sorted(apart) if place.is_dir() for entry in scene_entries(place)]
    alone = tuple(one for one in (*others, *beside) if one not in images and one.resolve() not in labels)
    return MatchedFiles(images, {image: told[image] for image in images if image in told}, alone)


def _names(images: Sequence[Path]) -> dict[str, Path]:
    """Return the names of scenes: their first numbers, where each has its own, else the names of their files.

    Endings are kept where two names differ by nothing else.
    """
    numbers = [scene_number(image) or "" for image in images]
    stems = [image.stem for image in images]
    for names in (numbers, stems):
        if all(names) and len(set(names)) == len(images):
            return dict(zip(names, images, strict=True))
    return {image.name: image for image in images}
