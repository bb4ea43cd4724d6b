"""Captures of a sweep: what each is called, what the vector memory holds during it, and where its lines lie then.

The records of the positions name the way that was used, and its possible error. Times of lines are the mirror's; the
camera stamps its frames in whole microseconds of its own clock.

A capture's prefix says which lines of which sweep it takes, so that a folder tells what it holds.
``coarse-0_cy-31p5_0p5_96x16x16_0`` is the coarse sweep ``coarse-0``, whose lines lie along y. It is on strip -31.5 px,
from scan coordinate 0.5 px on, of 96 lines of 16 held positions, binned by 16. The capture begins at its line 0. ``p``
is the decimal point; a number that takes more room than its bits is ``b`` and those, to base 32.
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
from pipeline.rig.device_settings import Pulses, check_capture
from pipeline.rig.mirror.mirror_controller import wire_positions

Floats = NDArray[Any]  # float64
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
Span = tuple[float, float]  # moments between which a command took effect: sent and acknowledged [s]

_WINDOW = 7  # neighbours that say whether a stamp strayed: up to three strays in a row are seen


@dataclass(frozen=True)
class FrameTimes:
    """Frame times by the camera; -1 where it says nothing. Lines are in the order in which they were taken."""

    number: Ints  # (line,) frame numbers, the capture's first frame 0
    stamp_us: Ints  # (line,) by the camera's clock, taken for the exposure's start: its papers do not say which moment
    exposure_ms: float
    period_ms: float


def mend_times(frames: FrameTimes) -> tuple[Ints, Ints, list[str]]:
    """Return every line a stamp and a number, and say what was done.

    Frames come at a steady rate or later, never sooner. A stamp off its neighbours' by half a period strayed; where all
    after one are early the clock was set back. Both follow their neighbours then; so do lines without a stamp. A later
    stamp counts, since a frame may have been dropped.
    """
    number, notes = whole_numbers(frames.number)
    if (number < 0).all():
        number = np.arange(len(number))
        notes.append("no line has a frame number: lines are taken for frames in order")
    line = np.arange(len(number))
    number = np.rint(np.interp(line, line[number >= 0], number[number >= 0])).astype(np.int64)
    period_us = frames.period_ms * 1e3
    good = frames.stamp_us >= 0
    if not good.any():
        notes.append("no line has a time stamp: frames are taken to follow their period")
        return np.rint(number * period_us).astype(np.int64), number, notes
    origin = int(frames.stamp_us[good][0])
    late = (frames.stamp_us - origin) - number * period_us  # of frames at the rate that was set
    good[good] = ~_strayed(late[good], period_us)
    if not good.all():
        notes.append(f"{np.count_nonzero(~good)} time stamps are missing or stray, and follow their neighbours")
    back = np.minimum(np.diff(late[good]) + period_us / 2, 0)
    back = np.where(back < 0, back - period_us / 2, 0)
    if back.any():
        notes.append(f"the camera's clock was set back {np.count_nonzero(back)} times, by {-back.sum() / 1e6:.6g} s")
    mended = late[good] - np.concatenate([[0.0], np.cumsum(back)])
    whole = np.interp(line, line[good], mended) + number * period_us
    return origin + np.rint(whole).astype(np.int64), number, notes


def whole_numbers(number: Ints) -> tuple[Ints, list[str]]:
    """Return the frame numbers and findings; gaps are filled where the lines around them leave no doubt."""
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


def _strayed(late: Floats, period_us: float) -> Bools:
    """Return which stamps differ from the median of their neighbours by half a period."""
    if len(late) < 3:
        return np.zeros(len(late), np.bool_)
    window = min(_WINDOW, len(late) - 1 + len(late) % 2)  # odd
    around = np.lib.stride_tricks.sliding_window_view(np.pad(late, window // 2, mode="edge"), window)
    strayed: Bools = np.abs(late - np.median(around, axis=1)) > period_us / 2
    return strayed


@dataclass(frozen=True)
class MirrorScanPath:
    """Path of the mirror, by its clock: positions that its log measured, or those of a path that it played."""

    time_s: Floats  # (sample,) in order
    position: Floats  # (sample, 2) device X and Y


def played_scan_path(position: Floats, rate_hz: float) -> MirrorScanPath:
    """Return the track of a path: each of the positions (held, 2) held for 1 / ``rate_hz``, one after the other."""
    ends = np.repeat(np.arange(len(position) + 1), 2)[1:-1] / rate_hz
    return MirrorScanPath(ends, np.repeat(position, 2, axis=0))


@dataclass(frozen=True)
class LinePositions:
    """Mirror positions of lines, and how they were found. NaN where ``valid`` is False."""

    position: Floats  # (line, 2) device X and Y at mid exposure
    valid: Bools  # (line,)
    method: Literal["trigger", "log", "command"]
    residual_us: float | None  # half of what is not known of the commands' times; None where nothing measures it
    residual_px: float | None  # the same on the scene, at the mirror's speed
    offset_s: float | None = None  # of the first frame on the track
    notes: tuple[str, ...] = ()


def lines_by_trigger(frames: FrameTimes, positions: Floats, *, index_at_end: int | None = None) -> LinePositions:
    """Take the position that each frame's trigger played: one vector index a frame, whatever the clocks say.

    ``positions`` (held, 2) are those of the path. ``index_at_end``, the vector index read after the capture, shows
    whether frames were lost without a trace. RigError where the mirror counted other triggers than the camera frames,
    or the camera numbers no frame.
    """
    number, notes = whole_numbers(frames.number)
    if not (number >= 0).any():
        raise RigError("no line has a frame number, so which trigger each belongs to is not known; fetch frameIndex")
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
    """Take the track's position at mid exposure of each line, counted from the commands' times.

    ``began_s`` is when the log or the path began, ``capture_s`` when the capture did, by one clock. The time between a
    command and the first frame is unknown. A constant offset of the lines stays, for registration of sweeps that go
    both ways. A stamp that goes back or is missing is made up from its neighbours.
    """
    stamp, number, notes = mend_times(frames)
    first_s = float(np.mean(capture_s) - np.mean(began_s)) + float(scan_path.time_s[0])
    exposed_s = first_s + number[0] * frames.period_ms * 1e-3 + (stamp - stamp[0]) * 1e-6
    middle_s = exposed_s + frames.exposure_ms * 1e-3 / 2
    valid = (middle_s >= scan_path.time_s[0]) & (middle_s <= scan_path.time_s[-1])
    if not valid.all():
        notes.append(f"{np.count_nonzero(~valid)} of {len(valid)} lines lie outside of the {method}'s time")
    found = np.where(valid[:, None], _at(scan_path, middle_s), np.nan)
    unknown_s = float(np.ptp(began_s) + np.ptp(capture_s)) / 2
    px = _apart_px(scan_path, camera, (middle_s[valid], middle_s[valid] + unknown_s))
    notes.append(f"software timing: a constant line offset of about {px:.2g} px stays")
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


LEAD = 1  # cells before the first line's: a unit that waits for edges takes its first cell at the run command, assumed
REFERENCES = "references"  # prefix of a capture that is made for the dark and white frames in its folder
_LONGEST = 14  # b and 64 bits
_NUMBER = r"(-?\d+(?:p\d+)?|b[0-9a-v]{13})"
_FORM = re.compile(rf"(.+)_([cf])([xy]){_NUMBER}_{_NUMBER}_(\d+)x(\d+)x(\d+)(?:x(\d+))?_(\d+)", re.DOTALL)
_KINDS: dict[str, Literal["coarse", "fine"]] = {"c": "coarse", "f": "fine"}


@dataclass(frozen=True)
class Announced:
    """A sweep, and its line that a capture's first frame takes."""

    sweep: Sweep
    first: int


