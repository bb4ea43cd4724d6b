"""Captures of a sweep: their names, the vector memory during them, and the positions of their lines.

The mirror plays the path of a capture by its own clock, and the camera stamps its frames in whole microseconds of its
own. The times of the commands tie both.

A capture's prefix, which begins its folder's name, identifies the lines of the sweep that it takes.
``coarse-0_cy-31p5_0p5_96x16x16_0`` is the coarse sweep ``coarse-0``, whose lines lie along y. Its swath is at -31.5 px,
it starts at scan coordinate 0.5 px, and it has 96 lines of 16 held positions, binned by 16. The capture begins at its
line 0. ``p`` is the decimal point.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.errors import RigError, SettingsError
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.mirror import wire_positions
from spectralzoom.pipeline.geometry.scan import Sweep, exposing, line_positions, memory_loads, sweep_positions
from spectralzoom.pipeline.rig.camera.camera_cubes import CapturedLines

Floats = NDArray[Any]  # float64
Ints = NDArray[np.int64]
Span = tuple[float, float]  # moments between which a command took effect: sent and acknowledged [s]


@dataclass(frozen=True)
class FrameTimes:
    """Frame times by the camera; -1 where it gives none. Lines are in the order of capture."""

    number: Ints  # (line,) frame numbers, the capture's first frame 0
    stamp_us: Ints  # (line,) by the camera's clock, assumed to be the exposure's start
    period_ms: float

    def starts(self) -> tuple[Floats, NDArray[np.bool_]]:
        """Return the start of each frame since that of frame 0 (line,) [frame periods], and where it is known.

        Frames without any stamp follow their period, and so do those whose stamp is that time in whole microseconds.
        Raises RigError: the stamps go back.
        """
        by_period = self.number.astype(np.float64)
        known = (self.number >= 0) & (self.stamp_us >= 0)
        if not known.any():
            return by_period, self.number >= 0
        if (np.diff(self.stamp_us[known]) < 0).any():
            raise RigError("the time stamps of its frames go back; was the camera's clock set? Capture again")
        first = int(np.flatnonzero(known)[0])
        by_stamp = by_period[first] + (self.stamp_us - self.stamp_us[first]) * 1e-3 / self.period_ms
        near = np.abs(by_stamp - by_period) * self.period_ms <= STAMP_MS
        return np.where(near, by_period, by_stamp), known


@dataclass(frozen=True)
class LinePositions:
    """Mirror positions of lines. NaN where ``valid`` is False."""

    position: Floats  # (line, 2) device X and Y at mid exposure
    valid: NDArray[np.bool_]  # (line,)
    residual_px: float  # how far they may be off by the times of the commands
    notes: tuple[str, ...] = ()


def positions_by_time(
    frames: FrameTimes, middle: Floats, run_s: Span, capture_s: Span, sweep: Sweep, exposure_ms: float
) -> LinePositions:
    """Return the position of each frame on a path that the mirror plays by its own clock, a line in each frame period.

    ``middle`` (line, 2) are the path's positions at mid exposure. ``run_s`` spans the start of the path, ``capture_s``
    that of the capture, by one clock. The delay between a command and what it starts is unknown, so a constant offset
    of the lines remains; registration corrects it. Before and after its path the mirror holds the first and the last
    position. Raises RigError: the stamps go back.
    """
    starts, known = frames.starts()
    period_s = frames.period_ms * 1e-3
    place = float(np.mean(capture_s) - np.mean(run_s)) / period_s + starts  # in lines of the path
    valid = known & (place > -1) & (place < len(middle))
    lost = np.diff(frames.number[frames.number >= 0])
    missing = int(np.sum(lost[lost > 1] - 1))
    notes = [f"{missing} frames are missing between the lines"] if missing else []
    if (frames.stamp_us < 0).all():
        notes.append("no line has a time stamp: frames are taken to follow their period")
    if not valid.all():
        notes.append(f"without a time, or outside of the path's: {np.count_nonzero(~valid)} of {len(valid)} lines")
    unknown_s = float(np.ptp(run_s) + np.ptp(capture_s)) / 2
    # held positions fill the period, of which a shorter exposure sees the beginning
    early = (sweep.positions - 1) / 2 * (1 - exposure_ms / frames.period_ms)
    px = sweep.step * unknown_s / period_s + early
    notes.append(f"software timing: a constant line offset of about {px:.2g} px remains")
    position = np.stack([np.interp(place, np.arange(len(middle)), middle[:, axis]) for axis in (0, 1)], axis=-1)
    return LinePositions(np.where(valid[:, None], position, np.nan), valid, px, tuple(notes))


STAMP_MS = 1.5e-3  # between a frame's time and its stamp in whole microseconds, counted from that of another frame
REFERENCES = "references"  # prefix of a capture for the dark and white frames in its folder
_NUMBER = r"(-?\d+(?:p\d+)?(?:e-?\d+)?)"
_FORM = re.compile(rf"(.+)_([cf])([xy]){_NUMBER}_{_NUMBER}_(\d+)x(\d+)x(\d+)(?:x(\d+))?_(\d+)", re.DOTALL)


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


def announced(prefix: str) -> tuple[Sweep, int] | None:
    """Return the sweep of a capture's prefix, and its line in the first frame; None where it names none."""
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
    return sweep, int(first)


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
    frames = FrameTimes(number, captured.times.stamp_us, exposed.frame_ms)
    middle = path.middle.astype(np.float64)
    try:
        found = positions_by_time(frames, middle, taken.run_s, taken.capture_s, path.sweep, exposed.exposure_ms)
    except RigError as error:
        raise UnusableCaptureError(f"{taken.folder}: {error}") from error
    rows = np.flatnonzero((number >= 0) & (number < path.lines))
    placed = rows[found.valid[rows]]  # lines after the path's end are taken again
    row = np.full(int(number[placed].max(initial=-1)) + 1, -1, np.int64)
    rows = rows[number[rows] < len(row)]
    row[number[rows]] = rows
    return LocatedLines(row, found, frames.stamp_us)
