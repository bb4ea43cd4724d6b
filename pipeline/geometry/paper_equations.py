"""What the paper prints, function by function: for comparison with the stable forms only, never for computing.

Errata in brackets; ERRATA.md tells each with its figure. Normals and directions are in the frame of
:mod:`pipeline.geometry.mirror` unless a function says that it takes the paper's, with the camera at +z.
"""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.mirror import (
    REST_TANGENT,
    Floats,
    direction_to_normal,
    line_rotation,
    normal_to_device,
    scene_to_direction,
)
from pipeline.geometry.scan import points_of_scan

LineModel = Literal["L0", "L1", "L2", "L3", "L4"]
LINE_MODELS: tuple[LineModel, ...] = get_args(LineModel)
_RIM_SINE = float(np.sin(np.deg2rad(25.0)))
_SMALL_SLOPE = 1e-6


def paper_position(normal: ArrayLike) -> Floats:
    """Give the position by equation (7), X = n_x / sin 25 deg [E2].

    Agrees with the device at rest and at the rim, and is up to 6.40 deg (1056 px) wrong between.
    """
    position: Floats = normal_to_device(normal)[..., :2] / _RIM_SINE
    return position


def mechanical_position(normal: ArrayLike) -> Floats:
    """Give the position by equation (1) with theta read as the mirror's own tilt [E1]: half the deflection."""
    device = normal_to_device(normal)
    position: Floats = device[..., :2] / device[..., 2:] / REST_TANGENT
    return position


def product_position(normal: ArrayLike) -> Floats:
    """Give the position as code seen in public has it, X = n_x n_z / tan 50 deg: less than half the deflection."""
    device = normal_to_device(normal)
    position: Floats = device[..., 2:] * device[..., :2] / REST_TANGENT
    return position


def unlimited_position(normal: ArrayLike) -> Floats:
    """Give the exact position of normals, beyond the rim as well, so that the paper's forms can be followed there."""
    device = normal_to_device(normal)
    c2 = 2 * device[..., 2:] ** 2 - 1
    position: Floats = 2 * device[..., 2:] * device[..., :2] / (c2 * REST_TANGENT)
    return position


def paper_normal(direction: NDArray[np.floating]) -> NDArray[np.floating]:
    """Give the normal by equation (4), in the paper's frame [E7]: c = sqrt((o_z + 1) / 2), a = o_x / 2c, b = o_y / 2c.

    In the precision of ``direction`` (..., 3). Towards grazing (o_z -> -1) c loses all digits and becomes 0.
    """
    c = np.sqrt((direction[..., 2] + 1) / 2)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.stack([direction[..., 0] / (2 * c), direction[..., 1] / (2 * c), c], axis=-1)


def stable_normal(direction: NDArray[np.floating]) -> NDArray[np.floating]:
    """Give the normal (o_x, o_y, 1 + o_z) / |.| in the paper's frame, 1 + o_z taken without cancellation [E7]."""
    o = direction.copy()
    z = o[..., 2]
    o[..., 2] = np.where(z < 0, (o[..., 0] ** 2 + o[..., 1] ** 2) / (1 - np.minimum(z, 0)), 1 + z)
    o /= np.abs(o).max(axis=-1, keepdims=True)
    unit: NDArray[np.floating] = o / np.sqrt(np.sum(o**2, axis=-1, keepdims=True))
    return unit


def reflection_matrix(normal: ArrayLike) -> Floats:
    """Give the paper's reflection matrix (..., 3, 3), I - 2 n n^T [E4]: it turns i into -o, not into o."""
    n = np.asarray(normal)
    matrix: Floats = np.eye(3) - 2 * n[..., :, None] * n[..., None, :]
    return matrix


def paper_turn() -> NDArray[np.float64]:
    """Give the matrix of equation (5), (3, 3) [E5]: +45 deg about y, in the paper's frame."""
    half = float(np.sqrt(0.5))
    return np.array([[half, 0.0, half], [0.0, 1.0, 0.0], [-half, 0.0, half]])


