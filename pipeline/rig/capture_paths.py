"""Captures of a sweep: their names, the vector memory during them, and the positions of their lines.

A record of positions names the method that gave them, and their possible error. Times of lines are the mirror's; the
camera stamps its frames in whole microseconds of its own clock.

A capture's prefix, which begins its folder's name, identifies the lines of the sweep that it takes.
``coarse-0_cy-31p5_0p5_96x16x16_0`` is the coarse sweep ``coarse-0``, whose lines lie along y. Its swath is at -31.5 px,
it starts at scan coordinate 0.5 px, and it has 96 lines of 16 held positions, binned by 16. The capture begins at its
line 0. ``p`` is the decimal point.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import RigError, SettingsError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.mirror import direction_to_scene, position_to_direction, wire_positions
from pipeline.geometry.scan import Sweep, exposing, line_positions, memory_loads, sweep_positions
from pipeline.rig.camera.camera_cubes import CapturedLines
from pipeline.rig.mirror_controller import MotionLog

Floats = NDArray[Any]  # float64
Ints = NDArray[np.int64]
Span = tuple[float, float]  # moments between which a command took effect: sent and acknowledged [s]


@dataclass(frozen=True)
class FrameTimes:
    """Frame times by the camera; -1 where it gives none. Lines are in the order of capture."""

    number: Ints  # (line,) frame numbers, the capture's first frame 0
    stamp_us: Ints  # (line,) by the camera's clock, assumed to be the exposure's start
    exposure_ms: float
    period_ms: float


@dataclass(frozen=True)
class MirrorScanPath:
    """Path of the mirror by its clock: positions of its log, or of a path that it played."""

    time_s: Floats  # (sample,) in order
    position: Floats  # (sample, 2) device X and Y


def played_scan_path(position: Floats, rate_hz: float) -> MirrorScanPath:
    """Return the scan path of positions (held, 2) that are each held for 1 / ``rate_hz``, one after the other."""
    return MirrorScanPath(np.repeat(np.arange(len(position) + 1), 2)[1:-1] / rate_hz, np.repeat(position, 2, axis=0))


def _followed(logged: MirrorScanPath, played: MirrorScanPath, begin_s: float, off_s: float) -> MirrorScanPath:
    """Return the played path as the mirror followed it: at the time and place that bring it nearest to its log.

    The path begins at ``begin_s`` of the log's time, give or take ``off_s`` and two positions. A log has few samples a
    position, and is linear between them. It is returned itself if any sample lies more than a step and a half beside.
    """
    held_s = float(played.time_s[1] - played.time_s[0])
    wide = math.ceil(off_s / held_s + 2)
    for steps in (np.arange(-wide, wide + 1), np.linspace(-1, 1, 2 * STEPS_A_POSITION + 1)):
        shifts = begin_s + steps * held_s
        spread = np.array([np.var(logged.position - _at(played, logged.time_s - one), axis=0).sum() for one in shifts])
        alike = spread <= spread.min() + 1e-6 * np.ptp(spread)  # with one sample a position, many shifts are
        begin_s = float(shifts[alike].mean())
    off = logged.position - _at(played, logged.time_s - begin_s)
    beside = np.median(off, axis=0)
    step = np.linalg.norm(np.diff(played.position[::2], axis=0), axis=1)
    if not len(step) or np.linalg.norm(off - beside, axis=1).max() > MOST_STEPS_OFF * np.median(step):
        return logged
    ends = logged.time_s[[0, -1]]
    time_s = np.concatenate([ends[:1], np.clip(played.time_s + begin_s, *ends), ends[1:]])
    return MirrorScanPath(time_s, played.position[[0, *range(len(played.position)), -1]] + beside)


@dataclass(frozen=True)
class LinePositions:
    """Mirror positions of lines, and the method that gave them. NaN where ``valid`` is False."""

    position: Floats  # (line, 2) device X and Y at mid exposure
    valid: NDArray[np.bool_]  # (line,)
    method: Literal["trigger", "log", "command"]
    residual_px: float | None  # how far they may be off by the times of the commands; None where it is not measured
    notes: tuple[str, ...] = ()


def lines_by_trigger(frames: FrameTimes, positions: Floats, *, counted: bool) -> LinePositions:
    """Return the position that each frame's trigger played: one of ``positions`` (line, 2) per frame number.

    ``counted``: the mirror's count of triggers agrees with that of the frames.
    """
    number = frames.number
    valid = (number >= 0) & (number < len(positions))
    found = np.full((len(number), 2), np.nan)
    found[valid] = positions[number[valid]]
    note = "positions are those sent, not measured" + ("" if counted else "; triggers were not counted")
    return LinePositions(found, valid, "trigger", 0.0 if counted else None, (*_dropped(number), note))


def _dropped(number: Ints) -> tuple[str, ...]:
    """Return a note on the frames that are missing between the lines."""
    steps = np.diff(number[number >= 0])
    lost = int(np.sum(steps[steps > 1] - 1))
    return (f"{lost} frames are missing between the lines",) if lost else ()


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
    usable = (frames.number >= 0) & (frames.stamp_us >= 0)
    notes = [*_dropped(frames.number)]
    since_first_s = frames.number * frames.period_ms * 1e-3
    if usable.any():
        first = int(np.flatnonzero(usable)[0])
        if (np.diff(frames.stamp_us[usable]) < 0).any():
            raise RigError("the time stamps of its frames go back; was the camera's clock set? Capture again")
        since_first_s = since_first_s[first] + (frames.stamp_us - frames.stamp_us[first]) * 1e-6
    else:
        usable = frames.number >= 0
        notes.append("no line has a time stamp: frames are taken to follow their period")
    first_s = float(np.mean(capture_s) - np.mean(began_s)) + float(scan_path.time_s[0])
    middle_s = first_s + since_first_s + frames.exposure_ms * 1e-3 / 2
    valid = usable & (middle_s >= scan_path.time_s[0]) & (middle_s <= scan_path.time_s[-1])
    if not valid.all():
        notes.append(f"without a time, or outside of the {method}'s: {np.count_nonzero(~valid)} of {len(valid)} lines")
    unknown_s = float(np.ptp(began_s) + np.ptp(capture_s)) / 2
    ramps = MirrorScanPath(*((one[:-1] + one[1:]) / 2 for one in (scan_path.time_s, scan_path.position)))
    px = _apart_px(ramps, camera, (middle_s[valid], middle_s[valid] + unknown_s))  # a step may lie between any two
    notes.append(f"software timing: a constant line offset of about {px:.2g} px remains")
    return LinePositions(np.where(valid[:, None], _at(scan_path, middle_s), np.nan), valid, method, px, tuple(notes))


def _at(scan_path: MirrorScanPath, time_s: Floats) -> Floats:
    """Return the logged positions between samples, (time, 2)."""
    return np.stack([np.interp(time_s, scan_path.time_s, scan_path.position[:, axis]) for axis in (0, 1)], axis=-1)


def _apart_px(scan_path: MirrorScanPath, camera: LineCamera, times: tuple[Floats, Floats]) -> float:
    """Return the root mean square distance that the view moves between two times of each line. [px]"""
    if not len(times[0]):
        return 0.0
    one, other = (direction_to_scene(position_to_direction(_at(scan_path, time_s))) for time_s in times)
    return float(np.sqrt(np.mean(np.sum((one - other) ** 2, axis=-1))) / camera.ifov_rad)


STEPS_A_POSITION = 20  # of time, in which a played path is laid on the mirror's log
MOST_STEPS_OFF = 1.5  # of any sample of a mirror that followed: those in a move are up to one step beside
LEAD = 1  # cells before the first line's: a triggered unit plays its first cell at the run command, assumed
REFERENCES = "references"  # prefix of a capture for the dark and white frames in its folder
_NUMBER = r"(-?\d+(?:p\d+)?(?:e-?\d+)?)"
_FORM = re.compile(rf"(.+)_([cf])([xy]){_NUMBER}_{_NUMBER}_(\d+)x(\d+)x(\d+)(?:x(\d+))?_(\d+)", re.DOTALL)


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
    if not re.fullmatch(r"[A-Za-z0-9_-]{0,128}", prefix):
        raise SettingsError(f"a prefix names a folder: expected up to 128 letters, digits, - and _, got {prefix!r}")
    return prefix


def announced(prefix: str) -> Announced | None:
    """Return the sweep of a capture's prefix; None where it names none."""
    found = _FORM.fullmatch(prefix)
    if found is None:
        return None
    name, kind, along, strip, start, lines, step, binning, held, first = found.groups()
    sizes = int(lines), int(step), int(binning)
    if min(sizes) < 1 or int(first) >= sizes[0] or held == "0":
        return None
    sweep = Sweep(
        name,
        "coarse" if kind == "c" else "fine",
        "x" if along == "x" else "y",
        _number(strip),
        _number(start),
        *sizes,
        held=None if held is None else int(held),
    )
    return Announced(sweep, int(first))


