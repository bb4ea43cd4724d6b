"""Captures of a sweep: their names, the vector memory during them, and the positions of their lines.

A record of positions names the method that gave them, and their possible error. Times of lines are the mirror's; the
camera stamps its frames in whole microseconds of its own clock.

A capture's prefix, which begins its folder's name, identifies the lines of the sweep that it takes.
``coarse-0_cy-31p5_0p5_96x16x16_0`` is the coarse sweep ``coarse-0``, whose lines lie along y. Its swath is at -31.5 px,
it starts at scan coordinate 0.5 px, and it has 96 lines of 16 held positions, binned by 16. The capture begins at its
line 0. ``p`` is the decimal point; a number that needs more characters than its bits is ``b`` and those in base 32.
"""

from __future__ import annotations

import base64
import re
import struct
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import RigError, SettingsError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.mirror import direction_to_scene, position_to_direction
from pipeline.geometry.scan import Axis, Sweep, exposing, line_positions, memory_loads, sweep_positions
from pipeline.rig.camera.camera_cubes import CapturedLines
from pipeline.rig.device_settings import Pulses, check_prefix
from pipeline.rig.mirror.mirror_controller import wire_positions

Floats = NDArray[Any]  # float64
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
Span = tuple[float, float]  # moments between which a command took effect: sent and acknowledged [s]


@dataclass(frozen=True)
class FrameTimes:
    """Frame times by the camera; -1 where it gives none. Lines are in the order of capture."""

    number: Ints  # (line,) frame numbers, the capture's first frame 0
    stamp_us: Ints  # (line,) by the camera's clock, assumed to be the exposure's start
    exposure_ms: float
    period_ms: float


def mend_times(frames: FrameTimes) -> tuple[Ints, Ints, list[str]]:
    """Return a stamp and a number for every line, and notes on those that were made up.

    A line without a stamp follows its neighbours at the frame period. A later stamp counts, since a frame may have been
    dropped. Raises RigError: the stamps go back.
    """
    number, notes = whole_numbers(frames.number)
    line = np.arange(len(number))
    if (number < 0).all():
        number = line
        notes.append("no line has a frame number: lines are taken for frames in order")
    number = np.rint(np.interp(line, line[number >= 0], number[number >= 0])).astype(np.int64)
    nominal_us = number * frames.period_ms * 1e3
    good = frames.stamp_us >= 0
    if not good.any():
        notes.append("no line has a time stamp: frames are taken to follow their period")
        return np.rint(nominal_us).astype(np.int64), number, notes
    if not good.all():
        notes.append(f"{np.count_nonzero(~good)} time stamps are missing, and follow their neighbours")
    stamps = frames.stamp_us[good]
    if (np.diff(stamps) < 0).any():
        raise RigError("the time stamps of its frames go back; was the camera's clock set? Capture again")
    delay_us = np.interp(line, line[good], (stamps - stamps[0]) - nominal_us[good])
    return stamps[0] + np.rint(delay_us + nominal_us).astype(np.int64), number, notes


def whole_numbers(number: Ints) -> tuple[Ints, list[str]]:
    """Return the frame numbers and notes; a gap is filled where the numbers around it determine it."""
    filled, notes = number.copy(), []
    known = np.flatnonzero(number >= 0)
    for left, right in pairwise(known.tolist()):
        if right - left > 1 and number[right] - number[left] == right - left:
            filled[left:right] = number[left] + np.arange(right - left)
    steps = np.diff(filled[filled >= 0])
    if lost := int(np.sum(steps[steps > 1] - 1)):
        notes.append(f"{lost} frames are missing between the lines")
    if twice := int(np.count_nonzero(steps <= 0)):
        notes.append(f"{twice} frames are there twice or out of order")
    return filled, notes


@dataclass(frozen=True)
class MirrorScanPath:
    """Path of the mirror by its clock: positions of its log, or of a path that it played."""

    time_s: Floats  # (sample,) in order
    position: Floats  # (sample, 2) device X and Y


def played_scan_path(position: Floats, rate_hz: float) -> MirrorScanPath:
    """Return the scan path of positions (held, 2) that are each held for 1 / ``rate_hz``, one after the other."""
    ends = np.repeat(np.arange(len(position) + 1), 2)[1:-1] / rate_hz
    return MirrorScanPath(ends, np.repeat(position, 2, axis=0))


