"""Register sweeps: a pass by the overlaps of its sweeps, and a fine sweep by the coarse mosaic."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.pipeline.planning.coverage import field_px
from spectralzoom.pipeline.rectify.registration.alignment import (
    Floats,
    PairShift,
    SweepShift,
    SweepShifts,
    WindowShift,
    no_shifts,
    nothing_found,
    pair_shift,
    solve_sweeps,
    tied_to,
)
from spectralzoom.pipeline.rectify.registration.overlaps import (
    LEAST_OVERLAP_PX,
    BroadSweep,
    PlacedImage,
    Window,
    overlap_windows,
)
from spectralzoom.pipeline.rectify.resample import resample

WINDOW_PX = 512.0
SETTLED_PRIOR_PX = 3.0  # after the first round


@dataclass(frozen=True)
class SeamWindow:
    """One window of one overlap and the shift found there."""

    window: Window
    found: PairShift | None  # in pixels of the pass, rows along the scan; None: too narrow
    measured: WindowShift | None  # in scene px; None unless found
    residual_px: Floats  # (2,) along and scan, after the correction; NaN unless found


@dataclass(frozen=True)
class NarrowOverlap:
    """Two neighbours whose overlap is too narrow to be registered."""

    reference: str
    moving: str
    width_px: float
    needed_px: float


@dataclass(frozen=True)
class Registration:
    """Corrections of all sweeps of a pass, and the windows that they come from."""

    shifts: tuple[SweepShift, ...]
    reference: str | None  # the fixed sweep; None without sweeps
    untied: tuple[str, ...]  # sweeps that no accepted window joins to it: unchanged on average
    narrow: tuple[NarrowOverlap, ...]  # of pairs that no other overlap joins
    windows: tuple[SeamWindow, ...]  # of the last round

    def of(self, name: str) -> SweepShift:
        """Return the correction of one sweep."""
        return next(shift for shift in self.shifts if shift.name == name)


def register_sweeps(
    sweeps: Sequence[BroadSweep], camera: LineCamera, *, prior_px: float, window_px: float = WINDOW_PX
) -> Registration:
    """Find the places of the lines of one pass, relative to the middle sweep of the largest group that overlaps.

    Neighbours are rectified in their overlap and compared window by window (``window_px`` long). One offset and drift
    per sweep is solved for from all windows. A second round rectifies again with these corrections and searches within
    3 px. It is needed because a line turns with its centre, which the first round does not know. Pixels are resampled
    once: the corrections go into ``place(shift_px=...)``, which computes the geolocation grid again.

    ``prior_px`` is the largest pointing error of a sweep in either axis; a pair may be apart by twice that. Overlaps
    need 64 px beyond.

    Raises PoseError: a corrected position is beyond the mirror's rim.
    """
    names = [one.sweep.name for one in sweeps]
    lines = [len(one.position) for one in sweeps]
    shifts = no_shifts(names)
    among = frozenset(range(len(sweeps)))
    reference = None
    rounds: list[tuple[list[SeamWindow], SweepShifts]] = []
    for reach in (2 * prior_px, min(SETTLED_PRIOR_PX, 2 * prior_px)):
        seen = _measure_windows(place_images(sweeps, shifts, camera), reach, window_px, among)
        measured = [each.measured for each in seen if each.measured is not None]
        solved = solve_sweeps(measured, names, lines, reference=reference)
        shifts = tuple(old.plus(new) for old, new in zip(shifts, solved.shifts, strict=True))
        reference = solved.reference
        among -= set(solved.untied)
        left = iter(solved.residual)
        seen = [each if each.measured is None else replace(each, residual_px=next(left)) for each in seen]
        rounds.append((seen, solved))
    first, solved = rounds[0]
    return Registration(
        shifts=shifts,
        reference=names[solved.reference] if names else None,
        untied=tuple(names[number] for number in solved.untied),
        narrow=tuple(_narrow(first, names, 2 * prior_px)),
        windows=tuple(rounds[-1][0]),
    )


def place_images(
    sweeps: Sequence[BroadSweep], shifts: Sequence[SweepShift], camera: LineCamera
) -> tuple[PlacedImage, ...]:
    """Return the broad-band images at their corrected places."""
    return tuple(
        PlacedImage(one, camera, shift.of_lines(len(one.position))) for one, shift in zip(sweeps, shifts, strict=True)
    )


def _measure_windows(
    images: Sequence[PlacedImage], reach_px: float, window_px: float, among: Collection[int]
) -> list[SeamWindow]:
    """Compare all neighbours ``among`` the sweeps window by window; residuals are the shifts themselves.

    ``reach_px`` is the largest shift of a pair.
    """
    seen = []
    for window in overlap_windows(images, window_px=window_px):
        pair = (window.reference, window.moving)
        if not set(pair) <= set(among):
            continue
        if window.width_px < LEAST_OVERLAP_PX + reach_px:
            seen.append(SeamWindow(window, None, None, np.full(2, np.nan)))
            continue
        one, other = (images[number] for number in pair)
        pitch = one.broad.sweep.step  # the distance of the pass's lines
        along, scan = (np.arange(low, high, pitch) for low, high in (window.along_px, window.scan_px))
        found = pair_shift(one.seen_at(along, scan), other.seen_at(along, scan), prior_px=reach_px / pitch)
        measured = None
        middle = [(low + high) / 2 for low, high in (window.along_px, window.scan_px)]
        if found.status == "found":
            here, there = one.line_and_turn(*middle), other.line_and_turn(*middle)
            if here is not None and there is not None:
                shift, error = found.shift[::-1] * pitch, found.error_px[::-1] * pitch
                turn = np.stack([here[1], there[1]])
                measured = WindowShift(*pair, line=(here[0], there[0]), turn=turn, shift=shift, error_px=error)
        seen.append(SeamWindow(window, found, measured, np.full(2, np.nan) if measured is None else measured.shift))
    return seen


def _narrow(seen: Sequence[SeamWindow], names: Sequence[str], reach_px: float) -> Iterator[NarrowOverlap]:
    """Yield pairs whose windows are all too narrow, unless other overlaps join the two."""
    measured = [each.measured for each in seen if each.measured is not None]
    for (one, other), group in groupby(seen, key=lambda each: (each.window.reference, each.window.moving)):
        windows = list(group)
        if other not in tied_to(measured, one, len(names)) and all(each.found is None for each in windows):
            width = max(each.window.width_px for each in windows)
            yield NarrowOverlap(names[one], names[other], width, LEAST_OVERLAP_PX + reach_px)


@dataclass(frozen=True)
class Anchor:
    """A sweep's correction and the last comparison; the correction is 0 unless one was found."""

    shift: SweepShift
    found: PairShift  # in scene px, rows along the scan


