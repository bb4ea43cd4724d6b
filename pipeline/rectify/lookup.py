"""Lookup: where on a sweep, in lines and samples, each point of the scene was seen. Exact rays, in closed form."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.camera import LineCamera
from pipeline.errors import PoseError, ShapeError
from pipeline.mirror import camera_slope, direction_to_scene, line_centre, position_to_direction
from pipeline.scan import Axis

BLOCK_PX = 16384  # some twenty temporaries of this length stay in cache
SETTLED_PX = 1e-7
MOST_ROUNDS = 60


@dataclass(frozen=True)
class _Path:
    """Tangents of the line centres by ascending scan tangent, and their line numbers; the ends reach half a line."""

    scan: NDArray[np.float64]
    across: NDArray[np.float64]
    line: NDArray[np.float64]
    straight: bool


def lookup(
    position: NDArray[np.float64], camera: LineCamera, points_px: NDArray[np.float64], *, along: Axis, binning: int = 1
) -> NDArray[np.float64]:
    """Find the line and sample at which a sweep saw each point.

    The line's centre and the camera ray to the point are closed forms (:func:`pipeline.mirror.line_centre`). Along a
    path that is not straight the centre's two tangents depend on each other, and are iterated.

    Parameters
    ----------
    position
        (line, 2) mirror X and Y at mid exposure. The sweep may run either way but must not turn.
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
    if points_px.shape[-1] != 2:
        raise ShapeError(f"expected points (..., 2) of y and x, got {points_px.shape}")
    path = _path(position, camera.ifov_rad * binning)
    points = points_px.reshape(-1, 2)
    out = np.empty(points.shape, np.float64)
    for start in range(0, len(points), BLOCK_PX):
        block = slice(start, start + BLOCK_PX)
        y, x = points[block].T * camera.ifov_rad
        out[block] = _line_and_sample(path, camera, *((x, y) if along == "x" else (y, x)), binning=binning)
    return out.reshape(points_px.shape)


def grid_lookup(
    position: NDArray[np.float64],
    camera: LineCamera,
    *,
    along: Axis,
    binning: int,
    origin_px: tuple[float, float],
    spacing_px: float,
    shape: tuple[int, int],
) -> NDArray[np.float64]:
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
    y = origin_px[0] + spacing_px * np.arange(shape[0])
    x = origin_px[1] + spacing_px * np.arange(shape[1])
    points = np.stack(np.broadcast_arrays(y[:, None], x[None, :]), axis=-1)
    return lookup(position, camera, points, along=along, binning=binning)


def _path(position: NDArray[np.float64], width: float) -> _Path:
    """Order the line centres by their scan tangent and reach half a line beyond both ends."""
    if position.ndim != 2 or position.shape[1] != 2 or not len(position):
        raise ShapeError(f"expected mirror positions (line, 2) of at least one line, got {position.shape}")
    tangent = direction_to_scene(position_to_direction(position))
    scan, across, line = tangent[:, 1], tangent[:, 0], np.arange(len(position), dtype=np.float64)
    if len(scan) > 1 and scan[-1] < scan[0]:
        scan, across, line = scan[::-1], across[::-1], line[::-1]
    gap = np.diff(scan)
    if (gap <= 0).any():
        at = int(line[int(np.argmax(gap <= 0))])
        raise PoseError(f"the sweep turns or stands still near line {at}; split it into parts that run one way")
    before, after = (gap[0], gap[-1]) if len(gap) else (width, width)
    step = line[1] - line[0] if len(gap) else 1.0
    return _Path(
        scan=np.concatenate([[scan[0] - before / 2], scan, [scan[-1] + after / 2]]),
        across=np.concatenate([across[:1], across, across[-1:]]),
        line=np.concatenate([[line[0] - step / 2], line, [line[-1] + step / 2]]),
        straight=bool(np.ptp(across) < SETTLED_PX * width),
    )


def _line_and_sample(
    path: _Path, camera: LineCamera, a: NDArray[np.float64], b: NDArray[np.float64], *, binning: int
) -> NDArray[np.float64]:
    """Line and sample at which points of tangents a (along the line) and b (scan) were seen, (n, 2)."""
    centre, across = _centre_on_path(path, a, b, SETTLED_PX * camera.ifov_rad)
    sample = camera.sample_at(camera_slope(a, b, across, centre), binning)
    count = camera.samples // binning
    line = np.interp(centre, path.scan, path.line, left=np.nan, right=np.nan)
    off = ~((sample >= -0.5) & (sample <= count - 0.5)) | np.isnan(line)
    line[off] = sample[off] = np.nan
    return np.stack([line, sample], axis=-1)


def _centre_on_path(
    path: _Path, a: NDArray[np.float64], b: NDArray[np.float64], tolerance: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Tangents (scan, along) of the centre of the line that sees each point; NaN where none does."""
    across = np.full(a.shape, path.across[len(path.across) // 2])
    centre = line_centre(a, b, across)
    if path.straight:
        return centre, across
    for _ in range(MOST_ROUNDS):
        across = np.interp(centre, path.scan, path.across)
        moved = line_centre(a, b, across)
        change = np.abs(moved - centre)
        centre = moved
        if not (change > tolerance).any():
            return centre, across
    centre[change > tolerance] = np.nan
    return centre, across