@dataclass(frozen=True)
class LinePositions:
    """Mirror positions of lines, and the method that gave them. NaN where ``valid`` is False."""

    position: Floats  # (line, 2) device X and Y at mid exposure
    valid: Bools  # (line,)
    method: Literal["trigger", "log", "command"]
    residual_us: float | None  # half of the uncertainty of the commands' times; None where it is not measured
    residual_px: float | None  # the same on the scene, at the mirror's speed
    offset_s: float | None = None  # of the first frame on the scan path
    notes: tuple[str, ...] = ()


def lines_by_trigger(frames: FrameTimes, positions: Floats, *, index_at_end: int | None = None) -> LinePositions:
    """Return the position that each frame's trigger played: one vector index per frame.

    ``positions`` (held, 2) are those of the path. ``index_at_end``, the vector index read after the capture, shows
    whether frames are missing. Raises RigError: the counts of triggers and frames differ, or no frame has a number.
    """
    number, notes = whole_numbers(frames.number)
    if not (number >= 0).any():
        raise RigError("no line has a frame number, so its trigger is not known; fetch frameIndex")
    if index_at_end is not None and index_at_end != number.max():
        raise RigError(
            f"the mirror counted {index_at_end + 1} triggers, the camera's last frame is number "
            f"{number.max()}: a frame or an edge was lost, and lines after it would be off; look at the trigger's cable"
        )
    valid = (number >= 0) & (number < len(positions))
    if beyond := int(np.count_nonzero(number >= len(positions))):
        notes.append(f"{beyond} lines are beyond the {len(positions)} positions of the path")
    counted = index_at_end is not None
    notes.append("positions are those sent, not measured" + ("" if counted else "; triggers were not counted"))
    found = np.full((len(number), 2), np.nan)
    found[valid] = positions[number[valid]]
    residual = 0.0 if counted else None
    return LinePositions(found, valid, "trigger", residual, residual, notes=tuple(notes))


def lines_by_time(
    frames: FrameTimes,
    camera: LineCamera,
    scan_path: MirrorScanPath,
    began_s: Span,
    capture_s: Span,
    method: Literal["log", "command"],
) -> LinePositions:
    """Return the scan path's position at mid exposure of each line, by the times of the commands.

    ``began_s`` spans the start of the log or path, ``capture_s`` that of the capture, by one clock. The delay between a
    command and the first frame is unknown, so a constant offset of the lines remains; registration corrects it. Raises
    RigError: the stamps go back.
    """
    stamp, number, notes = mend_times(frames)
    first_s = float(np.mean(capture_s) - np.mean(began_s)) + float(scan_path.time_s[0])
    exposed_s = first_s + number[0] * frames.period_ms * 1e-3 + (stamp - stamp[0]) * 1e-6
    middle_s = exposed_s + frames.exposure_ms * 1e-3 / 2
    valid = (middle_s >= scan_path.time_s[0]) & (middle_s <= scan_path.time_s[-1])
    if not valid.all():
        notes.append(f"outside of the {method}'s time: {np.count_nonzero(~valid)} of {len(valid)} lines")
    found = np.where(valid[:, None], _at(scan_path, middle_s), np.nan)
    unknown_s = float(np.ptp(began_s) + np.ptp(capture_s)) / 2
    px = _apart_px(scan_path, camera, (middle_s[valid], middle_s[valid] + unknown_s))
    notes.append(f"software timing: a constant line offset of about {px:.2g} px remains")
    return LinePositions(found, valid, method, unknown_s * 1e6, px, first_s, tuple(notes))


def _at(scan_path: MirrorScanPath, time_s: Floats) -> Floats:
    """Return the logged positions between samples, (time, 2)."""
    return np.stack([np.interp(time_s, scan_path.time_s, scan_path.position[:, axis]) for axis in (0, 1)], axis=-1)


def _apart_px(scan_path: MirrorScanPath, camera: LineCamera, times: tuple[Floats, Floats]) -> float:
    """Return the root mean square distance that the view moves between two times of each line. [px]"""
    if not len(times[0]):
        return 0.0
    one, other = (direction_to_scene(position_to_direction(_at(scan_path, time_s))) for time_s in times)
    return float(np.sqrt(np.mean(np.sum((one - other) ** 2, axis=-1))) / camera.ifov_rad)


