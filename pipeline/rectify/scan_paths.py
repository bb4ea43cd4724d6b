"""Find scan paths: the places of a sweep's lines, as runs in one direction, and the frames whose time
stamps can be trusted.
"""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.errors import PoseError
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.mirror import RIM_SLACK, direction_to_scene, position_to_direction
from spectralzoom.pipeline.readings import SIGMA_OF_MEDIAN

STANDING_STEPS = 1e-3  # a mirror that moves less than this stands still
DWELL_STEPS = 0.25  # lines closer than this show the same place
GAP_STEPS = 1.5  # a wider distance misses a line; a smaller step back is noise
UNPLANNED_STEPS = 1.25  # lines this far apart were not taken as the plan, in whole pixels, says
NOISE_SIGMAS = 6.0  # a step back of less than this much of the path's own noise is no turn
EVEN_STEPS = 1e-7  # a path this straight and even has a closed form
LEAST_FRAMES = 3  # fewer cannot show which stamp is wild
WILD_FRAMES = 1000  # a first or last stamp this far off the others is wrong, if they lie nearer to each other

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class ScanPath:
    """One run of a sweep along the scan: knots where lines lie, in ascending order. Tangents of the scene plane.

    A knot is one line, or several at the same place, whose values are averaged. Missing lines are replaced by knots at
    even distances that nothing saw (``seen`` False), so that an even path stays even. Their one member is the nearest
    line, and does not count.
    """

    scan: Floats  # (knot,) of the line centres on the scan axis, ascending
    across: Floats  # (knot,) of the line centres along the line
    lines: NDArray[np.intp]  # (member,) numbers of the lines, knot by knot
    starts: NDArray[np.intp]  # (knot,) first member of each knot in ``lines``
    seen: NDArray[np.bool_]  # (knot,)
    width: float  # usual distance of lines, as a tangent

    def __len__(self) -> int:
        return len(self.scan)

    @property
    def straight(self) -> bool:
        """Return whether all line centres lie on one parallel to the scan axis."""
        return bool(np.ptp(self.across) < EVEN_STEPS * self.width)

    @property
    def uniform(self) -> bool:
        """Return whether all knots are ``width`` apart."""
        even = self.scan[0] + self.width * np.arange(len(self.scan))
        return bool(np.abs(self.scan - even).max() < EVEN_STEPS * self.width)


def make_scan_paths(
    position: Floats,
    camera: LineCamera,
    *,
    usable: NDArray[np.bool_] | None = None,
    shift_px: Floats | None = None,
    binning: int = 1,
    step_px: float | None = None,
) -> tuple[ScanPath, ...]:
    """Split a sweep into runs in one direction along the scan, and order the lines of each.

    A path turns where it goes back by more than 1.5 steps, and by more than six times its noise by second differences.
    Smaller steps back are sorted. Lines closer than a quarter step are one knot (a dwell). Lines that are not usable do
    not count for the path. A missing line is replaced by a knot that nothing saw. Resampling ignores its values, and
    fails where the rest weighs less than a half.

    ``position`` is (line, 2) mirror X and Y at mid exposure. ``shift_px`` (line, 2) are pointing corrections along the
    line and along the scan, added to the line centres. ``step_px`` is the planned distance of the lines. None takes the
    median of the path's own steps, or the width of a sample of ``binning`` px for a path that stands still. So does a
    recording whose lines are farther apart than the whole pixels of its plan.

    Returns the scan paths in order of capture; none if no line is usable.

    Raises PoseError: the position of a usable line is not finite or beyond the mirror's disk; names the first.
    """
    scan, across, lines = line_centres(position, camera, usable, shift_px)
    if not len(lines):
        return ()
    apart = camera.ifov_rad * (step_px or binning)
    steps = np.abs(np.diff(scan)) / np.diff(lines)
    steps = steps[steps > STANDING_STEPS * apart]
    # The lower median: of one step and one gap, the step.
    own = float(np.percentile(steps, 50, method="lower")) if len(steps) else apart
    step = own if step_px is None or UNPLANNED_STEPS < own / apart < GAP_STEPS else apart
    bends = np.abs(np.diff(scan, 2))  # of a position's own noise: sqrt 6 times its standard deviation
    noise = float(np.median(bends)) * SIGMA_OF_MEDIAN / 6**0.5 if len(bends) else 0.0
    runs = _runs(scan, max(GAP_STEPS * step, NOISE_SIGMAS * noise), DWELL_STEPS * step)
    return tuple(_scan_path(scan[run], across[run], lines[run], step) for run in runs)


def line_centres(
    position: Floats, camera: LineCamera, usable: NDArray[np.bool_] | None = None, shift_px: Floats | None = None
) -> tuple[Floats, Floats, NDArray[np.intp]]:
    """Return the centres of the usable lines of a sweep, in order of capture; raises as :func:`make_scan_paths`.

    The result is tangents on the scan axis and along the line, (usable line,) each, and the numbers of these lines.
    """
    lines = np.arange(len(position)) if usable is None else np.flatnonzero(usable)
    place = np.asarray(position[lines], np.float64)
    out = ~(np.hypot(place[:, 0], place[:, 1]) <= 1 + RIM_SLACK["float64"])
    if out.any():
        first = int(np.argmax(out))
        x, y = place[first]
        raise PoseError(
            f"line {lines[first]} is at mirror position ({x:.15g}, {y:.15g}), expected finite numbers in the unit"
            " disk; mark the line as not usable, or keep the field within the mirror's range"
        )
    tangent = direction_to_scene(position_to_direction(place))
    if shift_px is not None:
        tangent = tangent + shift_px[lines] * camera.ifov_rad
    return tangent[:, 1], tangent[:, 0], lines


