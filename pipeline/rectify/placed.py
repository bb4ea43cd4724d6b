"""Place sweeps on a pixel grid: their scan paths, the tie points of the grid, and the pixels that lines reach.

The geolocation of a grid is stored as tie points at every few of its pixels, bilinear between, with a checked error.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.pipeline.geometry.scan import Axis, Floats, points_of_scan
from spectralzoom.pipeline.rectify.geolocation import KnotCurve, drop_unseen, knots_of_points, path_geolocation
from spectralzoom.pipeline.rectify.scan_paths import ScanPath, make_scan_paths
from spectralzoom.pipeline.signal.lines import CondensedSignal, Signal, signal_of
from spectralzoom.pipeline.source import SweepLines

SAFETY = 1.05  # on the bound of tie points, which holds to the second order
PIECE_SAMPLES = 64
MARGIN_PX = 2.0  # of the grid: half a pixel, half a sample, and rounding
TAPS = 3  # knots and samples that a kernel reads beyond the outermost coordinate
TOLERANCE_PX = 2e-3  # of interpolated coordinates [px of the sweep]
MOST_TIE_PX = 16  # from tie point to tie point
LEAST_TIE_PX = 4  # closer tie points take a byte a pixel and more: such points are located directly


@dataclass(frozen=True)
class PixelGrid:
    """Pixels of a grid: y and x of the first centre from the scene's centre, their distance, and their number."""

    origin_px: tuple[float, float]
    spacing_px: float
    shape: tuple[int, int]

    @classmethod
    def of_scene(cls, grid: SceneGrid) -> PixelGrid:
        """Return the scene's own pixels."""
        return cls(((1 - grid.height) / 2, (1 - grid.width) / 2), 1, (grid.height, grid.width))

    def points(self, rows: slice, columns: slice) -> NDArray[np.float64]:
        """Return the centres of a part of the pixels, (y, x, 2) from the scene's centre [px]."""
        y = self.origin_px[0] + self.spacing_px * np.arange(rows.start, rows.stop)
        x = self.origin_px[1] + self.spacing_px * np.arange(columns.start, columns.stop)
        return np.stack(np.broadcast_arrays(y[:, None], x[None, :]), axis=-1)


