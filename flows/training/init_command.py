"""The verb `init`: it looks at images and labels, and writes a scene.toml of what they do not say.

Of a folder of recorded sweeps it writes a survey.toml.
"""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from flows.cli.app import AsJson, Switch, stderr
from flows.terminal.figures import counted
from flows.terminal.processes import DONE, writing
from flows.terminal.progress import StageProgress, put_out
from flows.training.survey_draft import (
    draft_sweeps,
    printable,
    set_aside,
    show_draft,
    show_survey_draft,
    write_survey_draft,
)
from pipeline.readings import MOST_VALUE
from storage.archive.whole_files import write_whole
from storage.readers.label_files import is_store, listed_names
from storage.readers.open_cubes import split_variable
from storage.readers.polygons import is_polygon_file
from storage.readers.scene_drafts import FoundClass, SceneDraft, draft_scene
from storage.readers.scene_toml import SETTINGS_NAME

TITLES = {"extent": "looking at labels"}
NO_READING = -999.0  # at and below it an edge is filled, not seen


def init(source: str, *, force: Switch = False, as_json: AsJson = False) -> int:
    """Look at the images and labels of SOURCE, and write a scene.toml beside them that can be read and changed.

    Of a folder of recorded sweeps it is a survey.toml. Asks nothing, and says what it could not see and which command
    comes next.

    Parameters
    ----------
    source
        A folder of images with their labels, one image or cube, or a folder of sweeps: ENVI cubes with pointing tables
        or reference frames, or those of a Headwall camera.
    force
        Write a new file in the place of one that is there, which is kept as scene.toml.old or survey.toml.old.
    """
    if (draft := draft_sweeps(Path(source))) is not None:
        put_out(write_survey_draft(draft, force=force), show_survey_draft, as_json=as_json)
        return DONE
    put_out(run_init(source, stderr, force=force), _show, as_json=as_json)
    return DONE


def run_init(source: str, console: Console, *, force: bool = False) -> dict[str, Any]:
    """Write a scene.toml for a folder or file, with progress on ``console``; give what was found, as --json prints it.

    Raises SettingsError: there is a scene.toml and ``force`` is not given; ArchiveError: the folder cannot be written
    to; else as `draft_scene`.
    """
    place, _ = split_variable(source)
    path = (place if place.is_dir() and not is_store(place) else place.parent) / SETTINGS_NAME
    with writing(path.parent, "folder"), set_aside(path, force=force):
        with StageProgress(console, TITLES) as progress:
            draft = draft_scene(source, lambda done, name: progress.show("extent", done, name, ended=done == 1))
        # The lines of a scene.toml, each with a comment on where it comes from.
        parts = [
            [
                f"# What {counted(len(draft.files.images), 'image')} here cannot say, as `spectralzoom init` saw it.",
                "# Any line may be changed or taken away; what comes after a # is a comment.",
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
            f"# {len(labels)} of {len(images)} images have labels, found by their names: {printable(pair[0].name)}"
            f" has {printable(pair[1].name)}"
        ]
    return [f"labels = {_quoted(draft.pattern)}   # of {len(labels)} of {len(images)} images"]


def _wavelength_lines(draft: SceneDraft) -> list[str]:
    bands = draft.shape[2]
    if draft.wavelength_nm is None:
        return [
            f"# {bands} bands, and nothing says their wavelengths. Fill in one of these two lines, and take the # in",
            "# front of it away:",
            f"# wavelengths_nm = []   # {bands} numbers [nm] between the brackets, with commas",
            f'# wavelengths_file = "bands.txt"   # a text file beside this one of {bands} rows, which begin with nm',
        ]
    if "assumed" not in draft.wavelength_origin:
        low, high = draft.wavelength_nm.min(), draft.wavelength_nm.max()
        return [f"# {bands} bands, {low:g}-{high:g} nm: {printable(draft.wavelength_origin)}"]
    listed = ", ".join(repr(float(nm)) for nm in draft.wavelength_nm)
    return [f"# wavelengths_nm = [{listed}]   # assumed of its colours: if you know better, take away the first #"]


def _value_lines(draft: SceneDraft) -> list[str]:
    lines = []
    if draft.missing:
        lines.append(f"# {draft.missing:.1%} of the values looked at are NaN, and count as missing")
    if draft.nodata is not None:
        lines.append(f"# the file itself says that {draft.nodata:g} is no data")
    elif draft.edge is not None:
        value, fraction = draft.edge
        sure = value <= NO_READING or value > MOST_VALUE
        parts = f"nodata = {value!r}   # {fraction:.0%} of the first image's edge"
        lines.append(parts if sure else f"# {parts}; if it stands for no data there, take away the first #")
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
        f"# unlabelled = {_value(one)}   # if it stands for no class: take away the #, and its line below"
        for one in guess[:1]
    ]
    parts = "name = value in the label files, fraction of all pixels; rename them as you like"
    if all(is_polygon_file(label) for label in draft.files.labels.values()):
        parts = "name = number, fraction of the labelled pixels; polygons say the name or the number"
    lines += ["", f"[classes]   # {parts}"]
    return lines + [f"{_key(one.name)} = {_value(one)}   # {one.fraction:.1%}" for one in classes]


def _value(one: FoundClass) -> str:
    return str(one.value) if isinstance(one.value, int) else str(list(one.value))


def _key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else _quoted(name)


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _unseen(draft: SceneDraft) -> list[str]:
    """Return what needs a look: what the files do not say, or does not fit."""
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
    """Return what has to be written before the next command runs; None where it runs at once."""
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
