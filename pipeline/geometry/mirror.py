"""The two-axis mirror: device position, normal, view direction, and how the line turns. Closed forms, no trigonometry.

Camera frame: the chief ray leaves along k = (0, 0, 1) and the undeflected scene direction is (1, 0, 0); y is the normal
of the plane of incidence. Scene tangents are xi = o_y / o_x (along the line) and eta = o_z / o_x (the scan). The device
reports the point, in units of tan 50 deg, where a ray falling along the rest normal would go (position (0, 0) is rest).

float32 arrays stay float32, as devices keep them; everything else is worked out in float64. What the paper prints
instead is in :mod:`pipeline.geometry.paper_equations`, and the errata E1 to E18 are told in ERRATA.md.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.errors import PoseError, ShapeError

Floats = NDArray[Any]  # float64, or float32 where that came in
Slit = Literal["across", "in-plane"]

REST_TANGENT = float(np.tan(np.deg2rad(50.0)))
# How far beyond the rim, and off length 1, a vector may lie by rounding, by the precision that it came in.
RIM_SLACK = {"float64": 1e-12, "float32": 1e-6}
LENGTH_SLACK = {"float64": 1e-6, "float32": 1e-5}
_HALF = float(np.sqrt(0.5))
# Rows are e1, e2, e3 in the camera frame: the axes of device X, device Y, and the rest normal.
_DEVICE_AXES = np.array([[-_HALF, 0.0, -_HALF], [0.0, 1.0, 0.0], [_HALF, 0.0, -_HALF]])


def check_reach(position: ArrayLike) -> Floats:
    """Refuse device positions beyond the unit disk, before a device clamps them to its rim unasked (erratum E3).

    Parameters
    ----------
    position
        (..., 2) device X and Y.

    Returns
    -------
    The positions as (..., 2) floats.

    Raises
    ------
    PoseError : a position is not finite or beyond the rim; the message names the first.
    """
    xy = _vectors(position, 2, "mirror position")
    beyond = np.hypot(xy[..., 0], xy[..., 1]) > 1 + RIM_SLACK[xy.dtype.name]
    _refuse(beyond, xy, "lies outside the unit disk that the mirror reaches")
    return xy


def position_to_normal(position: ArrayLike) -> Floats:
    """Give the mirror normal of device positions.

    Parameters
    ----------
    position
        (..., 2) device X and Y, in the closed unit disk.

    Returns
    -------
    (..., 3) unit normals in the camera frame.

    Raises
    ------
    PoseError : a position is not finite or beyond the rim; the message names the first.
    """
    xy = check_reach(position)
    half = np.empty((*xy.shape[:-1], 3), xy.dtype)
    half[..., :2] = xy * REST_TANGENT
    # r + e3 up to a factor, r = (X T, Y T, 1) / |.|: no angle and no difference of near numbers.
    half[..., 2] = 1 + np.sqrt(1 + half[..., 0] ** 2 + half[..., 1] ** 2)
    normal: Floats = _unit(half) @ _DEVICE_AXES.astype(xy.dtype)
    return normal


def normal_to_position(normal: ArrayLike) -> Floats:
    """Give the device position of mirror normals: the inverse of ``position_to_normal``.

    Parameters
    ----------
    normal
        (..., 3) unit normals in the camera frame.

    Returns
    -------
    (..., 2) device X and Y.

    Raises
    ------
    PoseError : a normal is not finite, not of length 1, or turned beyond the rim. The disk is checked before anything
        is divided, since X overflows as the tilt nears 45 deg (erratum E2).
    """
    n = _units(normal, "mirror normal")
    device = normal_to_device(n)
    # cos 2 alpha as n_z^2 - (n_x^2 + n_y^2): half the rounding of 2 n_z^2 - 1, and an error of length cancels.
    c2 = device[..., 2] ** 2 - (device[..., 0] ** 2 + device[..., 1] ** 2)
    lateral = 2 * device[..., 2] * np.hypot(device[..., 0], device[..., 1])
    inside = (device[..., 2] > 0) & (c2 > 0) & (lateral <= REST_TANGENT * c2 * (1 + RIM_SLACK[n.dtype.name]))
    _refuse(~inside, n, "is turned beyond the rim of the mirror's range (25 deg)")
    position: Floats = 2 * device[..., 2:] * device[..., :2] / (c2 * n.dtype.type(REST_TANGENT))[..., None]
    return position


def normal_to_device(normal: ArrayLike) -> Floats:
    """Give the parts (..., 3) of normals along the device's X and Y axes and along the rest normal."""
    n = _vectors(normal, 3, "mirror normal")
    device: Floats = n @ _DEVICE_AXES.T.astype(n.dtype)
    return device


