"""How far a line's ends move when the mirror looks beside its plan: a little more than its centre, for it turns."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import Sweep, points_of_scan

Floats = NDArray[np.float64]


def end_gains(sweep: Sweep, camera: LineCamera) -> Floats:
    """Give the derivatives of a line's points (along, scan) by those of its centre, (line, point, 2, 2).

    The points are the line's two ends and its centre, where the derivatives are 1 and 0. At the end of 320 px a
    centre that moves by 1 px along the line moves the point by .034 px along the scan.
    """
    slopes = np.array([-0.5, 0.0, 0.5]) * camera.samples * camera.ifov_rad
    centre = sweep.line_px()[:, None]

    def points(strip: float, scan: float) -> Floats:
        return np.stack(points_of_scan(sweep.strip_px + strip, camera, centre + scan, slopes), axis=-1)

    by_strip, by_scan = (points(1, 0) - points(-1, 0)) / 2, (points(0, 1) - points(0, -1)) / 2
    return np.stack([by_strip, by_scan], axis=-1)


def at_line_ends(sweeps: Iterable[Sweep], camera: LineCamera, along: float, scan: float) -> tuple[float, float]:
    """Bound how far any point of any line moves, for centres that move by up to so much. [px]"""
    most = np.eye(2)
    for sweep in sweeps:
        if sweep.lines:
            most = np.maximum(most, np.abs(end_gains(sweep, camera)).max(axis=(0, 1)))
    moved = most @ [along, scan]
    return float(moved[0]), float(moved[1])