def capture_prefix(sweep: Sweep, first: int = 0) -> str:
    """Return the prefix of a capture of a sweep's lines from ``first`` on.

    SettingsError where the sweep's name holds what a folder's name must not, or is too long.
    """
    sizes = f"{sweep.lines}x{sweep.step}x{sweep.binning}" + ("" if sweep.held is None else f"x{sweep.held}")
    place = f"{sweep.kind[0]}{sweep.along}{_written(sweep.swath_px)}_{_written(sweep.start_px)}"
    prefix = f"{sweep.name}_{place}_{sizes}_{first}"
    check_capture(0, 0, prefix)
    return prefix


def announced(prefix: str) -> Announced | None:
    """Read a capture's prefix; None where it announces no sweep."""
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
    """Lines ``first`` to ``stop`` of a sweep, and the positions that are held for them.

    Positions are those of the plan, rounded to float32 as they go over the wire.
    """

    sweep: Sweep
    first: int
    stop: int
    cells: NDArray[np.float32]  # (lead + held, 2)
    middle: NDArray[np.float32]  # (line, 2) at mid exposure
    rate_hz: float  # of cells, for a path that no edge drives
    triggered: bool  # by one edge a cell; then the first line's first position is held twice

    @property
    def lines(self) -> int:
        """Lines of the capture."""
        return self.stop - self.first

    def frames_at(self, index: int) -> int | None:
        """Return how many frames had their edges counted, where the cell ``index`` was played last.

        None within a line.
        """
        frames, rest = divmod(index + 1 - LEAD, self.sweep.positions)
        return None if rest else frames


def next_path(sweep: Sweep, first: int, camera: LineCamera, *, vector_pairs: int, triggered: bool) -> CapturePath:
    """Return the path of the sweep's lines from ``first`` on, as many as the vector memory takes.

    SettingsError where the positions of one line do not fit the memory, PoseError where one is beyond the disk.
    """
    if vector_pairs <= LEAD:
        raise SettingsError(f"a vector memory of {vector_pairs} pairs holds no line; expected more than {LEAD}")
    rest = replace(sweep, lines=sweep.lines - first)
    stop = first + memory_loads([rest], vector_pairs - LEAD)[0].parts[0].lines[1]
    return path_of(sweep, (first, stop), camera, triggered=triggered)


