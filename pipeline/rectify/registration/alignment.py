"""Compute corrections from shifts of windows: of sweeps, by least squares over their overlaps, and of a whole field.

The shift and rotation of a field since an earlier visit come from windows of two coarse images. Crops grow, shadows
move and leaves fall between two visits, so single windows may be wrong. The result is what most windows agree on.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product

import numpy as np
import scipy
import skimage
from numpy.typing import NDArray

from pipeline.rectify.registration.shifts import Floats, pair_shift

ERROR_FLOOR_PX = 0.05  # least error of a window: lines jitter
OUTLIER_ERRORS = 2.0  # the influence of a window is limited beyond
WRONG_ERRORS = 10.0  # a window is left out beyond
DRIFT_PRIOR_PX = 10.0  # over half a sweep; separates drift from offset if there is one window alone
OFFSET_PRIOR_PX = 1e4  # affects only the mean of sweeps that are not tied to the reference
WINDOWS = 3  # along either side of a field
LEAST_WINDOW_PX = 24  # on a side; a smaller field is one window
WINDOW_REACH_PX = 8.0  # largest difference of a window's shift from that of the field
AGREE_PX, LOOSELY_PX = 0.5, 1.5  # largest differences of windows that agree, and agree loosely
LOOSE_SHIFT_PX, LOOSE_EDGE_PX = 2.0, 3.0  # least loose estimates that count: growth causes smaller ones
TRIED_DEG = (-8.0, 8.0, -16.0, 16.0)  # rotations that are tried if windows show nothing without one
LEAST_WINDOWS, LEAST_FRACTION = 4, 0.6  # number and fraction of windows that have to agree
TRIALS = 200


@dataclass(frozen=True)
class SweepShift:
    """Shift of a sweep's line centres from the reported ones, in scene px along the line and the scan."""

    name: str
    offset: Floats  # (2,) at the middle of the sweep [px]
    drift: Floats  # (2,) [px per line]

    def of_lines(self, lines: int) -> Floats:
        """Return the shift of every line of a sweep of ``lines`` lines, (line, 2) along and scan [px]."""
        return self.offset + self.drift * (np.arange(lines) - (lines - 1) / 2)[:, None]

    def plus(self, other: SweepShift) -> SweepShift:
        """Add a later correction of the same sweep."""
        return SweepShift(self.name, self.offset + other.offset, self.drift + other.drift)


@dataclass(frozen=True)
class WindowShift:
    """Shift of the moving sweep of a pair from the reference sweep, in one window of their overlap.

    A shift of the line centre by d moves the place of the window's sample by ``turn @ d``. That is nearly d, but the
    line turns with its centre: at its end by 1.7 px for 50.
    """

    reference: int  # number of the sweep
    moving: int
    line: tuple[float, float]  # at the window's middle, of either sweep
    turn: Floats  # (2, 2, 2) of either sweep
    shift: Floats  # (2,) along and scan [px]
    error_px: Floats  # (2,)


@dataclass(frozen=True)
class SweepShifts:
    """Corrections of all sweeps, the residuals of all windows, and the sweeps without a tie to the reference."""

    shifts: tuple[SweepShift, ...]
    residual: Floats  # (window, 2) measured less modelled [px]
    reference: int  # number of the sweep that was held
    untied: tuple[int, ...]  # numbers of those not joined to it by accepted windows


def no_shifts(names: Sequence[str]) -> tuple[SweepShift, ...]:
    """Return zero corrections."""
    return tuple(SweepShift(name, np.zeros(2), np.zeros(2)) for name in names)


