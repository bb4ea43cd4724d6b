"""Captures of a sweep: what each is called, what the vector memory holds during it, and where its lines lie then.

A capture's prefix says which lines of which sweep it takes, so that a folder tells what it holds.
``coarse-0_cy-31p5_0p5_96x16x16_0`` is the sweep ``coarse-0``, a coarse one whose lines lie along y, on strip -31.5 px,
from scan coordinate 0.5 px on, of 96 lines of 16 held positions, binned by 16; the capture begins at its line 0. ``p``
is the decimal point; a number that takes more room than its bits is ``b`` and those, to base 32.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import RigError, SettingsError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import Axis, Sweep, exposing, line_positions, memory_loads, sweep_positions
from pipeline.rig.camera.camera_cubes import CapturedLines
from pipeline.rig.capture.line_positions import (
    CommandTimes,
    FrameTimes,
    LinePositions,
    MirrorScanPath,
    PlayedPath,
    lines_by_commands,
    lines_by_log,
    lines_by_trigger,
)
from pipeline.rig.device_settings import Pulses, check_capture
from pipeline.rig.mirror.mirror_controller import wire_positions

LEAD = 1  # cells before the first line's: a unit that waits for edges takes its first cell at the run command, assumed
REFERENCES = "references"  # prefix of a capture that is made for the dark and white frames in its folder
_DIGITS = "0123456789abcdefghijklmnopqrstuv"
_LONGEST = 14  # b and 64 bits
_NUMBER = r"(-?\d+(?:p\d+)?|b[0-9a-v]{13})"
_FORM = re.compile(rf"(.+)_([cf])([xy]){_NUMBER}_{_NUMBER}_(\d+)x(\d+)x(\d+)_(\d+)", re.DOTALL)
_KINDS: dict[str, Literal["coarse", "fine"]] = {"c": "coarse", "f": "fine"}


@dataclass(frozen=True)
class Announced:
    """A sweep, and its line that a capture's first frame takes."""

    sweep: Sweep
    first: int


def capture_prefix(sweep: Sweep, first: int = 0) -> str:
    """Give the prefix of a capture of a sweep's lines from ``first`` on.

    SettingsError where the sweep's name holds what a folder's name must not, or is too long.
    """
    sizes = f"{sweep.lines}x{sweep.step}x{sweep.binning}"
    place = f"{sweep.kind[0]}{sweep.along}{_written(sweep.swath_px)}_{_written(sweep.start_px)}"
    prefix = f"{sweep.name}_{place}_{sizes}_{first}"
    check_capture(0, 0, prefix)
    return prefix


def announced(prefix: str) -> Announced | None:
    """Read a capture's prefix; None where it announces no sweep."""
    found = _FORM.fullmatch(prefix)
    if found is None:
        return None
    name, kind, along, strip, start, *sizes = found.groups()
    axis: Axis = "x" if along == "x" else "y"
    lines, step, binning, first = map(int, sizes)
    if lines < 1 or step < 1 or binning < 1 or first >= lines:
        return None
    return Announced(Sweep(name, _KINDS[kind], axis, _number(strip), _number(start), lines, step, binning), first)


def _written(value: float) -> str:
    short = repr(float(value)).removesuffix(".0")
    if len(short) < _LONGEST and set(short) <= set("-.0123456789"):
        return short.replace(".", "p")
    bits = int.from_bytes(struct.pack(">d", value), "big")
    return "b" + "".join(_DIGITS[bits >> shift & 31] for shift in range(60, -1, -5))


def _number(text: str) -> float:
    if not text.startswith("b"):
        return float(text.replace("p", "."))
    bits = 0
    for digit in text[1:]:
        bits = bits << 5 | _DIGITS.index(digit)
    return float(struct.unpack(">d", (bits & (1 << 64) - 1).to_bytes(8, "big"))[0])


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
        """Frames that edges were counted of, where the cell ``index`` was played last; None within a line."""
        frames, rest = divmod(index + 1 - LEAD, self.sweep.step)
        return None if rest else frames


def next_path(sweep: Sweep, first: int, camera: LineCamera, *, vector_pairs: int, triggered: bool) -> CapturePath:
    """Give the path of the sweep's lines from ``first`` on, as many as the vector memory takes.

    SettingsError where the positions of one line do not fit the memory, PoseError where one is beyond the disk.
    """
    if vector_pairs <= LEAD:
        raise SettingsError(f"a vector memory of {vector_pairs} pairs holds no line; expected more than {LEAD}")
    rest = replace(sweep, lines=sweep.lines - first)
    stop = first + memory_loads([rest], vector_pairs - LEAD)[0].parts[0].lines[1]
    return path_of(sweep, (first, stop), camera, triggered=triggered)


