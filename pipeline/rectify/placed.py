"""Placed sweeps: lines, the tracks on which they lie, and the pixel grid that they are brought to."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import ShapeError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.rectify.calibration.flat_field import Elements, judge_elements
from pipeline.rectify.lookup import track_lookup
from pipeline.rectify.tie_points import TieTable, tie_table
from pipeline.rectify.tracks import Track, make_tracks
from pipeline.source import SweepLines

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

    Parameters
    ----------
    grid
        Pixels to make tie tables for, which a large mosaic is made with; None looks every point up directly.
    usable
        (line,) lines whose position may be believed; None takes ``lines.valid_line``.
    shift_px
        (line, 2) pointing corrections along the line and along the scan. [px]
    gain
        (band,) illumination correction of the sweep.

    Raises
    ------
    PoseError : a line's position is beyond the mirror's disk, or its path has no direction.
    ShapeError : arrays that do not fit the lines.
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

    def of_shape(shape: tuple[int, int]) -> TieTable:
        return tie_table(
            track,
            camera,
            along=lines.sweep.along,
            binning=lines.sweep.binning,
            origin_px=grid.origin_px,
            spacing_px=grid.spacing_px,
            shape=shape,
        )

    if of_shape((1, 1)).spacing < LEAST_TIE_PX:
        return None
    return of_shape(grid.shape)
