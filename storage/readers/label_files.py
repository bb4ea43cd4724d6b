"""Find and read the label files of scenes.

Labels are pictures, or polygons if there is no picture. They lie beside their images with a word in their name
(``001_mask.png``, ``field_a.gpkg``), or in a folder of such a name (``labels/001.png``) there or beside a folder of
images. Upper and lower case are alike.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from odc.geo.geobox import GeoBox

from spectralzoom.pipeline.errors import SceneError, list_some
from spectralzoom.storage.addresses import split_variable
from spectralzoom.storage.readers.labels import Labels, found_classes, load_labels
from spectralzoom.storage.readers.open_cubes import CUBE_ENDINGS
from spectralzoom.storage.readers.own_files import stated_file
from spectralzoom.storage.readers.polygons import (
    POLYGON_ENDINGS,
    is_polygon_file,
    load_polygon_labels,
    polygon_classes,
    split_layer,
)
from spectralzoom.storage.readers.scene_toml import SETTINGS_NAME, ClassValue, SceneSettings, is_image_folder
from spectralzoom.storage.readers.user_files import is_there

WORDS = ("mask", "masks", "label", "labels", "annotation", "annotations", "gt", "ground_truth")  # of files and folders
SHOWN = 5  # names in a message
_LABEL_WORD = re.compile(rf"^(?:{'|'.join(WORDS)})[_\-. ]+|[_\-. ]+(?:{'|'.join(WORDS)})$")
_IMAGE_WORD = re.compile(r"^(?:image|img|rgb)[_\-. ]+|[_\-. ]+(?:image|img|rgb)$")


@dataclass(frozen=True)
class MatchedFiles:
    """Images of a folder, and their label files."""

    images: tuple[Path, ...]
    labels: dict[Path, Path]  # by image
    alone: tuple[Path, ...]  # label files without an image

    @property
    def lacking(self) -> tuple[str, ...]:
        """Return a line on each kind of file without a partner."""
        bare = [image for image in self.images if image not in self.labels] if self.labels else []
        none = "label files: beside an image NAME.png they are called NAME_mask.png, or labels/NAME.png"
        left_out = f"labels of {len(bare)} image{'s' * (len(bare) > 1)}, left out: {listed_names(bare)}"
        lone = f"the image of {len(self.alone)} label file{'s' * (len(self.alone) > 1)}: {listed_names(self.alone)}"
        return tuple(line for line, there in ((none, not self.labels), (left_out, bare), (lone, self.alone)) if there)


def read_labels(address: str | Path, shape: tuple[int, int], geobox: GeoBox | None, settings: SceneSettings) -> Labels:
    """Read labels on a scene's (y, x) pixels, out of a picture or of polygons (SceneError: they do not fit)."""
    if is_polygon_file(address):
        return load_polygon_labels(address, shape, geobox, settings=settings)
    return load_labels(
        address, shape, geobox, classes=settings.classes, unlabelled=settings.unlabelled, colours=settings.colours
    )


def classes_of_files(files: Sequence[Path], settings: SceneSettings) -> dict[str, ClassValue]:
    """Return every class of several label files by its value (SceneError: some are polygons, some pictures)."""
    polygons = [file for file in files if is_polygon_file(file)]
    if not polygons:
        return found_classes(files, settings.unlabelled)
    if len(polygons) < len(files):
        raise SceneError(
            f"some labels are polygons ({listed_names(polygons)}) and some are pictures; name their classes in a "
            f"{SETTINGS_NAME}, or use one kind"
        )
    return polygon_classes(polygons, settings)


def scene_entries(folder: Path) -> list[Path]:
    """Return the files and Zarr stores that may be scenes or labels, sorted by name, without hidden ones.

    Among them may be links that lead nowhere, which are refused where they are chosen.
    """
    return sorted(
        entry
        for entry in folder.iterdir()
        if not entry.name.startswith(".")
        and ((entry.suffix.lower() in CUBE_ENDINGS and not entry.is_dir()) or is_store(entry))
    )


def image_folder(folder: Path) -> Path:
    """Return the folder ``images`` (or of a similar name) in a folder, or the folder itself."""
    inner = sorted(entry for entry in folder.iterdir() if is_image_folder(entry) and is_there(entry) and entry.is_dir())
    return min(inner, key=lambda entry: entry.name != "images", default=folder)


def find_files(path: Path) -> MatchedFiles:
    """Match the images of a folder, or the one image, to their labels (SceneError: no image, or as `match_folder`)."""
    if not path.exists():
        raise SceneError(f"there is no file or folder {path}; check the name (seen from {Path.cwd()})")
    if not path.is_dir() or is_store(path):
        label = None if is_label_name(path) else find_label(path)
        return MatchedFiles((path,), {} if label is None else {path: label}, ())
    found = match_folder(image_folder(path))
    if not found.images:
        way = f"give a folder of images, or with images/ in it{folders_within(path)}"
        raise SceneError(f"{path} holds no image that is read; {way}")
    return found


