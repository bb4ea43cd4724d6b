"""Times of frames made whole, and fitted to the mirror's clock: offset and drift by robust least squares.

The camera stamps its frames in whole microseconds of its own clock, the mirror's logger counts samples at 10 kHz of
its own. Where the logger also takes down the frames' edges (the vector index under an external trigger, or a pulse at
an input), each edge and its frame are one event.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import RigError, ShapeError
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
