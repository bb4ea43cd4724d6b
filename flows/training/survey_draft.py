"""The survey.toml that `spectralzoom init` drafts for a folder of recorded sweeps: what is there and what is not."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape

from flows.terminal.processes import writing
from flows.training.sweep_draft import SweepsDraft
from pipeline.errors import SettingsError
from storage.archive.whole_files import write_whole

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
        write_whole(path, survey_text(draft))
    return {
        "file": str(path),
        "sweeps": [cube.name for cube in draft.cubes],
        "lines": None if draft.recording is None else sum(one.sweep.lines for one in draft.recording.sweeps),
        "bands": draft.bands,
        "notes": [] if draft.recording is None else list(draft.recording.notes),
        "unseen": [draft.problem] if draft.problem else [],
        "next": shlex.join(["spectralzoom", "survey", str(path), "--weights", "WEIGHTS.safetensors"]),
    }


def survey_text(draft: SweepsDraft) -> str:
    """Return the lines of a survey.toml, each with a comment on where it comes from."""
    parts = [
        [
            "# A survey of the recorded sweeps in this folder, as `spectralzoom init` saw them.",
            "# Any line may be changed or taken away; what comes after a # is a comment.",
        ],
        ['source = "recorded"', f'sweeps = "."   # {_counted(len(draft.cubes), "cube")}: {_listed(draft)}'],
        _pointing_lines(draft),
        _frame_lines(draft),
        _band_lines(draft),
        [
            "# budget = 0.5   # two passes in half of the seconds of a full scan; without it every line is read",
            '# weights = "WEIGHTS.safetensors"   # of a network that was trained on such data; "farm" is built in',
        ],
    ]
    return "\n\n".join("\n".join(lines) for lines in parts if lines) + "\n"


def _pointing_lines(draft: SweepsDraft) -> list[str]:
    recording = draft.recording
    found = [one for one in draft.pointing if any(one.name.startswith(f"{_stem(cube)}.") for cube in draft.cubes)]
    if found:
        more = " and so on, by the cubes' names" if found[1:] else ""
        return [f"# pointing is taken from {_said(found[0].name)}{more}"]
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


def _band_lines(draft: SweepsDraft) -> list[str]:
    if draft.has_wavelengths:
        return []
    return [f"# wavelengths = [450.0, ...]   # nothing says those of the {draft.bands} bands: write them [nm]"]


def _listed(draft: SweepsDraft) -> str:
    names = [_said(cube.name) for cube in draft.cubes[:4]]
    return ", ".join(names) + (", ..." if len(draft.cubes) > len(names) else "")


def _said(text: str) -> str:
    """Words in a comment, which ends with its line."""
    return "".join(letter if letter.isprintable() else "?" for letter in text)


def _stem(cube: Path) -> str:
    return cube.name.removesuffix(cube.suffix)


def _counted(count: int, what: str) -> str:
    return f"{count} {what}{'s' if count != 1 else ''}"


def show_survey_draft(record: Mapping[str, Any], console: Console) -> None:
    """Print what was found and written, and the next command."""
    lines = "" if record["lines"] is None else f" with {record['lines']} lines"
    console.print(escape(f"{_counted(len(record['sweeps']), 'sweep')}{lines}, {record['bands']} bands"), soft_wrap=True)
    for note in record["notes"]:
        console.print(escape(f"note: {note}"), soft_wrap=True)
    for words in record["unseen"]:
        console.print(escape(f"not seen: {words}"), soft_wrap=True)
    console.print(escape(f"written: {record['file']}"), soft_wrap=True)
    console.print(escape(f"next: {record['next']}"), soft_wrap=True)
