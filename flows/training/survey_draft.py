"""The survey.toml that `spectralzoom init` drafts for a folder of recorded sweeps: what is there and what is not."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape

from flows.terminal.figures import counted
from flows.terminal.processes import writing
from pipeline.errors import PipelineError, SettingsError
from storage.archive.whole_files import write_whole
from storage.readers.envi_files import find_reference
from storage.readers.label_files import image_folder, is_store, match_folder
from storage.readers.open_cubes import open_cube, reader_of
from storage.readers.pointing_tables import ENDINGS
from storage.readers.recorded_cubes import find_cubes
from storage.readers.recordings import Recording, open_recording

SURVEY_NAME = "survey.toml"


@contextmanager
def set_aside(path: Path, *, force: bool) -> Iterator[None]:
    """Keep a file that is there under another name: unread, and put back where no new one is written.

    Raises SettingsError: it is there and ``force`` is not given.
    """
    there = path.exists()
    if there and not force:
        raise SettingsError(f"there is a {path} already; change it by hand, or write a new one with --force")
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
    """Write survey.toml into the folder of the sweeps; give what was found, as --json prints it.

    Raises SettingsError: there is one and ``force`` is not given; ArchiveError: the folder cannot be written to.
    """
    path = draft.folder / SURVEY_NAME
    with writing(draft.folder, "folder"), set_aside(path, force=force):
        parts = [
            [
                "# A survey of the recorded sweeps in this folder, as `spectralzoom init` saw them.",
                "# Any line may be changed or taken away; what comes after a # is a comment.",
            ],
            ['source = "recorded"', f'sweeps = "."   # {counted(len(draft.cubes), "cube")}: {_listed(draft)}'],
            _pointing_lines(draft),
            _frame_lines(draft),
            []
            if draft.has_wavelengths
            else [f"# wavelengths = [450.0, ...]   # nothing says those of the {draft.bands} bands: write them [nm]"],
            [
                "# budget = 0.5   # zoom in half of the seconds of a full scan; without it every line is read",
                '# weights = "WEIGHTS.safetensors"   # of a network that was trained on such data; "farm" is built in',
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
    """Give words for a comment, which ends with its line: what cannot be printed is a question mark."""
    return "".join(letter if letter.isprintable() else "?" for letter in text)


def show_survey_draft(record: Mapping[str, Any], console: Console) -> None:
    """Print what was found and written, and the next command."""
    lines = "" if record["lines"] is None else f" with {record['lines']} lines"
    show_draft(record, [f"{counted(len(record['sweeps']), 'sweep')}{lines}, {record['bands']} bands"], console)


def show_draft(record: Mapping[str, Any], found: Sequence[str], console: Console) -> None:
    """Print what was found, what was not, where it is written, and the next command."""
    for words in found:
        console.print(escape(words), soft_wrap=True)
    for note in record["notes"]:
        console.print(escape(f"note: {note}"), soft_wrap=True)
    for words in record["unseen"]:
        console.print(escape(f"not seen: {words}"), soft_wrap=True)
    console.print(escape(f"written: {record['file']}"), soft_wrap=True)
    if first := record.get("first"):
        console.print(escape(f"first: {first}"), soft_wrap=True)
    console.print(escape(f"{'then' if first else 'next'}: {record['next']}"), soft_wrap=True)


CAMERA_NUMBERS = ("uint8", "uint16", "int16")


@dataclass(frozen=True)
class SweepsDraft:
    """Findings on the sweeps of a folder."""

    folder: Path
    cubes: tuple[Path, ...]
    pointing: tuple[Path, ...]  # tables and vectors that lie there, by any name
    recording: Recording | None  # None where something is missing without which it cannot be opened
    bands: int
    has_wavelengths: bool
    problem: str = ""  # why it could not be opened


def draft_sweeps(folder: Path) -> SweepsDraft | None:
    """Look at a folder; None where it holds no recorded sweeps: no cubes of a camera's numbers, or labelled ones.

    Cubes are taken for sweeps where a pointing table or reference frames lie with them, or where they are ENVI cubes of
    whole numbers that do not say where on earth they lie.
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
