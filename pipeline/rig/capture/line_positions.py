"""Where the mirror was at each line: by external trigger, by the mirror's own log, or by the times of the commands.

Which of them it was, and how far it may be off, is recorded with the positions. Times of lines are the mirror's. The
camera stamps its frames in whole microseconds of its own clock, the mirror's logger counts samples at 10 kHz of its
own: offset and drift come from edges that both saw, by robust least squares.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import RigError, ShapeError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.mirror import check_reach, direction_to_scene, position_to_direction
from pipeline.readings import SIGMA_OF_MEDIAN

Floats = NDArray[Any]  # float64
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
StampAt = Literal["start", "middle", "end"]

MOST_DRIFT_PPM = 1000.0  # of two quartz clocks, generously; more means that the wrong events were matched
LEAST_SCALE_S = 1e-6  # stamps are whole microseconds
_TUKEY = 4.685  # 95 % efficient where the errors are normal
_ROUNDS = 30
_NEAR = 64  # edges around a hint
_BLOCK = 256  # frames matched before the offset is looked at again
_WINDOW = 7  # neighbours that say whether a stamp strayed: up to three strays in a row are seen


@dataclass(frozen=True)
class FrameTimes:
    """What the camera says of its lines; -1 where it says nothing. Lines are in the order in which they were taken."""

    number: Ints  # (line,) frame numbers, the capture's first frame 0
    stamp_us: Ints  # (line,) by the camera's clock
    exposure_ms: float
    period_ms: float
    stamp_at: StampAt = "start"  # of the exposure; the camera's papers do not say which


def mend_times(frames: FrameTimes) -> tuple[Ints, Ints, list[str]]:
    """Give every line a stamp and a number, and say what was done.

    Frames come at a steady rate or later, never sooner: a stamp off its neighbours' by half a period strayed, and
    where all after one are early the clock was set back. Both follow their neighbours then; so do lines without a
    stamp. A later stamp is believed, since a frame may have been dropped.
    """
    number, notes = whole_numbers(frames.number)
    if frames.stamp_us.shape != number.shape:
        raise ShapeError(f"expected a stamp a line, got {frames.stamp_us.shape} for {number.shape} frame numbers")
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
    """Frame numbers, gaps filled where the lines around them leave no doubt, and what was found."""
    if number.ndim != 1 or not len(number):
        raise ShapeError(f"expected the frame numbers of at least one line, got shape {number.shape}")
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
    """Stamps off the median of their neighbours by half a period."""
    if len(late) < 3:
        return np.zeros(len(late), np.bool_)
    window = min(_WINDOW, len(late) - 1 + len(late) % 2)  # odd
    around = np.lib.stride_tricks.sliding_window_view(np.pad(late, window // 2, mode="edge"), window)
    strayed: Bools = np.abs(late - np.median(around, axis=1)) > period_us / 2
    return strayed


@dataclass(frozen=True)
class ClockFit:
    """The mirror's time of a camera stamp: offset at ``origin_us``, and how much faster the camera's seconds pass."""

    origin_us: int
    offset_s: float
    drift_ppm: float
    residual_us: float  # rms of the events that count
    rejected: int  # events too far off to count

    def mirror_s(self, stamp_us: Ints) -> Floats:
        """Mirror's time of camera stamps. [s]"""
        return self.offset_s + (1 + self.drift_ppm * 1e-6) * ((stamp_us - self.origin_us) * 1e-6)


