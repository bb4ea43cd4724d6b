"""Folders of a Headwall camera: parts of one cube, when their frames were taken, dark and white references.

::

    raw_0  raw_0.hdr  raw_2000  raw_2000.hdr     parts of one cube, each named by its first frame
    frameIndex_0.txt  frameIndex_2000.txt        when each frame was taken
    darkReference(.hdr)  whiteReference(.hdr)    found by how their names begin, whatever their endings

The layout is that of the Nano-Hyperspec's files as users' programs read them. Tested on small folders made in it, and
on the references of a real MV.X.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SceneError
from pipeline.rig.camera.frame_index import LONGEST_LINE, FrameIndex, LineTimes, parse_frame_index, times_of_lines
from storage.readers.cube_sources import MOST_MISSING
from storage.readers.envi_cubes import EnviCube, find_envi_pair, open_envi_cube

_PART = re.compile(r"raw_(\d{1,12})(\.[A-Za-z]{1,4})?", re.IGNORECASE)
_INDEX = re.compile(r"frameindex_(\d{1,12})\.txt", re.IGNORECASE)


@dataclass(frozen=True)
class CubePart:
    """One file of a cube: its lines begin at line ``start`` of the whole."""

    start: int
    cube: EnviCube

    @property
    def stop(self) -> int:
        """Line after its last whole one."""
        return self.start + len(self.cube.values)


@dataclass(frozen=True)
class PartedCube:
    """Files that follow each other as one cube of ``lines``, some of which may be in none of them."""

    parts: tuple[CubePart, ...]
    lines: int
    times: LineTimes | None
    index_files: tuple[Path, ...]
    notes: tuple[str, ...]
    by_names: tuple[tuple[int, ...], ...] = ()  # of parts and indices, where lines or times follow from their names

    def valid_lines(self) -> NDArray[np.bool_]:
        """(line,) lines that a file holds whole."""
        valid = np.zeros(self.lines, np.bool_)
        for part in self.parts:
            valid[part.start : part.stop] = True
        return valid

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Lines in native byte order, (line, sample, band); those in no file are 0."""
        first = self.parts[0].cube.values
        block = np.zeros((stop - start, *first.shape[1:]), first.dtype.newbyteorder("="))
        for part in self.parts:
            low, high = max(start, part.start), min(stop, part.stop)
            if low < high:
                block[low - start : high - start] = part.cube.values[low - part.start : high - part.start]
        return block


def is_headwall_folder(folder: Path) -> bool:
    """Whether a folder holds parts of a cube as the camera names them."""
    return any(_PART.fullmatch(entry.name) and entry.is_file() for entry in folder.iterdir())


def open_parts(folder: Path) -> PartedCube:
    """Open the parts of a folder as one cube, in the order of their frames.

    A part whose name says a later frame than where the one before it ends leaves lines between them that no file holds;
    so does a file that is cut off. A part without any byte is left out. Raises SceneError: a part cannot be used, parts
    differ in their frames, or too many lines between them are missing.
    """
    opened: list[tuple[int, EnviCube]] = []
    notes: list[str] = []
    for number, header in _headers(folder).items():
        _, data = find_envi_pair(header)
        if data.stat().st_size == 0:
            notes.append(f"{data.name} is empty and left out")
            continue
        opened.append((number, open_envi_cube(header)))
    if not opened:
        raise SceneError(f"every part of {folder} is empty; copy the folder again")
    _check_alike(opened)
    parts = _placed(opened, notes)
    return _with_times(folder, [number for number, _ in opened], parts, notes)


def one_part(cube: EnviCube) -> PartedCube:
    """A single file as a cube of parts; the lines that it lost are its last."""
    notes: list[str] = []
    parts = [CubePart(0, cube)]
    return PartedCube(tuple(parts), len(cube.values) + _lost_at_end(parts, notes), None, (), (*cube.notes, *notes))


def find_reference(folder: Path, kind: str) -> Path | None:
    """Header of the ``dark`` or ``white`` frame in a folder, by how its name begins.

    Raises SceneError: there are several; name one.
    """
    headers = (entry for entry in sorted(folder.iterdir()) if entry.suffix.lower() == ".hdr")
    found = [entry for entry in headers if entry.name.lower().startswith(kind)]
    if len(found) > 1:
        names = ", ".join(entry.name for entry in found)
        raise SceneError(f"{folder} has several {kind} frames ({names}); name one with --{kind}")
    return found[0] if found else None


