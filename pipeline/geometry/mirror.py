"""Convert between device position, mirror normal, view direction and scene point of the two-axis mirror.

All conversions are closed forms. Camera frame: the chief ray leaves along k = (0, 0, 1), and the undeflected scene
direction is (1, 0, 0). The y axis is the normal of the plane of incidence. Scene tangents are xi = o_y / o_x (along the
line) and eta = o_z / o_x (the scan). A device position is where a ray along the rest normal would go, in units of tan
50 deg; (0, 0) is rest.

float32 arrays stay float32, as devices keep them; all else is computed in float64. The printed equations of the paper
are in ``tests/pipeline/geometry/paper_equations.py``, and docs/background/errata.md lists the errata E1 to E18.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spectralzoom.pipeline.errors import PoseError, SettingsError, ShapeError

Floats = NDArray[Any]  # float64, or float32 where that came in

REST_TANGENT = float(np.tan(np.deg2rad(50.0)))
# Rounding by which a vector may lie beyond the rim, or differ from length 1, by its precision.
RIM_SLACK = {"float64": 1e-12, "float32": 1e-6}
LENGTH_SLACK = {"float64": 1e-6, "float32": 1e-5}
_HALF = float(np.sqrt(0.5))
Axes = Literal["x,y", "x,-y", "-x,y", "-x,-y", "y,x", "y,-x", "-y,x", "-y,-x"]
_ROWS = {"x": (1, 0), "-x": (-1, 0), "y": (0, 1), "-y": (0, -1)}
# Rows are e1, e2, e3 in the camera frame: the axes of device X, device Y, and the rest normal.
_DEVICE_AXES = np.array([[-_HALF, 0.0, -_HALF], [0.0, 1.0, 0.0], [_HALF, 0.0, -_HALF]])


def check_reach(position: ArrayLike) -> Floats:
    """Return device positions (..., 2) as floats, none beyond the unit disk (erratum E3).

    A device would clamp such positions to its rim without notice.

    Raises PoseError: a position is not finite or beyond the rim; the message names the first.
    """
    xy = _vectors(position, 2, "mirror position")
    beyond = np.hypot(xy[..., 0], xy[..., 1]) > 1 + RIM_SLACK[xy.dtype.name]
    _refuse(beyond, xy, "lies outside the unit disk that the mirror reaches")
    return xy


def position_to_normal(position: ArrayLike) -> Floats:
    """Return the unit mirror normals (..., 3), in the camera frame, of device positions (..., 2) in the unit disk.

    Raises PoseError: a position is not finite or beyond the rim; the message names the first.
    """
    xy = check_reach(position)
    half = np.empty((*xy.shape[:-1], 3), xy.dtype)
    half[..., :2] = xy * REST_TANGENT
    # r + e3 up to a factor, r = (X T, Y T, 1) / |.|: no angle and no difference of near numbers.
    half[..., 2] = 1 + np.sqrt(1 + half[..., 0] ** 2 + half[..., 1] ** 2)
    return np.asarray(_unit(half) @ _DEVICE_AXES.astype(xy.dtype))


def normal_to_position(normal: ArrayLike) -> Floats:
    """Return the device positions (..., 2) of unit normals (..., 3): the inverse of ``position_to_normal``.

    The disk is checked before the division, since X overflows as the tilt nears 45 deg (erratum E2).

    Raises PoseError: a normal is not finite, not of length 1, or beyond the rim.
    """
    n = _units(normal, "mirror normal")
    device = normal_to_device(n)
    # cos 2 alpha as n_z^2 - (n_x^2 + n_y^2): half the rounding of 2 n_z^2 - 1, and an error of length cancels.
    c2 = device[..., 2] ** 2 - (device[..., 0] ** 2 + device[..., 1] ** 2)
    lateral = 2 * device[..., 2] * np.hypot(device[..., 0], device[..., 1])
    inside = (device[..., 2] > 0) & (c2 > 0) & (lateral <= REST_TANGENT * c2 * (1 + RIM_SLACK[n.dtype.name]))
    _refuse(~inside, n, "is turned beyond the rim of the mirror's range (25 deg)")
    return np.asarray(2 * device[..., 2:] * device[..., :2] / (c2 * n.dtype.type(REST_TANGENT))[..., None])


def normal_to_device(normal: ArrayLike) -> Floats:
    """Return the components (..., 3) of normals along the device's X and Y axes and along the rest normal."""
    n = _vectors(normal, 3, "mirror normal")
    return np.asarray(n @ _DEVICE_AXES.T.astype(n.dtype))


def direction_to_normal(direction: ArrayLike) -> Floats:
    """Return the normals (..., 3) that send the chief ray along unit directions (..., 3), n ~ o - k.

    Stable up to grazing (o_z -> 1, erratum E7): there 1 - o_z is computed as (o_x^2 + o_y^2) / (1 + o_z).

    Raises PoseError: a direction is not finite, not of length 1, or is the chief ray itself, which no mirror makes.
    """
    o = _units(direction, "view direction")
    n = o.copy()
    n[..., 2] = -_one_minus_z(o)
    return _unit(n)


