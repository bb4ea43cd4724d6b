"""Run the verb `init`: inspect images and labels, and draft a scene.toml."""

from __future__ import annotations

import os
import re
import shlex
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from spectralzoom.flows.settings.documents import as_toml
from spectralzoom.flows.settings.flags import AsJson, Switch
from spectralzoom.flows.terminal.figures import counted
from spectralzoom.flows.terminal.processes import DONE, writing
from spectralzoom.flows.terminal.progress import put_out, show_text, stderr
from spectralzoom.pipeline.errors import PipelineError, SceneError, SettingsError, list_some
from spectralzoom.pipeline.geometry.grid import UNLABELLED
from spectralzoom.storage.readers import label_files
from spectralzoom.storage.readers.cube_sources import CubeSource
from spectralzoom.storage.readers.open_cubes import open_cube_source, split_variable, with_wavelengths
from spectralzoom.storage.readers.scene_toml import SETTINGS_NAME, ClassValue, SceneSettings, load_scene_settings
from spectralzoom.storage.whole_files import write_whole

KEPT = ("class_attribute", "unlabelled")  # of an existing file


@dataclass(frozen=True)
class FoundClass:
    """A value of the label files: a name for scene.toml, and its fraction of the labelled pixels."""

    name: str
    value: ClassValue
    fraction: float


@dataclass(frozen=True)
class SceneDraft:
    """Facts about the scenes that one scene.toml describes."""

    files: label_files.MatchedFiles
    cube: CubeSource  # the first scene
    classes: tuple[FoundClass, ...]
    unseen: tuple[str, ...]  # on files that cannot be read or do not fit


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
    path = (place if place.is_dir() and not label_files.is_store(place) else place.parent) / SETTINGS_NAME
    if path.exists() and not force:
        raise SettingsError(f"{path} exists; edit it, or replace it with --force")
    stated: dict[str, Any] = {}
    with suppress(PipelineError, FileNotFoundError):  # a file that cannot be read is replaced
        before = load_scene_settings(path)
        stated = {name: value for name in KEPT if (value := getattr(before, name)) is not None}
    with writing(path.parent, "folder"), _set_aside(path):
        with console.status("reading images and labels"):
            draft = draft_scene(source, SceneSettings(**stated))
        write_whole(path, _toml(draft, path.parent, stated))
    files, cube = draft.files, draft.cube
    nm = cube.bands.wavelength_nm
    first, scene = None, str(files.images[0]) if place.is_dir() else source
    following = ["survey", "--scene", scene, "--weights", "WEIGHTS.safetensors"]
    if files.labels and not draft.classes:
        first = f"repair these label files, or write what is missing into {path}"
        following = ["init", source, "--force"]
    elif nm is None:
        first = f"write the {cube.shape[2]} wavelengths into {path}, as its lines say"
    if len(draft.classes) > 1:
        following = ["train", source, "-o", f"{place.resolve().stem or 'mine'}.safetensors"]
    return {
        "file": str(path),
        "images": len(files.images),
        "labelled": len(files.labels),
        "shape": list(cube.shape),
        "wavelengths_nm": None if nm is None else nm.tolist(),
        "classes": [asdict(one) for one in draft.classes],
        "notes": list(cube.notes),
        "unseen": [*_missing(draft), *draft.unseen],
        "first": first,
        "next": shlex.join(["spectralzoom", *following]),
    }


@contextmanager
def _set_aside(path: Path) -> Iterator[None]:
    """Rename an existing file within the context; restore it where no new one is written."""
    there = path.exists()
    kept = path.with_name(path.name + ".old")
    if there:
        path.replace(kept)
    try:
        yield
    except BaseException:
        if there:
            kept.replace(path)
        raise


def _toml(draft: SceneDraft, folder: Path, stated: dict[str, Any]) -> str:
    """Return the text of the scene.toml of a folder; lines behind a # are for the user to fill in."""
    files = draft.files
    lines = [
        f"# Properties of {counted(len(files.images), 'image')} by `spectralzoom init`.",
        "# Any line may be changed or removed; text after a # is a comment.\n",
        *(f"{name} = {as_toml(value)}" for name, value in stated.items()),
    ]
    for image, label in list(files.labels.items())[:1]:
        pair = f"{as_toml(image.name)} has {as_toml(label.name)}"
        lines.append(f"# labels of {len(files.labels)} of {len(files.images)} images were found: {pair}")
        if len(files.images) == 1:  # they may have any names
            lines.append(f"labels = {as_toml(Path(os.path.relpath(label, folder)).as_posix())}")
    if not files.labels:
        lines.append('# labels = "labels/{name}.png"   # no label files were found: {name} is an image\'s name')
    return "\n".join([*lines, "", *_value_lines(draft.cube), *_class_lines(draft.classes), ""])


