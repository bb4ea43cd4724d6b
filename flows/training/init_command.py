"""Run the verb `init`: inspect images and labels, and draft a scene.toml."""

from __future__ import annotations

import os
import re
import shutil
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np
from rich.console import Console

from spectralzoom.flows.settings.flags import AsJson, Switch
from spectralzoom.flows.terminal.figures import counted
from spectralzoom.flows.terminal.processes import DONE, writing
from spectralzoom.flows.terminal.progress import put_out, show_text, stderr
from spectralzoom.pipeline.errors import PipelineError, SettingsError, list_some
from spectralzoom.pipeline.geometry.grid import UNLABELLED
from spectralzoom.pipeline.toml_files import as_toml
from spectralzoom.storage.addresses import split_variable
from spectralzoom.storage.readers import label_files
from spectralzoom.storage.readers.band_facts import bands_text
from spectralzoom.storage.readers.cube_sources import CubeSource
from spectralzoom.storage.readers.open_cubes import open_cube_source
from spectralzoom.storage.readers.scene_files import empty_bands
from spectralzoom.storage.readers.scene_toml import SETTINGS_NAME, ClassValue, SceneSettings, load_scene_settings
from spectralzoom.storage.whole_files import write_whole

LOWEST, HIGHEST = (0, (0, 0, 0)), (255, 65535, (255, 255, 255))  # labels that may mean no class
SPARSE = 0.8  # of the borders between labels, for one that fills the gaps between all others


@dataclass(frozen=True)
class FoundClass:
    """A value of the label files with a name for scene.toml."""

    name: str
    value: ClassValue
    fraction: float  # of the labelled pixels
    borders: float  # fraction of those between labels that it takes part in


@dataclass(frozen=True)
class SceneDraft:
    """Facts about the scenes that one scene.toml describes."""

    files: label_files.MatchedFiles
    cube: CubeSource  # the first scene
    classes: tuple[FoundClass, ...]
    void: FoundClass | None  # a label that is assumed to mean no class
    unseen: tuple[str, ...]  # on files that cannot be read or do not fit


def init(source: str, *, force: Switch = False, as_json: AsJson = False) -> int:
    """Inspect the images and labels of SOURCE, and write a scene.toml beside them to edit.

    The output lists what is missing, the next command, and last what is assumed of a label such as 0.

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

    Raises SettingsError: one exists, and ``force`` is not given; ArchiveError: no write access; else as `draft_scene`.
    """
    place, _ = split_variable(source)
    path = (place if place.is_dir() and not label_files.is_store(place) else place.parent) / SETTINGS_NAME
    if path.exists() and not force:
        raise SettingsError(f"{path} exists; edit it, or replace it with --force")
    before = SceneSettings()
    with suppress(PipelineError, FileNotFoundError):  # a file that cannot be read is replaced
        before = load_scene_settings(path)
    with console.status("reading images and labels"):
        draft = draft_scene(source, before)
    kept = {"class_attribute": before.class_attribute, "unlabelled": before.unlabelled}
    kept |= {} if draft.void is None else {"unlabelled": draft.void.value}
    with writing(path.parent, "folder"):
        if path.exists():
            shutil.copyfile(path, path.with_name(path.name + ".old"))
        write_whole(path, _toml(draft, path.parent, kept))
    files, cube, nm = draft.files, draft.cube, draft.cube.bands.wavelength_nm
    first = None if nm is not None else f"write the {counted(cube.shape[2], 'wavelength')} into {path}, as it says"
    scene = str(files.images[0]) if place.is_dir() else source
    following = f"survey --scene {quote(scene)} --weights WEIGHTS.safetensors"
    if files.labels and not draft.classes:
        first = f"repair these label files, or write what is missing into {path}"
        following = f"init {quote(source)} --force"
    if len(draft.classes) > 1:
        following = f"train {quote(source)} -o {quote(place.resolve().stem or 'mine')}.safetensors"
    return {
        "file": str(path),
        "images": len(files.images),
        "labelled": len(files.labels),
        "shape": list(cube.shape),
        "wavelengths_nm": None if nm is None else [None if np.isnan(one) else one for one in nm.tolist()],
        "classes": [asdict(one) for one in draft.classes],
        "notes": list(cube.notes),
        "unseen": [*_missing(draft), *draft.unseen],
        "first": first,
        "next": f"spectralzoom {following}",
        "assumed": list(_assumed(draft, before)),
    }


