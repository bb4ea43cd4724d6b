"""Locate points of the scene on a sweep, in lines and samples, by exact rays.

A straight scan path with even steps has a closed form; any other is solved by Newton's method on its knots. For whole
grids :mod:`pipeline.rectify.placed` stores the exact result at every few pixels.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.mirror import camera_slope, line_centre
from spectralzoom.pipeline.geometry.scan import Axis, Floats
from spectralzoom.pipeline.rectify.scan_paths import ScanPath

NEWTON_ROUNDS = 4
HALVINGS = 34  # from one knot to 1e-10 of it
SEARCH_KNOTS = 12
END_KNOTS = 4  # whose mean step is used beyond the end
FAR_KNOTS = 1e6  # Newton does not return from a larger step
SETTLED_PX = 1e-7
BLOCK_PX = 16384  # some twenty temporaries of this length stay in cache


@dataclass(frozen=True)
class KnotCurve:
    """The line's centre as a smooth function of the knot coordinate: the Catmull-Rom spline of a scan path's knots.

    Resampling by Catmull-Rom at the coordinate found here is exact where the scene is linear, however uneven the lines
    lie. Beyond the ends the curve is straight.
    """

    scan_path: ScanPath

    @cached_property
    def scan(self) -> Floats:
        """Return (4, interval) polynomials of the tangent on the scan axis; interval k + 1 begins at knot k."""
        return _catmull_rom_pieces(self.scan_path.scan, self.scan_path.width)

    @cached_property
    def across(self) -> Floats:
        """Return (4, interval) polynomials of the tangent along the line."""
        return _catmull_rom_pieces(self.scan_path.across, 0.0)

    def at(self, knot: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """Return scan tangent, its slope, tangent along the line, and its slope, at (n,) finite knot coordinates."""
        interval = np.clip(np.floor(knot), -1, len(self.scan_path) - 1)
        u = knot - interval
        number = interval.astype(np.intp) + 1
        found: list[Floats] = []
        for pieces in (self.scan, self.across):
            piece = pieces[:, number]
            found.append(((piece[3] * u + piece[2]) * u + piece[1]) * u + piece[0])
            found.append((3 * piece[3] * u + 2 * piece[2]) * u + piece[1])
        return found[0], found[1], found[2], found[3]

    def rough_knot(self, centre: Floats) -> Floats:
        """Return the knot coordinate of (n,) scan tangents by straight lines between the knots."""
        scan = self.scan_path.scan
        inside = np.interp(centre, scan, np.arange(len(scan), dtype=np.float64))
        before, after = np.minimum(centre - scan[0], 0), np.maximum(centre - scan[-1], 0)
        return np.asarray(inside + before / self.scan[1, 0] + after / self.scan[1, -1])


def knots_of_points(curve: KnotCurve, camera: LineCamera, points: Floats, along: Axis, binning: int) -> Floats:
    """Return knot and sample of points (n, 2), y and x [px], extrapolated beyond the scan path, block by block."""
    out = np.empty(points.shape, np.float64)
    for start in range(0, len(points), BLOCK_PX):
        block = slice(start, start + BLOCK_PX)
        y, x = points[block].T * camera.ifov_rad
        out[block] = _knot_and_sample(curve, camera, *((x, y) if along == "x" else (y, x)), binning)
    return out


def drop_unseen(found: Floats, seen: NDArray[np.bool_], samples: int) -> None:
    """Write NaN where coordinates (..., 2) lie off the scan path or next to a knot that nothing saw."""
    knot, sample = found[..., 0], found[..., 1]
    on = (knot >= -0.5) & (knot <= len(seen) - 0.5) & (sample >= -0.5) & (sample <= samples - 0.5)
    if not seen.all():
        on &= seen[np.clip(np.floor(np.where(on, knot, 0) + 0.5).astype(np.intp), 0, len(seen) - 1)]  # the nearest knot
    if not on.all():
        found[~on] = np.nan


def _knot_and_sample(curve: KnotCurve, camera: LineCamera, a: Floats, b: Floats, binning: int) -> Floats:
    """Return knot coordinate and sample (n, 2) of points with tangents a (along the line) and b (scan).

    Extrapolated beyond the scan path's ends and the line's; NaN where no line passes or no solution was found.
    """
    scan_path = curve.scan_path
    if scan_path.straight and scan_path.uniform:  # the knot coordinate has a closed form
        across = np.float64(scan_path.across[len(scan_path) // 2])
        centre = line_centre(a, b, across)
        found = np.empty((len(a), 2))
        np.multiply(centre - scan_path.scan[0], 1 / scan_path.width, out=found[:, 0])
        found[:, 1] = camera.sample_at(camera_slope(a, b, across, centre), binning)
        return found
    found = np.full((len(a), 2), np.nan)
    knot = _find_knots(curve, a, b, SETTLED_PX * camera.ifov_rad)
    settled = np.isfinite(knot)
    centre, _, wandered, _ = curve.at(knot[settled])
    found[settled, 0] = knot[settled]
    found[settled, 1] = camera.sample_at(camera_slope(a[settled], b[settled], wandered, centre), binning)
    return found


def _catmull_rom_pieces(knots: Floats, alone: float) -> Floats:
    """Return coefficients of 1, u, u^2, u^3 of all pieces; straight ones before the first knot and after the last."""
    reach = min(END_KNOTS, len(knots) - 1)
    before, after = (alone, alone) if not reach else (knots[reach] - knots[0], knots[-1] - knots[-1 - reach])
    before, after = before / max(reach, 1), after / max(reach, 1)
    padded = np.concatenate([[knots[0] - before], knots, [knots[-1] + after]])
    tangent = np.concatenate([[before], (padded[2:] - padded[:-2]) / 2, [after]])
    step = np.diff(padded)
    pieces = np.stack(
        [padded[:-1], tangent[:-1], 3 * step - 2 * tangent[:-1] - tangent[1:], tangent[:-1] + tangent[1:] - 2 * step]
    )
    pieces[2:, [0, -1]] = 0
    pieces[1, [0, -1]] = before, after
    return pieces


def _find_knots(curve: KnotCurve, a: Floats, b: Floats, tolerance: float) -> Floats:
    """Return the knot coordinate (n,) of the line that sees each point: by Newton, or by bisection if that fails."""
    rough = curve.rough_knot(line_centre(a, b, np.full_like(a, curve.scan_path.across[len(curve.scan_path) // 2])))
    knot = rough.copy()
    left = np.flatnonzero(np.isfinite(knot))
    for turn in range(NEWTON_ROUNDS + 1):
        miss, slope = _miss(curve, a[left], b[left], knot[left])
        off = ~(np.abs(miss) <= tolerance)
        left, miss, slope = left[off], miss[off], slope[off]
        if not len(left):
            return knot
        if turn < NEWTON_ROUNDS:
            moved = knot[left] - miss / np.where(slope == 0, np.nan, slope)
            knot[left] = np.where(np.abs(moved) < FAR_KNOTS, moved, rough[left])
    knot[left] = _bisect(curve, a[left], b[left], rough[left])
    return knot


def _miss(curve: KnotCurve, a: Floats, b: Floats, knot: Floats) -> tuple[Floats, Floats]:
    """Return how far the curve lies beyond the centre that the point needs, and the slope of this over the knots."""
    scan, scan_slope, across, across_slope = curve.at(knot)
    # the need is `pipeline.geometry.mirror.line_centre` of ``across``: d reach = 2 (a - c), d product = 2 c - a
    reach = 1 + a * a - (a - across) ** 2
    reach = np.where(reach > 0, reach, np.nan)
    root = np.sqrt(reach + b * b)
    product = across * (across - a)
    grown = (b + root) / reach
    need_slope = (2 * across - a) * grown + product * 2 * (a - across) * (0.5 / root - grown) / reach
    return scan - (b + product * grown), scan_slope - need_slope * across_slope


def _bisect(curve: KnotCurve, a: Floats, b: Floats, rough: Floats) -> Floats:
    """Halve the interval between two knots on either side of the centre, nearest to a rough start; NaN without one."""
    _, _, across, _ = curve.at(rough)
    rough = curve.rough_knot(line_centre(a, b, across))
    found = np.full_like(a, np.nan)
    known = np.isfinite(rough)
    a, b, rough = a[known], b[known], rough[known]
    knots = np.clip(np.floor(rough)[:, None] + np.arange(-SEARCH_KNOTS, SEARCH_KNOTS + 2), -1, len(curve.scan_path))
    beyond = np.stack([_miss(curve, a, b, column)[0] for column in knots.T], axis=-1)
    crosses = (beyond[:, :-1] <= 0) & (beyond[:, 1:] >= 0) & (knots[:, 1:] > knots[:, :-1])
    far = np.where(crosses, np.abs(knots[:, :-1] + 0.5 - rough[:, None]), np.inf)
    low = knots[np.arange(len(a)), np.argmin(far, axis=1)]
    size = 1.0
    for _ in range(HALVINGS):
        size /= 2
        low = np.where(_miss(curve, a, b, low + size)[0] <= 0, low + size, low)
    found[known] = np.where(crosses.any(axis=1), low, np.nan)
    return found


def path_geolocation(
    scan_path: ScanPath, camera: LineCamera, points_px: Floats, *, along: Axis, binning: int = 1
) -> Floats:
    """Return knot and sample at which a scan path saw some points (..., 2), y and x from the scene's centre [px].

    The result is (..., 2) float64 knot coordinate and sample, integers at centres. Catmull-Rom resampling at it gives
    the values of a linear scene for any distances of the knots, to the second order of the line's stretch. It is NaN
    where the point is off the scan path by more than half a step or half a sample. It is also NaN where nothing saw the
    nearest knot, or no crossing with the path was found.
    """
    found = knots_of_points(KnotCurve(scan_path), camera, points_px.reshape(-1, 2), along, binning)
    drop_unseen(found, scan_path.seen, camera.samples // binning)
    return found.reshape(points_px.shape)
