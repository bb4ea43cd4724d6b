"""What the mirror model leaves out, as bounds in px: finite distance, relief, an offset pivot, pointing, the staircase.

ERRATA.md gives their sizes, and the simulator's effects are held against them. The chief ray always passes through the
pivot, so there is no other parallax.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.mirror import direction_to_normal, scene_to_direction

_REST_INCIDENCE = float(np.sqrt(0.5))
_STEEPEST, _SHALLOWEST = float(np.sin(np.deg2rad(20.0))), float(np.sin(np.deg2rad(70.0)))


def distance_error(camera: LineCamera, distance_m: float, lever_m: float = 0.1) -> float:
    """Give the error at a line's end of taking the scene for infinitely far: half a line times L / d. [px]

    The virtual pinhole sits ``lever_m`` behind the pivot (assumed 0.1 m).
    """
    return camera.samples / 2 * lever_m / distance_m


def relief_error(camera: LineCamera, nearest_m: float, farthest_m: float, lever_m: float = 0.1) -> float:
    """Give the error at a line's end between the nearest and the farthest part of a scene, once one is right. [px]"""
    return camera.samples / 2 * lever_m * abs(1 / nearest_m - 1 / farthest_m)


def pivot_error(camera: LineCamera, distance_m: float, offset_m: float) -> float:
    """Give the greatest error of a mirror whose surface lies ``offset_m`` off its pivot. [px]

    2 delta |sin i - sin 45 deg| / (d IFOV) at incidences i of 20 to 70 deg.
    """
    turn = max(abs(sine - _REST_INCIDENCE) for sine in (_STEEPEST, _SHALLOWEST))
    return 2 * abs(offset_m) * turn / (distance_m * camera.ifov_rad)


def pointing_error(camera: LineCamera, tilt_rad: float) -> tuple[float, float]:
    """Give what a tilt error of the mirror moves the view by, at rest: in and across the plane of incidence. [px]"""
    return 2 * tilt_rad / camera.ifov_rad, 2**0.5 * tilt_rad / camera.ifov_rad


def line_stretch(
    camera: LineCamera, along_px: NDArray[np.float64], scan_px: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Give by how much a line's centre is stretched along the line, 1 / (2 |n_x n_z|), for arrays that broadcast. [-]

    Never below 1: strips one line apart always touch, and resolution falls by as much.
    """
    tangents = np.stack(np.broadcast_arrays(along_px, scan_px), axis=-1) * camera.ifov_rad
    normal = direction_to_normal(scene_to_direction(tangents))
    stretch: NDArray[np.float64] = 0.5 / np.abs(normal[..., 0] * normal[..., 2])
    return stretch


def staircase_jitter(samples: int, lines: int) -> float:
    """Give the rms error of line centres for ``samples`` held positions over ``lines`` lines 1 px apart. [px]

    Sample and hold with samples / lines positions per frame; 0 where that is a whole number.
    """
    # Area under the staircase in whole numbers: its differences then lose nothing.
    held, part = np.divmod(np.arange(lines + 1, dtype=np.int64) * samples, lines)
    area = lines * (held * (held - 1) // 2) + held * part
    off = np.diff(area) * (lines / samples**2) - np.arange(lines)
    return float(np.std(off))