def solve_sweeps(
    windows: Sequence[WindowShift], names: Sequence[str], lines: Sequence[int], *, reference: int | None = None
) -> SweepShifts:
    """Find the offset and drift of every sweep, given by name and lines, from the shifts of accepted windows.

    It is a least squares fit with soft L1 loss: each window is weighted by its error, and its influence is limited to
    twice that. Windows with residuals above ten times their error are then left out, and the fit is repeated. Overlaps
    show differences only, so the ``reference`` sweep is fixed: by default the middle one of the largest group that
    windows join. Sweeps without a tie to the reference have a mean shift of 0, and are listed as untied.
    """
    held = reference
    if held is None:
        groups = [sorted(tied_to(windows, sweep, len(names))) for sweep in range(len(names))]
        largest = max(groups, key=len, default=[0])
        held = largest[len(largest) // 2]
    joined = tied_to(windows, held, len(names))
    untied = tuple(number for number in range(len(names)) if number not in joined)
    if not windows:
        return SweepShifts(no_shifts(names), np.empty((0, 2)), held, untied)
    halves = [max((count - 1) / 2, 1.0) for count in lines]
    system = np.zeros((2 * len(windows), 4 * len(lines)))  # columns of a sweep: offset, and drift in px at its end
    for row, window in enumerate(windows):
        for side, sweep in enumerate((window.reference, window.moving)):
            place = (window.line[side] - (lines[sweep] - 1) / 2) / halves[sweep]
            signed = (2 * side - 1) * window.turn[side]
            system[2 * row : 2 * row + 2, 4 * sweep : 4 * sweep + 4] += np.hstack([signed, place * signed])
    system[:, 4 * held : 4 * held + 4] = 0
    measured = np.concatenate([window.shift for window in windows])
    error = np.concatenate([np.hypot(window.error_px, ERROR_FLOOR_PX) for window in windows])
    answer = _robust(system, measured, error)
    wrong = np.abs((measured - system @ answer) / error).reshape(-1, 2).max(axis=1) > WRONG_ERRORS
    if wrong.any():
        kept = np.repeat(~wrong, 2)
        answer = _robust(system[kept], measured[kept], error[kept])
    residual = (measured - system @ answer).reshape(-1, 2)
    ends = zip(names, answer.reshape(-1, 2, 2), halves, strict=True)
    shifts = tuple(SweepShift(name, offset, drift / half) for name, (offset, drift), half in ends)
    return SweepShifts(shifts, residual, held, untied)


def tied_to(windows: Sequence[WindowShift], sweep: int, sweeps: int) -> frozenset[int]:
    """Return the sweeps that windows join to one, itself included."""
    joined, waiting = {sweep}, [sweep]
    while waiting:
        here = waiting.pop()
        for window in windows:
            pair = {window.reference, window.moving}
            if here in pair:
                waiting += pair - joined
                joined |= pair
    return frozenset(joined & set(range(sweeps)))


def _robust(system: Floats, measured: Floats, error: Floats) -> Floats:
    """Return the least squares solution with soft L1 loss; weak priors decide what the windows leave open."""
    width = system.shape[1]
    prior = np.diag(np.tile([1 / OFFSET_PRIOR_PX] * 2 + [1 / DRIFT_PRIOR_PX] * 2, width // 4))
    whole = np.vstack([system / error[:, None], prior])
    wanted = np.concatenate([measured / error, np.zeros(width)])
    start, *_ = np.linalg.lstsq(whole, wanted, rcond=None)
    solved = scipy.optimize.least_squares(
        lambda x: whole @ x - wanted, start, jac=lambda x: whole, loss="soft_l1", f_scale=OUTLIER_ERRORS, method="trf"
    )
    return np.asarray(solved.x)


@dataclass(frozen=True)
class FieldShift:
    """Motion of an earlier image to a later one: ``shift`` rows and columns [px], then a rotation about the middle."""

    shift: tuple[float, float] = (0.0, 0.0)
    turned_deg: float = 0.0

    def edge_px(self, shape: tuple[int, ...]) -> float:
        """Return how far the corners of a field of (y, x) ``shape`` move by the rotation alone."""
        return math.radians(abs(self.turned_deg)) * math.hypot(*shape[:2]) / 2


def field_shift(now: NDArray[np.floating], before: NDArray[np.floating], *, reach_px: float) -> FieldShift:
    """Find the motion of ``before`` onto ``now``, two (y, x) broad-band images of one field with NaN for no value.

    Offsets are searched up to ``reach_px``. The result is no motion if the windows do not agree: for fields without
    texture, or with changes everywhere.
    """
    whole = pair_shift(now, before, prior_px=reach_px)
    start = np.rint(whole.shift) if whole.status == "found" else np.zeros(2)
    if min(now.shape) < WINDOWS * LEAST_WINDOW_PX:
        return FieldShift((float(whole.shift[0]), float(whole.shift[1]))) if whole.status == "found" else FieldShift()
    found = _of_windows(now, scipy.ndimage.shift(before, start, order=0, cval=np.nan)) if start.any() else []
    there = _of_windows(now, before)
    for within in (AGREE_PX, LOOSELY_PX):
        both = (_agreed(pairs, at, now.shape, within) for pairs, at in ((there, np.zeros(2)), (found, start)))
        count, lies = max(both, key=lambda one: one[0])
        far = math.hypot(*lies.shift) >= LOOSE_SHIFT_PX or lies.edge_px(now.shape) >= LOOSE_EDGE_PX
        if count:
            return lies if far or within == AGREE_PX else FieldShift()
    for turn in TRIED_DEG:
        turned = scipy.ndimage.rotate(before, turn, reshape=False, order=1, cval=np.nan)
        count, lies = _agreed(_of_windows(now, turned), np.zeros(2), now.shape, LOOSELY_PX)
        if count:
            return replace(lies, turned_deg=lies.turned_deg + turn)
    return FieldShift()


Pairs = list[tuple[NDArray[np.float64], NDArray[np.float64]]]  # middle of a window, and its shift


def _of_windows(now: NDArray[np.floating], before: NDArray[np.floating]) -> Pairs:
    """Return the middles and shifts of the windows with a shift."""
    edges = [np.linspace(0, size, WINDOWS + 1).astype(int).tolist() for size in now.shape]
    pairs: Pairs = []
    for (top, bottom), (left, right) in product(pairwise(edges[0]), pairwise(edges[1])):
        window = np.s_[top:bottom, left:right]
        found = pair_shift(now[window], before[window], prior_px=WINDOW_REACH_PX)
        if found.status == "found":
            pairs.append((np.array([(top + bottom) / 2, (left + right) / 2]), found.shift))
    return pairs


def _agreed(
    pairs: Pairs, start: NDArray[np.float64], shape: tuple[int, ...], within_px: float
) -> tuple[int, FieldShift]:
    """Return how many windows agree, and on which motion; 0 and no motion if too few do."""
    if len(pairs) < LEAST_WINDOWS:
        return 0, FieldShift()
    middle = np.array(shape[:2]) / 2
    places = np.array([place - middle for place, _ in pairs])
    model, inliers = skimage.measure.ransac(  # type: ignore[no-untyped-call]
        (places, places + np.array([shift for _, shift in pairs])),
        skimage.transform.EuclideanTransform,
        min_samples=2,
        residual_threshold=within_px,
        max_trials=TRIALS,
        rng=0,
    )
    count = 0 if inliers is None else int(inliers.sum())
    if model is None or count < max(LEAST_WINDOWS, LEAST_FRACTION * len(pairs)):
        return 0, FieldShift()
    down, across = (model.translation + start).tolist()
    return count, FieldShift((float(down), float(across)), math.degrees(model.rotation))
