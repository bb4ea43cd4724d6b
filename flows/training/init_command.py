"""Run the verb `init`: inspect images and labels, and draft a scene.toml; for recorded sweeps a survey.toml."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape

from flows.cli.app import AsJson, Switch, stderr
from flows.terminal.figures import counted
from flows.terminal.processes import DONE, writing
from flows.terminal.progress import StageProgress, put_out
from pipeline.errors import PipelineError, SettingsError
from pipeline.readings import MOST_VALUE
from storage.archive.whole_files import write_whole
from storage.readers.envi_files import find_reference
from storage.readers.label_files import image_folder, is_store, listed_names, match_folder
from storage.readers.open_cubes import open_cube, reader_of, split_variable
from storage.readers.pointing_tables import ENDINGS
from storage.readers.polygons import is_polygon_file
from storage.readers.recorded_cubes import find_cubes
from storage.readers.recordings import Recording, open_recording
from storage.readers.scene_drafts import FoundClass, SceneDraft, draft_scene
from storage.readers.scene_toml import SETTINGS_NAME

SURVEY_NAME = "survey.toml"
CAMERA_NUMBERS = ("uint8", "uint16", "int16")
TITLES = {"extent": "reading labels"}
NO_READING = -999.0  # at and below it an edge is nodata


def init(source: str, *, force: Switch = False, as_json: AsJson = False) -> int:
    """Inspect the images and labels of SOURCE, and write a scene.toml beside them to edit.

    For a folder of recorded sweeps it is a survey.toml. The output lists what is missing, and the next command.

    Parameters
    ----------
    source
        A folder of images with their labels, one image or cube, or a folder of sweeps: ENVI cubes with pointing tables
        or reference frames, or those of a Headwall camera.
    force
        Replace an existing file, which is kept as scene.toml.old or survey.toml.old.
    """
    if (draft := draft_sweeps(Path(source))) is not None:
        put_out(write_survey_draft(draft, force=force), show_survey_draft, as_json=as_json)
        return DONE
    put_out(run_init(source, stderr, force=force), _show, as_json=as_json)
    return DONE


def run_init(source: str, console: Console, *, force: bool = False) -> dict[str, Any]:
    """Write a scene.toml for a folder or file, with progress on ``console``; return the findings for --json.

    Raises SettingsError: a scene.toml exists and ``force`` is not given; ArchiveError: the folder cannot be written to;
    else as `draft_scene`.
    """
    place, _ = split_variable(source)
    path = (place if place.is_dir() and not is_store(place) else place.parent) / SETTINGS_NAME
    with writing(path.parent, "folder"), set_aside(path, force=force):
        with StageProgress(console, TITLES) as progress:
            draft = draft_scene(source, lambda done, name: progress.show("extent", done, name, ended=done == 1))
        parts = [
            [
                f"# Properties of {counted(len(draft.files.images), 'image')} by `spectralzoom init`.",
                "# Any line may be changed or removed; text after a # is a comment.",
            ],
            _label_lines(draft),
            _wavelength_lines(draft),
            _value_lines(draft),
            _class_lines(draft),
        ]
        write_whole(path, ("\n\n".join("\n".join(lines) for lines in parts if lines) + "\n"))
    found = draft.files
    return {
        "file": str(path),
        "images": len(found.images),
        "labelled": len(found.labels),
        "labels": draft.pattern,
        "shape": list(draft.shape),
        "wavelengths_nm": None if draft.wavelength_nm is None else np.asarray(draft.wavelength_nm).tolist(),
        "wavelength_origin": draft.wavelength_origin,
        "classes": [{"name": one.name, "value": one.value, "fraction": one.fraction} for one in draft.classes],
        "notes": list(draft.notes),
        "unseen": _unseen(draft),
        "first": _first(path, draft),
        "next": _next(source, draft),
    }


def _label_lines(draft: SceneDraft) -> list[str]:
    images, labels = draft.files.images, draft.files.labels
    if not labels:
        return ['# labels = "labels/{name}.png"   # no label files were found: {name} is an image\'s name']
    if draft.pattern is None:
        pair = next(iter(labels.items()))
        return [
            f"# labels of {len(labels)} of {len(images)} images were found by their names: {printable(pair[0].name)}"
            f" has {printable(pair[1].name)}"
        ]
    return [f"labels = {_quoted(draft.pattern)}   # of {len(labels)} of {len(images)} images"]


def _wavelength_lines(draft: SceneDraft) -> list[str]:
    bands = draft.shape[2]
    if draft.wavelength_nm is None:
        return [
            f"# {bands} bands without wavelengths. Fill in one of these two lines, and remove the # in front of it:",
            f"# wavelengths_nm = []   # {bands} numbers [nm] between the brackets, with commas",
            f'# wavelengths_file = "bands.txt"   # a text file beside this one of {bands} rows, which begin with nm',
        ]
    if "assumed" not in draft.wavelength_origin:
        low, high = draft.wavelength_nm.min(), draft.wavelength_nm.max()
        return [f"# {bands} bands, {low:g}-{high:g} nm: {printable(draft.wavelength_origin)}"]
    listed = ", ".join(repr(float(nm)) for nm in draft.wavelength_nm)
    return [f"# wavelengths_nm = [{listed}]   # assumed from the colours; remove the first # to change them"]


def _value_lines(draft: SceneDraft) -> list[str]:
    lines = []
    if draft.missing:
        lines.append(f"# NaN counts as missing: {draft.missing:.1%} of the inspected values")
    if draft.nodata is not None:
        lines.append(f"# the file states that {draft.nodata:g} is nodata")
    elif draft.edge is not None:
        value, fraction = draft.edge
        sure = value <= NO_READING or value > MOST_VALUE
        parts = f"nodata = {value!r}   # {fraction:.0%} of the first image's edge"
        lines.append(parts if sure else f"# {parts}; if it means nodata, remove the first #")
    if draft.dtype.itemsize == 2:
        lines.append("# scale = 0.0001   # if these numbers are reflectance times 10000")
    if not draft.placed:
        lines.append("# pixel_m = 0.05   # side of a pixel on the ground [m], where it is known: gives hectares")
    return lines


def _class_lines(draft: SceneDraft) -> list[str]:
    classes = draft.classes
    if not classes:
        return []
    guess = [one for one in classes if one.value in (0, 255, (0, 0, 0), (255, 255, 255))]
    lines = [
        f"# unlabelled = {_value(one)}   # if it means no class: remove the #, and its line below" for one in guess[:1]
    ]
    parts = "name = value in the label files, fraction of all pixels; rename them as you like"
    if all(is_polygon_file(label) for label in draft.files.labels.values()):
        parts = "name = number, fraction of the labelled pixels; polygons have the name or the number"
    lines += ["", f"[classes]   # {parts}"]
    return lines + [f"{_key(one.name)} = {_value(one)}   # {one.fraction:.1%}" for one in classes]


def _value(one: FoundClass) -> str:
    return str(one.value) if isinstance(one.value, int) else str(list(one.value))


def _key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else _quoted(name)


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _unseen(draft: SceneDraft) -> list[str]:
    """Return the missing or inconsistent properties."""
    found, parts = draft.files, []
    if found.labels and found.bare:
        images = counted(len(found.bare), "image")
        parts.append(f"labels of {images}, left out of the training: {listed_names(found.bare)}")
    if not found.labels:
        parts.append("label files: beside an image NAME.png they are called NAME_mask.png, or labels/NAME.png")
    if found.alone:
        parts.append(f"the image of {counted(len(found.alone), 'label file')}: {listed_names(found.alone)}")
    if draft.wavelength_nm is None:
        parts.append(f"the wavelengths of {draft.shape[2]} bands")
    if len(draft.classes) == 1:
        parts.append(f"a second class: all labels are {draft.classes[0].name}")
    return [*parts, *draft.unseen]


def _first(path: Path, draft: SceneDraft) -> str | None:
    """Return what has to be written before the next command; None if nothing."""
    if draft.wavelength_nm is not None:
        return None
    return f"write the {draft.shape[2]} wavelengths into {path}: wavelengths_nm or wavelengths_file, as its lines say"


def _next(source: str, draft: SceneDraft) -> str:
    place, _ = split_variable(source)
    name = re.sub(r"[^\w.-]+", "-", place.resolve().stem).strip("-") or "mine"
    if len(draft.classes) > 1:
        scenes = draft.first if draft.has_steps else source
        return shlex.join(["spectralzoom", "train", scenes, "-o", f"{name}.safetensors"])
    scene = draft.first if draft.has_steps or place.is_dir() else source
    return shlex.join(["spectralzoom", "survey", "--scene", scene, "--weights", "WEIGHTS.safetensors"])


def _show(record: dict[str, Any], console: Console) -> None:
    height, width, bands = record["shape"]
    images = counted(record["images"], "image")
    names = ", ".join(one["name"] for one in record["classes"][:8])
    more = f" and {len(record['classes']) - 8} more" if len(record["classes"]) > 8 else ""
    found = [f"{images}, {record['labelled']} with labels; the first has {height} x {width} px, {bands} bands"]
    show_draft(record, [*found, *([f"classes: {names}{more}"] if names else [])], console)


# survey.toml of a folder of recorded sweeps


@contextmanager
def set_aside(path: Path, *, force: bool) -> Iterator[None]:
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


def write_survey_draft(draft: SweepsDraft, *, force: bool = False) -> dict[str, Any]:
    """Write survey.toml into the folder of the sweeps; return the findings for --json.

    Raises SettingsError: it exists and ``force`` is not given; ArchiveError: the folder cannot be written to.
    """
    path = draft.folder / SURVEY_NAME
    with writing(draft.folder, "folder"), set_aside(path, force=force):
        parts = [
            [
                "# A survey of the recorded sweeps in this folder, by `spectralzoom init`.",
                "# Any line may be changed or removed; text after a # is a comment.",
            ],
            ['source = "recorded"', f'sweeps = "."   # {counted(len(draft.cubes), "cube")}: {_listed(draft)}'],
            _pointing_lines(draft),
            _frame_lines(draft),
            []
            if draft.has_wavelengths
            else [f"# wavelengths = [450.0, ...]   # those of the {draft.bands} bands are missing: write them [nm]"],
            [
                "# budget = 0.5   # zoom in half of the seconds of a full scan; without it every line is used",
                '# weights = "WEIGHTS.safetensors"   # trained on such data; "farm" is built in',
            ],
        ]
        write_whole(path, ("\n\n".join("\n".join(lines) for lines in parts if lines) + "\n"))
    return {
        "file": str(path),
        "sweeps": [cube.name for cube in draft.cubes],
        "lines": None if draft.recording is None else sum(one.sweep.lines for one in draft.recording.sweeps),
        "bands": draft.bands,
        "notes": [] if draft.recording is None else list(draft.recording.notes),
        "unseen": [draft.problem] if draft.problem else [],
        "next": shlex.join(["spectralzoom", "survey", str(path), "--weights", "WEIGHTS.safetensors"]),
    }


def _pointing_lines(draft: SweepsDraft) -> list[str]:
    recording = draft.recording
    found = [one for one in draft.pointing if any(one.name.startswith(f"{cube.stem}.") for cube in draft.cubes)]
    if found:
        more = " and so on, by the cubes' names" if found[1:] else ""
        return [f"# pointing is taken from {printable(found[0].name)}{more}"]
    if draft.pointing:
        return [f"pointing = {json.dumps(draft.pointing[0].name)}   # a row for each line"]
    assumed = "" if recording is None else "; without it one straight, even scan is assumed"
    return [f'# pointing = "pointing.csv"   # where each line looked, a row a line{assumed}']


def _frame_lines(draft: SweepsDraft) -> list[str]:
    if draft.recording is None:
        return []
    missing = {kind: any(f"no {kind} frame" in note for note in draft.recording.notes) for kind in ("dark", "white")}
    assumed = {"dark": "a dark level of 0 is assumed", "white": "full scale is assumed to be white"}
    return [
        f'# {kind} = "{kind}.hdr"   # none was found: {assumed[kind]}'
        if missing[kind]
        else f"# the {kind} frame is here"
        for kind in missing
    ]


def _listed(draft: SweepsDraft) -> str:
    names = [printable(cube.name) for cube in draft.cubes[:4]]
    return ", ".join(names) + (", ..." if len(draft.cubes) > len(names) else "")


def printable(text: str) -> str:
    """Return text for a comment, with a question mark for what cannot be printed."""
    return "".join(letter if letter.isprintable() else "?" for letter in text)


def show_survey_draft(record: Mapping[str, Any], console: Console) -> None:
    """Print the findings and the next command."""
    lines = "" if record["lines"] is None else f" with {record['lines']} lines"
    show_draft(record, [f"{counted(len(record['sweeps']), 'sweep')}{lines}, {record['bands']} bands"], console)


def show_draft(record: Mapping[str, Any], found: Sequence[str], console: Console) -> None:
    """Print the findings, what is missing, the file, and the next command."""
    first = record.get("first")
    lines = [
        *found,
        *(f"note: {note}" for note in record["notes"]),
        *(f"missing: {one}" for one in record["unseen"]),
        f"written: {record['file']}",
        *([f"first: {first}"] if first else []),
        f"{'then' if first else 'next'}: {record['next']}",
    ]
    for line in lines:
        console.print(escape(line), soft_wrap=True)


@dataclass(frozen=True)
class SweepsDraft:
    """Findings on the sweeps of a folder."""

    folder: Path
    cubes: tuple[Path, ...]
    pointing: tuple[Path, ...]  # tables and vectors, by any name
    recording: Recording | None  # None where it cannot be opened
    bands: int
    has_wavelengths: bool
    problem: str = ""  # reason that it cannot be opened


def draft_sweeps(folder: Path) -> SweepsDraft | None:
    """Inspect a folder; return None where it has no recorded sweeps: no cubes of raw numbers, or labelled ones.

    Cubes are sweeps if there are pointing tables or reference frames, or if they are ENVI cubes of whole numbers
    without georeference.
    """
    if not folder.is_dir() or is_store(folder):
        return None
    try:
        cubes = find_cubes(folder)
        if match_folder(image_folder(folder)).labels:
            return None
        sources = [open_cube(cube) for cube in cubes]
    except (PipelineError, OSError):
        return None
    if any(source.dtype.name not in CAMERA_NUMBERS for source in sources):
        return None
    endings = tuple(f"pointing{ending}" for ending in ENDINGS)
    pointing = tuple(sorted(one for one in folder.iterdir() if one.name.lower().endswith(endings)))
    frames = any(find_reference(folder, kind) is not None for kind in ("dark", "white"))
    beside = any(folder.glob("*.dark.hdr")) or any(folder.glob("*.white.hdr"))
    unplaced_envi = all(
        reader_of(cube) in ("envi", "headwall") and source.geobox is None
        for cube, source in zip(cubes, sources, strict=True)
    )
    if not (pointing or frames or beside or unplaced_envi):
        return None
    recording, problem = None, ""
    try:
        recording = open_recording(folder)
    except PipelineError as error:
        problem = str(error)
    first = sources[0]
    known = all(source.bands.wavelength_nm is not None for source in sources)
    return SweepsDraft(folder, tuple(cubes), pointing, recording, first.shape[2], known, problem)