def fit_clocks(stamp_us: Ints, mirror_s: Floats) -> ClockFit:
    """Fit offset and drift to events that both clocks saw.

    A line through medians, then least squares with Tukey's weights; one event gives an offset alone.

    ``stamp_us`` (event,) are camera stamps [us], ``mirror_s`` (event,) the same events by the mirror's clock [s].
    ShapeError where there is no event, or the two are not of one length; RigError where the drift is above 1000 ppm, so
    these are not the same events.
    """
    if stamp_us.ndim != 1 or stamp_us.shape != mirror_s.shape or not len(stamp_us):
        raise ShapeError(f"expected as many stamps as times, at least one, got {stamp_us.shape} and {mirror_s.shape}")
    origin = int(np.sort(stamp_us)[len(stamp_us) // 2])
    camera = (stamp_us - origin) * 1e-6  # differences of whole numbers first: stamps may be larger than 2^53
    slope, offset = _median_line(camera, mirror_s - camera)
    weight = np.ones(len(camera))
    for _ in range(_ROUNDS):
        off = mirror_s - camera - (offset + slope * camera)
        before = weight
        scale = max(SIGMA_OF_MEDIAN * float(np.median(np.abs(off))), LEAST_SCALE_S)
        weight = np.clip(1 - (off / (_TUKEY * scale)) ** 2, 0, None) ** 2
        slope, offset = _weighted_line(camera, mirror_s - camera, weight)
        if np.allclose(weight, before, rtol=0, atol=1e-9):
            break
    if abs(slope) * 1e6 > MOST_DRIFT_PPM:
        raise RigError(
            f"the camera's and the mirror's clocks would drift by {slope * 1e6:.0f} ppm, more than {MOST_DRIFT_PPM:g}: "
            f"the {len(camera)} events are not the same ones; look at the trigger's cable and its edge"
        )
    off = (mirror_s - camera - (offset + slope * camera)) * 1e6
    kept = off[weight > 0]
    freedom = max(len(kept) - min(len(kept) - 1, 2), 1)
    return ClockFit(
        origin_us=origin,
        offset_s=offset,
        drift_ppm=slope * 1e6,
        residual_us=float(np.sqrt(np.sum(kept**2) / freedom)),
        rejected=len(camera) - len(kept),
    )


def match_edges(
    stamp_us: Ints,
    number: Ints,
    edge_s: Floats,
    *,
    log_s: tuple[float, float],
    period_s: float,
    first_near_s: float | None = None,
) -> Ints:
    """Say which edge each frame belongs to.

    Frames repeat at a steady rate, so one frame's edge must be known: the first edge is that of frame 0 where the log
    was quiet before, the last is the last frame's where it is quiet after; else ``first_near_s`` must say it.

    Parameters
    ----------
    stamp_us, number
        (frame,) stamps that never go back, and numbers from the start of the capture; numbers may have gaps.
    edge_s, log_s
        (edge,) in order, by the mirror's clock; from when to when the log runs.
    first_near_s
        When frame 0 was, within less than half a period.

    Gives (frame,) the number of the edge; -1 where there is none within half a period. RigError where there is no edge,
    or nothing tells which frame one belongs to.
    """
    if not len(edge_s):
        raise RigError("the log holds no edge of a frame; is the trigger's cable in, and was the log on?")
    after = (stamp_us - stamp_us[0]) * 1e-6 + number[0] * period_s  # frame 0 would be at 0
    offset = _first_offset(after, edge_s, log_s, period_s, first_near_s)
    order = range(0, len(after), _BLOCK)
    backwards = offset < log_s[0] and after[-1] + offset <= log_s[1]  # the log has the end, so begin there
    found = np.full(len(after), -1, np.int64)
    for start in reversed(order) if backwards else order:
        block = slice(start, start + _BLOCK)
        found[block], near = _nearest(after[block] + offset, edge_s, period_s)
        if len(near):
            offset += float(np.median(near))
    return found


def _first_offset(
    after: Floats, edge_s: Floats, log_s: tuple[float, float], period_s: float, first_near_s: float | None
) -> float:
    """When frame 0 was, by the mirror's clock."""
    if edge_s[0] - log_s[0] > 1.5 * period_s:
        return float(edge_s[0])
    if log_s[1] - edge_s[-1] > 1.5 * period_s:
        return float(edge_s[-1] - after[-1])
    if first_near_s is None:
        raise RigError(
            f"the log ({log_s[1] - log_s[0]:.4g} s) begins after the first frame and ends before the last, so which of "
            "its edges is which frame is not known; start the log before the capture, or say when the first frame was"
        )
    begin = int(np.clip(np.searchsorted(edge_s, first_near_s) - _NEAR // 2, 0, max(len(edge_s) - _NEAR, 0)))
    near = edge_s[begin : begin + _NEAR]
    phase = float(np.median((near - first_near_s + period_s / 2) % period_s - period_s / 2))
    return first_near_s + phase


def _nearest(at_s: Floats, edge_s: Floats, period_s: float) -> tuple[Ints, Floats]:
    """Edge nearest to each time, -1 beyond half a period, and how far off those found are."""
    right = np.clip(np.searchsorted(edge_s, at_s), 1, max(len(edge_s) - 1, 1))
    left = right - 1
    right = np.minimum(right, len(edge_s) - 1)
    edge = np.where(np.abs(edge_s[right] - at_s) < np.abs(edge_s[left] - at_s), right, left)
    off = edge_s[edge] - at_s
    near = np.abs(off) < period_s / 2
    return np.where(near, edge, -1), off[near]


def _median_line(x: Floats, y: Floats) -> tuple[float, float]:
    """Slope and offset by medians: slopes over half the events each, so that noise counts little."""
    half = len(x) // 2
    span = x[half:] - x[: len(x) - half] if half else np.zeros(0)
    rise = y[half:] - y[: len(y) - half] if half else np.zeros(0)
    apart = span != 0
    slope = float(np.median(rise[apart] / span[apart])) if apart.any() else 0.0
    return slope, float(np.median(y - slope * x))


def _weighted_line(x: Floats, y: Floats, weight: Floats) -> tuple[float, float]:
    total = weight.sum()
    x0, y0 = float(weight @ x / total), float(weight @ y / total)
    spread = float(weight @ (x - x0) ** 2)
    slope = float(weight @ ((x - x0) * (y - y0))) / spread if spread > 0 else 0.0
    return slope, y0 - slope * x0


Method = Literal["trigger", "log", "command"]
_MIDDLE = {"start": 0.5, "middle": 0.0, "end": -0.5}  # exposures from the stamp to mid exposure


@dataclass(frozen=True)
class MirrorScanPath:
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
    frames: FrameTimes, camera: LineCamera, scan_path: MirrorScanPath, *, commands: CommandTimes | None = None
) -> LinePositions:
    """Take the logged position at mid exposure of each line, by the clocks' offset and drift.

    Edges in the log give both, by a fit; without edges the commands give an offset, and drift is taken as 0. There
    ``commands.run_s`` is when the log began. A stamp that goes back or is missing is made up from its neighbours; one
    far off its own edge counts by that edge. RigError without edges and command times, or where edges and stamps are of
    different events; ShapeError where the track's arrays do not fit each other.
    """
    if (
        scan_path.time_s.ndim != 1
        or not len(scan_path.time_s)
        or scan_path.position.shape != (len(scan_path.time_s), 2)
    ):
        raise ShapeError(
            f"expected logged times (sample,) and positions (sample, 2), got {scan_path.time_s.shape} and "
            f"{scan_path.position.shape}"
        )
    stamp, number, notes = mend_times(frames)
    first_s = None if commands is None else np.mean(commands.capture_s) - np.mean(commands.run_s)
    if scan_path.edge_s is None or not len(scan_path.edge_s):
        if first_s is None:
            raise RigError("the log holds no edges and there are no command times; nothing ties its clock to frames")
        return _by_offset(frames, camera, scan_path, stamp, float(first_s) + scan_path.time_s[0], commands, notes)
    log_s = (float(scan_path.time_s[0]), float(scan_path.time_s[-1]))
    near = None if first_s is None else float(first_s) + log_s[0]
    edge = match_edges(
        stamp, number, scan_path.edge_s, log_s=log_s, period_s=frames.period_ms * 1e-3, first_near_s=near
    )
    tied = edge >= 0
    if not tied.any():
        raise RigError(
            f"none of {len(edge)} frames lies within half a period of one of the log's edges; see the trigger"
        )
    fit = fit_clocks(stamp[tied], scan_path.edge_s[edge[tied]])
    began_s = fit.mirror_s(stamp)
    own = np.where(tied, scan_path.edge_s[edge], began_s)
    step_s = float(np.median(np.diff(scan_path.time_s))) if len(scan_path.time_s) > 1 else 0.0
    limit_s = max(6 * fit.residual_us * 1e-6, 3 * step_s)
    odd = tied & (np.abs(own - began_s) > limit_s)
    began_s = np.where(odd, own, began_s)
    notes += [f"{np.count_nonzero(tied)} of {len(tied)} frames have an edge in the log"]
    notes += [f"{np.count_nonzero(odd)} frames are stamped off their edge, which counts"] if odd.any() else []
    notes += [f"a drift cannot be told from {np.count_nonzero(tied)} frame"] if np.count_nonzero(tied) == 1 else []
    placed = _placed(frames, scan_path, began_s, "start", notes)
    px = _apart_px(scan_path, camera, (began_s[tied & ~odd], own[tied & ~odd]))
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
    scan_path = MirrorScanPath((np.arange(len(positions)) + 0.5) / path.rate_hz, positions)
    px = _apart_px(scan_path, camera, (middle_s[valid], middle_s[valid] + unknown_s))
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
    scan_path: MirrorScanPath,
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
    px = _apart_px(scan_path, camera, (began_s, began_s + unknown_s))
    notes = [*notes, f"the log has no edges: software timing, a constant line offset of about {px:.2g} px stays"]
    return replace(
        _placed(frames, scan_path, began_s, frames.stamp_at, notes),
        residual_us=unknown_s * 1e6,
        residual_px=px,
        offset_s=first_s,
    )


def _placed(
    frames: FrameTimes, scan_path: MirrorScanPath, told_s: Floats, told_at: StampAt, notes: list[str]
) -> LinePositions:
    """The log's positions at mid exposure of lines of which one moment is told by its clock."""
    middle_s = told_s + frames.exposure_ms * 1e-3 * _MIDDLE[told_at]
    valid = (middle_s >= scan_path.time_s[0]) & (middle_s <= scan_path.time_s[-1])
    if not valid.all():
        notes = [*notes, f"{np.count_nonzero(~valid)} of {len(valid)} lines lie outside of the log and are not valid"]
    found = np.where(valid[:, None], _at(scan_path, middle_s), np.nan)
    return LinePositions(found, np.where(valid, middle_s, np.nan), valid, "log", None, None, notes=tuple(notes))


def _at(scan_path: MirrorScanPath, time_s: Floats) -> Floats:
    """Logged positions between samples, (time, 2)."""
    return np.stack([np.interp(time_s, scan_path.time_s, scan_path.position[:, axis]) for axis in (0, 1)], axis=-1)


def _apart_px(scan_path: MirrorScanPath, camera: LineCamera, times: tuple[Floats, Floats]) -> float:
    """Root mean square of how far the view moves between two times of each line. [px]"""
    if not len(times[0]):
        return 0.0
    one, other = (direction_to_scene(position_to_direction(_at(scan_path, time_s))) for time_s in times)
    return float(np.sqrt(np.mean(np.sum((one - other) ** 2, axis=-1))) / camera.ifov_rad)


def _unknown_s(commands: CommandTimes) -> float:
    """Half of the time within which the path and the first frame began."""
    return float(np.ptp(commands.run_s) + np.ptp(commands.capture_s)) / 2
