"""Numbers and time stamps of frames, made whole where some are missing or stray, or the camera's clock was set back."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np

from pipeline.errors import ShapeError
from pipeline.rig.capture.clock_fit import Bools, Floats, Ints

StampAt = Literal["start", "middle", "end"]
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
    from scipy import ndimage  # takes its time to import

    if len(late) < 3:
        return np.zeros(len(late), np.bool_)
    window = min(_WINDOW, len(late) - 1 + len(late) % 2)
    strayed: Bools = np.abs(late - ndimage.median_filter(late, window, mode="nearest")) > period_us / 2
    return strayed
