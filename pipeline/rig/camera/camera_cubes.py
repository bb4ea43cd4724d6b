"""Bytes of a capture's files to lines with their frames' numbers and times, and of its references to mean frames.

These readers are strict, for the loop that waits for the camera; ``storage.readers.envi_files`` reads any folder.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spectralzoom.pipeline.envi_headers import parse_envi_header
from spectralzoom.pipeline.errors import RigError, SceneError, ShapeError
from spectralzoom.pipeline.exposures import Taken, match_exposures, taken_with
from spectralzoom.pipeline.frame_indices import FRAME_INDEX, LineTimes, parse_frame_index, times_of_lines
from spectralzoom.pipeline.signal.calibrate import check_frames, find_bad_elements
from spectralzoom.pipeline.source import References

_PART = re.compile(r"raw_(\d{1,12})", re.IGNORECASE)
_REFERENCE = re.compile(r"(dark|white)[A-Za-z_]*", re.IGNORECASE)

Read = Callable[[str], bytes]  # the content of a file by its name
FRAMES_FOR_STUCK = 8  # fewer frames cannot tell an element that never changes from a quiet one


@dataclass(frozen=True)
class Cube:
    """Lines of one file. ``lost`` lines are in its header, but not whole in the file."""

    values: NDArray[np.uint16]  # (line, sample, band), a view of the bytes
    lost: int
    taken: Taken


@dataclass(frozen=True)
class CapturedLines:
    """The whole lines of a capture, in order."""

    values: NDArray[np.uint16]  # (line, sample, band)
    first_frame: int  # number of the first line's frame by the file's name
    times: LineTimes
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class MeanFrame:
    """The mean of a reference's frames."""

    mean: NDArray[np.float32]  # (sample, band) DN
    stuck: NDArray[np.bool_]  # (sample, band) the same number in every frame while the others change
    taken: Taken = field(default_factory=Taken)


def parse_cube(header: str, data: bytes, where: str) -> Cube:
    """Return the lines that are whole in ``data``; ``where`` is the header's name.

    Raises RigError: it is no whole ENVI header, the numbers are not 16-bit BIL, or there are more bytes than it states.
    """
    try:
        found = parse_envi_header(header, where)
    except SceneError as error:
        raise RigError(f"{error}; fetch it again") from error
    kind, lines = found.dtype.str[1:], found.lines or 0
    if (found.interleave, kind) != ("bil", "u2"):
        raise RigError(f"{where}: interleave {found.interleave!r} of {kind}; expected bil and u2, as cameras write")
    if len(data) > found.offset + lines * found.line_bytes:
        raise RigError(
            f"{where} states {found.offset + lines * found.line_bytes} bytes of data, there are {len(data)}; is it "
            "another file's?"
        )
    held = max(len(data) - found.offset, 0) // found.line_bytes
    shape = (held, found.bands, found.samples)
    values: NDArray[Any] = np.ndarray(shape, found.dtype, data, found.offset if held else 0)
    return Cube(values.transpose(0, 2, 1), lines - held, taken_with(where, found.fields, found.settings))


def read_capture(names: Iterable[str], read: Read) -> CapturedLines:
    """Read a capture of one cube from its files, by their names with or without the folder.

    Raises RigError: there is no line or more than one cube, or the header is missing, wrong or states less.
    """
    by_name = {name.rsplit("/", 1)[-1]: name for name in names}
    parts = [match for name in by_name if (match := _PART.fullmatch(name))]
    cube = _read_cube(by_name, parts[0][0], read) if len(parts) == 1 else None
    if cube is None or not len(cube.values):
        raise RigError(
            f"expected one cube with a whole line, got {', '.join(sorted(by_name)) or 'an empty folder'}; capture again"
        )
    first, held = int(parts[0][1]), len(cube.values)
    notes = [f"raw_{first} is cut off: {held} of {held + cube.lost} lines are whole"] if cube.lost else []
    times = LineTimes.unknown(held)
    name = next((name for name in by_name if (match := FRAME_INDEX.fullmatch(name)) and int(match[1]) == first), None)
    if name is None:
        notes.append(f"there is no frame index for raw_{first}")
    else:
        try:
            index = parse_frame_index(read(by_name[name]).decode("utf-8-sig", errors="replace").splitlines(), name)
        except SceneError as error:
            notes.append(str(error))
        else:
            times = times_of_lines(index, first, held, cube.lost)
            notes += [*index.notes, *(f"{name}: {note}" for note in times.notes)]
    return CapturedLines(cube.values.astype(np.uint16, copy=False), first, times, tuple(notes))


