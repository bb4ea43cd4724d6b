"""Captures of a sweep: their names, the vector memory during them, and the positions of their lines.

The mirror plays the path of a capture by its own clock, and the camera stamps its frames in whole microseconds of its
own. The times of the commands tie both.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.errors import RigError, SettingsError
from spectralzoom.pipeline.frame_indices import LineTimes
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.mirror import wire_positions
from spectralzoom.pipeline.geometry.scan import Axis, Sweep, exposing, line_positions, memory_loads, sweep_positions
from spectralzoom.pipeline.rig.camera.camera_cubes import CapturedLines

Floats = NDArray[Any]  # float64
Span = tuple[float, float]  # moments between which a command took effect: sent and acknowledged [s]
STAMP_MS = 1.5e-3  # between a frame's time and its stamp in whole microseconds, counted from that of another frame
MOST_PERIOD_ERROR = 0.05  # of a frame period: clocks differ by far less
REFERENCES = "references"  # prefix of a capture for the dark and white frames in its folder


class UnusableCaptureError(RigError):
    """A capture gives no line, or no further one, and is taken again."""


def capture_prefix(sweep: Sweep, first: int = 0) -> str:
    """Return the prefix of a capture of a sweep's lines from ``first`` on, with which its folder's name begins.

    It has the sweep's name, kind and axis, swath and start [px] with ``p`` for the decimal point, lines, line spacing,
    binning, held positions (0: those of the line spacing), and the first line. Raises SettingsError: the sweep's name
    is too long, or cannot be part of a folder's name.
    """
    sizes = (sweep.lines, sweep.step, sweep.binning, sweep.held or 0, first)
    places = [repr(float(one)).removesuffix(".0").translate(_NAMED) for one in (sweep.swath_px, sweep.start_px)]
    prefix = "_".join([sweep.name, sweep.kind, sweep.along, *places, *map(str, sizes)])
    if not re.fullmatch(r"[A-Za-z0-9_-]{0,128}", prefix):
        raise SettingsError(f"a prefix names a folder: expected up to 128 letters, digits, - and _, got {prefix!r}")
    return prefix


def announced(prefix: str) -> tuple[Sweep, int] | None:
    """Return the sweep of a capture's prefix, and its line in the first frame; None where it names none."""
    found = _FORM.fullmatch(prefix)
    if found is None:
        return None
    name, kind, along, *numbers = found.groups()
    places, (lines, step, binning, held, first) = numbers[:2], map(int, numbers[2:])
    if min(lines, step, binning) < 1 or first >= lines:
        return None
    swath, start = (float(text.replace("p", ".")) for text in places)
    sweep = Sweep(name, cast(Any, kind), cast(Axis, along), swath, start, lines, step, binning, held=held or None)
    return sweep, first


_NAMED = str.maketrans(".", "p", "+")
_PLACE = r"(-?\d+(?:p\d+)?(?:e-?\d+)?)"
_FORM = re.compile(rf"(.+)_(coarse|fine)_([xy])_{_PLACE}_{_PLACE}_(\d+)_(\d+)_(\d+)_(\d+)_(\d+)", re.DOTALL)


@dataclass(frozen=True)
class CapturePath:
    """Lines ``first`` to ``stop`` of a sweep, and the positions held for them: those of the plan, as float32."""

    sweep: Sweep
    first: int
    stop: int
    cells: NDArray[np.float32]  # (held, 2)
    middle: NDArray[np.float32]  # (line, 2) at mid exposure
    rate_hz: float  # of cells

    @property
    def lines(self) -> int:
        """Lines of the capture."""
        return self.stop - self.first


def next_path(sweep: Sweep, first: int, camera: LineCamera, *, vector_pairs: int) -> CapturePath:
    """Return the path of as many of the sweep's lines from ``first`` on as the vector memory holds.

    Raises SettingsError: the positions of one line do not fit the memory. Raises PoseError: one is beyond the disk.
    """
    rest = [replace(sweep, lines=sweep.lines - first)]
    return path_of(sweep, (first, first + memory_loads(rest, vector_pairs)[0].parts[0].lines[1]), camera)


def path_of(sweep: Sweep, lines: tuple[int, int], camera: LineCamera) -> CapturePath:
    """Return the path of some of the sweep's lines; PoseError where a position is beyond the disk."""
    cells = wire_positions(sweep_positions(sweep, camera)[slice(*lines)].reshape(-1, 2))
    middle = wire_positions(line_positions(sweep, camera)[slice(*lines)])
    return CapturePath(sweep, *lines, cells, middle, sweep.positions * 1000 / exposing(camera, sweep).frame_ms)