def _value_lines(cube: CubeSource) -> Iterator[str]:
    """Yield lines on wavelengths, no-data value, scale and size of a pixel."""
    bands, nm = cube.shape[2], cube.bands.wavelength_nm
    if nm is None:
        yield f"# {bands} bands without wavelengths. Fill in one of these two lines, and remove the # in front of it:"
        yield f"# wavelengths_nm = []   # {bands} numbers [nm] between the brackets, with commas"
        yield f'# wavelengths_file = "bands.txt"   # a text file beside this one of {bands} rows, which begin with nm'
    elif "assumed" in cube.bands.origin:
        yield f"# wavelengths_nm = {nm.tolist()}   # assumed from the colours; remove the first # to change them"
    else:
        yield f"# {bands} bands, {nm.min():g}-{nm.max():g} nm: {as_toml(cube.bands.origin)}"
    if cube.nodata is None:
        yield "# nodata = 0   # if that value means no data: remove the first #"
    if cube.dtype.itemsize == 2:
        yield "# scale = 0.0001   # if these numbers are reflectance times 10000"
    if cube.geobox is None:
        yield "# pixel_m = 0.05   # side of a pixel on the ground [m], where it is known: gives hectares"


def _class_lines(classes: Sequence[FoundClass]) -> Iterator[str]:
    """Yield the table of classes, and the value that may mean no class."""
    for one in [one for one in classes if one.value in (0, 255, (0, 0, 0), (255, 255, 255))][:1]:
        yield f"\n# unlabelled = {as_toml(one.value)}   # if it means no class: remove the #, and its line below"
    if classes:
        yield "\n[classes]   # name = value in the label files, with its fraction of the labelled pixels"
    for one in classes:
        name = one.name if re.fullmatch(r"[A-Za-z0-9_-]+", one.name) else as_toml(one.name)
        yield f"{name} = {as_toml(one.value)}   # {one.fraction:.1%}"


def _missing(draft: SceneDraft) -> Iterator[str]:
    """Yield the missing or inconsistent properties."""
    found = draft.files
    if found.labels and found.bare:
        yield f"labels of {counted(len(found.bare), 'image')}, left out: {label_files.listed_names(found.bare)}"
    if not found.labels:
        yield "label files: beside an image NAME.png they are called NAME_mask.png, or labels/NAME.png"
    if found.alone:
        yield f"the image of {counted(len(found.alone), 'label file')}: {label_files.listed_names(found.alone)}"
    if draft.cube.bands.wavelength_nm is None:
        yield f"the wavelengths of {draft.cube.shape[2]} bands"
    if len(draft.classes) == 1:
        yield f"a second class: all labels are {draft.classes[0].name}"


def _show(record: dict[str, Any], console: Console) -> None:
    """Print the findings, what is missing, the file, and the next command."""
    height, width, bands = record["shape"]
    images = f"{counted(record['images'], 'image')}, {record['labelled']} with labels"
    show_text(f"{images}; the first has {height} x {width} px, {bands} bands", console)
    if record["classes"]:
        show_text(f"classes: {list_some([one['name'] for one in record['classes']], 8)}", console)
    for word, lines in (("note", record["notes"]), ("missing", record["unseen"]), ("written", [record["file"]])):
        for line in lines:
            show_text(f"{word}: {line}", console)
    if record["first"]:
        show_text(f"first: {record['first']}", console)
    show_text(f"{'then' if record['first'] else 'next'}: {record['next']}", console)


def draft_scene(address: str | Path, known: SceneSettings = SceneSettings()) -> SceneDraft:  # noqa: B008 - frozen
    """Inspect the images and labels of a folder, or one file and its labels, by what is ``known`` of the labels.

    The first image is read, of others only the size; all label files are read. Raises SceneError: there is no image, or
    the first one cannot be read; labels may belong to several images, or have mixed values.
    """
    path, _ = split_variable(address)
    if not path.exists():
        raise SceneError(f"there is no file or folder {path}; check the name (seen from {Path.cwd()})")
    first: str | Path = address
    if not path.is_dir() or label_files.is_store(path):
        label = None if label_files.is_label_name(path) else label_files.find_label(path)
        found = label_files.MatchedFiles((path,), {} if label is None else {path: label}, ())
    else:
        found = label_files.match_folder(label_files.image_folder(path))
        if not found.images:
            way = f"give a folder of images, or with images/ in it{label_files.folders_within(path)}"
            raise SceneError(f"{path} holds no image that is read; {way}")
        first = found.images[0]
    source = with_wavelengths(open_cube_source(first), first, None)
    classes, unseen = _classes(found, source.shape[2], known)
    return SceneDraft(found, source, classes, unseen)


def _classes(
    found: label_files.MatchedFiles, bands: int, settings: SceneSettings
) -> tuple[tuple[FoundClass, ...], tuple[str, ...]]:
    """Return all classes of the label files, and notes on files that cannot be used."""
    counts: Counter[str] = Counter()
    used: list[Path] = []
    unseen: list[str] = []
    for image, label in found.labels.items():
        try:
            source = open_cube_source(image)
            labels = label_files.read_labels(label, source.shape[:2], source.geobox, settings)
        except PipelineError as error:
            unseen.append(str(error))
            continue
        if source.shape[2] != bands:
            unseen.append(f"{image} has {source.shape[2]} bands, the first image {bands}: use one camera")
        used.append(label)
        pixels = np.bincount(labels.index[labels.index != UNLABELLED], minlength=len(labels.names))
        counts.update(dict(zip(labels.names, pixels.tolist(), strict=True)))
    values = label_files.classes_of_files(used, settings) if used else {}
    return tuple(FoundClass(name, value, counts[name] / counts.total()) for name, value in values.items()), tuple(
        unseen
    )
