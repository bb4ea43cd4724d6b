"""ENVI cubes as sources of lines: one file, or the parts of one cube in a folder of a Headwall camera.

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
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SceneError
from pipeline.rig.camera.camera_texts import (
    FRAME_INDEX,
    LONGEST_LINE,
    FrameIndex,
    LineTimes,
    parse_frame_index,
    times_of_lines,
)
from storage.readers.cube_sources import MOST_MISSING, Bands, CubeSource, LineFacts
from storage.readers.envi_cubes import EnviCube, find_envi_pair, open_envi_cube
from storage.readers.raster_tags import bad_bands, place_of_envi

_PART = re.compile(r"raw_(\d{1,12})(\.[A-Za-z]{1,4})?", re.IGNORECASE)
_EXPOSURE = "exposure (ms)"  # a setting in the comments of Headwall's headers


@dataclass(frozen=True)
class CubePart:
    """One file of a cube: its lines begin at line ``start`` of the whole."""

    start: int
    cube: EnviCube

    @property
    def stop(self) -> int:
        """Line after its last whole one."""
        return self.start + len(self.cube.values)


def is_headwall_folder(folder: Path) -> bool:
    """Return whether a folder holds parts of a cube as a Headwall camera names them."""
    return any(_PART.fullmatch(entry.name) is not None for entry in folder.iterdir())


def open_envi_source(path: Path) -> CubeSource:
    """Open one ENVI cube by its header or data file; the lines that it lost are its last (SceneError as there)."""
    header, data = find_envi_pair(path)
    parts, notes = [CubePart(0, open_envi_cube(header))], list[str]()
    lines = parts[0].stop + _lost_at_end(parts, notes)
    source = _source(data.name, parts, lines, None, notes=(*parts[0].cube.notes, *notes))
    geobox, where = place_of_envi(parts[0].cube.header.fields, data, source.shape[:2])
    return replace(source, geobox=geobox, notes=(*source.notes, *where))


def open_headwall_cube(folder: Path) -> CubeSource:
    """Open the parts of a folder as one cube, in the order of their frames.

    A part whose name says a later frame than where the one before it ends leaves lines between them that no file holds;
    so does a file that is cut off. A part without any byte is left out. Raises SceneError: a part cannot be used, parts
    differ in their frames, or too many lines between them are missing.
    """
    headers, notes = _headers(folder), list[str]()
    if not headers:
        raise SceneError(
            f"{folder} is a folder, expected a file, a Zarr store, or a folder with raw_<frame> files of a Headwall "
            "camera; name one of the files in it"
        )
    opened: dict[int, EnviCube] = {}
    for number, header in headers.items():
        _, data = find_envi_pair(header)
        if data.stat().st_size == 0:
            notes.append(f"{data.name} is empty and left out")
        else:
            opened[number] = open_envi_cube(header)
    if not opened:
        raise SceneError(f"every part of {folder} is empty; copy the folder again")
    _check_alike(list(opened.values()))
    parts = _placed(opened, notes)
    lines = parts[-1].stop + _lost_at_end(parts, notes)
    found = {
        int(match[1]): file
        for file in folder.iterdir()
        if file.is_file() and (match := FRAME_INDEX.fullmatch(file.name))
    }
    used = {number: found[number] for number in opened if number in found}
    told_by_name = any(before.stop != after.start for before, after in pairwise(parts))
    times = None
    if used:
        times, counted = _times(used, dict(zip(opened, parts, strict=True)), lines, notes)
        told_by_name = told_by_name or counted or len(used) < len(opened)
    names = (tuple(opened), tuple(used)) if told_by_name else ()
    return _source(folder.resolve().name, parts, lines, times, tuple(notes), tuple(used.values()), names)


def _source(
    name: str,
    parts: Sequence[CubePart],
    lines: int,
    times: LineTimes | None,
    notes: tuple[str, ...],
    index_files: tuple[Path, ...] = (),
    by_names: tuple[tuple[int, ...], ...] = (),
) -> CubeSource:
    """Files that follow each other as one cube of ``lines``, some of which may be in none of them: these are 0."""
    first, values = parts[0].cube.header, parts[0].cube.values
    native = values.dtype.newbyteorder("=")
    headers = [Path(part.cube.header.where) for part in parts]
    told = next((part.cube.header for part in parts if part.cube.header.wavelength_nm is not None), None)
    bands = Bands()
    if told is not None:
        units = told.fields.get("wavelength units", "")
        bands = Bands(told.wavelength_nm, told.fwhm_nm, units, f"wavelengths from {Path(told.where).name}")

    def read(start: int, stop: int) -> NDArray[Any]:
        block = np.zeros((stop - start, *values.shape[1:]), native)
        for part in parts:
            low, high = max(start, part.start), min(stop, part.stop)
            if low < high:
                block[low - start : high - start] = part.cube.values[low - part.start : high - part.start]
        return block

    data = [file for header, part in zip(headers, parts, strict=True) for file in (header, part.cube.path)]
    return CubeSource(
        name=name,
        shape=(lines, values.shape[1], values.shape[2]),
        dtype=native,
        read=read,
        files=(*data, *index_files),
        lines=_line_facts(parts, lines, times),
        bands=bands,
        nodata=first.nodata,
        bad_bands=bad_bands(first.fields.get("bbl"), values.shape[2]),
        headers={header.name: header.read_bytes().decode("utf-8", errors="replace") for header in headers},
        notes=notes,
        by_names=by_names,
    )


def _line_facts(parts: Sequence[CubePart], lines: int, times: LineTimes | None) -> LineFacts:
    """Which lines a file holds whole; exposures by the frame indices, else by the headers."""
    valid = np.zeros(lines, np.bool_)
    for part in parts:
        valid[part.start : part.stop] = True
    if times is None and not any(_EXPOSURE in part.cube.header.settings for part in parts):
        return LineFacts(valid)
    exposure = np.full(lines, np.nan)
    for part in parts:
        try:
            exposure[part.start : part.stop] = float(part.cube.header.settings.get(_EXPOSURE, "nan"))
        except ValueError:
            continue
    if times is not None:
        exposure = np.where(np.isnan(times.exposure_ms), exposure, times.exposure_ms)
    told = None if np.isnan(exposure).all() else exposure
    if times is None:
        return LineFacts(valid, exposure_ms=told)
    known = times.stamp_us >= 0
    if not known.any():
        return LineFacts(valid, exposure_ms=told, frame=times.frame)
    first = int(times.stamp_us[known][0])
    return LineFacts(valid, np.where(known, (times.stamp_us - first) * 1e-6, np.nan), told, times.frame, first)


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


def _check_alike(cubes: Sequence[EnviCube]) -> None:
    """All parts must have one frame size, type and set of wavelengths."""
    first = cubes[0]
    for cube in cubes[1:]:
        if cube.values.shape[1:] != first.values.shape[1:] or cube.values.dtype != first.values.dtype:
            raise SceneError(
                f"{cube.path} has frames of {cube.values.shape[1:]} (sample, band) {cube.values.dtype}, "
                f"{first.path.name} of {first.values.shape[1:]} {first.values.dtype}; ingest them by themselves"
            )
        ours, theirs = first.header.wavelength_nm, cube.header.wavelength_nm
        if ours is not None and theirs is not None and not np.array_equal(ours, theirs):
            raise SceneError(f"{cube.path} has other wavelengths than {first.path.name}; ingest them by themselves")


def _placed(opened: dict[int, EnviCube], notes: list[str]) -> list[CubePart]:
    parts: list[CubePart] = []
    end = missing = 0
    for number, cube in opened.items():
        start = number - min(opened)
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


def _times(used: dict[int, Path], parts: dict[int, CubePart], lines: int, notes: list[str]) -> tuple[LineTimes, bool]:
    """Times of all lines by the indices, and whether an index counts other lines than its part has."""
    times, counted = LineTimes(np.full(lines, -1), np.full(lines, -1), np.full(lines, np.nan), ()), False
    for number, part in parts.items():
        if number not in used:
            notes.append(f"there is no frame index for {part.cube.path.name}")
            continue
        index = load_frame_index(used[number])
        own = times_of_lines(index, number, len(part.cube.values), part.cube.lost_lines)
        counted = counted or len(index.frame) != len(part.cube.values)
        for whole, piece in (
            (times.frame, own.frame),
            (times.stamp_us, own.stamp_us),
            (times.exposure_ms, own.exposure_ms),
        ):
            whole[part.start : part.stop] = piece
        notes.extend((*index.notes, *(f"{used[number].name}: {note}" for note in own.notes)))
    return times, counted