@dataclass(frozen=True)
class CaptureRecord:
    """Lines ``first`` to ``stop`` of a sweep, in a folder of the camera."""

    sweep: Sweep
    first: int
    stop: int
    folder: str
    run_s: Span
    capture_s: Span
    spent: str = ""  # why it gives no further line; empty where it may
    residual_px: float | None = None  # see `LinePositions`; None until its lines were read
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class LinePositions:
    """Mirror positions of lines. NaN where ``valid`` is False."""

    position: Floats  # (line, 2) device X and Y at mid exposure
    valid: NDArray[np.bool_]  # (line,)
    residual_px: float  # how far they may be off by the times of the commands
    notes: tuple[str, ...] = ()


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
    number = captured.times.frame
    if (number >= 0).any():
        number = np.where(number >= 0, number - captured.first_frame, -1)
    elif len(captured.values) == path.lines:  # no number, and no line is missing
        number = np.arange(path.lines)
    else:
        raise UnusableCaptureError("no line has a frame number; fetch frameIndex")
    inside = (number >= 0) & (number < path.lines)
    if not inside.any():
        raise UnusableCaptureError(f"frameIndex has no number of the {path.lines} frames of its files")
    times = LineTimes(number, captured.times.stamp_us)
    found = positions_by_time(times, path.middle, taken, exposing(camera, path.sweep))
    placed = np.flatnonzero(inside & found.valid)  # lines after the path's end are taken again
    row = np.full(int(number[placed].max(initial=-1)) + 1, -1, np.int64)
    rows = np.flatnonzero((number >= 0) & (number < len(row)))
    row[number[rows]] = rows
    return LocatedLines(row, found, times.stamp_us)


def positions_by_time(times: LineTimes, middle: Floats, taken: CaptureRecord, exposed: LineCamera) -> LinePositions:
    """Return the position of each frame on a path that the mirror plays by its own clock, a line in each frame period.

    Frames count from the capture's first. ``middle`` (line, 2) are the path's positions at mid exposure, ``exposed``
    has exposure and frame period. The delay between a command and what it starts is unknown, so a constant offset of
    the lines remains; registration corrects it. Before and after its path the mirror holds the first and the last
    position. Raises UnusableCaptureError: the time stamps go back. Raises RigError: they contradict the frame period.
    """
    period_s = exposed.frame_ms * 1e-3
    starts, known = _frame_starts(times, exposed.frame_ms)
    place = float(np.mean(taken.capture_s) - np.mean(taken.run_s)) / period_s + starts  # in lines of the path
    valid = known & (place > -1) & (place < len(middle))
    lost = np.diff(times.frame[times.frame >= 0])
    missing = int(np.sum(lost[lost > 1] - 1))
    notes = [f"{missing} frames are missing between the lines"] if missing else []
    if (times.stamp_us < 0).all():
        notes.append("no line has a time stamp: frames are taken to follow their period")
    if not valid.all():
        notes.append(f"without a time, or outside of the path's: {np.count_nonzero(~valid)} of {len(valid)} lines")
    unknown_s = float(np.ptp(taken.run_s) + np.ptp(taken.capture_s)) / 2
    # held positions fill the period, of which a shorter exposure sees the beginning
    early = (taken.sweep.positions - 1) / 2 * (1 - exposed.exposure_ms / exposed.frame_ms)
    px = taken.sweep.step * unknown_s / period_s + early
    notes.append(f"software timing: a constant line offset of about {px:.2g} px remains")
    lines = np.arange(len(middle))
    position = np.stack([np.interp(place, lines, middle[:, axis].astype(np.float64)) for axis in (0, 1)], axis=-1)
    return LinePositions(np.where(valid[:, None], position, np.nan), valid, px, tuple(notes))


def _frame_starts(times: LineTimes, period_ms: float) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the start of each frame since that of frame 0 (line,) [frame periods], and where it is known.

    Frames without any stamp follow their period, and so do those whose stamp is that time in whole microseconds.
    """
    by_period = times.frame.astype(np.float64)
    known = (times.frame >= 0) & (times.stamp_us >= 0)
    if not known.any():
        return by_period, times.frame >= 0
    if (np.diff(times.stamp_us[known]) < 0).any():
        raise UnusableCaptureError("the time stamps of its frames go back; was the camera's clock set? Capture again")
    frames, steps_ms = np.maximum(np.diff(times.frame[known]), 1), np.diff(times.stamp_us[known]) * 1e-3
    found_ms = (np.median(steps_ms / frames), steps_ms.sum() / frames.sum()) if len(frames) else (period_ms,)
    if min(abs(ms / period_ms - 1) for ms in found_ms) > MOST_PERIOD_ERROR:  # neither by dropped frames nor by jitter
        raise RigError(
            f"the time stamps of its frames are {found_ms[0]:g} ms apart, the camera was set to a frame period of "
            f"{period_ms:g} ms; are they in microseconds, and does it keep that period? The capture is kept"
        )
    first = int(np.flatnonzero(known)[0])
    by_stamp = by_period[first] + (times.stamp_us - times.stamp_us[first]) * 1e-3 / period_ms
    near = np.abs(by_stamp - by_period) * period_ms <= STAMP_MS
    return np.where(near, by_period, by_stamp), known