def load_frame_index(path: Path) -> FrameIndex:
    """Read one index. Lines that are no frame are passed over and counted; of a frame listed twice the first counts.

    Raises SceneError: the file cannot be read, or no line of it is a frame.
    """
    try:
        with path.open(encoding="utf-8-sig", errors="replace") as file:
            return parse_frame_index(iter(lambda: file.readline(LONGEST_LINE), ""), path.name, str(path))
    except SceneError:
        raise
    except OSError as error:
        raise SceneError(f"{path} cannot be read: {error}; take it away to go on without times") from error


def _headers(folder: Path) -> dict[int, Path]:
    """First frame -> header of each part, in order."""
    found: dict[int, list[Path]] = {}
    for entry in folder.iterdir():
        match = _PART.fullmatch(entry.name)
        if match is not None and entry.is_file():
            found.setdefault(int(match[1]), []).append(entry)
    headers: dict[int, Path] = {}
    for number, files in sorted(found.items()):
        named = [file for file in files if file.suffix.lower() == ".hdr"]
        if len(named) != 1:
            listed = ", ".join(sorted(file.name for file in files))
            raise SceneError(f"frame {number} of {folder}: expected one header raw_{number}.hdr, found {listed}")
        headers[number] = named[0]
    return headers


def _check_alike(opened: Sequence[tuple[int, EnviCube]]) -> None:
    """All parts must have one frame size, type and set of wavelengths."""
    first = opened[0][1]
    for _, cube in opened[1:]:
        if cube.values.shape[1:] != first.values.shape[1:] or cube.values.dtype != first.values.dtype:
            raise SceneError(
                f"{cube.path} has frames of {cube.values.shape[1:]} (sample, band) {cube.values.dtype}, "
                f"{first.path.name} of {first.values.shape[1:]} {first.values.dtype}; ingest them by themselves"
            )
        ours, theirs = first.header.wavelength_nm, cube.header.wavelength_nm
        if ours is not None and theirs is not None and not np.array_equal(ours, theirs):
            raise SceneError(f"{cube.path} has other wavelengths than {first.path.name}; ingest them by themselves")


def _placed(opened: Sequence[tuple[int, EnviCube]], notes: list[str]) -> list[CubePart]:
    parts: list[CubePart] = []
    end = missing = 0
    for number, cube in opened:
        start = number - opened[0][0]
        if start < end:
            notes.append(f"{cube.path.name} begins {end - start} frames before the part before it ends")
        elif start > end:
            missing += start - end
            notes.append(f"{start - end} lines before {cube.path.name} are in no file")
        if missing > MOST_MISSING:
            raise SceneError(
                f"{missing} lines before {cube.path} are in no file, more than {MOST_MISSING}; ingest the parts by "
                "themselves"
            )
        parts.append(CubePart(max(start, end), cube))
        end = parts[-1].stop
        notes.extend(cube.notes)
    return parts


def _lost_at_end(parts: Sequence[CubePart], notes: list[str]) -> int:
    """Lines that the last file promises and does not hold; none where a header promises more than can be meant."""
    lost = parts[-1].cube.lost_lines
    if lost <= MOST_MISSING:
        return lost
    notes.append(f"the {lost} lines that {parts[-1].cube.path.name} lacks are not filled up")
    return 0


def _with_times(folder: Path, numbers: Sequence[int], parts: Sequence[CubePart], notes: list[str]) -> PartedCube:
    lines = parts[-1].stop + _lost_at_end(parts, notes)
    entries = [entry for entry in folder.iterdir() if entry.is_file()]
    found = {int(match[1]): entry for entry in entries if (match := _INDEX.fullmatch(entry.name))}
    used = {number: found[number] for number in numbers if number in found}
    names = (tuple(numbers), tuple(used))
    told_by_name = any(before.stop != after.start for before, after in pairwise(parts))
    if not used:
        return PartedCube(tuple(parts), lines, None, (), tuple(notes), names if told_by_name else ())
    times = LineTimes(np.full(lines, -1), np.full(lines, -1), np.full(lines, np.nan), ())
    for number, part in zip(numbers, parts, strict=True):
        if number not in used:
            notes.append(f"there is no frame index for {part.cube.path.name}")
            continue
        index = load_frame_index(used[number])
        own = times_of_lines(index, number, len(part.cube.values), part.cube.lost_lines)
        told_by_name = told_by_name or len(index.frame) != len(part.cube.values)
        for whole, piece in ((times.frame, own.frame), (times.stamp_us, own.stamp_us)):
            whole[part.start : part.stop] = piece
        times.exposure_ms[part.start : part.stop] = own.exposure_ms
        notes.extend((*index.notes, *(f"{used[number].name}: {note}" for note in own.notes)))
    told_by_name = told_by_name or len(used) < len(numbers)
    index_files = tuple(used.values())
    return PartedCube(tuple(parts), lines, times, index_files, tuple(notes), names if told_by_name else ())
