"""Sweeps of a whole field cut down to what shows a part of it: an area of interest, or what zones leave of a field."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import Sweep, scene_to_sweep
from pipeline.planning.coverage import ROUNDING_PX, TAPS_AFTER, TAPS_BEFORE


def sweeps_over(sweeps: Sequence[Sweep], grid: SceneGrid, camera: LineCamera, shown: NDArray[np.bool_]) -> list[Sweep]:
    """Give the lines of sweeps that show some of the ``shown`` (seat,) seats; sweeps that show none are left out.

    Lines stay where they lie and keep their order, between the first and the last that is needed none is left out, and
    the lines that resampling reads beside a pixel are among them. Of a sweep with all its lines nothing changes.
    """
    cut = ((sweep, lines_showing(sweep, grid, camera, np.flatnonzero(shown))) for sweep in sweeps)
    return [some_lines(sweep, *lines) for sweep, lines in cut if lines is not None]


def some_lines(sweep: Sweep, first: int, stop: int) -> Sweep:
    """Give a sweep with its lines from ``first`` to before ``stop`` alone, where they lie."""
    return replace(sweep, start_px=sweep.start_px + first * sweep.step, lines=stop - first)


def lines_showing(sweep: Sweep, grid: SceneGrid, camera: LineCamera, seats: NDArray[np.intp]) -> tuple[int, int] | None:
    """Give the first line that shows something of the seats and the one after the last; None where none does."""
    at = _corners_on(sweep, grid, camera, seats)
    ends = -0.5 - TAPS_BEFORE, camera.samples // sweep.binning - 0.5 + TAPS_AFTER
    seen = (at[..., 1].max(axis=0) >= ends[0]) & (at[..., 1].min(axis=0) <= ends[1])
    if not seen.any():
        return None
    lines = at[:, seen, 0]
    first = max(int(np.floor(lines.min() + ROUNDING_PX)) - TAPS_BEFORE, 0)
    stop = min(int(np.floor(lines.max() + ROUNDING_PX)) + TAPS_AFTER + 1, sweep.lines)
    return (first, stop) if first < stop else None


def seats_shown(sweeps: Sequence[Sweep], grid: SceneGrid, camera: LineCamera) -> NDArray[np.bool_]:
    """Tell of which seats (seat,) samples of some sweeps show something, without what is read beside them."""
    seats, shown = grid.valid_seats(), np.zeros(int(np.prod(grid.seat_shape)), np.bool_)
    for sweep in sweeps:
        at = _corners_on(sweep, grid, camera, seats)
        ends = sweep.lines - 0.5, camera.samples // sweep.binning - 0.5
        shown[seats] |= ((at.max(axis=0) > -0.5) & (at.min(axis=0) < ends)).all(axis=-1)
    return shown


def _corners_on(sweep: Sweep, grid: SceneGrid, camera: LineCamera, seats: NDArray[np.intp]) -> NDArray[np.float64]:
    """Line and sample of the corners of seats on a sweep, (corner, seat, 2).

    Either is monotone in either coordinate, so that a rectangle's corners hold its extremes.
    """
    origin, size = grid.seat_origin(seats), np.array([grid.height, grid.width])
    low, high = origin - size / 2, np.minimum(origin + grid.patch, size) - size / 2
    along, scan = (1, 0) if sweep.along == "x" else (0, 1)
    corners_along = np.stack([low, low, high, high])[..., along]
    return scene_to_sweep(sweep, camera, corners_along, np.stack([low, high, low, high])[..., scan])