def reflect(ray: ArrayLike, normal: ArrayLike) -> Floats:
    """Reflect travelling rays, o = k - 2 (n . k) n, over (..., 3) arrays that broadcast."""
    n = np.asarray(normal, _kept(ray, normal))
    k = np.asarray(ray, n.dtype)
    return np.asarray(k - 2 * np.sum(n * k, axis=-1, keepdims=True) * n)


def position_to_direction(position: ArrayLike) -> Floats:
    """Return the unit view direction (..., 3) of the chief ray at device positions (..., 2)."""
    return reflect((0.0, 0.0, 1.0), position_to_normal(position))


def direction_to_position(direction: ArrayLike) -> Floats:
    """Return the device position (..., 2) that points the chief ray along unit directions (..., 3)."""
    return normal_to_position(direction_to_normal(direction))


def scene_to_direction(tangents: ArrayLike) -> Floats:
    """Return unit directions (..., 3) of scene tangents (..., 2), xi along the line and eta along the scan."""
    t = _vectors(tangents, 2, "scene tangent")
    return _unit(np.concatenate([np.ones((*t.shape[:-1], 1), t.dtype), t], axis=-1))


def direction_to_scene(direction: ArrayLike) -> Floats:
    """Return scene tangents (..., 2) of directions (..., 3).

    Raises PoseError: a direction does not meet the scene plane (o_x <= 0).
    """
    o = _vectors(direction, 3, "view direction")
    _refuse(o[..., 0] <= 0, o, "looks away from the scene plane (its x must be above 0)")
    return o[..., 1:] / o[..., :1]


def mirror_throughput(position: ArrayLike) -> Floats:
    """Return the light that the mirror passes at device positions (..., 2), relative to rest (erratum E16).

    |n_z| / |n_z at rest|: the mirror is the aperture stop, and passes light in proportion to its projected area. It is
    1 at rest and 0.48 to 1.33 over the disk.

    Raises PoseError: a position is not finite or beyond the rim.
    """
    normal = position_to_normal(position)
    return np.asarray(-normal[..., 2] / normal.dtype.type(_HALF))


def line_centre(along: Floats, scan: Floats, across: ArrayLike) -> Floats:
    """Return the centre of the line that passes through a point, as a tangent on the scan axis.

    The ray to a point meets the slit's plane for exactly one tilt of the mirror. Let a and b be the tangents of the
    point ``along`` the line and on the ``scan``. Let c (``across``) be that of the line's centre along the line. With
    P = c (c - a) and D = 1 + a^2 - (a - c)^2 the centre lies at ``b + P (b + sqrt(D + b^2)) / D``. Nothing cancels
    within the mirror's reach. Arrays broadcast; NaN where no line passes: beyond 45 deg to the side.
    """
    c = np.asarray(across, _kept(along, scan, across))
    gap = along - c
    reach = 1 + along * along - gap * gap
    reach = np.where(reach > 0, reach, np.nan)
    centre: Floats = scan - c * gap * (scan + np.sqrt(reach + scan * scan)) / reach
    return centre


def camera_slope(along: Floats, scan: Floats, across: ArrayLike, centre: Floats) -> Floats:
    """Return the slope k_y / k_z of the camera ray that the mirror, aimed at (across, centre), sends to each point.

    With :func:`line_centre` it undoes the rotation of the lines. It is the reflection of the ray (1, along, scan) in
    the normal c - k0, for the unit vector c to the line's centre. All are tangents; ``centre`` is that of
    :func:`line_centre` for the same point.
    """
    c = np.asarray(across, _kept(along, scan, across))
    r = np.sqrt(1 + c * c + centre * centre)
    ahead = 1 + along * c + scan * centre
    slope: Floats = (along * r - (ahead - scan * r) * c / (r - centre)) / ahead
    return slope


def _one_minus_z(o: Floats) -> Floats:
    """Return 1 - o_z of unit vectors without cancellation; PoseError where it is 0."""
    z = o[..., 2]
    across = o[..., 0] ** 2 + o[..., 1] ** 2
    _refuse((o[..., 0] == 0) & (o[..., 1] == 0) & (z > 0), o, "is the camera's own ray, which no mirror makes")
    return np.where(z > 0, across / (1 + np.maximum(z, 0)), 1 - z)


def _unit(vectors: Floats) -> Floats:
    # Divide by the largest component first: near grazing the squares of small vectors lose digits or vanish.
    scaled = vectors / np.max(np.abs(vectors), axis=-1, keepdims=True)
    return np.asarray(scaled / np.sqrt(np.sum(scaled**2, axis=-1, keepdims=True)))


def _kept(*values: ArrayLike) -> np.dtype[Any]:
    """Return float32 if all arrays among the values are float32, else float64; plain numbers do not count."""
    found = {value.dtype for value in values if isinstance(value, np.ndarray | np.generic)}
    return np.dtype(np.float32 if found == {np.dtype(np.float32)} else np.float64)


