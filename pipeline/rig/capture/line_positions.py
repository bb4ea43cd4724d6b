"""Where the mirror was at each line: by external trigger, by the mirror's own log, or by the times of the commands.

Which of them it was, and how far it may be off, is recorded with the positions. Times of lines are the mirror's.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from pipeline.errors import RigError, ShapeError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.mirror import check_reach, direction_to_scene, position_to_direction
from pipeline.rig.capture.clock_fit import (
    Bools,
    Floats,
    FrameTimes,
    Ints,
    StampAt,
    fit_clocks,
    match_edges,
    mend_times,
    whole_numbers,
)

Method = Literal["trigger", "log", "command"]
_MIDDLE = {"start": 0.5, "middle": 0.0, "end": -0.5}  # exposures from the stamp to mid exposure


@dataclass(frozen=True)
class MirrorTrack:
    """Positions measured by the mirror's log, and the edges of frames that it saw, by the mirror's clock."""

    time_s: Floats  # (sample,) in order
    position: Floats  # (sample, 2) device X and Y
    edge_s: Floats | None = None  # (edge,) in order, as exposures begin: the index stepped, under an external trigger


@dataclass(frozen=True)
class PlayedPath:
    """A path as it was run: held positions, each for 1 / ``rate_hz``, or until the next trigger."""

    position: Floats  # (held, 2)
    rate_hz: float


@dataclass(frozen=True)
class CommandTimes:
    """When path and capture were begun, by one clock: sent and acknowledged. [s]"""

    run_s: tuple[float, float]
    capture_s: tuple[float, float]


@dataclass(frozen=True)
class LinePositions:
    """Mirror positions of lines, and how they were found. NaN where ``valid`` is False."""

    position: Floats  # (line, 2) device X and Y at mid exposure
    time_s: Floats  # (line,) mid exposure; the mirror's clock for a log, else since the first frame began
    valid: Bools  # (line,)
    method: Method
    residual_us: float | None  # rms, or for commands half of what is not known; None where nothing measures it
    residual_px: float | None  # the same on the scene, at the mirror's speed
    offset_s: float | None = None  # of the two clocks, at the middle frame
    drift_ppm: float | None = None
    notes: tuple[str, ...] = ()


def lines_by_trigger(
    frames: FrameTimes, camera: LineCamera, path: PlayedPath, *, index_at_end: int | None = None
) -> LinePositions:
    """Take the position that each frame's trigger played: one vector index a frame, whatever the clocks say.

    ``index_at_end``, the vector index read after the capture, shows whether frames were lost without a trace. RigError
    where the mirror counted other triggers than the camera frames, or the camera numbers no frame.
    """
    positions = check_reach(path.position).astype(np.float64)
    number, notes = whole_numbers(frames.number)
    if not (number >= 0).any():
        raise RigError("no line has a frame number, so which trigger each belongs to is not known; fetch frameIndex")
    if index_at_end is not None and index_at_end != number.max():
        raise RigError(
            f"the mirror counted {index_at_end + 1} triggers, the camera's last frame is number "
            f"{number.max()}: a frame or an edge was lost, and lines after it would be off; tie them by the log"
        )
    valid = (number >= 0) & (number < len(positions))
    if beyond := int(np.count_nonzero(number >= len(positions))):
        notes.append(f"{beyond} lines are beyond the {len(positions)} positions of the path")
    counted = index_at_end is not None
    notes.append("positions are those sent, not measured" + ("" if counted else "; triggers were not counted"))
    found = np.full((len(number), 2), np.nan)
    found[valid] = positions[number[valid]]
    middle_s = np.where(valid, number * frames.period_ms + frames.exposure_ms / 2, np.nan) * 1e-3
    residual = 0.0 if counted else None
    return LinePositions(found, middle_s, valid, "trigger", residual, residual, notes=tuple(notes))


def lines_by_log(
    frames: FrameTimes, camera: LineCamera, track: MirrorTrack, *, commands: CommandTimes | None = None
) -> LinePositions:
    """Take the logged position at mid exposure of each line, by the clocks' offset and drift.

    Edges in the log give both, by a fit; without edges the commands give an offset, and drift is taken as 0. There
    ``commands.run_s`` is when the log began. A stamp that goes back or is missing is made up from its neighbours; one
    far off its own edge counts by that edge. RigError without edges and command times, or where edges and stamps are of
    different events; ShapeError where the track's arrays do not fit each other.
    """
    if track.time_s.ndim != 1 or not len(track.time_s) or track.position.shape != (len(track.time_s), 2):
        raise ShapeError(
            f"expected logged times (sample,) and positions (sample, 2), got {track.time_s.shape} and "
            f"{track.position.shape}"
        )
    stamp, number, notes = mend_times(frames)
    first_s = None if commands is None else np.mean(commands.capture_s) - np.mean(commands.run_s)
    if track.edge_s is None or not len(track.edge_s):
        if first_s is None:
            raise RigError("the log holds no edges and there are no command times; nothing ties its clock to frames")
        return _by_offset(frames, camera, track, stamp, float(first_s) + track.time_s[0], commands, notes)
    log_s = (float(track.time_s[0]), float(track.time_s[-1]))
    near = None if first_s is None else float(first_s) + log_s[0]
    edge = match_edges(stamp, number, track.edge_s, log_s=log_s, period_s=frames.period_ms * 1e-3, first_near_s=near)
    tied = edge >= 0
    if not tied.any():
        raise RigError(
            f"none of {len(edge)} frames lies within half a period of one of the log's edges; see the trigger"
        )
    fit = fit_clocks(stamp[tied], track.edge_s[edge[tied]])
    began_s = fit.mirror_s(stamp)
    own = np.where(tied, track.edge_s[edge], began_s)
    step_s = float(np.median(np.diff(track.time_s))) if len(track.time_s) > 1 else 0.0
    limit_s = max(6 * fit.residual_us * 1e-6, 3 * step_s)
    odd = tied & (np.abs(own - began_s) > limit_s)
    began_s = np.where(odd, own, began_s)
    notes += [f"{np.count_nonzero(tied)} of {len(tied)} frames have an edge in the log"]
    notes += [f"{np.count_nonzero(odd)} frames are stamped off their edge, which counts"] if odd.any() else []
    notes += [f"a drift cannot be told from {np.count_nonzero(tied)} frame"] if np.count_nonzero(tied) == 1 else []
    placed = _placed(frames, track, began_s, "start", notes)
    px = _apart_px(track, camera, (began_s[tied & ~odd], own[tied & ~odd]))
    return replace(placed, residual_us=fit.residual_us, residual_px=px, offset_s=fit.offset_s, drift_ppm=fit.drift_ppm)


def lines_by_commands(
    frames: FrameTimes, camera: LineCamera, path: PlayedPath, commands: CommandTimes
) -> LinePositions:
    """Take the position that the path should have had, counted from the commands' times.

    Software timing: what passes between a command and the first frame is not known, so a constant offset of the lines
    stays, for whoever registers sweeps that go both ways.
    """
    positions = check_reach(path.position).astype(np.float64)
    stamp, number, notes = mend_times(frames)
    after_s = number[0] * frames.period_ms * 1e-3 + (stamp - stamp[0]) * 1e-6
    begins_s = float(np.mean(commands.capture_s) - np.mean(commands.run_s))
    middle_s = begins_s + after_s + frames.exposure_ms * 1e-3 * _MIDDLE[frames.stamp_at]
    held = np.floor(middle_s * path.rate_hz).astype(np.int64)
    valid = (held >= 0) & (held < len(positions))
    if not valid.all():
        notes.append(f"{np.count_nonzero(~valid)} lines lie outside of the path's time")
    found = np.full((len(held), 2), np.nan)
    found[valid] = positions[held[valid]]
    unknown_s = _unknown_s(commands)
    track = MirrorTrack((np.arange(len(positions)) + 0.5) / path.rate_hz, positions)
    px = _apart_px(track, camera, (middle_s[valid], middle_s[valid] + unknown_s))
    notes.append(f"software timing: a constant line offset of about {px:.2g} px stays")
    return LinePositions(
        found,
        np.where(valid, middle_s - begins_s, np.nan),
        valid,
        "command",
        unknown_s * 1e6,
        px,
        begins_s,
        None,
        tuple(notes),
    )


def line_edges(index: Ints, time_s: Floats, first: int, step: int) -> Floats:
    """Give the times of lines' first edges by a log of the path's index under an external trigger. [s]

    Line 0 begins with the cell ``first``, each further one ``step`` cells later; an edge was half a sample before its
    cell, or a later one, was first seen.
    """
    reached = np.maximum.accumulate(index) if len(index) else index
    cells = np.arange(first, int(reached[-1]) + 1 if len(reached) else 0, step)
    seen = np.searchsorted(reached, cells)
    edges: Floats = (time_s[seen] + time_s[np.maximum(seen - 1, 0)]) / 2
    return edges


def _by_offset(
    frames: FrameTimes,
    camera: LineCamera,
    track: MirrorTrack,
    stamp: Ints,
    first_s: float,
    commands: CommandTimes | None,
    notes: list[str],
) -> LinePositions:
    """Logged positions by an offset alone, from the commands' times."""
    assert commands is not None
    number = whole_numbers(frames.number)[0]
    began_s = first_s + max(int(number[0]), 0) * frames.period_ms * 1e-3 + (stamp - stamp[0]) * 1e-6
    unknown_s = _unknown_s(commands)
    px = _apart_px(track, camera, (began_s, began_s + unknown_s))
    notes = [*notes, f"the log has no edges: software timing, a constant line offset of about {px:.2g} px stays"]
    return replace(
        _placed(frames, track, began_s, frames.stamp_at, notes),
        residual_us=unknown_s * 1e6,
        residual_px=px,
        offset_s=first_s,
    )


