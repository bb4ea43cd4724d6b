"""Mirror positions for lines that look at given places."""

from __future__ import annotations

import numpy as np

from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.mirror import direction_to_position, scene_to_direction
from spectralzoom.pipeline.geometry.scan import Axis
from spectralzoom.pipeline.rectify.geolocation import path_geolocation
from spectralzoom.pipeline.rectify.scan_paths import ScanPath, line_centres

CAMERA = LineCamera()


def aim(along_px: np.ndarray | float, scan_px: np.ndarray) -> np.ndarray:
    """Return mirror positions (line, 2) that look at points given in px along the line and the scan."""
    tangents = np.stack(np.broadcast_arrays(along_px, scan_px), axis=-1) * CAMERA.ifov_rad
    return direction_to_position(scene_to_direction(tangents))


def geolocation(
    position: np.ndarray, camera: LineCamera, points_px: np.ndarray, *, along: Axis, binning: int = 1
) -> np.ndarray:
    """Return line and sample at which a forward sweep sees points (..., 2), with a knot for every line."""
    scan, across, lines = line_centres(position, camera)
    steps = np.diff(scan)
    width = float(np.median(steps)) if len(steps) else camera.ifov_rad * binning
    if len(steps) and np.ptp(steps) < 1e-7 * width:
        width = float(scan[-1] - scan[0]) / len(steps)
    scan_path = ScanPath(scan, across, lines, np.arange(len(lines)), np.ones(len(lines), np.bool_), width)
    return path_geolocation(scan_path, camera, points_px, along=along, binning=binning)