def _vectors(values: ArrayLike, size: int, name: str) -> Floats:
    """Return ``values`` as (..., size) finite floats."""
    array = np.asarray(values, _kept(values))
    if array.ndim == 0 or array.shape[-1] != size:
        raise ShapeError(f"a {name} needs {size} numbers on the last axis, got shape {array.shape}")
    _refuse(~np.isfinite(array).all(axis=-1), array, "is not finite")
    return array


def _units(values: ArrayLike, name: str) -> Floats:
    """Return ``values`` as (..., 3) vectors of length 1."""
    array = _vectors(values, 3, name)
    off = np.abs(np.sum(array**2, axis=-1) - 1) > LENGTH_SLACK[array.dtype.name]
    _refuse(off, array, f"is not of length 1, as a {name} must be")
    return array


def _refuse(bad: NDArray[np.bool_] | np.bool_, values: Floats, reason: str) -> None:
    """Raise PoseError for the first bad vector, with its index."""
    if not np.any(bad):
        return
    first = np.argwhere(bad)[0]
    where = f" (index {', '.join(map(str, first.tolist()))})" if first.size else ""
    what = {2: "position or tangent", 3: "direction or normal"}[values.shape[-1]]
    numbers = ", ".join(f"{value:.15g}" for value in values[tuple(first)])
    raise PoseError(f"{what} ({numbers}){where} {reason}; keep the field within the mirror's range")


@dataclass(frozen=True)
class Mounting:
    """Convert between the XY of a device and of the model: device = axes @ rotation(clocking_deg) @ model + offset.

    The paper does not say which axis of the device is which, and which way it turns (erratum E6). ``axes`` names the
    device's X and Y: "y,-x" means that its X is the model's Y and its Y the model's -X. ``clocking_deg`` is the small
    rotation of the mirror about its rest normal, anticlockwise from X to Y. The offset is the device's XY at the
    model's rest.
    """

    axes: str = "x,y"
    clocking_deg: float = 0.0
    offset_x: float = 0.0
    offset_y: float = 0.0

    def __post_init__(self) -> None:
        if self.axes not in get_args(Axes):
            raise SettingsError(f"a mirror's axes must be one of {'  '.join(get_args(Axes))}; got {self.axes!r}")
        if not np.isfinite([self.clocking_deg, self.offset_x, self.offset_y]).all():
            raise SettingsError(f"a mirror's clocking and offset must be finite, got {self}")

    def to_device(self, position: ArrayLike) -> NDArray[np.floating]:
        """Return the device positions of model positions (..., 2).

        Raises PoseError: a position is beyond the disk of the model, or of the device, which would clamp it without
        notice.
        """
        model = check_reach(position)
        if self == STRAIGHT:
            return model
        try:
            return check_reach(model @ self._matrix().T + (self.offset_x, self.offset_y))
        except PoseError as error:
            raise PoseError(
                f"as mounted (offset {self.offset_x:g}; {self.offset_y:g}), the device's {error}; survey less of the "
                "field, or mount the mirror nearer to its middle"
            ) from error

    def to_model(self, device: ArrayLike) -> NDArray[np.float64]:
        """Return the model positions (..., 2) of device positions: the inverse of ``to_device``.

        Measured positions may lie slightly beyond the rim, and are accepted.
        """
        given = np.asarray(device, np.float64)
        model: NDArray[np.float64] = (given - (self.offset_x, self.offset_y)) @ self._matrix()
        return given if self == STRAIGHT else model

    def _matrix(self) -> NDArray[np.float64]:
        """Return the orthogonal part; its transpose is its inverse."""
        turn = np.deg2rad(self.clocking_deg)
        rotation = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
        return np.array([_ROWS[axis] for axis in self.axes.split(",")]) @ rotation


STRAIGHT = Mounting()


def wire_positions(positions: ArrayLike, mounting: Mounting = STRAIGHT) -> NDArray[np.float32]:
    """Return positions (position, 2) as float32 for the wire; rounding moves none of them beyond the rim.

    Positions of a mirror mounted straight become those of the device in its ``mounting``. Raises ShapeError: they have
    another shape, or there is none. Raises PoseError: one is not finite or lies beyond the rim.
    """
    exact = np.array(positions)
    if exact.ndim != 2 or exact.shape[1:] != (2,) or not len(exact):
        raise ShapeError(f"a path needs positions as (position, 2), at least one, got shape {exact.shape}")
    exact = check_reach(exact).astype(np.float64)
    exact /= np.maximum(np.hypot(exact[:, :1], exact[:, 1:]), 1)  # the slack that check_reach allows
    rounded: NDArray[np.float32] = exact.astype(np.float32)
    beyond = np.hypot(*rounded.astype(np.float64).T) > 1
    rounded[beyond] = np.nextafter(rounded[beyond], np.float32(0))
    return rounded if mounting == STRAIGHT else wire_positions(mounting.to_device(rounded))