def _placed(
    frames: FrameTimes, track: MirrorTrack, told_s: Floats, told_at: StampAt, notes: list[str]
) -> LinePositions:
    """The log's positions at mid exposure of lines of which one moment is told by its clock."""
    middle_s = told_s + frames.exposure_ms * 1e-3 * _MIDDLE[told_at]
    valid = (middle_s >= track.time_s[0]) & (middle_s <= track.time_s[-1])
    if not valid.all():
        notes = [*notes, f"{np.count_nonzero(~valid)} of {len(valid)} lines lie outside of the log and are not valid"]
    found = np.where(valid[:, None], _at(track, middle_s), np.nan)
    return LinePositions(found, np.where(valid, middle_s, np.nan), valid, "log", None, None, notes=tuple(notes))


def _at(track: MirrorTrack, time_s: Floats) -> Floats:
    """Logged positions between samples, (time, 2)."""
    return np.stack([np.interp(time_s, track.time_s, track.position[:, axis]) for axis in (0, 1)], axis=-1)


def _apart_px(track: MirrorTrack, camera: LineCamera, times: tuple[Floats, Floats]) -> float:
    """Root mean square of how far the view moves between two times of each line. [px]"""
    if not len(times[0]):
        return 0.0
    one, other = (direction_to_scene(position_to_direction(_at(track, time_s))) for time_s in times)
    return float(np.sqrt(np.mean(np.sum((one - other) ** 2, axis=-1))) / camera.ifov_rad)


def _unknown_s(commands: CommandTimes) -> float:
    """Half of the time within which the path and the first frame began."""
    return float(np.ptp(commands.run_s) + np.ptp(commands.capture_s)) / 2
