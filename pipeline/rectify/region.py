"""Pixels of the scene grid from the lines of sweeps, a block of points at a time, reading only the lines it needs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.camera import LineCamera
from pipeline.grid import SceneGrid
from pipeline.rectify.calibrate import calibrate
from pipeline.rectify.lookup import grid_lookup, lookup
from pipeline.rectify.mosaic import Part, edge_distance, mosaic
from pipeline.rectify.resample import Kernel, resample
from pipeline.source import SweepLines

REACH_LINES = 3  # beyond the outermost coordinate, for the kernel's taps


def read_points(
    lines: SweepLines, camera: LineCamera, coordinates: NDArray[np.float64], kernel: Kernel = "catmull-rom"
) -> Part:
    """Calibrate and resample one sweep at lookup coordinates (n, 2).

    Invalid lines, saturated and uncalibrated samples count nothing; where they leave less than half of a kernel's
    weight the point is NaN with weight 0.
    """
    total, samples = len(lines.valid_line), lines.references.dark.shape[0]
    known = np.isfinite(coordinates.sum(axis=1))
    edge = edge_distance(coordinates, total, samples)
    if not known.any():
        bands = lines.references.panel.shape[0]
        return Part(np.full((len(known), bands), np.nan, np.float32), np.zeros(len(known), np.float32), edge)
    place = coordinates[known, 0]
    first = max(int(np.floor(place.min())) - REACH_LINES, 0)
    last = min(int(np.ceil(place.max())) + REACH_LINES + 1, total)
    saturated = camera.full_scale_dn * lines.sweep.binning
    values, valid = calibrate(lines.read(first, last), lines.references, saturated_dn=saturated)
    values_at, weight = resample(
        values, valid & lines.valid_line[first:last, None], coordinates - np.array([first, 0.0]), kernel
    )
    return Part(values_at, weight, edge)


def mosaic_rows(
    sweeps: Sequence[SweepLines], camera: LineCamera, grid: SceneGrid, *, rows: int, kernel: Kernel = "catmull-rom"
) -> Iterator[tuple[int, NDArray[np.float32], NDArray[np.intp]]]:
    """Rectify and blend the sweeps of one pass onto its grid, ``rows`` rows at a time.

    The pass's step says which grid: 1 the scene's pixels, ``grid.factor`` the coarse ones.

    Yields
    ------
    First row, (row, x, band) float32 with NaN where no line reached, (row, x) how many sweeps did.
    """
    step = sweeps[0].sweep.step
    height, width = (grid.height, grid.width) if step == 1 else grid.coarse_shape
    origin = ((step - grid.height) / 2, (step - grid.width) / 2)
    for first in range(0, height, rows):
        shape = (min(rows, height - first), width)
        parts = []
        for lines in sweeps:
            coordinates = grid_lookup(
                lines.position, camera, along=lines.sweep.along, binning=lines.sweep.binning,
                origin_px=(origin[0] + first * step, origin[1]), spacing_px=step, shape=shape,
            )  # fmt: skip
            parts.append(read_points(lines, camera, coordinates.reshape(-1, 2), kernel))
        values, coverage = mosaic(parts)
        yield first, values.reshape(*shape, -1), coverage.reshape(shape)


def seat_pixels(grid: SceneGrid, seats: NDArray[np.integer]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Give the points to look up for whole patches, (seat, p, p, 2), and which of them lie on the scene.

    A pixel beyond the scene's border repeats one inside by reflection within the seat, or the border pixel.
    """
    p = grid.patch
    inside = []
    places = []
    for axis, size in enumerate((grid.height, grid.width)):
        first = grid.seat_origin(seats)[:, axis, None]
        pixel = first + np.arange(p)
        mirrored = 2 * (size - 1) - pixel
        kept = np.where(pixel < size, pixel, np.where(mirrored >= first, mirrored, size - 1))
        inside.append(pixel < size)
        places.append(kept - (size - 1) / 2)
    y = np.broadcast_to(places[0][:, :, None], (len(seats), p, p))
    x = np.broadcast_to(places[1][:, None, :], (len(seats), p, p))
    return np.stack([y, x], axis=-1), inside[0][:, :, None] & inside[1][:, None, :]


def read_seats(
    sweeps: Sequence[SweepLines],
    camera: LineCamera,
    grid: SceneGrid,
    seats: NDArray[np.integer],
    kernel: Kernel = "catmull-rom",
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Rectify whole patches from the sweeps that saw them.

    Returns
    -------
    (seat, p, p, band) float32, NaN where no line reached, and (seat, p, p) pixels that lie on the scene and were seen.
    """
    points, on_scene = seat_pixels(grid, seats)
    flat = points.reshape(-1, 2)
    parts = []
    for lines in sweeps:
        coordinates = lookup(lines.position, camera, flat, along=lines.sweep.along, binning=lines.sweep.binning)
        parts.append(read_points(lines, camera, coordinates, kernel))
    values, coverage = mosaic(parts)
    patches = values.reshape(*points.shape[:3], -1)
    return patches, on_scene & (coverage > 0).reshape(on_scene.shape)