def path_of(sweep: Sweep, lines: tuple[int, int], camera: LineCamera, *, triggered: bool) -> CapturePath:
    """Return the path of some of the sweep's lines; PoseError where a position is beyond the mirror's disk."""
    held: NDArray[Any] = sweep_positions(sweep, camera)[slice(*lines)].reshape(-1, 2)
    lead = held[:LEAD] if triggered else held[:0]
    cells, middle = (
        wire_positions(some) for some in (np.concatenate([lead, held]), line_positions(sweep, camera)[slice(*lines)])
    )
    rate_hz = sweep.positions * 1000 / exposing(camera, sweep).frame_ms
    return CapturePath(sweep, *lines, cells, middle, rate_hz, triggered)


def can_trigger(pulses: Pulses, sweep: Sweep) -> bool:
    """Return whether the pulses at the mirror's input step through this sweep: one a position is needed."""
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
    index_at_end: int | None = None  # cell of the path that was played last
    log: LoggedPath | None = None
    spent: str = ""  # why no line is to be had from it any more


@dataclass(frozen=True)
class LoggedPath:
    """A log of measured positions that is kept beside the files: (sample, 2) big-endian float32."""

    name: str
    rate_hz: float
    started_s: float
    start_error_s: float
    crc32: int


class UntiedError(RigError):
    """A capture from which no line, or no further one, is to be had: it is taken again."""


@dataclass(frozen=True)
class PlacedLines:
    """A capture's lines by their order in the sweep."""

    row: NDArray[np.int64]  # (line,) of the captured values; -1 of a line that the camera dropped
    tied: LinePositions  # by row
    stamp_us: NDArray[np.int64]  # (row,) by the camera's clock; -1 where it says nothing

    def is_valid(self, line: int) -> bool:
        """Return whether a line, counted from the capture's first, is there with its position."""
        row = int(self.row[line])
        return row >= 0 and bool(self.tied.valid[row])


def place_lines(
    captured: CapturedLines,
    path: CapturePath,
    taken: CaptureRecord,
    camera: LineCamera,
    scan_path: MirrorScanPath | None,
) -> PlacedLines:
    """Return each line of the path its row of the capture, up to the last one that is there whole.

    UntiedError where nothing, or what contradicts itself, ties frames to the mirror.
    """
    held = int(np.flatnonzero(captured.valid)[-1]) + 1
    number = captured.times.frame[:held]  # from the capture's start; rows in order if none is given or can be missing
    if (number >= 0).any():
        number = np.where(number >= 0, number - captured.first_frame, -1)
    elif len(captured.values) == path.lines:
        number = np.arange(held)
    exposed = exposing(camera, path.sweep)
    frames = FrameTimes(number, captured.times.stamp_us[:held], exposed.exposure_ms, exposed.frame_ms)
    try:
        tied = _tied(frames, path, taken, camera, scan_path, total=len(captured.values))
    except RigError as error:
        raise UntiedError(f"{taken.folder}: {error}") from error
    row = np.full(min(int(number.max()) + 1, path.lines), -1, np.int64)
    rows = np.flatnonzero(captured.valid[:held] & (number >= 0) & (number < path.lines))
    row[number[rows]] = rows
    return PlacedLines(row, tied, frames.stamp_us)


def _tied(
    frames: FrameTimes,
    path: CapturePath,
    taken: CaptureRecord,
    camera: LineCamera,
    scan_path: MirrorScanPath | None,
    *,
    total: int,
) -> LinePositions:
    """Return the positions by the edges that stepped the mirror, else by its log, else by the commands' times."""
    if taken.triggered:
        counted = None if taken.index_at_end is None else path.frames_at(taken.index_at_end)
        taken_in_all = max(total, int(frames.number.max()) + 1)
        if taken.index_at_end is not None and counted != taken_in_all:
            raise RigError(
                f"the mirror stands at cell {taken.index_at_end} of its path, after {taken_in_all} frames cell "
                f"{taken_in_all * path.sweep.positions} was expected: edges were lost, or are not one a position (see "
                f"pulses in [rig])"
            )
        last = None if counted is None else int(frames.number.max())
        return lines_by_trigger(frames, path.middle.astype(np.float64), index_at_end=last)
    if (
        scan_path is not None and taken.log is not None and len(scan_path.position) > 1
    ):  # then it was begun before the capture
        began_s = (taken.log.started_s - taken.log.start_error_s, taken.log.started_s)
        return lines_by_time(frames, camera, scan_path, began_s, taken.capture_s, "log")
    played = played_scan_path(path.cells.astype(np.float64), path.rate_hz)
    return lines_by_time(frames, camera, played, taken.run_s, taken.capture_s, "command")
