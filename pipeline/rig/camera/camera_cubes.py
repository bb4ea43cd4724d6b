"""Bytes of a capture's files to lines: ENVI cubes as the camera writes them, with their frames' numbers and times.

What the camera itself writes is read strictly here, for the loop that waits for it; folders from anywhere are read by
``storage.readers.headwall_folders``.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import RigError, SceneError
from pipeline.rig.camera.frame_index import LineTimes, parse_frame_index, times_of_lines
from pipeline.rig.envi_fields import split_header, wavelengths_nm

_PART = re.compile(r"raw_(\d{1,12})", re.IGNORECASE)
_INDEX = re.compile(r"frameindex_(\d{1,12})\.txt", re.IGNORECASE)
_REFERENCE = re.compile(r"(dark|white)[A-Za-z_]*", re.IGNORECASE)
MOST_MISSING = 100_000  # lines between two parts; more means that the names are wrong
MOST_NUMBERS = 1 << 26  # of a line: a hundred times those of any such camera

Read = Callable[[str], bytes]  # the content of a file by its name


@dataclass(frozen=True)
class CubeHeader:
    """What a header says of 16-bit lines, band after band within each."""

    samples: int
    lines: int
    bands: int
    dtype: np.dtype[np.uint16]  # with its byte order
    offset: int
    wavelength_nm: NDArray[np.float64] | None  # (band,)

    @property
    def line_bytes(self) -> int:
        """Bytes of a line."""
        return self.samples * self.bands * 2


@dataclass(frozen=True)
class CubeLines:
    """Lines of one file. ``lost`` are those that its header promises and it does not hold whole."""

    values: NDArray[np.uint16]  # (line, sample, band), a view of the bytes
    header: CubeHeader
    lost: int


@dataclass(frozen=True)
class CapturedLines:
    """Lines of a capture, all its files in order. Lines in no file are 0 and not valid."""

    values: NDArray[np.uint16]  # (line, sample, band)
    valid: NDArray[np.bool_]  # (line,)
    first_frame: int  # number of the first line's frame by the first file's name
    times: LineTimes
    wavelength_nm: NDArray[np.float64] | None  # (band,)
    notes: tuple[str, ...]


def parse_cube_header(text: str, where: str) -> CubeHeader:
    """Read the header of a cube as the camera writes them.

    Raises
    ------
    RigError : it is no whole ENVI header, a size is missing, or the numbers are not 16-bit BIL.
    """
    if not text.lstrip("\ufeff \r\n").upper().startswith("ENVI"):
        raise RigError(f"{where} begins with {text[:40]!r}, expected ENVI; fetch it again")
    try:
        fields, _ = split_header(text, where, [])
    except SceneError as error:
        raise RigError(f"{error}; fetch it again") from error
    layout = (fields.get("interleave", "").lower(), fields.get("data type", ""))
    if layout != ("bil", "12"):
        raise RigError(
            f"{where}: interleave {layout[0]!r}, data type {layout[1]!r}; expected bil and 12, as cameras write"
        )
    samples, lines, bands = (_whole(fields, key, where) for key in ("samples", "lines", "bands"))
    if not samples or not bands:
        raise RigError(f"{where}: {samples} samples and {bands} bands; expected at least one of each")
    if samples * bands > MOST_NUMBERS:
        raise RigError(f"{where}: {samples} samples and {bands} bands; no camera has so many, fetch it again")
    order = _whole(fields | {"byte order": fields.get("byte order", "0")}, "byte order", where)
    if order > 1:
        raise RigError(f"{where}: byte order = {order}, expected 0 or 1")
    offset = _whole(fields | {"header offset": fields.get("header offset", "0")}, "header offset", where)
    wavelength, _ = wavelengths_nm(fields, bands, [])
    return CubeHeader(samples, lines, bands, np.dtype(("<u2", ">u2")[order]), offset, wavelength)


def cube_lines(header: CubeHeader, data: bytes) -> CubeLines:
    """Give the lines that are whole in ``data``, (line, sample, band)."""
    held = min(max(len(data) - header.offset, 0) // header.line_bytes, header.lines)
    shape = (held, header.bands, header.samples)
    values = np.ndarray(shape, header.dtype, data, header.offset if held else 0).transpose(0, 2, 1)
    return CubeLines(values, header, header.lines - held)


def read_capture(names: Iterable[str], read: Read) -> CapturedLines:
    """Put a capture's files together.

    Parameters
    ----------
    names
        Files of the folder, with or without the folder; what is no part, header or index does not matter.
    read
        Gives the content of one of them.

    Raises
    ------
    RigError : there is no line, a header is missing, wrong or promises less, or the files do not belong together.
    """
    by_name = {name.rsplit("/", 1)[-1]: name for name in names}
    raw = sorted((int(match[1]), name) for name in by_name if (match := _PART.fullmatch(name)))
    notes: list[str] = []
    parts = [(first, cube) for first, name in raw if len((cube := _read_cube(by_name, name, read)).values)]
    if not parts:
        raise RigError(f"no whole line in {', '.join(sorted(by_name)) or 'an empty folder'}; capture again")
    sizes = {cube.values.shape[1:] for _, cube in parts}
    if len(sizes) > 1:
        raise RigError(
            f"parts of one capture have frames of {sorted(sizes)} (sample, band); they are of several captures"
        )
    placed = _placed(parts, notes)
    lost = placed[-1][2].lost
    if lost > MOST_MISSING:
        notes.append(f"the {lost} lines that raw_{placed[-1][1]} lacks are not filled up")
        lost = 0
    lines = placed[-1][0] + len(placed[-1][2].values) + lost
    shape = (lines, *parts[0][1].values.shape[1:])
    alone = len(placed) == 1 and not lost  # then no copy is made: a capture may have a gigabyte
    values = parts[0][1].values.astype(np.uint16, copy=False) if alone else np.zeros(shape, np.uint16)
    valid = np.zeros(lines, np.bool_)
    times = LineTimes(np.full(lines, -1), np.full(lines, -1), np.full(lines, np.nan), ())
    for start, first, cube in placed:
        stop = start + len(cube.values)
        valid[start:stop] = True
        if not alone:
            values[start:stop] = cube.values
        if cube.lost:
            notes.append(
                f"raw_{first} is cut off: {len(cube.values)} of {len(cube.values) + cube.lost} lines are whole"
            )
        if (own := _times(by_name, first, cube, read, notes)) is not None:
            times.frame[start:stop], times.stamp_us[start:stop] = own.frame, own.stamp_us
            times.exposure_ms[start:stop] = own.exposure_ms
    return CapturedLines(values, valid, parts[0][0], times, parts[0][1].header.wavelength_nm, tuple(notes))


def read_references(names: Iterable[str], read: Read) -> dict[str, CubeLines]:
    """Give the reference cubes of a folder by ``dark`` and ``white``, where there are such.

    Raises
    ------
    RigError : one has no header, a wrong one, or frames less or more, or there are two of a kind.
    """
    by_name = {name.rsplit("/", 1)[-1]: name for name in names}
    found: dict[str, CubeLines] = {}
    for name in sorted(by_name):
        match = _REFERENCE.fullmatch(name)
        if match is None:
            continue
        if match[1].lower() in found:
            raise RigError(f"two {match[1].lower()} references among {', '.join(sorted(by_name))}; keep one of them")
        found[match[1].lower()] = cube = _read_cube(by_name, name, read)
        if cube.lost:
            raise RigError(
                f"{by_name[name]} holds {len(cube.values)} whole frames, its header says "
                f"{len(cube.values) + cube.lost}; take both references again"
            )
    return found


def _read_cube(by_name: Mapping[str, str], name: str, read: Read) -> CubeLines:
    header = next((found for found in by_name if found.lower() == name.lower() + ".hdr"), None)
    if header is None:
        raise RigError(f"{by_name[name]} has no header {name}.hdr beside it; fetch the folder again")
    found = parse_cube_header(read(by_name[header]).decode("utf-8", errors="replace"), by_name[header])
    data = read(by_name[name])
    promised = found.offset + found.lines * found.line_bytes
    if len(data) > promised:
        raise RigError(f"{by_name[name]} has {len(data)} bytes, its header says {promised}; is it another file's?")
    return cube_lines(found, data)


def _placed(parts: list[tuple[int, CubeLines]], notes: list[str]) -> list[tuple[int, int, CubeLines]]:
    """Start line, first frame and lines of each part."""
    placed: list[tuple[int, int, CubeLines]] = []
    end = 0
    for first, cube in parts:
        start = first - parts[0][0]
        if start - end > MOST_MISSING:
            raise RigError(f"{start - end} lines before raw_{first} are in no file; is it of another capture?")
        if start > end:
            notes.append(f"{start - end} lines before raw_{first} are in no file")
        elif start < end:
            notes.append(f"raw_{first} begins {end - start} frames before the part before it ends")
        placed.append((max(start, end), first, cube))
        end = placed[-1][0] + len(cube.values)
    return placed


def _times(by_name: Mapping[str, str], first: int, cube: CubeLines, read: Read, notes: list[str]) -> LineTimes | None:
    """What the part's index says of its lines; None where there is none that can be read."""
    name = next((name for name in by_name if (match := _INDEX.fullmatch(name)) and int(match[1]) == first), None)
    if name is None:
        notes.append(f"there is no frame index for raw_{first}")
        return None
    try:
        text = read(by_name[name]).decode("utf-8-sig", errors="replace")
        index = parse_frame_index(text.splitlines(), name)
    except SceneError as error:
        notes.append(str(error))
        return None
    own = times_of_lines(index, first, len(cube.values), cube.lost)
    notes += [*index.notes, *(f"{name}: {note}" for note in own.notes)]
    return own


def _whole(fields: Mapping[str, str], key: str, where: str) -> int:
    if not re.fullmatch(r"\d{1,12}", fields.get(key, "")):
        raise RigError(f"{where}: {key} = {fields.get(key)!r}, expected a whole number; fetch it again")
    return int(fields[key])
