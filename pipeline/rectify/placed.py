"""Placed sweeps: lines, the tracks on which they lie, the pixel grid, and what of it each track can reach."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import ShapeError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import points_of_scan
from pipeline.rectify.calibration.calibrate import Elements, judge_elements
from pipeline.rectify.lookup import track_lookup
from pipeline.rectify.tie_points import TieTable, tie_table
from pipeline.rectify.tracks import Track, make_tracks
from pipeline.source import SweepLines

PIECE_SAMPLES = 64
MARGIN_PX = 2.0  # of the grid: half a pixel, half a sample, and rounding
TAPS = 3  # knots and samples that a kernel reads beyond the outermost coordinate
LEAST_TIE_PX = 4  # closer ties take a byte a pixel and more


@dataclass(frozen=True)
class PixelGrid:
    """Pixels to be filled: y and x of the first centre from the scene's centre, their distance, and how many."""

    origin_px: tuple[float, float]
    spacing_px: int
    shape: tuple[int, int]

    @classmethod
    def of_scene(cls, grid: SceneGrid, step: int) -> PixelGrid:
        """The scene's own pixels for step 1, its coarse ones for ``grid.factor``."""
        shape = (grid.height, grid.width) if step == 1 else grid.coarse_shape
        return cls(((step - grid.height) / 2, (step - grid.width) / 2), step, shape)

    def points(self, rows: slice, columns: slice) -> NDArray[np.float64]:
        """Centres of a part of the pixels, (y, x, 2) from the scene's centre [px]."""
        y = self.origin_px[0] + self.spacing_px * np.arange(rows.start, rows.stop)
        x = self.origin_px[1] + self.spacing_px * np.arange(columns.start, columns.stop)
        return np.stack(np.broadcast_arrays(y[:, None], x[None, :]), axis=-1)


@dataclass(frozen=True)
class Placed:
    """One sweep and where its lines lie: tracks, each with the tie table of a grid or None for direct lookup."""

    lines: SweepLines
    tracks: tuple[tuple[Track, TieTable | None], ...]
    gain: NDArray[np.float32] | None = None  # (band,) what the sweep's values are multiplied by

    @cached_property
    def elements(self) -> Elements:
        """The detector's elements, judged by all of the references; the gain is in the panel's values."""
        plain = self.lines.references
        if self.gain is None:
            return judge_elements(plain)
        if self.gain.shape != plain.panel.shape:
            raise ShapeError(
                f"sweep {self.lines.sweep.name} has {len(plain.panel)} bands, its gain has shape {self.gain.shape}"
            )
        return judge_elements(replace(plain, panel=(plain.panel * self.gain).astype(np.float32)))

    def coordinates(
        self, number: int, camera: LineCamera, grid: PixelGrid, rows: slice, columns: slice
    ) -> NDArray[np.float64]:
        """Knot and sample at which track ``number`` saw a part of the grid's pixels, (y, x, 2); NaN off it."""
        track, table = self.tracks[number]
        if table is not None:
            return table.coordinates(rows, columns)
        return self.look_up(track, camera, grid.points(rows, columns))

    def look_up(self, track: Track, camera: LineCamera, points_px: NDArray[np.float64]) -> NDArray[np.float64]:
        """Knot and sample at which a track saw any points, (..., 2); NaN off it."""
        sweep = self.lines.sweep
        return track_lookup(track, camera, points_px, along=sweep.along, binning=sweep.binning)


def place(
    lines: SweepLines,
    camera: LineCamera,
    *,
    grid: PixelGrid | None = None,
    usable: NDArray[np.bool_] | None = None,
    shift_px: NDArray[np.float64] | None = None,
    gain: NDArray[np.float32] | None = None,
) -> Placed:
    """Find where the lines of a sweep lie.

    ``grid`` are pixels to make tie tables for, which a large mosaic is made with; None looks every point up directly.
    ``usable`` (line,) are lines whose position may be believed, None takes ``lines.valid_line``; ``shift_px`` (line, 2)
    pointing corrections along the line and along the scan [px]; ``gain`` (band,) the illumination correction of the
    sweep.

    Raises PoseError: a line's position is beyond the mirror's disk, or its path has no direction.
    Raises ShapeError: arrays that do not fit the lines.
    """
    sweep = lines.sweep
    tracks = make_tracks(
        lines.position,
        camera,
        usable=lines.valid_line if usable is None else usable,
        shift_px=shift_px,
        binning=sweep.binning,
        step_px=sweep.step,
    )
    tables = [None if grid is None else _table(track, lines, camera, grid) for track in tracks]
    return Placed(lines, tuple(zip(tracks, tables, strict=True)), gain)


