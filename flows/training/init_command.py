"""Run the verb `init`: inspect images and labels, and draft a scene.toml."""

from __future__ import annotations

import os
import re
import shlex
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from flows.settings.documents import as_toml
from flows.settings.flags import AsJson, Switch
from flows.terminal.figures import counted
from flows.terminal.processes import DONE, writing
from flows.terminal.progress import StageProgress, put_out, show_text, stderr
from pipeline.errors import PipelineError, SceneError, SeriesError, SettingsError, list_some
from pipeline.geometry.grid import UNLABELLED
from storage.archive.whole_files import write_whole
from storage.readers.cube_sources import CubeSource
from storage.readers.label_files import (
    LABEL_WORDS,
    MatchedFiles,
    classes_of_files,
    find_label,
    folders_within,
    image_folder,
    is_label_name,
    is_store,
    listed_names,
    match_folder,
    read_labels,
)
from storage.readers.labels import MixedLabelsError
from storage.readers.open_cubes import open_cube, open_labels, split_variable, with_wavelengths
from storage.readers.polygons import is_polygon_file
from storage.readers.scene_toml import SETTINGS_NAME, ClassValue, SceneSettings, load_scene_settings

TITLES = {"extent": "reading labels"}
NOTHING_KNOWN = SceneSettings()
Report = Callable[[float, str], None]  # progress, 0..1, and the name of the file


def init(source: str, *, force: Switch = False, as_json: AsJson = False) -> int:
    """Inspect the images and labels of SOURCE, and write a scene.toml beside them to edit.

    The output lists what is missing, and the next command.

    Parameters
    ----------
    source
        A folder of images with their labels, or one image or cube.
    force
        Replace an existing file, which is kept as scene.toml.old; its class_attribute and unlabelled stay.
    """
    put_out(run_init(source, stderr, force=force), _show, as_json=as_json)
    return DONE


def run_init(source: str, console: Console, *, force: bool = False) -> dict[str, Any]:
    """Write a scene.toml for a folder or file, with progress on ``console``; return the findings for --json.

    Raises SettingsError: a scene.toml exists and ``force`` is not given; ArchiveError: the folder cannot be written to;
    else as `draft_scene`.
    """
    place, _ = split_variable(source)
    path = (place if place.is_dir() and not is_store(place) else place.parent) / SETTINGS_NAME
    known = NOTHING_KNOWN
    with suppress(PipelineError):  # a file that cannot be read is replaced
        before = load_scene_settings(path) if force and path.exists() else NOTHING_KNOWN
        known = SceneSettings(class_attribute=before.class_attribute, unlabelled=before.unlabelled)
    with writing(path.parent, "folder"), _set_aside(path, force=force):
        with StageProgress(console, TITLES) as progress:
            draft = draft_scene(source, known, lambda done, name: progress.show("extent", done, name, ended=done == 1))
        parts = [
            [
                f"# Properties of {counted(len(draft.files.images), 'image')} by `spectralzoom init`.",
                "# Any line may be changed or removed; text after a # is a comment.",
            ],
            _label_lines(draft, known),
            _wavelength_lines(draft),
            _value_lines(draft),
            _class_lines(draft),
        ]
        write_whole(path, ("\n\n".join("\n".join(lines) for lines in parts if lines) + "\n"))
    found = draft.files
    bands = draft.cube.bands
    first = None
    following = _next(source, draft)
    if found.labels and not draft.classes:
        first = f"repair these label files, or write what is missing into {path}"
        following = shlex.join(["spectralzoom", "init", source, "--force"])
    elif bands.wavelength_nm is None:
        count = draft.cube.shape[2]
        first = f"write the {count} wavelengths into {path}: wavelengths_nm or wavelengths_file, as its lines say"
    return {
        "file": str(path),
        "images": len(found.images),
        "labelled": len(found.labels),
        "labels": draft.only_label,
        "shape": list(draft.cube.shape),
        "wavelengths_nm": None if bands.wavelength_nm is None else bands.wavelength_nm.tolist(),
        "wavelength_origin": bands.origin,
        "classes": [{"name": one.name, "value": one.value, "fraction": one.fraction} for one in draft.classes],
        "notes": list(draft.notes),
        "unseen": _unseen(draft),
        "first": first,
        "next": following,
    }