LEAD = 1  # cells before the first line's: a triggered unit plays its first cell at the run command, assumed
REFERENCES = "references"  # prefix of a capture for the dark and white frames in its folder
_LONGEST = 14  # b and 64 bits
_NUMBER = r"(-?\d+(?:p\d+)?|b[0-9a-v]{13})"
_FORM = re.compile(rf"(.+)_([cf])([xy]){_NUMBER}_{_NUMBER}_(\d+)x(\d+)x(\d+)(?:x(\d+))?_(\d+)", re.DOTALL)
_KINDS: dict[str, Literal["coarse", "fine"]] = {"c": "coarse", "f": "fine"}


@dataclass(frozen=True)
class Announced:
    """A sweep, and the line of it that a capture's first frame takes."""

    sweep: Sweep
    first: int


def capture_prefix(sweep: Sweep, first: int = 0) -> str:
    """Return the prefix of a capture of a sweep's lines from ``first`` on.

    Raises SettingsError: the sweep's name is too long, or cannot be part of a folder's name.
    """
    sizes = f"{sweep.lines}x{sweep.step}x{sweep.binning}" + ("" if sweep.held is None else f"x{sweep.held}")
    place = f"{sweep.kind[0]}{sweep.along}{_written(sweep.swath_px)}_{_written(sweep.start_px)}"
    prefix = f"{sweep.name}_{place}_{sizes}_{first}"
    check_prefix(prefix)
    return prefix


def announced(prefix: str) -> Announced | None:
    """Return the sweep of a capture's prefix; None where it names none."""
    found = _FORM.fullmatch(prefix)
    if found is None:
        return None
    name, kind, along, strip, start, lines, step, binning, held, first = found.groups()
    axis: Axis = "x" if along == "x" else "y"
    sizes = int(lines), int(step), int(binning)
    if min(sizes) < 1 or int(first) >= sizes[0] or held == "0":
        return None
    of_exposure = None if held is None else int(held)
    sweep = Sweep(name, _KINDS[kind], axis, _number(strip), _number(start), *sizes, held=of_exposure)
    return Announced(sweep, int(first))


def _written(value: float) -> str:
    short = repr(float(value)).removesuffix(".0")
    if len(short) < _LONGEST and set(short) <= set("-.0123456789"):
        return short.replace(".", "p")
    return "b" + base64.b32hexencode(struct.pack(">d", value)).decode().lower().rstrip("=")


def _number(text: str) -> float:
    if not text.startswith("b"):
        return float(text.replace("p", "."))
    return float(struct.unpack(">d", base64.b32hexdecode(f"{text[1:].upper()}==="))[0])


@dataclass(frozen=True)
class CapturePath:
    """Lines ``first`` to ``stop`` of a sweep, and the positions held for them: those of the plan, as float32."""

    sweep: Sweep
    first: int
    stop: int
    cells: NDArray[np.float32]  # (lead + held, 2)
    middle: NDArray[np.float32]  # (line, 2) at mid exposure
    rate_hz: float  # of cells, for a path that no edge drives
    triggered: bool  # one edge per cell; then the first line's first position is held twice

    @property
    def lines(self) -> int:
        """Lines of the capture."""
        return self.stop - self.first

    def frames_at(self, index: int) -> int | None:
        """Return the number of complete frames where cell ``index`` played last; None within a line."""
        frames, rest = divmod(index + 1 - LEAD, self.sweep.positions)
        return None if rest else frames


def next_path(sweep: Sweep, first: int, camera: LineCamera, *, vector_pairs: int, triggered: bool) -> CapturePath:
    """Return the path of as many of the sweep's lines from ``first`` on as the vector memory holds.

    Raises SettingsError: the positions of one line do not fit the memory. Raises PoseError: one is beyond the disk.
    """
    if vector_pairs <= LEAD:
        raise SettingsError(f"a vector memory of {vector_pairs} pairs holds no line; expected more than {LEAD}")
    rest = replace(sweep, lines=sweep.lines - first)
    stop = first + memory_loads([rest], vector_pairs - LEAD)[0].parts[0].lines[1]
    return path_of(sweep, (first, stop), camera, triggered=triggered)


def path_of(sweep: Sweep, lines: tuple[int, int], camera: LineCamera, *, triggered: bool) -> CapturePath:
    """Return the path of some of the sweep's lines; PoseError where a position is beyond the disk."""
    held: NDArray[Any] = sweep_positions(sweep, camera)[slice(*lines)].reshape(-1, 2)
    lead = held[:LEAD] if triggered else held[:0]
    cells, middle = (
        wire_positions(some) for some in (np.concatenate([lead, held]), line_positions(sweep, camera)[slice(*lines)])
    )
    rate_hz = sweep.positions * 1000 / exposing(camera, sweep).frame_ms
    return CapturePath(sweep, *lines, cells, middle, rate_hz, triggered)


