"""Anchoring: the pointing of one fine sweep from what the coarse mosaic shows of the same ground."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SettingsError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.planning.coverage import field_px
from pipeline.rectify.registration.alignment import SweepShift, no_shifts
from pipeline.rectify.registration.overlaps import BroadSweep, PlacedImage
from pipeline.rectify.registration.shifts import PairShift, pair_shift
from pipeline.rectify.resample import resample

Floats = NDArray[np.float64]

ROUNDS = 2  # the second looks again from where the first has put the sweep
SETTLED_PRIOR_PX = 3.0


@dataclass(frozen=True)
class Anchor:
    """A sweep's correction, and what the last comparison said; without ``found`` the correction is 0."""

    shift: SweepShift
    found: PairShift  # in scene px, rows along the scan


def anchor_sweep(
    sweep: BroadSweep, camera: LineCamera, grid: SceneGrid, mosaic: NDArray[np.floating], *, prior_px: float
) -> Anchor:
    """Find where a fine sweep lies on the coarse mosaic.

    The sweep is rectified at the scene's pixels, blurred to what a coarse pixel sees, and compared with the mosaic
    interpolated there. One offset for the whole sweep: runs of the fine pass are short.

    Parameters
    ----------
    mosaic
        (y, x) broad-band mean of the coarse mosaic, the mean of the same bands as the sweep's image.
    prior_px
        How far the sweep may look beside its reported positions, in either axis. [px]

    Raises
    ------
    SettingsError : the prior is negative or not finite.
    PoseError : a corrected position is beyond the mirror's rim.
    """
    if not (np.isfinite(prior_px) and prior_px >= 0):
        raise SettingsError(f"expected a finite prior >= 0 px, got {prior_px}")
    (shift,) = no_shifts([sweep.sweep.name])
    lines = len(sweep.position)
    if not sweep.usable.any():
        return Anchor(shift, _nothing(prior_px))
    for turn in range(ROUNDS):
        reach = prior_px if turn == 0 else min(prior_px, SETTLED_PRIOR_PX)
        image = PlacedImage(sweep, camera, shift.of_lines(lines))
        found = _compare(image, grid, mosaic, reach)
        if found.status != "found":
            return Anchor(no_shifts([sweep.sweep.name])[0], found)
        moved = np.asarray(np.linalg.solve(image.turn_at_middle, found.shift[::-1]), np.float64)
        shift = shift.plus(SweepShift(shift.name, moved, np.zeros(2)))
    return Anchor(shift, found)


def _compare(image: PlacedImage, grid: SceneGrid, mosaic: NDArray[np.floating], reach_px: float) -> PairShift:
    """Compare a sweep with the mosaic under it."""
    from scipy.ndimage import convolve1d

    along_px, scan_px = _box(image, grid, reach_px)
    if not (len(along_px) and len(scan_px)):
        return _nothing(reach_px)
    seen = image.seen_at(along_px, scan_px).astype(np.float64)
    for axis in (0, 1):  # a coarse pixel is a mean over factor x factor; what is not seen spreads by as much
        seen = convolve1d(seen, _coarse_footprint(grid.factor), axis=axis, mode="constant", cval=np.nan)
    under = _interpolated(mosaic, grid, image, (along_px, scan_px))
    return pair_shift(under, seen, prior_px=reach_px)


def _nothing(reach_px: float) -> PairShift:
    """What a comparison of nothing says."""
    nothing = np.full((1, 1), np.nan)
    return pair_shift(nothing, nothing, prior_px=reach_px)


def _coarse_footprint(factor: int) -> Floats:
    """Mean over ``factor`` pixels, centred; of an even number the outer two count half."""
    if factor % 2:
        return np.full(factor, 1 / factor)
    return np.concatenate([[0.5], np.ones(factor - 1), [0.5]]) / factor


def _interpolated(
    mosaic: NDArray[np.floating], grid: SceneGrid, image: PlacedImage, places: tuple[Floats, Floats]
) -> Floats:
    """The coarse mosaic at fine places, (scan, along); NaN where it holds nothing."""
    scan, along = np.meshgrid(places[1], places[0], indexing="ij")
    y, x = (scan, along) if image.broad.sweep.along == "x" else (along, scan)
    rows, columns = (
        (place + (size - 1) / 2 - (grid.factor - 1) / 2) / grid.factor
        for place, size in ((y, grid.height), (x, grid.width))
    )
    points = np.stack([rows.ravel(), columns.ravel()], axis=-1)
    values = np.ascontiguousarray(mosaic[..., None], np.float32)
    seen, _ = resample(values, np.isfinite(mosaic), points)
    return seen[:, 0].astype(np.float64).reshape(scan.shape)


def _box(image: PlacedImage, grid: SceneGrid, reach_px: float) -> tuple[Floats, Floats]:
    """Scene pixels along the line and along the scan that the sweep may have seen [px]."""
    across, scan = field_px(grid, image.broad.sweep.along)
    places = image.edges.reshape(-1, 2)
    found: list[Floats] = []
    for axis, size in ((0, across), (1, scan)):
        low, high = (float(end) + (size - 1) / 2 for end in (places[:, axis].min(), places[:, axis].max()))
        first, last = max(int(np.floor(low - reach_px)), 0), min(int(np.ceil(high + reach_px)), size - 1)
        found.append(np.arange(first, last + 1, dtype=np.float64) - (size - 1) / 2)
    return found[0], found[1]