@contextmanager
def _set_aside(path: Path, *, force: bool) -> Iterator[None]:
    """Rename an existing file within the context; restore it where no new one is written.

    Raises SettingsError: it exists and ``force`` is not given.
    """
    there = path.exists()
    if there and not force:
        raise SettingsError(f"{path} exists; edit it, or replace it with --force")
    kept = path.with_name(path.name + ".old")
    if there:
        path.replace(kept)
    try:
        yield
    except BaseException:
        if there:
            kept.replace(path)
        raise


def _label_lines(draft: SceneDraft, known: SceneSettings) -> list[str]:
    labels = draft.files.labels
    if not labels:
        return ['# labels = "labels/{name}.png"   # no label files were found: {name} is an image\'s name']
    kept = [] if known.class_attribute is None else [f"class_attribute = {as_toml(known.class_attribute)}"]
    if known.unlabelled is not None:
        kept.append(f"unlabelled = {as_toml(known.unlabelled)}")
    if draft.only_label is None:
        pair = next(iter(labels.items()))
        return [
            *kept,
            f"# labels of {len(labels)} of {len(draft.files.images)} images were found by their names: "
            f"{_printable(pair[0].name)} has {_printable(pair[1].name)}",
        ]
    return [*kept, f"labels = {as_toml(draft.only_label)}   # of all images"]


def _wavelength_lines(draft: SceneDraft) -> list[str]:
    bands = draft.cube.shape[2]
    if draft.cube.bands.wavelength_nm is None:
        return [
            f"# {bands} bands without wavelengths. Fill in one of these two lines, and remove the # in front of it:",
            f"# wavelengths_nm = []   # {bands} numbers [nm] between the brackets, with commas",
            f'# wavelengths_file = "bands.txt"   # a text file beside this one of {bands} rows, which begin with nm',
        ]
    if "assumed" not in draft.cube.bands.origin:
        low, high = draft.cube.bands.wavelength_nm.min(), draft.cube.bands.wavelength_nm.max()
        return [f"# {bands} bands, {low:g}-{high:g} nm: {_printable(draft.cube.bands.origin)}"]
    listed = ", ".join(repr(float(nm)) for nm in draft.cube.bands.wavelength_nm)
    return [f"# wavelengths_nm = [{listed}]   # assumed from the colours; remove the first # to change them"]


def _value_lines(draft: SceneDraft) -> list[str]:
    void = draft.cube.nodata
    lines = [
        "# nodata = 0   # if that value means no data: remove the first #"
        if void is None
        else f"# the file states that {void:g} is nodata"
    ]
    if draft.cube.dtype.itemsize == 2:
        lines.append("# scale = 0.0001   # if these numbers are reflectance times 10000")
    if draft.cube.geobox is None:
        lines.append("# pixel_m = 0.05   # side of a pixel on the ground [m], where it is known: gives hectares")
    return lines


def _class_lines(draft: SceneDraft) -> list[str]:
    classes = draft.classes
    if not classes:
        return []
    guess = [one.value for one in classes if one.value in (0, 255, (0, 0, 0), (255, 255, 255))]
    lines = [
        f"# unlabelled = {as_toml(one)}   # if it means no class: remove the #, and its line below" for one in guess[:1]
    ]
    polygons = all(is_polygon_file(label) for label in draft.files.labels.values())
    parts = (
        "number; polygons have the name or the number"
        if polygons
        else "value in the label files; rename them as you like"
    )
    lines += ["", f"[classes]   # with its fraction of the labelled pixels: name = {parts}"]
    return lines + [f"{_key(one.name)} = {as_toml(one.value)}   # {one.fraction:.1%}" for one in classes]


def _key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else as_toml(name)