def anchor_sweep(
    sweep: BroadSweep, camera: LineCamera, grid: SceneGrid, mosaic: NDArray[np.floating], *, prior_px: float
) -> Anchor:
    """Find the place of a fine sweep on the coarse mosaic, (y, x), the broad-band mean of the same bands as its image.

    The sweep is rectified at the scene's pixels. The search goes up to ``prior_px`` from its reported positions in
    either axis [px]. The result is one offset for the whole sweep, since runs of the fine pass are short.

    Raises PoseError: a corrected position is beyond the mirror's rim.
    """
    (shift,) = no_shifts([sweep.sweep.name])
    if not sweep.usable.any():
        return Anchor(shift, nothing_found("empty"))
    for reach in (prior_px, min(prior_px, SETTLED_PRIOR_PX)):
        image = PlacedImage(sweep, camera, shift.of_lines(len(sweep.position)))
        found = _compare_with_mosaic(image, grid, mosaic, reach)
        if found.status != "found":
            return Anchor(no_shifts([sweep.sweep.name])[0], found)
        moved = np.asarray(np.linalg.solve(image.turn_at_middle, found.shift[::-1]), np.float64)
        shift = shift.plus(SweepShift(shift.name, moved, np.zeros(2)))
    return Anchor(shift, found)


def _compare_with_mosaic(
    image: PlacedImage, grid: SceneGrid, mosaic: NDArray[np.floating], reach_px: float
) -> PairShift:
    """Compare a sweep with the mosaic at the scene's pixels that it may have seen."""
    places = image.edges.reshape(-1, 2)
    shown = []
    for axis, size in enumerate(field_px(grid, image.broad.sweep.along)):
        low, high = (float(end) + (size - 1) / 2 for end in (places[:, axis].min(), places[:, axis].max()))
        first, last = max(int(np.floor(low - reach_px)), 0), min(int(np.ceil(high + reach_px)), size - 1)
        shown.append(np.arange(first, last + 1, dtype=np.float64) - (size - 1) / 2)
    along_px, scan_px = shown
    if not (len(along_px) and len(scan_px)):
        return nothing_found("empty")
    seen = image.seen_at(along_px, scan_px).astype(np.float64)
    scan, along = np.meshgrid(scan_px, along_px, indexing="ij")
    y, x = (scan, along) if image.broad.sweep.along == "x" else (along, scan)
    rows, columns = (place + (size - 1) / 2 for place, size in ((y, grid.height), (x, grid.width)))
    points = np.stack([rows.ravel(), columns.ravel()], axis=-1)
    under, _ = resample(np.ascontiguousarray(mosaic[..., None], np.float32), np.isfinite(mosaic), points)
    return pair_shift(under[:, 0].astype(np.float64).reshape(scan.shape), seen, prior_px=reach_px)