def _runs(scan: Floats, most_back: float, still: float) -> list[slice]:
    """Return parts of the path in one direction, up to steps back of ``most_back``.

    The first line within ``still`` of the turn ends its part; later lines at the turn begin the next.
    """
    runs = []
    up, down = scan - np.minimum.accumulate(scan) > most_back, np.maximum.accumulate(scan) - scan > most_back
    rising = bool(up.any() and (not down.any() or np.argmax(up) < np.argmax(down)))
    first = 0
    while first < len(scan):
        way = scan[first:] if rising else -scan[first:]
        back = np.maximum.accumulate(way) - way > most_back
        rise = way[: np.argmax(back)] if back.any() else way[:0]
        stop = first + int(np.argmax(rise > rise.max() - still)) + 1 if len(rise) else len(scan)
        runs.append(slice(first, stop))
        first = stop
        rising = not rising
    return runs


def _scan_path(scan: Floats, across: Floats, lines: NDArray[np.intp], step: float) -> ScanPath:
    """Order one run, join its dwells and fill its gaps."""
    order = np.argsort(scan, kind="stable")
    scan, across, lines = scan[order], across[order], lines[order]
    starts = _dwell_starts(scan, DWELL_STEPS * step)
    counts = np.diff(starts, append=len(lines))
    if len(starts) < len(lines):
        lines = lines[np.lexsort((lines, np.repeat(np.arange(len(starts)), counts)))]
        scan, across = (np.add.reduceat(values, starts) / counts for values in (scan, across))
    missing = np.where(np.diff(scan) > GAP_STEPS * step, np.rint(np.diff(scan) / step) - 1, 0).astype(np.intp)
    at = np.concatenate([[0], np.cumsum(missing + 1)])
    seen = np.zeros(at[-1] + 1, np.bool_)
    seen[at] = True
    sizes = np.ones(len(seen), np.intp)
    sizes[at] = counts
    empty = np.flatnonzero(~seen)
    before = np.searchsorted(at, empty) - 1
    nearest = np.where(empty - at[before] <= at[np.minimum(before + 1, len(at) - 1)] - empty, before, before + 1)
    real = np.repeat(seen, sizes)
    members = np.empty(len(real), np.intp)
    members[real] = lines
    members[~real] = lines[(np.cumsum(counts) - counts)[nearest]]  # unseen knots get the nearest knot's first line
    knot = np.arange(len(seen))
    scan, across = np.interp(knot, at, scan), np.interp(knot, at, across)
    if len(scan) > 1:  # the mean step where all are equal up to rounding
        mean = float(scan[-1] - scan[0]) / (len(scan) - 1)
        step = mean if np.abs(scan - scan[0] - mean * knot).max() < EVEN_STEPS * mean else step
    return ScanPath(scan, across, members, np.cumsum(sizes) - sizes, seen, step)


def _dwell_starts(scan: Floats, reach: float) -> NDArray[np.intp]:
    """Return first members of the groups of lines that lie less than ``reach`` beyond the first of their group."""
    if (np.diff(scan) >= reach).all():
        return np.arange(len(scan))
    following = np.searchsorted(scan, scan + reach)
    starts = [0]
    while (start := int(following[starts[-1]])) < len(scan):
        starts.append(start)
    return np.array(starts, np.intp)


@dataclass(frozen=True)
class JudgedStamps:
    """Frames of a sweep with a trusted time stamp, and the faults of the others."""

    usable: NDArray[np.bool_]  # (frame,)
    lost: int  # lines between the first and the last without a frame
    repeated: int  # frames with a stamp that came before
    backward: int  # frames whose stamp goes back, lies far off all others, or is not finite


def judge_stamps(time_s: Floats, frame_s: float) -> JudgedStamps:
    """Judge time stamps (frame,) of mid exposure, in the order of arrival [s]; gaps above 1.5 periods lose lines.

    The first of frames with equal stamps is used. Stamps that go back are not trusted: the longest ascending row of
    stamps is, the one with the earlier frames if several are equally long. So one wild stamp costs one line, also at
    either end. A late frame is used, with the position at its own time. ``frame_s`` is the planned frame period.
    """
    known = np.isfinite(time_s)
    first = np.zeros(len(time_s), np.bool_)
    first[np.unique(time_s, return_index=True)[1]] = True
    repeated = int((known & ~first).sum())
    fresh = np.flatnonzero(known & first)
    usable = np.zeros(len(time_s), np.bool_)
    row = fresh[_longest_ascent(time_s[fresh])]
    if len(row) >= LEAST_FRAMES:  # a first or last stamp is wild if it lies farther off than the others from each other
        stamps = time_s[row]
        far = max(WILD_FRAMES * frame_s, float(stamps[-2] - stamps[1]))
        row = row[int(stamps[1] - stamps[0] > far) : len(row) - int(stamps[-1] - stamps[-2] > far)]
    usable[row] = True
    steps = np.ceil(np.diff(time_s[usable]) / frame_s - 0.5).astype(np.intp)  # half a period rounds down
    # A frame that comes late by more than half a period looks like the next line; the one after shows that it is not.
    missing = np.append(0, np.cumsum(steps - 1))
    lost = int(missing[-1] - missing.min())
    return JudgedStamps(usable, lost, repeated, backward=int((~usable).sum()) - repeated)


def _longest_ascent(values: Floats) -> NDArray[np.intp]:
    """Return indices of the longest ascending row (patience sorting, from the back to prefer earlier frames)."""
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