def path_of(sweep: Sweep, lines: tuple[int, int], camera: LineCamera, *, triggered: bool) -> CapturePath:
    """Give the path of some of the sweep's lines; PoseError where a position is beyond the mirror's disk."""
    held: NDArray[Any] = sweep_positions(sweep, camera)[slice(*lines)].reshape(-1, 2)
    lead = held[:LEAD] if triggered else held[:0]
    cells, middle = (
        wire_positions(some) for some in (np.concatenate([lead, held]), line_positions(sweep, camera)[slice(*lines)])
    )
    return CapturePath(sweep, *lines, cells, middle, sweep.step * 1000 / exposing(camera, sweep).frame_ms, triggered)


def can_trigger(pulses: Pulses, sweep: Sweep) -> bool:
    """Whether the pulses at the mirror's input step through this sweep: one a position is needed."""
    return pulses == "position" or (pulses == "frame" and sweep.step == 1)


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
    """A log of measured positions that is kept beside the files: (sample, 2) big-endian float32.

    ``index_name`` is where the cells that were played are, (sample,) big-endian int32; empty where nobody asked.
    """

    name: str
    rate_hz: float
    started_s: float
    start_error_s: float
    index_name: str = ""
    crc32: int | None = None  # of both files, one after the other; None by an earlier version


class UntiedError(RigError):
    """A capture from which no line, or no further one, is to be had: it is taken again."""


@dataclass(frozen=True)
class PlacedLines:
    """A capture's lines by their order in the sweep."""

    row: NDArray[np.int64]  # (line,) of the captured values; -1 of a line that the camera dropped
    tied: LinePositions  # by row
    stamp_us: NDArray[np.int64]  # (row,) by the camera's clock; -1 where it says nothing

    def is_valid(self, line: int) -> bool:
        """Whether a line, counted from the capture's first, is there with its position."""
        row = int(self.row[line])
        return row >= 0 and bool(self.tied.valid[row])


def place_lines(
    captured: CapturedLines,
    path: CapturePath,
    taken: CaptureRecord,
    camera: LineCamera,
    scan_path: MirrorScanPath | None,
) -> PlacedLines:
    """Give each line of the path its row of the capture, up to the last one that is there whole.

    UntiedError where nothing, or what contradicts itself, ties frames to the mirror.
    """
    held = int(np.flatnonzero(captured.valid)[-1]) + 1
    number = captured.times.frame[:held]  # from the capture's start; rows in order if none is told or can be missing
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
    """Positions by edges in the mirror's log, else by the edges that stepped it, by its log, by the commands' times."""
    commands = CommandTimes(taken.run_s, taken.capture_s)
    if taken.log is not None:  # then it, and not the path, was begun before the capture
        began = (taken.log.started_s - taken.log.start_error_s, taken.log.started_s)
        commands = CommandTimes(began, taken.capture_s)
    if taken.triggered:
        counted = None if taken.index_at_end is None else path.frames_at(taken.index_at_end)
        taken_in_all = max(total, int(frames.number.max()) + 1)
        if taken.index_at_end is not None and counted != taken_in_all:
            raise RigError(
                f"the mirror stands at cell {taken.index_at_end} of its path, after {taken_in_all} frames cell "
                f"{taken_in_all * path.sweep.step} was expected: edges were lost, or are not one a position (see "
                f"pulses in [rig])"
            )
        if scan_path is not None and scan_path.edge_s is not None and len(scan_path.edge_s):
            return lines_by_log(frames, camera, scan_path, commands=commands)
        sent = PlayedPath(path.middle.astype(np.float64), path.rate_hz)
        last = None if counted is None else int(frames.number.max())
        return lines_by_trigger(frames, camera, sent, index_at_end=last)
    if scan_path is not None and taken.log is not None and len(scan_path.position) > 1:
        return lines_by_log(frames, camera, scan_path, commands=commands)
    commands = CommandTimes(taken.run_s, taken.capture_s)
    played = PlayedPath(path.cells.astype(np.float64), path.rate_hz)  # by its own clock
    return lines_by_commands(frames, camera, played, commands)