def read_references(names: Iterable[str], read: Read) -> dict[str, MeanFrame]:
    """Read the references of a folder by ``dark`` and ``white``; empty without any.

    Raises RigError: one has no header, a wrong one, or another number of frames, or there are two of a kind.
    """
    by_name = {name.rsplit("/", 1)[-1]: name for name in names}
    found: dict[str, MeanFrame] = {}
    for name in sorted(by_name):
        match = _REFERENCE.fullmatch(name)
        if match is None:
            continue
        kind = match[1].lower()
        if kind in found:
            raise RigError(f"two {kind} references among {', '.join(sorted(by_name))}; keep one of them")
        cube = _read_cube(by_name, name, read)
        if cube.lost or not len(cube.values):
            raise RigError(
                f"{by_name[name]} holds {len(cube.values)} whole frames, its header says "
                f"{len(cube.values) + cube.lost}; take both references again"
            )
        found[kind] = replace(mean_frame(cube.values), taken=cube.taken)
    return found


def _read_cube(by_name: Mapping[str, str], name: str, read: Read) -> Cube:
    header = next((found for found in by_name if found.lower() == name.lower() + ".hdr"), None)
    if header is None:
        raise RigError(f"{by_name[name]} has no header {name}.hdr beside it; fetch the folder again")
    text = read(by_name[header]).decode("utf-8", errors="replace")
    return parse_cube(text, read(by_name[name]), by_name[header])


def mean_frame(lines: NDArray[np.integer]) -> MeanFrame:
    """Return the mean of frames (line, sample, band); exact sums, so that their order does not matter.

    Raises ShapeError: there is no frame.
    """
    if lines.ndim != 3 or not lines.size:
        raise ShapeError(f"expected at least one frame (line, sample, band), got {lines.shape}; capture the reference")
    stuck = lines.min(axis=0) == lines.max(axis=0)
    if len(lines) < FRAMES_FOR_STUCK or stuck.mean() > 0.5:  # most elements have some noise
        stuck = np.zeros(stuck.shape, np.bool_)
    return MeanFrame((lines.sum(axis=0, dtype=np.int64) / len(lines)).astype(np.float32), stuck)


def as_references(
    dark: MeanFrame,
    white: MeanFrame,
    *,
    white_reference: ArrayLike = 1.0,
    exposure_ms: float | None = None,
    full_scale_dn: float | None = None,
) -> tuple[References, list[str]]:
    """Join dark and white into the references of a sweep, and return notes.

    An element is bad where its dark frame is stuck, or `pipeline.signal.calibrate.find_bad_elements` finds it bad.
    ``white_reference`` is the value of the white reference, one or (band,). ``exposure_ms`` is that of the lines; a
    frame without a stated exposure has it. Raises RigError: the frames are of two sizes, swapped or without light, or
    the dark frame was taken with an exposure that does not fit.
    """
    if dark.mean.shape != white.mean.shape:
        raise RigError(f"dark is {dark.mean.shape} (sample, band), white {white.mean.shape}; take both anew")
    values = np.broadcast_to(np.asarray(white_reference, np.float32), dark.mean.shape[1]).copy()
    stated = {kind: (one.mean, one.taken) for kind, one in (("dark", dark), ("white", white)) if one.taken.exposures}
    try:
        notes = check_frames("", dark.mean, white.mean, full_scale_dn)
        found = References(dark.mean, white.mean, values, find_bad_elements(dark.mean, white.mean) | dark.stuck)
        if exposure_ms is not None and stated:
            white_ms, more = match_exposures(stated, Taken(), np.array([exposure_ms]), stated=True)
            found, notes = replace(found, exposure_ms=white_ms), [*notes, *more]
    except SceneError as error:
        raise RigError(f"{error}; take both again") from error
    return found, notes
