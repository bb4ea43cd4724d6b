"""Registration: the pointing of a pass from the overlaps of its sweeps, and of a fine sweep from the coarse mosaic."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np
import scipy
from numpy.typing import NDArray

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.planning.coverage import field_px
from pipeline.rectify.registration.alignment import (
    SweepShift,
    SweepShifts,
    WindowShift,
    no_shifts,
    solve_sweeps,
    tied_to,
)
from pipeline.rectify.registration.overlaps import LEAST_OVERLAP_PX, BroadSweep, PlacedImage, Window, overlap_windows
from pipeline.rectify.registration.shifts import PairShift, nothing_found, pair_shift
from pipeline.rectify.resample import resample

Floats = NDArray[np.float64]

WINDOW_PX = 512.0
SETTLED_PRIOR_PX = 3.0  # once the first round has brought the sweeps together


@dataclass(frozen=True)
class SeamWindow:
    """One window of one overlap: where it lies and what was found there."""

    window: Window
    found: PairShift | None  # in pixels of the pass, rows along the scan; None: too narrow to tell
    measured: WindowShift | None  # in scene px; None unless found
    residual_px: Floats  # (2,) along and scan: what the correction leaves; NaN unless found


@dataclass(frozen=True)
class NarrowOverlap:
    """Two neighbours whose overlap is too narrow to be registered."""

    reference: str
    moving: str
    width_px: float
    needed_px: float


@dataclass(frozen=True)
class Registration:
    """Corrections of all sweeps of a pass, and what they rest on."""

    shifts: tuple[SweepShift, ...]
    reference: str | None  # the sweep that was held; None without sweeps
    untied: tuple[str, ...]  # sweeps that no accepted window joins to it: left where they were, on average
    narrow: tuple[NarrowOverlap, ...]  # where they leave sweeps apart
    windows: tuple[SeamWindow, ...]  # of the last round

    def of(self, name: str) -> SweepShift:
        """Give the correction of one sweep."""
        return next(shift for shift in self.shifts if shift.name == name)


def register_sweeps(
    sweeps: Sequence[BroadSweep], camera: LineCamera, *, prior_px: float, window_px: float = WINDOW_PX
) -> Registration:
    """Find where the lines of all sweeps of one pass lie, relative to the middle one of the largest group that overlap.

    Neighbours are rectified where they should overlap, compared window by window (``window_px`` long), and one offset
    and drift per sweep is solved for from all windows. A second round rectifies again with these corrections and looks
    within 3 px: a line turns with its centre, and the first round cannot see by how much. No pixel is shifted twice:
    the corrections go into ``place(shift_px=...)``, which makes the geolocation grid again.

    ``prior_px`` is how far any sweep may look beside the position that it reports, in either axis; a pair may be apart
    by twice that. Overlaps need 64 px beyond.

    Raises SettingsError: windows that are too short.
    Raises PoseError: a corrected position is beyond the mirror's rim.
    """
    shifts, among = no_shifts([one.sweep.name for one in sweeps]), frozenset(range(len(sweeps)))
    names, lines = [one.sweep.name for one in sweeps], [len(one.position) for one in sweeps]
    made: list[tuple[list[SeamWindow], SweepShifts]] = []
    reference: int | None = None
    for number in range(2):
        reach = 2 * prior_px if number == 0 else min(SETTLED_PRIOR_PX, 2 * prior_px)
        images = place_images(sweeps, shifts, camera)
        seen = measure_windows(images, reach_px=reach, window_px=window_px, among=among)
        measured = [each.measured for each in seen if each.measured is not None]
        solved = solve_sweeps(measured, names, lines, reference=reference)
        shifts = tuple(old.plus(new) for old, new in zip(shifts, solved.shifts, strict=True))
        reference, among = solved.reference, among - set(solved.untied)
        left = iter(solved.residual)
        seen = [each if each.measured is None else replace(each, residual_px=next(left)) for each in seen]
        made.append((seen, solved))
    first, solved = made[0]
    return Registration(
        shifts=shifts,
        reference=names[solved.reference] if names else None,
        untied=tuple(names[number] for number in solved.untied),
        narrow=tuple(_narrow(first, names, 2 * prior_px)),
        windows=tuple(made[-1][0]),
    )


def place_images(
    sweeps: Sequence[BroadSweep], shifts: Sequence[SweepShift], camera: LineCamera
) -> tuple[PlacedImage, ...]:
    """Put broad-band images where corrections say that their lines lie."""
    return tuple(
        PlacedImage(one, camera, shift.of_lines(len(one.position))) for one, shift in zip(sweeps, shifts, strict=True)
    )


def measure_windows(
    images: Sequence[PlacedImage],
    *,
    reach_px: float,
    window_px: float = WINDOW_PX,
    among: Collection[int] | None = None,
) -> list[SeamWindow]:
    """Compare all neighbours window by window, as they are placed; residuals are what was found.

    ``reach_px`` is the largest shift of a pair; ``among`` the numbers of the sweeps to be compared, None takes all.
    """
    seen = []
    for window in overlap_windows(images, window_px=window_px):
        if among is not None and not {window.reference, window.moving} <= set(among):
            continue
        if window.width_px < LEAST_OVERLAP_PX + reach_px:
            seen.append(SeamWindow(window, None, None, np.full(2, np.nan)))
            continue
        one, other = images[window.reference], images[window.moving]
        pitch = one.broad.sweep.step  # the distance of the pass's lines
        along, scan = (np.arange(low, high, pitch) for low, high in (window.along_px, window.scan_px))
        found = pair_shift(one.seen_at(along, scan), other.seen_at(along, scan), prior_px=reach_px / pitch)
        measured = _measured(window, found, images)
        seen.append(SeamWindow(window, found, measured, np.full(2, np.nan) if measured is None else measured.shift))
    return seen


def _measured(window: Window, found: PairShift, images: Sequence[PlacedImage]) -> WindowShift | None:
    """Return what a window says of its two sweeps, in scene px; None unless something was found."""
    if found.status != "found":
        return None
    middle = [(low + high) / 2 for low, high in (window.along_px, window.scan_px)]
    both = [images[number].line_and_turn(*middle) for number in (window.reference, window.moving)]
    if both[0] is None or both[1] is None:
        return None
    pitch = images[window.reference].broad.sweep.step
    return WindowShift(
        reference=window.reference,
        moving=window.moving,
        line=(both[0][0], both[1][0]),
        turn=np.stack([both[0][1], both[1][1]]),
        shift=found.shift[::-1] * pitch,
        error_px=found.error_px[::-1] * pitch,
    )


def _narrow(seen: Sequence[SeamWindow], names: Sequence[str], reach_px: float) -> Iterator[NarrowOverlap]:
    """Pairs none of whose windows was wide enough, unless other overlaps join the two."""
    measured = [each.measured for each in seen if each.measured is not None]
    for (one, other), group in groupby(seen, key=lambda each: (each.window.reference, each.window.moving)):
        windows = list(group)
        apart = other not in tied_to(measured, one, len(names))
        if apart and all(each.found is None for each in windows):
            width = max(each.window.width_px for each in windows)
            yield NarrowOverlap(names[one], names[other], width, LEAST_OVERLAP_PX + reach_px)


@dataclass(frozen=True)
class Anchor:
    """A sweep's correction, and what the last comparison said; without ``found`` the correction is 0."""

    shift: SweepShift
    found: PairShift  # in scene px, rows along the scan