def _written(value: float) -> str:
    return repr(float(value)).removesuffix(".0").replace(".", "p").replace("+", "")


def _number(text: str) -> float:
    return float(text.replace("p", "."))


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
    rest = [replace(sweep, lines=sweep.lines - first)]
    stop = first + memory_loads(rest, vector_pairs, lead=LEAD if triggered else 0)[0].parts[0].lines[1]
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
    log: MotionLog | None = None
    spent: str = ""  # why it gives no further line; empty where it may


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


def locate_lines(captured: CapturedLines, path: CapturePath, taken: CaptureRecord, camera: LineCamera) -> LocatedLines:
    """Return the row and position of each line of the path, up to the last complete one.

    Raises UnusableCaptureError: frames cannot be assigned to mirror positions without contradiction.
    """
    held = len(captured.values)
    number = captured.times.frame
    if (number >= 0).any():
        number = np.where(number >= 0, number - captured.first_frame, -1)
    elif held == path.lines:  # no number, and no line is missing
        number = np.arange(held)
    else:
        raise UnusableCaptureError(f"{taken.folder}: no line has a frame number; fetch frameIndex")
    if not ((number >= 0) & (number < path.lines)).any():
        raise UnusableCaptureError(f"{taken.folder}: frameIndex has no number of the {path.lines} frames of its files")
    exposed = exposing(camera, path.sweep)
    frames = FrameTimes(number, captured.times.stamp_us, exposed.exposure_ms, exposed.frame_ms)
    try:
        tied = _positions(frames, path, taken, camera, total=held + captured.lost)
    except RigError as error:
        raise UnusableCaptureError(f"{taken.folder}: {error}") from error
    rows = np.flatnonzero((number >= 0) & (number < path.lines))
    placed = rows if tied.method == "trigger" else rows[tied.valid[rows]]  # lines after the log's end are taken again
    row = np.full(int(number[placed].max(initial=-1)) + 1, -1, np.int64)
    rows = rows[number[rows] < len(row)]
    row[number[rows]] = rows
    return LocatedLines(row, tied, frames.stamp_us)


