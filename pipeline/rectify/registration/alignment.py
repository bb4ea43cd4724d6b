"""Alignment: from shifts between overlapping windows to one correction per sweep, by least squares over all of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from pipeline.errors import SettingsError, ShapeError

Floats = NDArray[np.float64]

ERROR_FLOOR_PX = 0.05  # no window is believed better: lines jitter
OUTLIER_ERRORS = 2.0  # beyond it a window pulls no harder
WRONG_ERRORS = 10.0  # beyond it a window is left out
DRIFT_PRIOR_PX = 10.0  # over half a sweep; decides where one window alone would have to tell drift from offset
OFFSET_PRIOR_PX = 1e4  # decides nothing but the mean of sweeps that are tied to each other only


@dataclass(frozen=True)
class SweepShift:
    """Where a sweep's line centres lie beside the reported ones, in scene px along the line and the scan."""

    name: str
    offset: Floats  # (2,) at the middle of the sweep [px]
    drift: Floats  # (2,) [px per line]

    def of_lines(self, lines: int) -> Floats:
        """Give the shift of every line of a sweep of ``lines`` lines, (line, 2) along and scan [px]."""
        return self.offset + self.drift * (np.arange(lines) - (lines - 1) / 2)[:, None]

    def plus(self, other: SweepShift) -> SweepShift:
        """Add a later correction of the same sweep."""
        return SweepShift(self.name, self.offset + other.offset, self.drift + other.drift)


@dataclass(frozen=True)
class WindowShift:
    """How far the moving sweep of a pair looks beside the reference sweep, seen in one window of their overlap.

    A shift of the line centre by d moves the place that the window's sample sees by ``turn @ d``: nearly the same, but
    the line turns with its centre, which at its end is 1.7 px for 50.
    """

    reference: int  # number of the sweep
    moving: int
    line: tuple[float, float]  # at the window's middle, of either sweep
    turn: Floats  # (2, 2, 2) of either sweep
    shift: Floats  # (2,) along and scan [px]
    error_px: Floats  # (2,)


@dataclass(frozen=True)
class SweepShifts:
    """Corrections of all sweeps, what they leave of every window's shift, and the sweeps that nothing ties down."""

    shifts: tuple[SweepShift, ...]
    residual: Floats  # (window, 2) measured less modelled [px]
    reference: int  # number of the sweep that was held
    untied: tuple[int, ...]  # numbers of those not joined to it by accepted windows


def no_shifts(names: Sequence[str]) -> tuple[SweepShift, ...]:
    """Give corrections of nothing."""
    return tuple(SweepShift(name, np.zeros(2), np.zeros(2)) for name in names)


def solve_sweeps(
    windows: Sequence[WindowShift], names: Sequence[str], lines: Sequence[int], *, reference: int | None = None
) -> SweepShifts:
    """Find the offset and drift of every sweep, given by name and lines, from the shifts of accepted windows.

    Least squares, each window weighted by its error and none pulling harder than twice that error would (soft L1);
    those that are then still off by ten times their error are left out, and the rest is solved again. Overlaps see
    differences only: the ``reference`` sweep is held, by default the middle one of those with the most windows. Sweeps
    in no window stay at 0; those joined to each other but not to the reference stay at 0 on average. Both are named as
    untied.

    Raises SettingsError: the reference is no sweep.
    Raises ShapeError: a window names a sweep that is not there.
    """
    if len(names) != len(lines):
        raise ShapeError(f"expected a number of lines for each of {len(names)} sweeps, got {len(lines)}")
    for window in windows:
        if not {window.reference, window.moving} <= set(range(len(names))):
            raise ShapeError(f"a window joins sweeps {window.reference} and {window.moving}; there are {len(names)}")
    held = reference
    if held is None:  # the first of the largest groups that windows join, and of it the middle one
        groups = [sorted(tied_to(windows, sweep, len(names))) for sweep in range(len(names))]
        largest = max(groups, key=len, default=[0])
        held = largest[len(largest) // 2]
    if names and not 0 <= held < len(names):
        raise SettingsError(f"the reference must be one of the sweeps 0 to {len(names) - 1}, got {held}")
    joined = tied_to(windows, held, len(names))
    untied = tuple(number for number in range(len(names)) if number not in joined)
    if not windows:
        return SweepShifts(no_shifts(names), np.empty((0, 2)), held, untied)
    system, measured = _equations(windows, lines)
    system[:, 4 * held : 4 * held + 4] = 0
    error = np.concatenate([np.hypot(window.error_px, ERROR_FLOOR_PX) for window in windows])
    answer = _robust(system, measured, error)
    wrong = np.abs((measured - system @ answer) / error).reshape(-1, 2).max(axis=1) > WRONG_ERRORS
    if wrong.any():
        kept = np.repeat(~wrong, 2)
        answer = _robust(system[kept], measured[kept], error[kept])
    residual = (measured - system @ answer).reshape(-1, 2)
    ends = answer.reshape(-1, 2, 2)
    shifts = tuple(
        SweepShift(name, ends[number, 0], ends[number, 1] / _half(lines[number])) for number, name in enumerate(names)
    )
    return SweepShifts(shifts, residual, held, untied)


def tied_to(windows: Sequence[WindowShift], sweep: int, sweeps: int) -> frozenset[int]:
    """Give the sweeps that windows join to one, itself included."""
    joined, waiting = {sweep}, [sweep]
    while waiting:
        here = waiting.pop()
        for window in windows:
            pair = {window.reference, window.moving}
            if here in pair:
                waiting += pair - joined
                joined |= pair
    return frozenset(joined & set(range(sweeps)))


def _equations(windows: Sequence[WindowShift], lines: Sequence[int]) -> tuple[Floats, Floats]:
    """Two rows per window over four columns per sweep (offset, drift in px at the sweep's end), and what was seen."""
    system = np.zeros((2 * len(windows), 4 * len(lines)))
    for row, window in enumerate(windows):
        for side, sweep in enumerate((window.reference, window.moving)):
            place = (window.line[side] - (lines[sweep] - 1) / 2) / _half(lines[sweep])
            signed = (2 * side - 1) * window.turn[side]
            system[2 * row : 2 * row + 2, 4 * sweep : 4 * sweep + 4] += np.hstack([signed, place * signed])
    return system, np.concatenate([window.shift for window in windows])


def _half(lines: int) -> float:
    return max((lines - 1) / 2, 1.0)


def _robust(system: Floats, measured: Floats, error: Floats) -> Floats:
    """Least squares with soft L1 loss; weak priors settle what the windows leave open."""
    width = system.shape[1]
    prior = np.diag(np.tile([1 / OFFSET_PRIOR_PX] * 2 + [1 / DRIFT_PRIOR_PX] * 2, width // 4))
    whole = np.vstack([system / error[:, None], prior])
    wanted = np.concatenate([measured / error, np.zeros(width)])
    start, *_ = np.linalg.lstsq(whole, wanted, rcond=None)
    solved = scipy.optimize.least_squares(
        lambda x: whole @ x - wanted, start, jac=lambda x: whole, loss="soft_l1", f_scale=OUTLIER_ERRORS, method="trf"
    )
    answer: Floats = solved.x
    return answer
