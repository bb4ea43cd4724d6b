"""Drafts of scenes: what files of images and labels show, for a scene.toml that is still to be written."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
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
    filled,
    find_label,
    folders_within,
    image_folder,
    is_label_name,
    is_store,
    listed_names,
    match_folder,
    scene_number,
)
from storage.readers.labels import found_codes, load_codes
from storage.readers.open_cubes import open_cube, open_labels, split_variable, with_wavelengths
from storage.readers.polygons import is_polygon_file, load_polygon_labels, polygon_classes
from storage.readers.scene_toml import ClassValue, SceneSettings

Report = Callable[[float, str], None]  # how far it is, 0..1, and at which file
_ROWS_OF_EDGE = 32  # whose first and last pixels are looked at


@dataclass(frozen=True)
class FoundClass:
    """A value of the label files: what a scene.toml may call it, and its fraction of all their pixels."""

    name: str
    value: ClassValue
    fraction: float


@dataclass(frozen=True)
class SceneDraft:
    """Findings on the scenes that one scene.toml describes."""

    folder: Path  # of scene.toml
    files: MatchedFiles
    first: str  # address of the scene that was looked at
    shape: tuple[int, int, int]  # of the first image, (y, x, band)
    pattern: str | None  # of all label files by their images' names, relative to ``folder``
    wavelength_nm: NDArray[np.float64] | None  # (band,)
    wavelength_origin: str
    nodata: float | None  # as the file itself says
    dtype: np.dtype[Any]  # of its values, once the file's own scale was applied
    edge: tuple[float, float] | None  # value that fills the edge, and its fraction of it
    placed: bool  # whether the file says where its pixels lie on the earth
    missing: float  # fraction of NaN among the values looked at
    classes: tuple[FoundClass, ...] = ()
    notes: tuple[str, ...] = ()  # what readers made of the first image
    unseen: tuple[str, ...] = field(default=())  # what could not be read or does not fit, one sentence each
    has_steps: bool = False  # the first is one step of a series


def draft_scene(address: str | Path, report: Report = lambda done, name: None) -> SceneDraft:
    """Look at the images and labels of a folder, or at one file and its labels.

    The first image is read, of the others only the sizes; label files are all read. Raises SceneError: there is no file
    to read, or the first image cannot be read. So do labels that may belong to several images, or that have no classes
    because their values are mixed.
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
    # files that may hold outlines in words that no reader here knows
    outlines = [one for image in found.bare for one in map(image.with_suffix, (".json", ".xml")) if one.is_file()]
    if outlines:
        unseen.append(f"what is in {listed_names(outlines)}: outlines are read as GeoPackage, GeoJSON or shapefile")
    pictures = {image: label for image, label in found.labels.items() if not is_polygon_file(label)}
    if pictures or not found.labels:
        classes = _classes(replace(found, labels=pictures), source.shape, unseen, report)
    else:
        classes = _polygon_classes(found, unseen, report)
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
    """Return the address of a scene, of a series that of its first step; and a note of the others."""
    try:
        open_cube(address)
    except SeriesError as error:
        last = f"{address}:{error.steps - 1}"
        return f"{address}:0", (f"{address} has {error.steps} steps of time; each is a scene, {address}:0 to {last}",)
    return address, ()


def _shared_labels(found: MatchedFiles, shape: tuple[int, ...]) -> MatchedFiles:
    """Return all images the only label file, where it is called by a word for labels alone and has their size."""
    if found.labels or len(found.alone) != 1 or found.alone[0].stem.lower() not in LABEL_WORDS:
        return found
    with suppress(PipelineError):
        if open_labels(found.alone[0]).shape[:2] == shape:
            return MatchedFiles(found.images, dict.fromkeys(found.images, found.alone[0]), ())
    return found


def _pattern(found: MatchedFiles, folder: Path) -> str | None:
    """Return the ``labels`` of a scene.toml that matches each image to its own file; None where no pattern does."""
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


def _classes(
    found: MatchedFiles, shape: tuple[int, int, int], unseen: list[str], report: Report
) -> tuple[FoundClass, ...]:
    """Return all values of the label files, as classes; notes name files that cannot be read or have another size."""
    counts: Counter[int] = Counter()
    greys: Counter[int] = Counter()  # of files without colours, while others have some
    for number, (image, label) in enumerate(found.labels.items()):
        report(number / len(found.labels), label.name)
        try:
            source = open_cube(_named_step(image)[0])
            size, read = source.shape, load_codes(label, source.geobox, by_number=False)
            codes, is_colour = read.values, read.of_colours
        except PipelineError as error:
            unseen.append(str(error))
            continue
        if size[2] != shape[2]:
            unseen.append(f"{image} has {size[2]} bands, the first image {shape[2]}: train on images of one camera")
        if codes.shape != size[:2]:
            unseen.append(f"{label} is {codes.shape[0]} x {codes.shape[1]} px, its image {size[0]} x {size[1]} (y x x)")
        there, number_of = np.unique(codes, return_counts=True)
        found_codes(there, None, is_colour, str(label))  # refuses mixed values by the file's name
        into = counts if is_colour else greys
        into.update({int(value): int(count) for value, count in zip(there, number_of, strict=True) if value >= 0})
    if found.labels:
        report(1.0, "")
    of_colours = bool(counts)
    counts.update({code * (0x010101 if of_colours else 1): count for code, count in greys.items()})
    values = found_codes(np.array(sorted(counts), np.int64), None, of_colours, "of all images together")
    every = counts.total()
    return tuple(
        FoundClass(name, value, counts[code] / every)
        for code, (name, value) in zip(sorted(counts), values.items(), strict=True)
    )


def _polygon_classes(found: MatchedFiles, unseen: list[str], report: Report) -> tuple[FoundClass, ...]:
    """Return all classes of label files that are polygons, and their fractions of the labelled pixels."""
    settings, counts, readable = SceneSettings(), Counter[str](), list[Path]()
    for number, (image, label) in enumerate(found.labels.items()):
        report(number / len(found.labels), label.name)
        try:
            source = open_cube(image)
            labels, _ = load_polygon_labels(label, source.shape[:2], source.geobox, settings=settings)
        except PipelineError as error:
            unseen.append(str(error))
            continue
        readable.append(label)
        pixels = np.bincount(labels.index[labels.index != UNLABELLED], minlength=len(labels.names))
        counts.update(dict(zip(labels.names, pixels.tolist(), strict=True)))
    report(1.0, "")
    values = polygon_classes(readable, settings) if readable else {}
    return tuple(FoundClass(name, value, counts[name] / counts.total()) for name, value in values.items())


def _check_edge(source: CubeSource) -> tuple[tuple[float, float] | None, float]:
    """Return what fills the edge of a cube, and the fraction of NaN in the rows that were read for it."""
    height = source.shape[0]
    starts = sorted({round(at) for at in np.linspace(0, height - 1, min(_ROWS_OF_EDGE, height))})
    rows: Sequence[NDArray[np.generic]] = [source.read(start, start + 1) for start in starts]
    edge = np.concatenate([rows[0][0], rows[-1][0], *(row[0][[0, -1]] for row in rows)])
    missing = float(np.mean([np.isnan(row).mean() for row in rows])) if source.dtype.kind == "f" else 0.0
    return edge_fill(edge), missing