def _toml(draft: SceneDraft, folder: Path, kept: dict[str, Any]) -> str:
    """Return the text of the scene.toml of a folder; lines behind a # are for the user to fill in."""
    files = draft.files
    lines = [
        f"# Properties of {counted(len(files.images), 'image')} by `spectralzoom init`.",
        "# Any line may be changed or removed; text after a # is a comment.\n",
        *(f"{name} = {as_toml(value)}" for name, value in kept.items() if value is not None),
        '# labels = "labels/{name}.png"   # no label files were found: {name} is an image\'s name',
    ]
    for image, label in list(files.labels.items())[:1]:
        pair = f"{as_toml(image.name)} has {as_toml(label.name)}"
        lines[-1] = f"# labels of {len(files.labels)} of {len(files.images)} images were found: {pair}"
        if len(files.images) == 1:  # they may have any names
            lines.append(f"labels = {as_toml(Path(os.path.relpath(label, folder)).as_posix())}")
    return "\n".join([*lines, "", *_value_lines(draft.cube), *_class_lines(draft), ""])


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
        yield f"# {counted(bands, 'band')}, {np.nanmin(nm):g}-{np.nanmax(nm):g} nm: {as_toml(cube.bands.origin)}"
    empty = set(empty_bands(cube, SceneSettings()))
    if empty - (left_out := {*cube.bad_bands, *cube.bands.unknown}) and len(empty) < bands:
        used = bands_text(sorted({*range(bands)} - left_out - empty))
        yield f'bands = "{used}"   # the others have no value, or the file marks them as bad'
    if cube.nodata is None:
        yield "# nodata = 0   # if that value means no data: remove the first #"
    if cube.dtype.itemsize == 2:
        yield "# scale = 0.0001   # if these numbers are reflectance times 10000"
    if cube.geobox is None:
        yield "# pixel_m = 0.05   # side of a pixel on the ground [m], where it is known: gives hectares"


def _class_lines(draft: SceneDraft) -> Iterator[str]:
    """Yield the table of classes; the label that is assumed to mean none is a comment."""
    if draft.classes:
        yield "\n[classes]   # name = value in the label files, with its fraction of the labelled pixels"
    for one in (*draft.classes, *filter(None, [draft.void])):
        name = one.name if re.fullmatch(r"[A-Za-z0-9_-]+", one.name) else as_toml(one.name)
        yield f"{'# ' * (one is draft.void)}{name} = {as_toml(one.value)}   # {one.fraction:.1%}"


def _assumed(draft: SceneDraft, before: SceneSettings) -> Iterator[str]:
    """Yield a line for each label that may mean no class: what is assumed, and how to change it."""
    if before.unlabelled is not None:
        yield f"label {as_toml(before.unlabelled)} means no class, as the earlier {SETTINGS_NAME} said"
    for one in filter(None, [*draft.classes, draft.void]):
        label = f"label {as_toml(one.value)} ({one.fraction:.1%} of the pixels)"
        if one is draft.void:
            yield f"{label} means no class; if it is one, remove unlabelled, and the # in front of {one.name}"
        elif one.value in LOWEST + HIGHEST:
            yield f"{label} is a class; if it means none, write unlabelled = {as_toml(one.value)} and remove {one.name}"


