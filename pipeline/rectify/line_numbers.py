"""Line numbers: which line of the plan each arriving frame is, by its time stamp."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SettingsError, ShapeError

LATE_FRAMES = 0.25
LEAST_FRAMES = 3  # below that none can be told to be the late one
WILD_FRAMES = 1000  # a first or last stamp so far off the others is wrong, if they all lie nearer to each other
FITS = 2  # the second without the frames that the first finds late

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class LineNumbers:
    """What the time stamps of a sweep's frames say of its lines."""

    number: NDArray[np.intp]  # (frame,) line of the plan, counted from the first believed frame; of that line's
    # first frame where a frame came again; of the line before where the stamp is not believed
    usable: NDArray[np.bool_]  # (frame,)
    lost: int  # lines between the first and the last for which no frame came
    repeated: int  # frames that came again under the same stamp
    backward: int  # frames whose stamp goes back, lies far off all others, or is no number
    late: int  # usable frames more than a quarter period from their place


def number_lines(time_s: Floats, frame_s: float) -> LineNumbers:
    """Tell from time stamps (frame,), of mid exposure in the order of arrival [s], which line each frame is.

    A gap of more than 1.5 periods leaves numbers out. Of frames with equal stamps the first is kept. A stamp that goes
    back is not believed: the longest ascending row of stamps is, and of equally long ones that with the earlier frames,
    so that one wild stamp costs one line; so does a wild one that comes first or last. A late frame is used: its
    position is that of its own time. ``frame_s`` is the planned frame period; its true value is taken from the stamps,
    so that a slow clock makes no frame late.

    Raises SettingsError: the period is not above 0.
    Raises ShapeError: the stamps are not one row.
    """
    if not frame_s > 0:
        raise SettingsError(f"the frame period must be above 0 s, got {frame_s}")
    if time_s.ndim != 1:
        raise ShapeError(f"expected time stamps (frame,), got {time_s.shape}")
    known = np.isfinite(time_s)
    first = np.zeros(len(time_s), np.bool_)
    first[np.unique(time_s, return_index=True)[1]] = True
    repeated = int((known & ~first).sum())
    fresh = np.flatnonzero(known & first)
    usable = np.zeros(len(time_s), np.bool_)
    row = fresh[_longest_ascent(time_s[fresh])]
    usable[row[_without_wild_ends(time_s[row], frame_s)]] = True
    count = _numbers(time_s[usable], frame_s)
    number = np.zeros(len(time_s), np.intp)
    if len(count):
        same = np.minimum(np.searchsorted(time_s[usable], time_s), len(count) - 1)
        before = count[np.maximum(np.cumsum(usable) - 1, 0)]
        number = np.where(time_s[usable][same] == time_s, count[same], before)
    return LineNumbers(
        number=number,
        usable=usable,
        lost=int(count[-1]) + 1 - len(count) if len(count) else 0,
        repeated=repeated,
        backward=int((~usable).sum()) - repeated,
        late=_count_late(time_s[usable], count, frame_s),
    )


def _longest_ascent(values: Floats) -> NDArray[np.intp]:
    """Indices of the longest ascending row (patience sorting, from the back so that earlier frames are preferred)."""
    tops: list[float] = []
    piles: list[int] = []
    below = np.full(len(values), -1, np.intp)
    for index in range(len(values) - 1, -1, -1):
        pile = bisect_left(tops, -values[index])
        if pile:
            below[index] = piles[pile - 1]
        tops[pile : pile + 1] = [-values[index]]
        piles[pile : pile + 1] = [index]
    row = []
    index = piles[-1] if piles else -1
    while index >= 0:
        row.append(index)
        index = int(below[index])
    return np.array(row, np.intp)


def _without_wild_ends(time_s: Floats, frame_s: float) -> slice:
    """Ascending stamps but for a first and a last one that lie farther off than the others from each other."""
    if len(time_s) < LEAST_FRAMES:
        return slice(None)
    far = max(WILD_FRAMES * frame_s, float(time_s[-2] - time_s[1]))
    wild_first, wild_last = time_s[1] - time_s[0] > far, time_s[-1] - time_s[-2] > far
    return slice(int(wild_first), len(time_s) - int(wild_last))


def _numbers(time_s: Floats, frame_s: float) -> NDArray[np.intp]:
    """Line numbers of ascending stamps, the first being 0."""
    steps = np.ceil(np.diff(time_s) / frame_s - 0.5).astype(np.intp)  # half a period rounds down: 1.5 lose nothing
    count = np.concatenate([np.zeros(min(len(time_s), 1), np.intp), np.cumsum(steps)])
    # A frame that comes late by more than half a period looks like the next line; the one after shows that it is not.
    order = np.arange(len(count))
    count = order + np.minimum.accumulate((count - order)[::-1])[::-1]
    return count - count[:1]


def _count_late(time_s: Floats, count: NDArray[np.intp], frame_s: float) -> int:
    """Frames more than a quarter period from the even clock that fits them best."""
    near = np.ones(len(time_s), np.bool_)
    for _ in range(FITS):
        if near.sum() < LEAST_FRAMES:
            break
        period, start = np.polyfit(count[near], time_s[near], 1)
        near = np.abs(time_s - start - period * count) <= LATE_FRAMES * frame_s
    return int((~near).sum())
