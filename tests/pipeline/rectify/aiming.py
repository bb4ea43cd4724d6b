"""Mirror positions for lines that look at given places."""

from __future__ import annotations

import numpy as np

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.mirror import direction_to_position, scene_to_direction

CAMERA = LineCamera()


def aim(along_px: np.ndarray | float, scan_px: np.ndarray) -> np.ndarray:
    """Mirror positions (line, 2) that look at points given in px along the line and the scan."""
    tangents = np.stack(np.broadcast_arrays(along_px, scan_px), axis=-1) * CAMERA.ifov_rad
    return direction_to_position(scene_to_direction(tangents))