def slope_rotation(position: NDArray[np.float64]) -> NDArray[np.float64]:
    """Give the rotation as the paper takes it from a path, -atan(dY/dX) [E8, E9].

    Parameters
    ----------
    position
        (line, 2) X and Y, as commanded or measured.

    Returns
    -------
    (line - 1,) angles between one line and the next; NaN where a position is repeated. [rad]
    """
    step = np.diff(position, axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        angle: NDArray[np.float64] = -np.arctan(step[:, 1] / step[:, 0])
    return angle


def straight_slope_rotation(strip_px: ArrayLike, scan_px: ArrayLike, camera: LineCamera) -> NDArray[np.float64]:
    """Give -atan(dY/dX) of sweeps that are straight in the scene, free of the path's own steps and noise.

    Parameters
    ----------
    strip_px, scan_px
        Line centres; arrays that broadcast. [px]

    Returns
    -------
    (...) angles; the derivative is a central difference over 2e-6 of tangent. [rad]
    """
    xi, eta = (np.asarray(value, np.float64) * camera.ifov_rad for value in (strip_px, scan_px))
    ends = [
        unlimited_position(direction_to_normal(scene_to_direction(np.stack(np.broadcast_arrays(xi, e), axis=-1))))
        for e in (eta - _SMALL_SLOPE, eta + _SMALL_SLOPE)
    ]
    step = ends[1] - ends[0]
    angle: NDArray[np.float64] = -np.arctan(step[..., 1] / step[..., 0])
    return angle


def paper_scene_speed(sensor_mm: float, distance_m: float, camera: LineCamera) -> float:
    """Give the speed of the scene by equation (8), H d / (f t_exp) with the whole sensor as H [E11]. [m/s]"""
    return sensor_mm / camera.focal_length_mm * distance_m / (camera.exposure_ms * 1e-3)


def paper_sample_rate(samples: int, lines: int, camera: LineCamera) -> float:
    """Give the sampling speed by equation (9), m / t_img with t_img in ms: samples per ms, not Hz [E12]."""
    return samples / paper_imaging_ms(lines, camera)


def paper_imaging_ms(lines: int, camera: LineCamera) -> float:
    """Give the imaging time by equation (10), t_exp y_res: the least possible, without readout and set-up [E13]."""
    return lines * camera.exposure_ms


def public_cells(samples: int, *, inclusive: bool) -> tuple[range, range]:
    """Give the cells that X and Y are played from by code seen in public, 0..n and n + 1..2n [E14].

    X is stored in cells 0..n - 1 and Y in n..2n - 1.
    """
    last = 1 if inclusive else 0
    return range(samples + last), range(samples + 1, 2 * samples + last)


def line_points(
    model: LineModel, strip_px: float, scan_px: NDArray[np.float64], camera: LineCamera
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Give where each sample of each line looks, by five models of a line.

    Parameters
    ----------
    model
        L0 no rotation; L1 the paper's -atan(dY/dX); L2 the exact rotation; L3 exact rotation and local scale; L4 exact
        rays. L0 to L2 keep the scale of the undeflected line.
    strip_px
        Of the line centres, along the line. [px]
    scan_px
        (line,) of the line centres. [px]

    Returns
    -------
    along, scan
        (line, sample) each. [px]

    Raises
    ------
    ValueError : no such model.
    """
    if model not in LINE_MODELS:
        raise ValueError(f"line model must be one of {', '.join(LINE_MODELS)}, got {model!r}")
    slopes = camera.pixel_slopes()
    if model == "L4":
        return points_of_scan(strip_px, camera, scan_px[:, None], slopes)
    angle = _model_rotation(model, strip_px, scan_px, camera)
    length = slopes / camera.ifov_rad * (_local_scale(strip_px, scan_px, camera) if model == "L3" else 1.0)
    return strip_px + length * np.cos(angle)[:, None], scan_px[:, None] + length * np.sin(angle)[:, None]


def _model_rotation(
    model: LineModel, strip_px: float, scan_px: NDArray[np.float64], camera: LineCamera
) -> NDArray[np.float64]:
    if model == "L0":
        return np.zeros_like(scan_px)
    if model == "L1":
        return straight_slope_rotation(strip_px, scan_px, camera)
    tangents = np.stack([np.full_like(scan_px, strip_px), scan_px], axis=-1) * camera.ifov_rad
    return line_rotation(scene_to_direction(tangents))


def _local_scale(strip_px: float, scan_px: NDArray[np.float64], camera: LineCamera) -> NDArray[np.float64]:
    """Length of the line in the scene for one IFOV at the camera, at the line's centre, (line, 1) [-].

    The derivative of :func:`pipeline.geometry.scan.points_of_scan` at its centre: N hypot(1, xi0 / q), q = N - e.
    """
    xi0, e = strip_px * camera.ifov_rad, scan_px[:, None] * camera.ifov_rad
    size = np.sqrt(1 + xi0**2 + e**2)
    scale: NDArray[np.float64] = size * np.hypot(1.0, xi0 / (size - e))
    return scale