def direction_to_normal(direction: ArrayLike) -> Floats:
    """Give the normal that sends the chief ray along unit directions, n ~ o - k.

    Stable up to grazing (o_z -> 1, erratum E7): there 1 - o_z is taken as (o_x^2 + o_y^2) / (1 + o_z).

    Parameters
    ----------
    direction
        (..., 3) unit view directions in the camera frame.

    Raises
    ------
    PoseError : a direction is not finite, not of length 1, or is the chief ray itself, which no mirror makes.
    """
    o = _units(direction, "view direction")
    n = o.copy()
    n[..., 2] = -_one_minus_z(o)
    return _unit(n)


def reflect(ray: ArrayLike, normal: ArrayLike) -> Floats:
    """Reflect travelling rays, o = k - 2 (n . k) n, over (..., 3) arrays that broadcast."""
    n = np.asarray(normal, _kept(ray, normal))
    k = np.asarray(ray, n.dtype)
    out: Floats = k - 2 * np.sum(n * k, axis=-1, keepdims=True) * n
    return out


def position_to_direction(position: ArrayLike) -> Floats:
    """Give the unit direction (..., 3) in which the chief ray looks from device positions (..., 2)."""
    return reflect((0.0, 0.0, 1.0), position_to_normal(position))


def direction_to_position(direction: ArrayLike) -> Floats:
    """Give the device position (..., 2) that points the chief ray along unit directions (..., 3)."""
    return normal_to_position(direction_to_normal(direction))


def scene_to_direction(tangents: ArrayLike) -> Floats:
    """Give unit directions (..., 3) of scene tangents (..., 2), xi along the line and eta along the scan."""
    t = _vectors(tangents, 2, "scene tangent")
    return _unit(np.concatenate([np.ones((*t.shape[:-1], 1), t.dtype), t], axis=-1))


def direction_to_scene(direction: ArrayLike) -> Floats:
    """Give scene tangents (..., 2) of directions (..., 3).

    Raises
    ------
    PoseError : a direction does not look at the scene plane (o_x <= 0).
    """
    o = _vectors(direction, 3, "view direction")
    _refuse(o[..., 0] <= 0, o, "looks away from the scene plane (its x must be above 0)")
    tangents: Floats = o[..., 1:] / o[..., :1]
    return tangents


def line_rotation(direction: ArrayLike, slit: Slit = "across") -> Floats:
    """Give the angle by which the image of the slit is turned in the scene tangent plane, against rest.

    A property of the pose and not of the path (erratum E8). For the slit across the plane of incidence, along y,
    psi = atan2(o_y, 1 - o_z); the line stays straight and runs along (cos psi, sin psi) in (xi, eta), exactly. For
    the slit in the plane of incidence psi = atan2(o_y, 1 - o_y^2 / (1 - o_z)); its line runs along (-sin, cos).

    Parameters
    ----------
    direction
        (..., 3) unit view directions of the line's centre.
    slit
        "across" the plane of incidence or "in-plane".

    Returns
    -------
    (...) angle, anticlockwise from xi to eta. [rad]

    Raises
    ------
    PoseError : a direction is not finite, not of length 1, or is the camera's own ray.
    ValueError : no such slit.
    """
    if slit not in ("across", "in-plane"):
        raise ValueError(f"slit must be 'across' or 'in-plane', got {slit!r}")
    o = _units(direction, "view direction")
    psi: Floats = np.arctan2(o[..., 1], _one_minus_z(o) if slit == "across" else _in_plane_run(o))
    return psi


def mirror_throughput(position: ArrayLike) -> Floats:
    """Give the share of light that the mirror passes, over its share at rest: |n_z| / |n_z at rest| (erratum E16).

    The mirror is the aperture stop; what it passes goes with its area as the camera sees it.

    Parameters
    ----------
    position
        (..., 2) device X and Y, in the closed unit disk.

    Returns
    -------
    (...) factor [-]: 1 at rest, 0.48 to 1.33 over the disk.

    Raises
    ------
    PoseError : a position is not finite or beyond the rim.
    """
    normal = position_to_normal(position)
    share: Floats = -normal[..., 2] / normal.dtype.type(_HALF)
    return share


