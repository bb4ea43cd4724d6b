"""Lines of one capture with their places in the sweep: which frame is which line, where the mirror was, and when."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.camera import LineCamera
from pipeline.errors import RigError
from pipeline.rig.camera.camera_cubes import CapturedLines
from pipeline.rig.capture.capture_journal import Taken, commands_of
from pipeline.rig.capture.capture_paths import CapturePath
from pipeline.rig.capture.frame_times import FrameTimes
from pipeline.rig.capture.line_positions import (
    CommandTimes,
    LinePositions,
    MirrorTrack,
    PlayedPath,
    lines_by_commands,
    lines_by_log,
    lines_by_trigger,
)


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
    captured: CapturedLines, path: CapturePath, taken: Taken, camera: LineCamera, track: MirrorTrack | None
) -> PlacedLines:
    """Give each line of the path its row of the capture, up to the last one that is there whole.

    Raises
    ------
    UntiedError : nothing, or what contradicts itself, ties frames to the mirror.
    """
    held = int(np.flatnonzero(captured.valid)[-1]) + 1
    number = _numbers(captured, held, path.lines)
    frames = FrameTimes(number, captured.times.stamp_us[:held], camera.exposure_ms, camera.frame_ms)
    try:
        tied = _tied(frames, path, taken, camera, track, total=len(captured.values))
    except RigError as error:
        raise UntiedError(f"{taken.folder}: {error}") from error
    row = np.full(min(int(number.max()) + 1, path.lines), -1, np.int64)
    rows = np.flatnonzero(captured.valid[:held] & (number >= 0) & (number < path.lines))
    row[number[rows]] = rows
    return PlacedLines(row, tied, frames.stamp_us)


def _numbers(captured: CapturedLines, held: int, lines: int) -> NDArray[np.int64]:
    """Frames' numbers from the capture's start; where none is told, rows in order if none can be missing."""
    told = captured.times.frame[:held]
    if (told >= 0).any():
        return np.where(told >= 0, told - captured.first_frame, -1)
    return np.arange(held) if len(captured.values) == lines else told


def _tied(
    frames: FrameTimes, path: CapturePath, taken: Taken, camera: LineCamera, track: MirrorTrack | None, *, total: int
) -> LinePositions:
    """Positions by edges in the mirror's log, else by the edges that stepped it, by its log, by the commands' times."""
    commands = commands_of(taken)
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
        if track is not None and track.edge_s is not None and len(track.edge_s):
            return lines_by_log(frames, camera, track, commands=commands)
        sent = PlayedPath(path.middle.astype(np.float64), path.rate_hz)
        last = None if counted is None else int(frames.number.max())
        return lines_by_trigger(frames, camera, sent, index_at_end=last)
    if track is not None and taken.log is not None and len(track.position) > 1:
        return lines_by_log(frames, camera, track, commands=commands)
    return lines_by_commands(frames, camera, path.played, commands_of(taken))
