"""Compute where the samples of a line look by five models, from no rotation (L0) to exact rays (L4).

For comparison only, never for computing. Errata are in brackets; docs/background/errata.md has the figure of each.
Normals and directions are in the frame of :mod:`pipeline.geometry.mirror`.
"""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spectralzoom.pipeline.geometry import mirror
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.scan import points_of_scan

LineModel = Literal["L0", "L1", "L2", "L3", "L4"]
LINE_MODELS: tuple[LineModel, ...] = get_args(LineModel)
_SMALL_SLOPE = 1e-6


def line_rotation(direction: ArrayLike) -> mirror.Floats:
    """Return the rotation of the slit's image in the scene tangent plane, for unit directions (..., 3) [rad].

    It depends on the pose and not on the path (erratum E8). For a slit along y it is psi = atan2(o_y, 1 - o_z),
    anticlockwise from xi to eta. The line is exactly straight and runs along (cos psi, sin psi) in (xi, eta).

    A survey uses `scan.points_of_scan` instead, which includes the rotation; `line_centre` and `camera_slope` undo it.

    Raises PoseError: a direction is not finite, not of length 1, or is the camera's own ray.
    """
    o = mirror._units(direction, "view direction")
    return np.arctan2(o[..., 1], mirror._one_minus_z(o))


def unlimited_position(normal: ArrayLike) -> mirror.Floats:
    """Return the exact position of normals, also beyond the rim, because the paper's formulas continue there."""
    device = mirror.normal_to_device(normal)
    c2 = 2 * device[..., 2:] ** 2 - 1
    return 2 * device[..., 2:] * device[..., :2] / (c2 * mirror.REST_TANGENT)


def straight_slope_rotation(swath_px: ArrayLike, scan_px: ArrayLike, camera: LineCamera) -> NDArray[np.float64]:
    """Return the slope rotation -atan(dY/dX) of sweeps that are straight in the scene, without steps or noise. [rad]

    Line centres [px] broadcast; the derivative is a central difference over 2e-6 of tangent.
    """
    xi, eta = (np.asarray(value, np.float64) * camera.ifov_rad for value in (swath_px, scan_px))
    tangents = (np.stack(np.broadcast_arrays(xi, eta + way), axis=-1) for way in (-_SMALL_SLOPE, _SMALL_SLOPE))
    ends = [unlimited_position(mirror.direction_to_normal(mirror.scene_to_direction(one))) for one in tangents]
    step = ends[1] - ends[0]
    angle: NDArray[np.float64] = -np.arctan(step[..., 1] / step[..., 0])
    return angle


def line_points(
    model: LineModel, swath_px: float, scan_px: NDArray[np.float64], camera: LineCamera
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the places of each line's samples by one model of a line: along and scan, (line, sample) [px].

    L0 no rotation; L1 the paper's -atan(dY/dX); L2 the exact rotation; L3 exact rotation and local scale; L4 exact
    rays. L0 to L2 keep the scale of the undeflected line. ``scan_px`` is (line,).
    """
    slopes = camera.pixel_slopes()
    if model == "L4":
        return points_of_scan(swath_px, camera, scan_px[:, None], slopes)
    tangents = np.stack([np.full_like(scan_px, swath_px), scan_px], axis=-1) * camera.ifov_rad
    if model == "L0":
        angle = np.zeros_like(scan_px)
    elif model == "L1":
        angle = straight_slope_rotation(swath_px, scan_px, camera)
    else:
        angle = line_rotation(mirror.scene_to_direction(tangents))
    length = slopes / camera.ifov_rad * (_local_scale(swath_px, scan_px, camera) if model == "L3" else 1.0)
    return swath_px + length * np.cos(angle)[:, None], scan_px[:, None] + length * np.sin(angle)[:, None]


def _local_scale(swath_px: float, scan_px: NDArray[np.float64], camera: LineCamera) -> NDArray[np.float64]:
    """Return the length of a line in the scene per IFOV at the camera, at the line's centre, (line, 1) [-].

    It is the derivative of :func:`pipeline.geometry.scan.points_of_scan`: N hypot(1, xi0 / q), q = N - e.
    """
    xi0, e = swath_px * camera.ifov_rad, scan_px[:, None] * camera.ifov_rad
    size = np.sqrt(1 + xi0**2 + e**2)
    return size * np.hypot(1.0, xi0 / (size - e))


def paper_numbers(yx: NDArray[np.float64], *, fine: bool, columns: int, factor: int) -> NDArray[np.float64]:
    """Return the paper's patch numbers: coarse patch n has P = n(m + 1) + 1, its fine patches have P + 1 ... P + m.

    ``yx`` (..., 2) are centres in patches. A row has ``columns`` coarse patches; m = factor^2. Fine patches are
    numbered by rows. The paper's text says jumps of four; its formula and its example 21 -> 26 give m + 1 = 5.
    """
    cell = np.floor(yx / factor)
    number = (cell[..., 0] * columns + cell[..., 1]) * (factor**2 + 1) + 1
    inside = np.floor(yx - cell * factor)
    return number + inside[..., 0] * factor + inside[..., 1] + 1 if fine else number