def line_centre(along: Floats, scan: Floats, across: ArrayLike) -> Floats:
    """Give where the line that passes through a point has its centre, as a tangent on the scan axis.

    The ray to a point meets the slit's plane for exactly one tilt of the mirror. With a and b the tangents of the
    point along the line and on the scan, c that of the line's centre along the line, P = c (c - a) and
    D = 1 + a^2 - (a - c)^2, the centre lies at ``b + P (b + sqrt(D + b^2)) / D``; nothing cancels within the mirror's
    reach.

    Parameters
    ----------
    along, scan, across
        a, b and c; arrays that broadcast.

    Returns
    -------
    (...) tangents, NaN where no line passes: beyond 45 deg to the side.
    """
    c = np.asarray(across, _kept(along, scan, across))
    gap = along - c
    reach = 1 + along * along - gap * gap
    reach = np.where(reach > 0, reach, np.nan)
    centre: Floats = scan - c * gap * (scan + np.sqrt(reach + scan * scan)) / reach
    return centre


def camera_slope(along: Floats, scan: Floats, across: ArrayLike, centre: Floats) -> Floats:
    """Give the slope k_y / k_z of the camera ray that the mirror, aimed at (across, centre), sends to each point.

    The reflection of the ray (1, along, scan) in the normal c - k0, written out for the unit vector c to the line's
    centre. All are tangents; ``centre`` is that of :func:`line_centre`, the point's own line.
    """
    c = np.asarray(across, _kept(along, scan, across))
    r = np.sqrt(1 + c * c + centre * centre)
    ahead = 1 + along * c + scan * centre
    slope: Floats = (along * r - (ahead - scan * r) * c / (r - centre)) / ahead
    return slope


def _one_minus_z(o: Floats) -> Floats:
    """1 - o_z of unit vectors without cancellation on either side; refused where it is 0."""
    z = o[..., 2]
    across = o[..., 0] ** 2 + o[..., 1] ** 2
    _refuse((o[..., 0] == 0) & (o[..., 1] == 0) & (z > 0), o, "is the camera's own ray, which no mirror makes")
    return np.where(z > 0, across / (1 + np.maximum(z, 0)), 1 - z)


def _in_plane_run(o: Floats) -> Floats:
    """1 - o_y^2 / (1 - o_z) of unit vectors; towards o_z = 1 the quotient is (o_y / hypot(o_x, o_y))^2 (1 + o_z)."""
    z, side = o[..., 2], np.hypot(o[..., 0], o[..., 1])
    sine = o[..., 1] / np.where(side > 0, side, 1)
    run: Floats = 1 - np.where(z > 0, sine**2 * (1 + z), o[..., 1] ** 2 / (1 - np.minimum(z, 0)))
    return run


def _unit(vectors: Floats) -> Floats:
    # The largest part is taken out first: near grazing the squares of small vectors would lose digits or vanish.
    scaled = vectors / np.max(np.abs(vectors), axis=-1, keepdims=True)
    unit: Floats = scaled / np.sqrt(np.sum(scaled**2, axis=-1, keepdims=True))
    return unit


def _kept(*values: ArrayLike) -> np.dtype[Any]:
    """float32 where all arrays among the values are of that precision, else float64; plain numbers do not count."""
    found = {value.dtype for value in values if isinstance(value, np.ndarray | np.generic)}
    return np.dtype(np.float32 if found == {np.dtype(np.float32)} else np.float64)


def _vectors(values: ArrayLike, size: int, name: str) -> Floats:
    """Read ``values`` as (..., size) finite floats."""
    array = np.asarray(values, _kept(values))
    if array.ndim == 0 or array.shape[-1] != size:
        raise ShapeError(f"a {name} needs {size} numbers on the last axis, got shape {array.shape}")
    _refuse(~np.isfinite(array).all(axis=-1), array, "is not finite")
    return array


def _units(values: ArrayLike, name: str) -> Floats:
    """Read ``values`` as (..., 3) vectors of length 1."""
    array = _vectors(values, 3, name)
    off = np.abs(np.sum(array**2, axis=-1) - 1) > LENGTH_SLACK[array.dtype.name]
    _refuse(off, array, f"is not of length 1, as a {name} must be")
    return array


def _refuse(bad: NDArray[np.bool_] | np.bool_, values: Floats, reason: str) -> None:
    """Raise for the first bad vector, saying which one it was."""
    if not np.any(bad):
        return
    first = np.argwhere(bad)[0]
    where = f" (index {', '.join(map(str, first.tolist()))})" if first.size else ""
    what = {2: "position or tangent", 3: "direction or normal"}[values.shape[-1]]
    numbers = ", ".join(f"{value:.15g}" for value in values[tuple(first)])
    raise PoseError(f"{what} ({numbers}){where} {reason}; keep the field within the mirror's range")