def match_folder(folder: Path) -> MatchedFiles:
    """Match the images of a folder to their labels.

    Raises SceneError: several files may be an image's labels, or one those of several images; both are named.
    """
    own = scene_entries(folder)
    images = [entry for entry in own if not is_label_name(entry)] or own  # a folder of labels is read as images
    pictures, polygons = _labels_near(folder)
    pictures = [entry for entry in pictures if entry not in images]
    matched = {image: _label_of(image, pictures) or _label_of(image, polygons) for image in images}
    labels = {image: found for image, found in matched.items() if found is not None}
    if len(images) == len(pictures) == 1:  # a single pair may have any names
        labels = dict(zip(images, pictures, strict=True))
    owner: dict[Path, Path] = {}
    for image, label in labels.items():
        if owner.setdefault(label, image) != image:
            raise SceneError(
                f"{owner[label]} and {image} would both have the labels {label}, by their names; rename one of them, or"
                f" say which files are labels in a {SETTINGS_NAME}"
            )
    for entry in (*images, *labels.values()):
        is_there(entry)
    return MatchedFiles(tuple(images), labels, tuple(entry for entry in pictures if entry not in owner))


def find_label(scene: Path) -> Path | None:
    """Return the label file of one scene by its name (SceneError: there are several)."""
    if not scene.parent.is_dir() or (scene.is_dir() and not is_store(scene)):
        return None
    try:
        pictures, polygons = _labels_near(scene.parent)
    except PermissionError:  # the folder cannot be listed
        return None
    found = _label_of(scene, [entry for entry in pictures if entry != scene]) or _label_of(scene, polygons)
    return found if found is not None and is_there(found) else None


def is_label_name(path: Path) -> bool:
    """Return whether a file's name is that of labels: ``001_mask.png``, ``labels.png``."""
    stem = path.stem.lower()
    return stem in WORDS or _LABEL_WORD.search(stem) is not None


def folders_within(folder: Path) -> str:
    """Return a hint on the folders within a folder that have images; empty if none has."""
    inner = [entry for entry in sorted(folder.iterdir()) if entry.is_dir() and not is_store(entry)]
    found = [entry for entry in inner if not entry.name.startswith(".") and scene_entries(image_folder(entry))]
    return f"; there are some in its folders {listed_names(found)}: name one" if found else ""


def listed_names(paths: Iterable[Path]) -> str:
    """Return the first names, and how many there are beyond them."""
    return list_some([path.name for path in paths], SHOWN)


def is_store(entry: Path) -> bool:
    """Return whether a folder is a Zarr store, which is one scene."""
    return entry.suffix.lower() == ".zarr" and not entry.is_file()


def _labels_near(folder: Path) -> tuple[list[Path], list[Path]]:
    """Return the pictures and the polygons that may be labels of a folder's images, by the names of files and folders.

    They lie in the folder or in folders of labels there, and beside it if it has images.
    """
    around = [folder, folder.parent] if is_image_folder(folder) else [folder]
    named = [one for place in around for one in sorted(place.iterdir()) if one.name.lower() in WORDS and is_there(one)]
    inside = [one for one in named if one.is_dir() and one != folder]
    pictures = [entry for entry in scene_entries(folder) if is_label_name(entry)]
    pictures += [entry for place in inside for entry in scene_entries(place)]
    visible = [entry for place in [*around, *inside] for entry in sorted(place.glob("[!.]*"))]
    return pictures, [entry for entry in visible if entry.suffix.lower() in POLYGON_ENDINGS and not entry.is_dir()]


def _label_of(image: Path, candidates: Sequence[Path]) -> Path | None:
    """Return the file with the image's name, both without a word for images and labels."""
    wanted = _IMAGE_WORD.sub("", image.stem.lower())
    stems = {one: _LABEL_WORD.sub("", one.stem.lower(), count=1) for one in candidates}
    found = [one for one, stem in stems.items() if wanted in (one.stem.lower(), stem, _IMAGE_WORD.sub("", stem))]
    if len(found) > 1:
        names = " and ".join(str(one) for one in found[:SHOWN])
        raise SceneError(
            f"{image} has several files of labels by their names: {names}; keep one, or name it with labels in a"
            f" {SETTINGS_NAME}"
        )
    return found[0] if found else None


def label_file(scene: Path, settings: SceneSettings) -> tuple[Path | None, str]:
    """Return the label file of a scene by scene.toml, else by its name; and a note if the named one is missing."""
    if settings.labels is None or settings.path is None:
        return find_label(scene), ""
    if not settings.labels:
        return None, ""
    name = settings.labels.replace("{number}", scene_number(scene) or "").replace("{name}", scene.stem)
    address = settings.path.parent / name
    file, _ = split_variable(split_layer(name)[0])
    stated_file(settings.path.parent, str(file), f"{settings.path}: labels")
    if address != settings.path.parent / settings.labels and not split_layer(address)[0].is_file():
        return None, f"no labels: there is no {address}"
    return address, ""


def scene_number(path: Path) -> str | None:
    """Return the first digits of the file's name: ``059_image.png`` -> ``059``."""
    digits = re.search(r"\d+", path.stem)
    return None if digits is None else digits.group()
