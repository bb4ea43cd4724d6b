"""Geometry: the round trip over the mirror's disk and the line's rotation, compared with the paper's equations."""

from __future__ import annotations

import numpy as np
from measure import Row
from numpy.typing import NDArray

from spectralzoom.pipeline.geometry import mirror
from spectralzoom.pipeline.geometry.camera import LineCamera
from tests.pipeline.geometry.paper_equations import line_rotation, straight_slope_rotation
from tests.pipeline.geometry.test_mirror import exact_direction
from tests.pipeline.geometry.test_paper import paper_position, slope_rotation

COUNT = 200_000
IFOV = LineCamera().ifov_rad


def rows() -> list[Row]:
    return [_round_trip(np.float64, 1e-12), _round_trip(np.float32, 1e-6), _fifty_digits(), *_rotation()]


def _disk(count: int, seed: int = 0) -> NDArray[np.float64]:
    rng = np.random.default_rng(seed)
    radius, turn = np.sqrt(rng.uniform(0, 1, count)), rng.uniform(0, 2 * np.pi, count)
    radius[: count // 10] = 1
    return radius[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=-1)


def _angle(a: NDArray[np.floating], b: NDArray[np.floating]) -> float:
    """Return the largest angle between unit vectors. [rad]"""
    return float(np.linalg.norm(a.astype(np.float64) - b, axis=-1).max())


def _round_trip(precision: type, goal: float) -> Row:
    position = _disk(COUNT).astype(precision)
    back = mirror.direction_to_position(mirror.position_to_direction(position))
    # Both ends are scaled by the same factor, as rounding may have put them beyond the rim in float64.
    ends = [mirror.position_to_direction(0.999999 * end.astype(np.float64)) for end in (position, back)]
    found = _angle(*ends)
    return Row(
        f"position -> ray -> position, {COUNT} over the disk, {np.dtype(precision).name}",
        f"{found:.2g} rad",
        f"< {goal:g} rad",
        found < goal,
        f"the paper's eq. 7: {_paper_round_trip():.3g} rad",
    )


def _paper_round_trip() -> float:
    """Return the largest angle between the requested direction and that of the paper's position on the device."""
    asked = mirror.position_to_direction(_disk(2000) * 0.95)
    reached = paper_position(mirror.direction_to_normal(asked))
    kept = np.hypot(*reached.T) <= 1
    return _angle(mirror.position_to_direction(reached[kept]), asked[kept])


def _fifty_digits() -> Row:
    import mpmath

    worst = 0.0
    with mpmath.workdps(50):
        for position in _disk(100, seed=1) * (1 - 1e-15):
            exact, found = exact_direction(position), mirror.position_to_direction(position)
            worst = max(worst, *(abs(float(e - mpmath.mpf(float(f)))) for e, f in zip(exact, found, strict=True)))
    return Row(
        "ray of 100 random positions against 50 digits, float64", f"{worst:.2g} rad", "< 1e-12 rad", worst < 1e-12
    )


def _rotation() -> list[Row]:
    """Compare the line's rotation with finite differences of reflected rays, and with the paper's slope."""
    position = _disk(20_000)
    psi = line_rotation(mirror.position_to_direction(position))
    rays = np.array([[[0.0, -1e-5, 1.0]], [[0.0, 1e-5, 1.0]]])
    ends = mirror.reflect(rays, mirror.position_to_normal(position)[None])
    moved = np.diff(ends[..., 1:] / ends[..., :1], axis=0)[0]
    off = float(np.abs(np.arctan2(moved[:, 1], moved[:, 0]) - psi).max())
    xi, eta = mirror.direction_to_scene(mirror.position_to_direction(position)).T / IFOV
    slope = float(np.rad2deg(np.abs(straight_slope_rotation(xi, eta, LineCamera()) - psi)).max())
    noisy_px, noisy_deg = _noise()
    return [
        Row(
            "line rotation against finite differences, over the disk",
            f"{off:.2g} rad",
            "< 1e-08 rad",
            off < 1e-8,
            f"the paper's -atan(dY/dX): {slope:.2f} deg",
        ),
        Row(
            "line end under 40 urad of position noise",
            f"{noisy_px:.2g} px rms",
            peers=f"the paper's -atan(dY/dX): {noisy_deg:.2g} deg rms",
        ),
    ]


def _noise() -> tuple[float, float]:
    """Return rms errors of line ends by pose [px] and of slopes [deg]: 1450 lines over 1280 px with noisy normals."""
    eta = np.linspace(-640, 640, 1450) * IFOV
    direction = np.stack([np.ones_like(eta), np.full_like(eta, 1000 * IFOV), eta], axis=-1)
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    normal = mirror.direction_to_normal(direction)
    normal = normal + np.random.default_rng(0).normal(0, 40e-6, normal.shape)
    noisy = mirror.reflect((0.0, 0.0, 1.0), normal / np.linalg.norm(normal, axis=-1, keepdims=True))
    turn = line_rotation(noisy) - line_rotation(direction)
    slope, exact = (slope_rotation(mirror.direction_to_position(one)) for one in (noisy, direction))
    return 320 * float(np.sqrt(np.mean(turn**2))), float(np.rad2deg(np.sqrt(np.mean((slope - exact) ** 2))))