def _unseen(draft: SceneDraft) -> list[str]:
    """Return the missing or inconsistent properties."""
    found = draft.files
    parts = []
    if found.labels and found.bare:
        parts.append(
            f"labels of {counted(len(found.bare), 'image')}, left out of the training: {listed_names(found.bare)}"
        )
    if not found.labels:
        parts.append("label files: beside an image NAME.png they are called NAME_mask.png, or labels/NAME.png")
    if found.alone:
        parts.append(f"the image of {counted(len(found.alone), 'label file')}: {listed_names(found.alone)}")
    if draft.cube.bands.wavelength_nm is None:
        parts.append(f"the wavelengths of {draft.cube.shape[2]} bands")
    if len(draft.classes) == 1:
        parts.append(f"a second class: all labels are {draft.classes[0].name}")
    return [*parts, *draft.unseen]


def _next(source: str, draft: SceneDraft) -> str:
    place, _ = split_variable(source)
    name = re.sub(r"[^\w.-]+", "-", place.resolve().stem).strip("-") or "mine"
    if len(draft.classes) > 1:
        scenes = draft.first if draft.has_steps else source
        return shlex.join(["spectralzoom", "train", scenes, "-o", f"{name}.safetensors"])
    scene = draft.first if draft.has_steps or place.is_dir() else source
    return shlex.join(["spectralzoom", "survey", "--scene", scene, "--weights", "WEIGHTS.safetensors"])


def _show(record: dict[str, Any], console: Console) -> None:
    """Print the findings, what is missing, the file, and the next command."""
    height, width, bands = record["shape"]
    images = counted(record["images"], "image")
    names = list_some([one["name"] for one in record["classes"]], 8)
    first = record["first"]
    lines = [
        f"{images}, {record['labelled']} with labels; the first has {height} x {width} px, {bands} bands",
        *([f"classes: {names}"] if names else []),
        *(f"note: {note}" for note in record["notes"]),
        *(f"missing: {one}" for one in record["unseen"]),
        f"written: {record['file']}",
        *([f"first: {first}"] if first else []),
        f"{'then' if first else 'next'}: {record['next']}",
    ]
    for line in lines:
        show_text(line, console)


def _printable(text: str) -> str:
    """Return text for a comment, with a question mark for what cannot be printed."""
    return "".join(letter if letter.isprintable() else "?" for letter in text)


@dataclass(frozen=True)
class FoundClass:
    """A value of the label files: a name for scene.toml, and its fraction of the labelled pixels."""

    name: str
    value: ClassValue
    fraction: float


@dataclass(frozen=True)
class SceneDraft:
    """Facts about the scenes that one scene.toml describes."""

    files: MatchedFiles
    first: str  # address of the scene that was read
    cube: CubeSource  # that scene
    only_label: str | None  # file with the labels of all images, relative to the folder of scene.toml
    classes: tuple[FoundClass, ...]
    notes: tuple[str, ...]  # on the first image
    unseen: tuple[str, ...]  # on files that cannot be read or do not fit
    has_steps: bool  # the first is one step of a series


def draft_scene(
    address: str | Path, known: SceneSettings = NOTHING_KNOWN, report: Report = lambda done, name: None
) -> SceneDraft:
    """Inspect the images and labels of a folder, or one file and its labels, by what is ``known`` of the labels.

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
    found = _shared_labels(found, source.shape[:2])
    unseen: list[str] = []
    # one file may have the labels of all images; else names find them
    of_all = set(found.labels.values())
    label_path = os.path.relpath(of_all.pop(), folder) if len(of_all) == 1 and not found.bare else ""
    return SceneDraft(
        files=found,
        first=str(first),
        cube=source,
        only_label=Path(label_path).as_posix() if label_path and label_path.isprintable() else None,
        classes=_classes(found, source.shape[2], known, unseen, report),
        notes=(*series, *source.notes),
        unseen=tuple(unseen),
        has_steps=bool(series),
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


def _classes(
    found: MatchedFiles, bands: int, settings: SceneSettings, unseen: list[str], report: Report
) -> tuple[FoundClass, ...]:
    """Return all classes of the label files; ``unseen`` gets notes on files that cannot be used."""
    counts: Counter[str] = Counter()
    used: list[Path] = []
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
    return tuple(FoundClass(name, value, counts[name] / counts.total()) for name, value in values.items())