def _table(track: Track, lines: SweepLines, camera: LineCamera, grid: PixelGrid) -> TieTable | None:
    """A table of the whole grid; None where lines lie too unevenly for ties to save anything."""
    of_grid = partial(tie_table, track, camera, along=lines.sweep.along, binning=lines.sweep.binning)
    of_shape = partial(of_grid, origin_px=grid.origin_px, spacing_px=grid.spacing_px)
    return None if of_shape(shape=(1, 1)).spacing < LEAST_TIE_PX else of_shape(shape=grid.shape)


@dataclass(frozen=True)
class ColumnReach:
    """What one track shows of some columns of the grid: rows between which each knot lies, and the samples there."""

    top: NDArray[np.float32]  # (knot,) first row, inf where the knot shows none of the columns
    bottom: NDArray[np.float32]
    samples: slice

    def knots(self, rows: slice) -> slice:
        """Knots that may show these rows, kernel's taps included; empty where none does."""
        hit = np.flatnonzero((self.top < rows.stop) & (self.bottom >= rows.start))
        if not len(hit):
            return slice(0, 0)
        return slice(max(int(hit[0]) - TAPS, 0), min(int(hit[-1]) + TAPS + 1, len(self.top)))


class TrackReach:
    """Where the lines of a track lie on a grid, in pieces of 64 samples. Never too little, at most a piece too much."""

    def __init__(self, placed: Placed, track: Track, camera: LineCamera, grid: PixelGrid) -> None:
        sweep = placed.lines.sweep
        self._placed = placed
        self._count = camera.samples // sweep.binning
        self._ends = np.append(np.arange(0, self._count, PIECE_SAMPLES), self._count)
        slope = ((self._ends - camera.samples / 2 / sweep.binning) * sweep.binning) * camera.ifov_rad
        centre = track.scan[:, None] / camera.ifov_rad, track.across[:, None] / camera.ifov_rad
        along, scan = points_of_scan(centre[1], camera, centre[0], slope[None, :])  # type: ignore[arg-type]
        y, x = (scan, along) if sweep.along == "x" else (along, scan)
        steps = np.hypot(np.diff(track.scan), np.diff(track.across))
        widest = max(float(track.width), float(steps.max(initial=0.0)))
        margin = MARGIN_PX + 0.75 * widest / (camera.ifov_rad * grid.spacing_px)
        self._top, self._bottom = _spans((y - grid.origin_px[0]) / grid.spacing_px, margin)
        self._left, self._right = _spans((x - grid.origin_px[1]) / grid.spacing_px, margin)

    def in_columns(self, columns: slice) -> ColumnReach | None:
        """What the track shows of some columns, or None where it shows nothing."""
        hit = (self._left < columns.stop) & (self._right >= columns.start)
        pieces = np.flatnonzero(hit.any(axis=0))
        if not len(pieces):
            return None
        first, last = int(self._ends[pieces[0]]), int(self._ends[pieces[-1] + 1])
        return ColumnReach(
            top=np.where(hit, self._top, np.inf).min(axis=1),
            bottom=np.where(hit, self._bottom, -np.inf).max(axis=1),
            samples=self._placed.elements.alone(slice(max(first - TAPS, 0), min(last + TAPS, self._count))),
        )


def _spans(place: NDArray[np.float64], margin: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Least and greatest place of each piece, (knot, piece) each; float32, for they are kept for every sweep."""
    one, other = place[:, :-1], place[:, 1:]
    low, high = np.minimum(one, other) - margin, np.maximum(one, other) + margin
    return low.astype(np.float32), high.astype(np.float32)


def member_lines(track: Track, knots: slice) -> NDArray[np.intp]:
    """Numbers of the lines that some knots are made of, knot by knot."""
    stop = track.starts[knots.stop] if knots.stop < len(track) else len(track.lines)
    return track.lines[track.starts[knots.start] : stop]
