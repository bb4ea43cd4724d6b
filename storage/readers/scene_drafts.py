"""Inspect files of images and labels for a scene.toml that is still to be written."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import PipelineError, SceneError, SeriesError
from pipeline.geometry.grid import UNLABELLED
from pipeline.readings import edge_fill
from storage.readers.cube_sources import CubeSource
from storage.readers.label_files import (
    LABEL_WORDS,
    MatchedFiles,
    classes_of_files,
    filled,
    find_label,
    folders_within,
    image_folder,
    is_label_name,
    is_store,
    match_folder,
    read_labels,
    scene_number,
)
from storage.readers.labels import MixedLabelsError
from storage.readers.open_cubes import open_cube, open_labels, split_variable, with_wavelengths
from storage.readers.scene_toml import ClassValue, SceneSettings

Report = Callable[[float, str], None]  # progress, 0..1, and the name of the file
_ROWS_OF_EDGE = 32  # whose first and last pixels are read


@dataclass(frozen=True)
class FoundClass:
    """A value of the label files: a name for scene.toml, and its fraction of the labelled pixels."""

    name: str
    value: ClassValue
    fraction: float


@dataclass(frozen=True)
class SceneDraft:
    """Facts about the scenes that one scene.toml describes."""

    folder: Path  # of scene.toml
    files: MatchedFiles
    first: str  # address of the scene that was read
    shape: tuple[int, int, int]  # of the first image, (y, x, band)
    pattern: str | None  # of all label files by their images' names, relative to ``folder``
    wavelength_nm: NDArray[np.float64] | None  # (band,)
    wavelength_origin: str
    nodata: float | None  # in the file
    dtype: np.dtype[Any]  # of its values, after the file's own scale
    edge: tuple[float, float] | None  # value that fills the edge, and its fraction of it
    placed: bool  # on the earth
    missing: float  # fraction of NaN among the sampled values
    classes: tuple[FoundClass, ...] = ()
    notes: tuple[str, ...] = ()  # on the first image
    unseen: tuple[str, ...] = field(default=())  # on files that cannot be read or do not fit
    has_steps: bool = False  # the first is one step of a series


def draft_scene(address: str | Path, report: Report = lambda done, name: None) -> SceneDraft:
    """Inspect the images and labels of a folder, or one file and its labels.

    The first image is read, of others only the size; all label files are read. Raises SceneError: there is no image, or
    the first one cannot be read; labels may belong to several images, or have mixed values.
    """
    path, _ = split_variable(address)
    alone = not path.is_dir() or is_store(path)
    if not path.exists():
        raise SceneError(f"there is no file or folder {path}; check the name (seen from {Path.cwd()})")
    if alone:
        label = None if is_label_name(path) else find_label(path)
        found = MatchedFiles((path,), {} if label is None else {path: label}, ())
    else:
        found = match_folder(image_folder(path))
    if not found.images:
        within = folders_within(path)
        raise SceneError(f"{path} holds no image that is read; give a folder of images, or with images/ in it{within}")
    folder = path.parent if alone else path
    first, series = _named_step(address if alone else found.images[0])
    source = with_wavelengths(open_cube(first), first, None)
    found, unseen = _shared_labels(found, source.shape[:2]), list[str]()
    classes = _classes(found, source.shape[2], unseen, report)
    edge, missing = _check_edge(source)
    return SceneDraft(
        folder=folder,
        files=found,
        shape=source.shape,
        pattern=_pattern(found, folder),
        wavelength_nm=source.bands.wavelength_nm,
        wavelength_origin=source.bands.origin,
        nodata=source.nodata,
        dtype=source.dtype,
        edge=edge,
        placed=source.geobox is not None,
        missing=missing,
        classes=classes,
        notes=(*series, *source.notes),
        first=str(first),
        has_steps=bool(series),
        unseen=tuple(unseen),
    )


def _named_step(address: str | Path) -> tuple[str | Path, tuple[str, ...]]:
    """Return the address of a scene, or of the first step of a series and a note on the others."""
    try:
        open_cube(address)
    except SeriesError as error:
        last = f"{address}:{error.steps - 1}"
        return f"{address}:0", (f"{address} has {error.steps} steps of time; each is a scene, {address}:0 to {last}",)
    return address, ()


def _shared_labels(found: MatchedFiles, shape: tuple[int, ...]) -> MatchedFiles:
    """Return all images with the only label file, if its name is a word for labels and it has their size."""
    if found.labels or len(found.alone) != 1 or found.alone[0].stem.lower() not in LABEL_WORDS:
        return found
    with suppress(PipelineError):
        if open_labels(found.alone[0]).shape[:2] == shape:
            return MatchedFiles(found.images, dict.fromkeys(found.images, found.alone[0]), ())
    return found


def _pattern(found: MatchedFiles, folder: Path) -> str | None:
    """Return the ``labels`` of a scene.toml that gives each image its own file; None if no pattern does."""
    for image, label in list(found.labels.items())[:1]:
        place = os.path.relpath(label.parent, folder)
        number = scene_number(image)
        tried = [label.name.replace(image.stem, "{name}", 1)] if image.stem in label.name else []
        tried += [label.name.replace(number, "{number}", 1)] if number and number in label.name else []
        tried += [label.name] if len(found.images) == 1 or len(set(found.labels.values())) == 1 else []
        for name in tried:
            pattern = Path(place, name).as_posix()
            places = {one: (folder / filled(pattern, one)).resolve() for one in found.images}
            fits = all(places[one] == own.resolve() for one, own in found.labels.items())
            if fits and pattern.isprintable() and not any(places[one].exists() for one in found.bare):
                return pattern
    return None


def _classes(found: MatchedFiles, bands: int, unseen: list[str], report: Report) -> tuple[FoundClass, ...]:
    """Return all classes of the label files; ``unseen`` gets notes on files that cannot be used."""
    counts, used, settings = Counter[str](), list[Path](), SceneSettings()
    for number, (image, label) in enumerate(found.labels.items()):
        report(number / len(found.labels), label.name)
        try:
            source = open_cube(_named_step(image)[0])
            labels = read_labels(label, source.shape[:2], source.geobox, settings)
        except MixedLabelsError:
            raise
        except PipelineError as error:
            unseen.append(str(error))
            continue
        if source.shape[2] != bands:
            unseen.append(
                f"{image} has {source.shape[2]} bands, the first image {bands}: train on images of one camera"
            )
        used.append(label)
        pixels = np.bincount(labels.index[labels.index != UNLABELLED], minlength=len(labels.names))
        counts.update(dict(zip(labels.names, pixels.tolist(), strict=True)))
    report(1.0, "")
    values = classes_of_files(used, settings) if used else {}
    # a grey file has class_7 where others have colour_070707
    own = {name: counts[name] + _count_of_grey(counts, value) for name, value in values.items()}
    return tuple(FoundClass(name, value, own[name] / counts.total()) for name, value in values.items())


def _count_of_grey(counts: Counter[str], value: ClassValue) -> int:
    return counts[f"class_{value[0]}"] if isinstance(value, tuple) and len(set(value)) == 1 else 0


def _check_edge(source: CubeSource) -> tuple[tuple[float, float] | None, float]:
    """Return the value that fills the edge of a cube with its fraction, and the fraction of NaN in some rows."""
    height = source.shape[0]
    starts = sorted({round(at) for at in np.linspace(0, height - 1, min(_ROWS_OF_EDGE, height))})
    rows: Sequence[NDArray[np.generic]] = [source.read(start, start + 1) for start in starts]
    edge = np.concatenate([rows[0][0], rows[-1][0], *(row[0][[0, -1]] for row in rows)])
    missing = float(np.mean([np.isnan(row).mean() for row in rows])) if source.dtype.kind == "f" else 0.0
    return edge_fill(edge), missing