def can_trigger(pulses: Pulses, sweep: Sweep) -> bool:
    """Return whether the pulses at the mirror's input step through this sweep: it needs one per position."""
    return pulses == "position" or (pulses == "frame" and sweep.positions == 1)


@dataclass(frozen=True)
class CaptureRecord:
    """Lines ``first`` to ``stop`` of a sweep, in a folder of the camera."""

    sweep: Sweep
    first: int
    stop: int
    folder: str
    triggered: bool
    run_s: tuple[float, float]  # sent and acknowledged, by the drivers' clock
    capture_s: tuple[float, float]
    index_at_end: int | None = None  # cell of the path that played last
    log: LoggedPath | None = None
    spent: str = ""  # why it gives no further line; empty where it may


@dataclass(frozen=True)
class LoggedPath:
    """A log of measured positions beside the fetched files: (sample, 2) big-endian float32."""

    name: str
    rate_hz: float
    started_s: float
    start_error_s: float
    crc32: int


class UnusableCaptureError(RigError):
    """A capture gives no line, or no further one, and is taken again."""


@dataclass(frozen=True)
class LocatedLines:
    """A capture's lines, in the order of the sweep."""

    row: NDArray[np.int64]  # (line,) of the captured values; -1 of a line that the camera dropped
    positions: LinePositions  # by row
    stamp_us: NDArray[np.int64]  # (row,) by the camera's clock; -1 where it gives none

    def is_valid(self, line: int) -> bool:
        """Return whether a line, counted from the capture's first, was captured and has a position."""
        row = int(self.row[line])
        return row >= 0 and bool(self.positions.valid[row])


def locate_lines(
    captured: CapturedLines,
    path: CapturePath,
    taken: CaptureRecord,
    camera: LineCamera,
    scan_path: MirrorScanPath | None,
) -> LocatedLines:
    """Return the row and position of each line of the path, up to the last complete one.

    Raises UnusableCaptureError: frames cannot be assigned to mirror positions without contradiction.
    """
    held = int(np.flatnonzero(captured.valid)[-1]) + 1
    number = captured.times.frame[:held]
    if (number >= 0).any():
        number = np.where(number >= 0, number - captured.first_frame, -1)
    elif len(captured.values) == path.lines:  # no number, and no line is missing
        number = np.arange(held)
    exposed = exposing(camera, path.sweep)
    frames = FrameTimes(number, captured.times.stamp_us[:held], exposed.exposure_ms, exposed.frame_ms)
    try:
        tied = _positions(frames, path, taken, camera, scan_path, total=len(captured.values))
    except RigError as error:
        raise UnusableCaptureError(f"{taken.folder}: {error}") from error
    row = np.full(min(int(number.max()) + 1, path.lines), -1, np.int64)
    rows = np.flatnonzero(captured.valid[:held] & (number >= 0) & (number < path.lines))
    row[number[rows]] = rows
    return LocatedLines(row, tied, frames.stamp_us)


def _positions(
    frames: FrameTimes,
    path: CapturePath,
    taken: CaptureRecord,
    camera: LineCamera,
    scan_path: MirrorScanPath | None,
    *,
    total: int,
) -> LinePositions:
    """Return the positions of lines by trigger edges, else by the mirror's log, else by the commands' times."""
    if taken.triggered:
        counted = None if taken.index_at_end is None else path.frames_at(taken.index_at_end)
        taken_in_all = max(total, int(frames.number.max()) + 1)
        if taken.index_at_end is not None and counted != taken_in_all:
            raise RigError(
                f"the mirror stands at cell {taken.index_at_end} of its path, after {taken_in_all} frames cell "
                f"{taken_in_all * path.sweep.positions} was expected: edges were lost, or are not one per position "
                "(see pulses in [rig])"
            )
        last = None if counted is None else int(frames.number.max())
        return lines_by_trigger(frames, path.middle.astype(np.float64), index_at_end=last)
    if scan_path is not None and taken.log is not None and len(scan_path.position) > 1:
        began_s = (taken.log.started_s - taken.log.start_error_s, taken.log.started_s)
        return lines_by_time(frames, camera, scan_path, began_s, taken.capture_s, "log")
    played = played_scan_path(path.cells.astype(np.float64), path.rate_hz)
    return lines_by_time(frames, camera, played, taken.run_s, taken.capture_s, "command")
