"""Lookup: where on a sweep, in lines and samples, each point of the scene was seen. Exact rays.

A straight even track has a closed form, any other is solved by Newton (:mod:`pipeline.rectify.knot_curve`). For whole
grids :mod:`pipeline.rectify.tie_points` keeps the exact answer at every few pixels.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import PoseError, ShapeError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import Axis
from pipeline.rectify.knot_curve import KnotCurve, drop_unseen, grid_points, knots_of_points
from pipeline.rectify.tie_points import TieTable as TieTable
from pipeline.rectify.tie_points import tie_table as tie_table
from pipeline.rectify.tracks import Track, line_centres, single_track

Floats = NDArray[np.float64]


def lookup(position: Floats, camera: LineCamera, points_px: Floats, *, along: Axis, binning: int = 1) -> Floats:
    """Find the line and sample at which a sweep that runs one way saw each point.

    Parameters
    ----------
    position
        (line, 2) mirror X and Y at mid exposure. The sweep may run either way but must not turn or stand still; such
        sweeps are split by :func:`pipeline.rectify.tracks.make_tracks` first.
    points_px
        (..., 2) y and x from the scene's centre. [px]
    along
        Scene axis that the line lies along.
    binning
        Neighbouring samples summed in the sweep.

    Returns
    -------
    (..., 2) float64 line and sample, integers at centres; NaN where the point is off the sweep by more than half a
    line or half a sample. The line of a one-line sweep is taken to be as wide as its (binned) samples.

    Raises
    ------
    PoseError : the sweep turns or stands still, naming the line; or a position is out of reach.
    ShapeError : positions or points are not pairs.
    """
    if not len(position):
        raise ShapeError(f"expected mirror positions (line, 2) of at least one line, got {position.shape}")
    scan, _, _ = line_centres(position, camera)
    falling = bool(scan[-1] < scan[0])
    if (still := np.diff(-scan if falling else scan) <= 0).any():
        at = int(np.argmax(still)) + falling
        raise PoseError(f"the sweep turns or stands still near line {at}; split it into parts that run one way")
    found = track_lookup(single_track(position, camera, binning), camera, points_px, along=along, binning=binning)
    if falling:
        found[..., 0] = len(position) - 1 - found[..., 0]
    return found


def grid_lookup(
    position: Floats,
    camera: LineCamera,
    *,
    along: Axis,
    binning: int,
    origin_px: tuple[float, float],
    spacing_px: float,
    shape: tuple[int, int],
) -> Floats:
    """Find the line and sample for every pixel of a regular grid.

    Parameters
    ----------
    origin_px
        y and x of the first pixel's centre, from the scene's centre. [px]
    spacing_px
        Distance of the pixel centres. [px]
    shape
        (y, x) of the grid.

    Returns
    -------
    (y, x, 2) float64, as of :func:`lookup`.
    """
    points = grid_points(origin_px, spacing_px, shape)
    return lookup(position, camera, points, along=along, binning=binning)


def track_lookup(track: Track, camera: LineCamera, points_px: Floats, *, along: Axis, binning: int = 1) -> Floats:
    """Find the knot and sample at which a track saw each point.

    Parameters
    ----------
    points_px
        (..., 2) y and x from the scene's centre. [px]
    along
        Scene axis that the line lies along.

    Returns
    -------
    (..., 2) float64 knot coordinate and sample, integers at centres. Resampling by Catmull-Rom at it gives the values
    of a linear scene whatever the knots' distances, to the second order of how a line's image stretches. NaN where
    the point is off the track by more than half a step or half a sample, where the nearest knot is one that nothing
    saw, and where no crossing with the path was found.

    Raises
    ------
    ShapeError : points are not pairs.
    """
    if points_px.shape[-1] != 2:
        raise ShapeError(f"expected points (..., 2) of y and x, got {points_px.shape}")
    found = knots_of_points(KnotCurve(track), camera, points_px.reshape(-1, 2), along, binning)
    drop_unseen(found, track.seen, camera.samples // binning)
    return found.reshape(points_px.shape)