def anchor_sweep(
    sweep: BroadSweep, camera: LineCamera, grid: SceneGrid, mosaic: NDArray[np.floating], *, prior_px: float
) -> Anchor:
    """Find where a fine sweep lies on the coarse mosaic, (y, x), the broad-band mean of the same bands as its image.

    The sweep is rectified at the scene's pixels, blurred to what a coarse pixel sees, and compared with the mosaic
    interpolated there, up to ``prior_px`` beside its reported positions in either axis [px]. One offset for the whole
    sweep: runs of the fine pass are short.

    Raises PoseError: a corrected position is beyond the mirror's rim.
    """
    (shift,) = no_shifts([sweep.sweep.name])
    lines = len(sweep.position)
    if not sweep.usable.any():
        return Anchor(shift, nothing_found("empty"))
    for turn in range(2):  # the second looks again from where the first has put the sweep
        reach = prior_px if turn == 0 else min(prior_px, SETTLED_PRIOR_PX)
        image = PlacedImage(sweep, camera, shift.of_lines(lines))
        found = _compare_with_mosaic(image, grid, mosaic, reach)
        if found.status != "found":
            return Anchor(no_shifts([sweep.sweep.name])[0], found)
        moved = np.asarray(np.linalg.solve(image.turn_at_middle, found.shift[::-1]), np.float64)
        shift = shift.plus(SweepShift(shift.name, moved, np.zeros(2)))
    return Anchor(shift, found)


def _compare_with_mosaic(
    image: PlacedImage, grid: SceneGrid, mosaic: NDArray[np.floating], reach_px: float
) -> PairShift:
    """Compare a sweep with the mosaic under it, at the scene's pixels that it may have seen."""
    places, shown = image.edges.reshape(-1, 2), []
    for axis, size in enumerate(field_px(grid, image.broad.sweep.along)):
        low, high = (float(end) + (size - 1) / 2 for end in (places[:, axis].min(), places[:, axis].max()))
        first, last = max(int(np.floor(low - reach_px)), 0), min(int(np.ceil(high + reach_px)), size - 1)
        shown.append(np.arange(first, last + 1, dtype=np.float64) - (size - 1) / 2)
    along_px, scan_px = shown
    if not (len(along_px) and len(scan_px)):
        return nothing_found("empty")
    mean = np.full(grid.factor, 1 / grid.factor)
    if grid.factor % 2 == 0:  # centred: the outer two count half
        mean = np.concatenate([[0.5], np.ones(grid.factor - 1), [0.5]]) / grid.factor
    seen = image.seen_at(along_px, scan_px).astype(np.float64)
    for axis in (0, 1):  # a coarse pixel is a mean over factor x factor; what is not seen spreads by as much
        seen = scipy.ndimage.convolve1d(seen, mean, axis=axis, mode="constant", cval=np.nan)
    scan, along = np.meshgrid(scan_px, along_px, indexing="ij")
    y, x = (scan, along) if image.broad.sweep.along == "x" else (along, scan)
    rows, columns = (
        (place + (size - 1) / 2 - (grid.factor - 1) / 2) / grid.factor
        for place, size in ((y, grid.height), (x, grid.width))
    )
    points = np.stack([rows.ravel(), columns.ravel()], axis=-1)
    under, _ = resample(np.ascontiguousarray(mosaic[..., None], np.float32), np.isfinite(mosaic), points)
    return pair_shift(under[:, 0].astype(np.float64).reshape(scan.shape), seen, prior_px=reach_px)
