"""Which label file belongs to which image, by their names alone: equal, or but for a word such as ``_mask``.

Labels lie beside their images (``001_mask.png``, ``field_a_labels.png``) or in a folder of labels there, or beside a
folder of images (``labels/001.png``, ``annotations/001_annotation.png``). Upper and lower case are alike.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.errors import SceneError
from storage.readers.raster_files import SCENE_ENDINGS
from storage.readers.scene_toml import SETTINGS_NAME, is_image_folder

LABEL_WORDS = ("mask", "masks", "label", "labels", "annotation", "annotations", "gt", "groundtruth", "truth", "seg")
LABEL_FOLDERS = {*LABEL_WORDS, "ground_truth", "segmentation", "segmentations", "targets", "labelimages"}
IMAGE_WORDS = ("image", "img", "rgb", "picture", "photo", "scene", "ortho", "cube")
SHOWN = 5  # names in a message


def _word_at_an_end(words: Sequence[str]) -> re.Pattern[str]:
    either = "|".join(words)
    return re.compile(rf"^(?:{either})[_\-. ]+|[_\-. ]+(?:{either})$")


_LABEL_WORD, _IMAGE_WORD = _word_at_an_end(LABEL_WORDS), _word_at_an_end(IMAGE_WORDS)


@dataclass(frozen=True)
class MatchedFiles:
    """Images of a folder, and the label files that belong to them."""

    images: tuple[Path, ...]
    labels: dict[Path, Path]  # of an image
    alone: tuple[Path, ...]  # label files without an image

    @property
    def bare(self) -> tuple[Path, ...]:
        """Images without labels."""
        return tuple(image for image in self.images if image not in self.labels)


def scene_entries(folder: Path) -> list[Path]:
    """Files and Zarr stores of a folder that may be scenes or labels, by name; hidden ones are nobody's."""
    return sorted(
        entry
        for entry in folder.iterdir()
        if not entry.name.startswith(".")
        and ((entry.suffix.lower() in SCENE_ENDINGS and entry.is_file()) or _is_store(entry))
    )


def image_folder(folder: Path) -> Path:
    """Where the images of a folder lie: in a folder ``images`` in it, where there is one, or in itself."""
    inner = sorted(entry for entry in folder.iterdir() if is_image_folder(entry) and entry.is_dir())
    return next((entry for entry in inner if entry.name == "images"), inner[0] if inner else folder)


def match_folder(folder: Path) -> MatchedFiles:
    """Match the images of a folder to their labels.

    Raises SceneError: several files may be an image's labels, or one those of several images; both are named.
    """
    own = scene_entries(folder)
    apart = _in_label_folders(folder)
    beside = [entry for entry in own if is_label_name(entry)]
    images = [entry for entry in own if entry not in beside]
    if not images:  # a folder of labels is asked for as such: they are what there is
        images, beside = own, []
    labels = {image: found for image in images if (found := _label_of(image, [*beside, *apart])) is not None}
    if len(images) == len([*beside, *apart]) == 1:  # they need no name to belong together
        labels = dict(zip(images, [*beside, *apart], strict=True))
    _refuse_shared(labels)
    alone = tuple(entry for entry in (*beside, *apart) if entry not in set(labels.values()))
    return MatchedFiles(tuple(images), labels, alone)


def find_label(scene: Path) -> Path | None:
    """The label file of one scene by its name; None where there is none (SceneError: there are several)."""
    if not scene.parent.is_dir() or (scene.is_dir() and not _is_store(scene)):
        return None
    try:
        beside = [entry for entry in scene_entries(scene.parent) if is_label_name(entry) and entry != scene]
        return _label_of(scene, [*beside, *_in_label_folders(scene.parent)])
    except PermissionError:  # who may read the file need not be allowed to list the folder
        return None


def is_label_name(path: Path) -> bool:
    """Whether a file's name says that it holds labels: ``001_mask.png``, ``labels.png``."""
    stem = path.stem.lower()
    return stem in LABEL_WORDS or _LABEL_WORD.search(stem) is not None


def folders_within(folder: Path) -> str:
    """Words for the folders of a folder in which images lie, for whoever looks for some; nothing where none does."""
    inner = [entry for entry in sorted(folder.iterdir()) if entry.is_dir() and not _is_store(entry)]
    found = [entry for entry in inner if not entry.name.startswith(".") and scene_entries(image_folder(entry))]
    return f"; there are some in its folders {listed_names(found)}: name one" if found else ""


def listed_names(paths: Iterable[Path]) -> str:
    """The first names, and how many more there are."""
    names = [path.name for path in paths]
    more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
    return ", ".join(names[:SHOWN]) + more


def _is_store(entry: Path) -> bool:
    return entry.suffix.lower() == ".zarr" and entry.is_dir()


def _in_label_folders(folder: Path) -> list[Path]:
    """All that may be labels in folders of labels: in this one, or beside it where it is one of images."""
    around = [folder, folder.parent] if is_image_folder(folder) else [folder]
    found = [entry for place in around for entry in sorted(place.iterdir()) if entry.name.lower() in LABEL_FOLDERS]
    return [entry for inner in found if inner.is_dir() and inner != folder for entry in scene_entries(inner)]


def _label_of(image: Path, candidates: Sequence[Path]) -> Path | None:
    """The one that has the image's name; without one, that differs by a word for images, too."""
    stem = image.stem.lower()
    for alike in (lambda name: name, lambda name: _IMAGE_WORD.sub("", name)):
        wanted = alike(stem)
        found = [one for one in candidates if wanted in (alike(one.stem.lower()), alike(_bare(one)))]
        if len(found) > 1:
            names = " and ".join(str(one) for one in found[:SHOWN])
            home = image.parent.parent if is_image_folder(image.parent) else image.parent
            told = Path(os.path.relpath(found[0].parent, home), found[0].name.replace(image.stem, "{name}", 1))
            raise SceneError(
                f"{image} has several files of labels by their names: {names}; keep one, or say which in a"
                f' {SETTINGS_NAME}: labels = "{told.as_posix()}"'
            )
        if found:
            return found[0]
    return None


def _bare(label: Path) -> str:
    return _LABEL_WORD.sub("", label.stem.lower(), count=1)


def _refuse_shared(labels: dict[Path, Path]) -> None:
    owner: dict[Path, Path] = {}
    for image, label in labels.items():
        if label in owner:
            raise SceneError(
                f"{owner[label]} and {image} would both have the labels {label}, by their names; rename one of them, or"
                f" say which files are labels in a {SETTINGS_NAME}"
            )
        owner[label] = image
