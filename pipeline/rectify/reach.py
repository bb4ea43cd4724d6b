"""Reach: which lines and samples of a track a part of the grid can need, before any pixel is looked up."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import points_of_scan
from pipeline.rectify.placed import PixelGrid, Placed
from pipeline.rectify.tracks import Track

PIECE_SAMPLES = 64
MARGIN_PX = 2.0  # of the grid: half a pixel, half a sample, and rounding
TAPS = 3  # knots and samples that a kernel reads beyond the outermost coordinate


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
        margin = MARGIN_PX + 0.75 * _widest_step(track) / (camera.ifov_rad * grid.spacing_px)
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


def _widest_step(track: Track) -> float:
    steps = np.hypot(np.diff(track.scan), np.diff(track.across))
    return max(float(track.width), float(steps.max(initial=0.0)))


def _spans(place: NDArray[np.float64], margin: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Least and greatest place of each piece, (knot, piece) each; float32, for they are kept for every sweep."""
    one, other = place[:, :-1], place[:, 1:]
    low, high = np.minimum(one, other) - margin, np.maximum(one, other) + margin
    return low.astype(np.float32), high.astype(np.float32)


def member_lines(track: Track, knots: slice) -> NDArray[np.intp]:
    """Numbers of the lines that some knots are made of, knot by knot."""
    stop = track.starts[knots.stop] if knots.stop < len(track) else len(track.lines)
    members: NDArray[np.intp] = track.lines[track.starts[knots.start] : stop]
    return members
