"""Bytes of a capture's files to lines with their frames' numbers and times, and of its references to mean frames.

The camera's own files are read strictly here, for the loop that waits for them; ``storage.readers.envi_files`` reads
folders from anywhere.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.errors import RigError, SceneError, ShapeError
from pipeline.readings import SIGMA_OF_MEDIAN
from pipeline.rig.camera.camera_texts import FRAME_INDEX, LineTimes, parse_frame_index, place_parts, times_of_lines
from pipeline.rig.camera.envi_headers import EnviHeader, parse_envi_header
from pipeline.signal.calibrate import find_bad_elements
from pipeline.source import References

_PART = re.compile(r"raw_(\d{1,12})", re.IGNORECASE)
_REFERENCE = re.compile(r"(dark|white)[A-Za-z_]*", re.IGNORECASE)
MOST_MISSING = 100_000  # lines between two parts; more means that the names are wrong
MOST_NUMBERS = 1 << 26  # of a line: a hundred times those of any such camera

Read = Callable[[str], bytes]  # the content of a file by its name
LEAST_LIT = 0.5  # fraction of the elements whose white is above their dark
FRAMES_FOR_STUCK = 8  # fewer frames cannot tell an element that never changes from a quiet one
FRAMES_FOR_JUMPS = 16  # fewer frames do not tell how much an element scatters by itself
JUMP_SIGMAS = 12.0  # off its median over the frames: in noise that would be one value in 1e32
LEAST_SIGMA_DN = 1.0  # of whole numbers; below one step a spread means nothing
MOST_JUMPING = 0.01  # of the elements
ODD_FRAME = 3.0  # times the scatter of the frame in the middle
_BLOCK = 64  # frames summed at a time
_SAMPLES = 16  # looked at together


@dataclass(frozen=True)
class CubeLines:
    """Lines of one file. ``lost`` are those that its header states and it does not hold whole."""

    values: NDArray[np.uint16]  # (line, sample, band), a view of the bytes
    lost: int


@dataclass(frozen=True)
class CapturedLines:
    """Lines of a capture, all its files in order. Lines in no file are 0 and not valid."""

    values: NDArray[np.uint16]  # (line, sample, band)
    valid: NDArray[np.bool_]  # (line,)
    first_frame: int  # number of the first line's frame by the first file's name
    times: LineTimes
    notes: tuple[str, ...]


def parse_cube_header(text: str, where: str) -> EnviHeader:
    """Read the header of a cube as the camera writes them.

    RigError where it is no whole ENVI header, a size is missing, or the numbers are not 16-bit BIL.
    """
    try:
        header = parse_envi_header(text, where)
    except SceneError as error:
        raise RigError(f"{error}; fetch it again") from error
    kind = header.dtype.str[1:]
    if (header.interleave, kind) != ("bil", "u2"):
        raise RigError(f"{where}: interleave {header.interleave!r} of {kind}; expected bil and u2, as cameras write")
    if header.lines is None:
        raise RigError(f"{where} does not say lines; fetch it again")
    if header.samples * header.bands > MOST_NUMBERS:
        raise RigError(
            f"{where}: {header.samples} samples and {header.bands} bands; no camera has so many, fetch it again"
        )
    return header


def cube_lines(header: EnviHeader, data: bytes) -> CubeLines:
    """Return the lines that are whole in ``data``, (line, sample, band)."""
    held = min(max(len(data) - header.offset, 0) // header.line_bytes, header.lines or 0)
    shape = (held, header.bands, header.samples)
    values: NDArray[Any] = np.ndarray(shape, header.dtype, data, header.offset if held else 0)
    return CubeLines(values.transpose(0, 2, 1), (header.lines or 0) - held)


def read_capture(names: Iterable[str], read: Read) -> CapturedLines:
    """Put a capture's files together, by their names in the folder, which may stand before them.

    RigError where there is no line, a header is missing, wrong or states less, or the files do not belong together.
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
    try:
        starts = place_parts([(f"raw_{first}", first, len(cube.values)) for first, cube in parts], MOST_MISSING, notes)
    except SceneError as error:
        raise RigError(str(error)) from error
    (first, cube), lost = parts[-1], parts[-1][1].lost
    if lost > MOST_MISSING:
        notes.append(f"the {lost} lines that raw_{first} lacks are not filled up")
        lost = 0
    lines = starts[-1] + len(cube.values) + lost
    alone = len(parts) == 1 and not lost  # then no copy is made: a capture may have a gigabyte
    shape = (lines, *cube.values.shape[1:])
    values = cube.values.astype(np.uint16, copy=False) if alone else np.zeros(shape, np.uint16)
    valid, times = np.zeros(lines, np.bool_), LineTimes.unknown(lines)
    for start, (first, cube) in zip(starts, parts, strict=True):
        stop = start + len(cube.values)
        valid[start:stop] = True
        if not alone:
            values[start:stop] = cube.values
        if cube.lost:
            notes.append(
                f"raw_{first} is cut off: {len(cube.values)} of {len(cube.values) + cube.lost} lines are whole"
            )
        if (own := _times(by_name, first, cube, read, notes)) is not None:
            times.put(start, own)
    return CapturedLines(values, valid, parts[0][0], times, tuple(notes))