def _positions(
    frames: FrameTimes, path: CapturePath, taken: CaptureRecord, camera: LineCamera, *, total: int
) -> LinePositions:
    """Return the positions of lines by trigger edges, else by the mirror's log, else by the commands' times."""
    if taken.triggered:
        taken_in_all = max(total, int(frames.number.max()) + 1)
        index = taken.index_at_end
        if index is not None and path.frames_at(index) != taken_in_all:
            raise RigError(
                f"the mirror stands at cell {index} of its path, after {taken_in_all} frames cell "
                f"{taken_in_all * path.sweep.positions} was expected: edges were lost, are not one per position "
                "(see pulses in [rig]), or the capture was stopped"
            )
        return lines_by_trigger(frames, path.middle.astype(np.float64), counted=index is not None)
    played = played_scan_path(path.cells.astype(np.float64), path.rate_hz)
    if taken.log is not None and len(taken.log.position) > 1:
        times_s = np.arange(len(taken.log.position)) / taken.log.rate_hz
        began_s = (taken.log.started_s - taken.log.start_error_s, taken.log.started_s)
        logged = MirrorScanPath(times_s, taken.log.position.astype(np.float64))
        begin_s = float(np.mean(taken.run_s) - np.mean(began_s))
        followed = _followed(logged, played, begin_s, float(np.ptp(taken.run_s) + np.ptp(began_s)))
        return lines_by_time(frames, camera, followed, began_s, taken.capture_s, "log")
    return lines_by_time(frames, camera, played, taken.run_s, taken.capture_s, "command")