@dataclass(frozen=True)
class TieTable:
    """Knot and sample of a grid's pixels, stored at every ``spacing``-th one and bilinear between.

    Only the part of the grid that the scan path can show is stored. Tie points beyond its ends and sides are
    extrapolated, so that every pixel near its border has four.
    """

    tie_points: Floats  # (row, column, 2) knot and sample of the pixels ``corner`` + (row, column) * spacing
    spacing: int
    shape: tuple[int, int]  # (y, x) of the grid
    bound_px: float  # largest error of a coordinate [px of the sweep]
    seen: NDArray[np.bool_]  # (knot,) of the scan path
    samples: int  # of a line
    corner: tuple[int, int]  # first row and column of the stored part of the grid
    kept: tuple[int, int]  # rows and columns of it

    def coordinates(self, rows: slice, columns: slice) -> Floats:
        """Return the coordinates of a contiguous part of the grid, (y, x, 2), as ``path_geolocation`` does."""
        asked = [range(size)[one] for one, size in zip((rows, columns), self.shape, strict=True)]
        here = [
            slice(min(max(one.start - first, 0), count), max(min(one.stop - first, count), 0))
            for one, first, count in zip(asked, self.corner, self.kept, strict=True)
        ]
        if any(part.stop <= part.start for part in here):
            found: Floats = np.empty((0, 0, 2))
        else:
            found = self._between(*here)
            tie_points = self.tie_points[
                tuple(slice(one.start // self.spacing, -(-one.stop // self.spacing) + 1) for one in here)
            ]
            most = np.array([len(self.seen), self.samples]) - 0.5
            # with all tie points on the scan path, all pixels between are
            if not (self.seen.all() and (tie_points >= -0.5).all() and (tie_points <= most).all()):
                drop_unseen(found, self.seen, self.samples)
        if found.shape[:2] == (len(asked[0]), len(asked[1])):
            return found
        whole = np.full((len(asked[0]), len(asked[1]), 2), np.nan)
        top, left = (first + one.start - part.start for first, one, part in zip(self.corner, here, asked, strict=True))
        whole[top : top + found.shape[0], left : left + found.shape[1]] = found
        return whole

    def _between(self, rows: slice, columns: slice) -> Floats:
        """Interpolate along the few rows of tie points first, then down the columns, which are contiguous in memory."""
        first, last = rows.start // self.spacing, (rows.stop - 1) // self.spacing
        cell, part = np.divmod(np.arange(columns.start, columns.stop), self.spacing)
        tie_points = self.tie_points[first : last + 2]
        left = np.take(tie_points, cell, axis=1)
        along = left + (part / self.spacing)[:, None] * (np.take(tie_points, cell + 1, axis=1) - left)
        flat = along.reshape(len(along), -1)  # two axes instead of three: numpy's loops are then twice as fast
        out = np.empty((rows.stop - rows.start, flat.shape[1]))
        for row in range(first, last + 1):
            start, stop = max(row * self.spacing, rows.start), min((row + 1) * self.spacing, rows.stop)
            down = (np.arange(start, stop) - row * self.spacing) / self.spacing
            block = out[start - rows.start : stop - rows.start]
            above = flat[row - first]
            np.multiply(flat[row - first + 1] - above, down[:, None], out=block)
            block += above
        return out.reshape(len(out), len(cell), 2)


def tie_table(
    scan_path: ScanPath, camera: LineCamera, grid: PixelGrid, *, along: Axis, binning: int = 1
) -> TieTable | None:
    """Tabulate the geolocation of a scan path over a grid; None if lines lie too unevenly for tie points.

    The distance of tie points starts at 16 pixels. It is halved until the error of the pixels between, in lines
    and in samples, is at most ``TOLERANCE_PX`` [px of the sweep]. The bound is an eighth of the tie points' second
    differences (of both axes together). The deviation of the knots from straight lines of that length is added, which
    finds a single line out of place between tie points. The error half-way between tie points is used instead if it is
    larger.
    """
    curve = KnotCurve(scan_path)
    samples = camera.samples // binning
    corner, kept = _within_reach(curve, camera, grid, along, binning)

    def exact(first: float, step: int, counts: tuple[int, int]) -> Floats:
        y, x = (start + grid.spacing_px * (at + first) for start, at in zip(grid.origin_px, corner, strict=True))
        points = PixelGrid((y, x), step * grid.spacing_px, counts).points(slice(0, counts[0]), slice(0, counts[1]))
        return knots_of_points(curve, camera, points.reshape(-1, 2), along, binning).reshape(*counts, 2)

    step_px = grid.spacing_px * camera.ifov_rad / scan_path.width
    tie = MOST_TIE_PX
    while tie >= LEAST_TIE_PX:
        tie_points = np.empty((0, 0, 2))
        bound = _knot_bound(scan_path, tie * step_px)
        if bound <= TOLERANCE_PX and min(kept) > 0:
            rows, columns = ((size - 1) // tie + 2 for size in kept)
            tie_points = exact(0, tie, (rows, columns))
            corners = _corners(tie_points)
            ends = np.array([len(scan_path), samples]) - 0.5
            cells = ((corners.max(axis=0) >= -0.5) & (corners.min(axis=0) <= ends)).all(axis=-1)  # with points of it
            bound = SAFETY * (bound + _tie_bound(tie_points, cells))
            if bound <= TOLERANCE_PX:
                middle = exact(tie / 2, tie, (rows - 1, columns - 1))
                bound = max(bound, float(np.abs(middle - corners.mean(axis=0))[cells].max(initial=0)))
        if bound <= TOLERANCE_PX:
            return TieTable(tie_points, tie, grid.shape, bound, scan_path.seen, samples, corner, kept)
        tie //= 2
    return None


def _within_reach(
    curve: KnotCurve, camera: LineCamera, grid: PixelGrid, along: Axis, binning: int
) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the first row and column of the pixels between the ends of any line of the scan path, and how many."""
    knots = np.concatenate([[-0.5], np.arange(len(curve.scan_path)), [len(curve.scan_path) - 0.5]])
    scan, _, across, _ = (tangent[:, None] / camera.ifov_rad for tangent in curve.at(knots))
    ends = np.array([0, camera.samples // binning * binning]) - camera.samples / 2
    x, y = points_of_scan(across, camera, scan, ends * camera.ifov_rad)  # type: ignore[arg-type]
    step = float(np.max(np.hypot(np.diff(scan[:, 0]), np.diff(across[:, 0]))))  # a curve leaves its knots by less
    low, high = [], []
    for place, start, size in zip((y, x) if along == "x" else (x, y), grid.origin_px, grid.shape, strict=True):
        low.append(int(np.clip(np.floor((place.min() - step - start) / grid.spacing_px) - 1, 0, size)))
        high.append(int(np.clip(np.ceil((place.max() + step - start) / grid.spacing_px) + 2, 0, size)))
    kept = (high[0] - low[0], high[1] - low[1])
    return ((low[0], low[1]), kept) if min(kept) > 0 else ((0, 0), (0, 0))


def _knot_bound(scan_path: ScanPath, knots: float) -> float:
    """Return the deviation of knots from the middle of straight lines, up to ``knots`` long [step]."""
    if scan_path.uniform and scan_path.straight:
        return 0.0
    worst = 0.0
    for half in range(1, min(int(np.ceil(knots / 2)), (len(scan_path) - 1) // 2) + 1):
        for tangent in (scan_path.scan, scan_path.across):
            middle = (tangent[: -2 * half] + tangent[2 * half :]) / 2
            worst = max(worst, float(np.abs(tangent[half:-half] - middle).max()) / scan_path.width)
    return worst


def _tie_bound(tie_points: Floats, cells: NDArray[np.bool_]) -> float:
    """Return the largest error of bilinear interpolation in the given cells, by their corners' second differences."""
    total = np.zeros_like(tie_points)
    for axis in (0, 1):
        if tie_points.shape[axis] > 2:
            inner = np.abs(np.diff(tie_points, 2, axis=axis))
            total += np.pad(inner, [(1, 1) if at == axis else (0, 0) for at in range(3)], mode="edge")
    return float(np.max(_corners(total), axis=0)[cells].max(initial=0)) / 8


def _corners(tie_points: Floats) -> Floats:
    """Return the four tie points of each cell, (4, row, column, 2)."""
    return np.stack([tie_points[:-1, :-1], tie_points[:-1, 1:], tie_points[1:, :-1], tie_points[1:, 1:]])


@dataclass(frozen=True)
class PlacedSweep:
    """One sweep and its scan paths, each with tie points of a grid, or None to locate points directly."""

    lines: SweepLines
    scan_paths: tuple[tuple[ScanPath, TieTable | None], ...]
    gain: NDArray[np.float32] | None = None  # (band,) factor of the sweep's values

    @cached_property
    def signal(self) -> Signal | CondensedSignal:
        """Return its lines in scene values, or in scores of components."""
        return signal_of(self.lines, self.gain)

    def coordinates(
        self, number: int, camera: LineCamera, grid: PixelGrid, rows: slice, columns: slice
    ) -> NDArray[np.float64]:
        """Return knot and sample at which scan path ``number`` saw part of the grid's pixels, (y, x, 2); NaN off it."""
        scan_path, table = self.scan_paths[number]
        if table is not None:
            return table.coordinates(rows, columns)
        return self.locate_point(scan_path, camera, grid.points(rows, columns))

    def locate_point(
        self, scan_path: ScanPath, camera: LineCamera, points_px: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return knot and sample at which a scan path saw any points, (..., 2); NaN off it."""
        sweep = self.lines.sweep
        return path_geolocation(scan_path, camera, points_px, along=sweep.along, binning=sweep.binning)


def place(
    lines: SweepLines,
    camera: LineCamera,
    *,
    grid: PixelGrid | None = None,
    usable: NDArray[np.bool_] | None = None,
    shift_px: NDArray[np.float64] | None = None,
    gain: NDArray[np.float32] | None = None,
) -> PlacedSweep:
    """Find where the lines of a sweep lie.

    ``grid`` are the pixels of a large mosaic, for which tie tables are made; None locates every point directly.
    ``usable`` (line,) are lines with a trusted position, by default ``lines.valid_line``. ``shift_px`` (line, 2) are
    pointing corrections along the line and along the scan [px], ``gain`` (band,) is the illumination correction.

    Raises PoseError: a line's position is beyond the mirror's disk, or its path has no direction.
    """
    sweep = lines.sweep
    usable = lines.valid_line if usable is None else usable
    scan_paths = make_scan_paths(
        lines.position, camera, usable=usable, shift_px=shift_px, binning=sweep.binning, step_px=sweep.step
    )

    def table(scan_path: ScanPath) -> TieTable | None:
        """Return the tie table of the whole grid."""
        return None if grid is None else tie_table(scan_path, camera, grid, along=sweep.along, binning=sweep.binning)

    return PlacedSweep(lines, tuple((scan_path, table(scan_path)) for scan_path in scan_paths), gain)


@dataclass(frozen=True)
class ColumnReach:
    """Knots and samples of one scan path in some columns of the grid, and the rows between which each knot lies."""

    top: NDArray[np.float32]  # (knot,) first row, inf where the knot shows none of the columns
    bottom: NDArray[np.float32]
    samples: slice

    def knots(self, rows: slice) -> slice:
        """Return knots that may show these rows, with the kernel's taps; empty if none does."""
        hit = np.flatnonzero((self.top < rows.stop) & (self.bottom >= rows.start))
        if not len(hit):
            return slice(0, 0)
        return slice(max(int(hit[0]) - TAPS, 0), min(int(hit[-1]) + TAPS + 1, len(self.top)))


class ScanPathReach:
    """Place of a scan path's lines on a grid, in pieces of 64 samples. Never too small, at most a piece too large."""

    def __init__(self, placed: PlacedSweep, scan_path: ScanPath, camera: LineCamera, grid: PixelGrid) -> None:
        sweep = placed.lines.sweep
        self._count = camera.samples // sweep.binning
        self._ends = np.append(np.arange(0, self._count, PIECE_SAMPLES), self._count)
        slope = ((self._ends - camera.samples / 2 / sweep.binning) * sweep.binning) * camera.ifov_rad
        centre = scan_path.scan[:, None] / camera.ifov_rad, scan_path.across[:, None] / camera.ifov_rad
        along, scan = points_of_scan(centre[1], camera, centre[0], slope[None, :])  # type: ignore[arg-type]
        y, x = (scan, along) if sweep.along == "x" else (along, scan)
        steps = np.hypot(np.diff(scan_path.scan), np.diff(scan_path.across))
        widest = max(float(scan_path.width), float(steps.max(initial=0.0)))
        margin = MARGIN_PX + 0.75 * widest / (camera.ifov_rad * grid.spacing_px)
        self._top, self._bottom = _spans((y - grid.origin_px[0]) / grid.spacing_px, margin)
        self._left, self._right = _spans((x - grid.origin_px[1]) / grid.spacing_px, margin)

    def in_columns(self, columns: slice) -> ColumnReach | None:
        """Return the reach of the scan path in some columns, or None if it shows none of them."""
        hit = (self._left < columns.stop) & (self._right >= columns.start)
        pieces = np.flatnonzero(hit.any(axis=0))
        if not len(pieces):
            return None
        first, last = int(self._ends[pieces[0]]), int(self._ends[pieces[-1] + 1])
        return ColumnReach(
            top=np.where(hit, self._top, np.inf).min(axis=1),
            bottom=np.where(hit, self._bottom, -np.inf).max(axis=1),
            samples=slice(max(first - TAPS, 0), min(last + TAPS, self._count)),
        )


def _spans(place: NDArray[np.float64], margin: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the least and greatest place of each piece, (knot, piece) each, as float32 to save memory."""
    one, other = place[:, :-1], place[:, 1:]
    low, high = np.minimum(one, other) - margin, np.maximum(one, other) + margin
    return low.astype(np.float32), high.astype(np.float32)


def member_lines(scan_path: ScanPath, knots: slice) -> NDArray[np.intp]:
    """Return the numbers of the lines of some knots, knot by knot."""
    stop = scan_path.starts[knots.stop] if knots.stop < len(scan_path) else len(scan_path.lines)
    return scan_path.lines[scan_path.starts[knots.start] : stop]