def read_references(names: Iterable[str], read: Read) -> dict[str, CubeLines]:
    """Return the reference cubes of a folder by ``dark`` and ``white``, where there are such.

    RigError where one has no header, a wrong one, or frames less or more, or there are two of a kind.
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
    promised = found.offset + (found.lines or 0) * found.line_bytes
    if len(data) > promised:
        raise RigError(f"{by_name[name]} has {len(data)} bytes, its header says {promised}; is it another file's?")
    return cube_lines(found, data)


def _times(by_name: Mapping[str, str], first: int, cube: CubeLines, read: Read, notes: list[str]) -> LineTimes | None:
    """Return the times of a part's lines by its index; None where there is none that can be read."""
    name = next((name for name in by_name if (match := FRAME_INDEX.fullmatch(name)) and int(match[1]) == first), None)
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


@dataclass(frozen=True)
class MeanFrame:
    """The mean of a reference's frames."""

    mean: NDArray[np.float32]  # (sample, band) DN
    noise: NDArray[np.float32]  # (sample, band) DN, standard deviation of one frame; 0 for a single frame
    frames: int
    stuck: NDArray[np.bool_]  # (sample, band) the same number in every frame while the others change
    jumping: NDArray[np.bool_]  # (sample, band) further off its median in some frame than noise goes
    odd_frames: tuple[int, ...]  # that show something else than the others: shifted, or in another light
    notes: tuple[str, ...]


def mean_frame(lines: NDArray[np.integer]) -> MeanFrame:
    """Average frames (line, sample, band); exact sums, so that the order of frames does not matter.

    All frames look at the same thing, so an element scatters about its median by its noise alone: by 12 sigma it jumps.
    Sigma is 1.4826 / sqrt(2) of the median step from frame to frame, which one change amid the frames does not widen.
    It is at least that of most elements, and 1 DN. A frame whose scatter about the medians, each at most those 12
    sigma, is 3 times that of most frames shows something else. ShapeError where there is no frame.
    """
    if lines.ndim != 3 or not lines.size:
        raise ShapeError(f"expected at least one frame (line, sample, band), got {lines.shape}; capture the reference")
    count = len(lines)
    total, squares = np.zeros(lines.shape[1:], np.int64), np.zeros(lines.shape[1:], np.int64)
    for start in range(0, count, _BLOCK):
        block = lines[start : start + _BLOCK].astype(np.int64)
        total += block.sum(axis=0)
        squares += (block * block).sum(axis=0)
    spread = count * squares - total * total  # whole numbers: nothing cancels
    noise = np.sqrt(spread / (count * max(count - 1, 1)))
    telling = count >= FRAMES_FOR_STUCK and np.median(noise) > 0  # most have some noise
    stuck = noise == 0 if telling else np.zeros(noise.shape, np.bool_)
    notes = [f"the mean of {count} frames; {np.count_nonzero(stuck)} of {stuck.size} elements are stuck"]
    if count < FRAMES_FOR_STUCK:
        notes.append(f"{count} frames cannot tell stuck elements; take {FRAMES_FOR_STUCK} or more")
    jumping, odd = _strays(lines)
    if jumping.any():
        notes.append(f"{np.count_nonzero(jumping)} of {jumping.size} elements jump amid the frames")
    return MeanFrame(
        (total / count).astype(np.float32), noise.astype(np.float32), count, stuck, jumping, odd, tuple(notes)
    )