def _missing(draft: SceneDraft) -> Iterator[str]:
    """Yield the missing or inconsistent properties."""
    yield from draft.files.lacking
    if draft.cube.bands.wavelength_nm is None:
        yield f"the wavelengths of {counted(draft.cube.shape[2], 'band')}"
    if len(draft.classes) == 1:
        yield f"a second class: all labels are {draft.classes[0].name}"


def _show(record: dict[str, Any], console: Console) -> None:
    """Print the findings, what is missing, the file, the next command, and the assumptions."""
    height, width, bands = record["shape"]
    counts = f"{counted(record['images'], 'image')}, {record['labelled']} with labels"
    lines = [f"{counts}; the first has {height} x {width} px, {counted(bands, 'band')}"]
    lines += [f"classes: {list_some([one['name'] for one in found], 8)}"] if (found := record["classes"]) else []
    lines += [f"{word}: {line}" for word, name in (("note", "notes"), ("missing", "unseen")) for line in record[name]]
    lines += [f"written: {record['file']}", *([f"first: {first}"] if (first := record["first"]) else [])]
    lines.append(f"{'then' if first else 'next'}: {record['next']}")
    lines += [f"assumed in {record['file']}: {line}" for line in record["assumed"]]
    show_text("\n".join(lines), console)


def draft_scene(address: str | Path, before: SceneSettings = SceneSettings()) -> SceneDraft:  # noqa: B008 - frozen
    """Inspect the images and labels of a folder, or one file and its labels, by an earlier scene.toml of them.

    All label files are read. Raises SceneError: the first image cannot be read; labels cannot be matched, or are mixed.
    """
    path, _ = split_variable(address)
    found = label_files.find_files(path)
    source = open_cube_source(address if found.images == (path,) else found.images[0])
    known = SceneSettings(class_attribute=before.class_attribute, unlabelled=before.unlabelled)
    classes, unseen = _classes(found, source.shape[2], known)
    void = None if before.unlabelled is not None else _void(classes, before)
    return SceneDraft(found, source, tuple(one for one in classes if one is not void), void, tuple(unseen))


def _void(classes: Sequence[FoundClass], before: SceneSettings) -> FoundClass | None:
    """Return the label that looks like no class: the highest of a type, or 0 or black between three others or more.

    The classes of a map without gaps touch each other. A name in an earlier scene.toml says that it is a class.
    """
    others = [one for one in classes if one.value not in before.classes.values()]
    found = [one for one in others if one.value in HIGHEST[:2] and len(classes) > 2]
    found += [one for one in others if one.value in LOWEST and one.borders >= SPARSE and len(classes) > 3 + len(found)]
    return max(found, key=lambda one: one.fraction, default=None)


def _classes(found: label_files.MatchedFiles, bands: int, known: SceneSettings) -> tuple[list[FoundClass], list[str]]:
    """Return all classes of the label files, and notes on files that cannot be used."""
    pixels, borders = Counter[str](), Counter[str]()
    used: list[Path] = []
    unseen: list[str] = []
    for image, label in found.labels.items():
        try:
            source = open_cube_source(image)
            labels = label_files.read_labels(label, source.shape[:2], source.geobox, known)
        except PipelineError as error:
            unseen.append(str(error))
            continue
        if source.shape[2] != bands:
            unseen.append(f"{image} has {source.shape[2]} bands, the first image {bands}: use one camera")
        used.append(label)
        left, right = labels.index[:, :-1], labels.index[:, 1:]
        between = (left != right) & (left != UNLABELLED) & (right != UNLABELLED)
        for counts, found_px in ((pixels, labels.index.ravel()), (borders, np.append(left[between], right[between]))):
            counts.update(dict(zip(labels.names, np.bincount(found_px, minlength=256).tolist(), strict=False)))
    values = label_files.classes_of_files(used, known) if used else {}
    px, edges = pixels.total() or 1, borders.total() / 2 or 1
    return [FoundClass(name, one, pixels[name] / px, borders[name] / edges) for name, one in values.items()], unseen