def as_references(
    dark: MeanFrame, white: MeanFrame, *, white_reference: ArrayLike = 1.0
) -> tuple[References, tuple[str, ...]]:
    """Join dark and white into the references of a sweep, and say what was found.

    An element is bad where its dark frame is stuck, where either jumps amid its frames, or where
    :func:`pipeline.signal.calibrate.find_bad_elements` says so.

    ``white_reference`` is the value of the white reference, one or (band,). RigError where the frames are of two sizes,
    swapped, without light, do not show the same throughout, or too many elements would be bad.
    """
    if dark.mean.shape != white.mean.shape:
        raise RigError(f"dark is {dark.mean.shape} (sample, band), white {white.mean.shape}; take both anew")
    values = np.asarray(white_reference, np.float32)
    if values.shape not in ((), (dark.mean.shape[1],)):
        raise RigError(
            f"panel has shape {values.shape}, expected one value or one for each of {dark.mean.shape[1]} bands"
        )
    for name, frame in (("dark", dark), ("white", white)):
        fraction = np.count_nonzero(frame.jumping) / frame.jumping.size
        if frame.odd_frames:
            first = ", ".join(map(str, frame.odd_frames[:5]))
            raise RigError(
                f"{len(frame.odd_frames)} of {frame.frames} frames of the {name} reference show something else than "
                f"the others ({first}); did the light change, or are bytes lost or added in it? Take both again"
            )
        if fraction > max(MOST_JUMPING, 1 / frame.jumping.shape[0]):
            raise RigError(
                f"{100 * fraction:.1f} % of the elements jump amid the frames of the {name} reference, at most "
                f"{100 * MOST_JUMPING:g} % can; did the light change, or are bytes lost or added in it? Take both again"
            )
    lit = np.count_nonzero(white.mean > dark.mean) / dark.mean.size
    if lit < LEAST_LIT:
        raise RigError(
            f"white is above dark in {100 * lit:.0f} % of the elements; are they swapped, or was the lamp off?"
        )
    bad = find_bad_elements(dark.mean, white.mean, saturated_dn=None)
    bad |= dark.stuck | dark.jumping | white.jumping
    notes = (
        *(f"dark: {note}" for note in dark.notes),
        *(f"white: {note}" for note in white.notes),
        f"{np.count_nonzero(bad)} of {bad.size} elements are bad",
    )
    return References(dark.mean, white.mean, np.broadcast_to(values, dark.mean.shape[1]).copy(), bad), notes


def _strays(lines: NDArray[np.integer]) -> tuple[NDArray[np.bool_], tuple[int, ...]]:
    """Return outlier elements (sample, band) and outlier frames; none where there are too few frames."""
    count, samples, bands = lines.shape
    jumping, scatter = np.zeros((samples, bands), np.bool_), np.zeros(count)
    if count < FRAMES_FOR_JUMPS:
        return jumping, ()
    blocks = [slice(start, start + _SAMPLES) for start in range(0, samples, _SAMPLES)]
    middle = [np.median(lines[:, block], axis=0) for block in blocks]
    sigma = [
        SIGMA_OF_MEDIAN / np.sqrt(2) * np.median(np.abs(np.diff(lines[:, block].astype(np.int32), axis=0)), axis=0)
        for block in blocks
    ]
    least = max(float(np.median(np.concatenate(sigma))), LEAST_SIGMA_DN)
    for block, mid, own in zip(blocks, middle, sigma, strict=True):
        off = np.abs(lines[:, block] - mid) / np.maximum(own, least)
        jumping[block] = (off > JUMP_SIGMAS).any(axis=0)
        scatter += (np.minimum(off, JUMP_SIGMAS) ** 2).sum(axis=(1, 2))
    usual = max(float(np.median(scatter)), samples * bands)  # one sigma each
    return jumping, tuple(np.flatnonzero(scatter > ODD_FRAME**2 * usual).tolist())
