"""The disc that a point out of focus is imaged to: what it passes of waves, and few points that stand for it."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import scipy
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Axes = tuple[float, float]
# Radii over the disc's of rings of 6, 12, 18 points about one in the middle, and up to which diameter they stand for it
# behind slit and pixel: fitted, no wave is off by more than 2e-3 of its amplitude.
_FITTED = ((0.6, ()), (1.7, (0.72,)), (3.3, (0.433, 0.811)), (5.0, (0.312, 0.578, 0.864)))  # diameter [px], radii
_PX_A_RING = 1.7  # of the diameter, where there are more rings
_MOST_RINGS = 9
_SMOOTH = 0.6  # sd of the Gaussian about each point over the distance of rings, where these are as many as may be


def disc_contrast(along: Floats, scan: Floats, axes: Axes) -> Floats:
    """Give what an even elliptic disc of diameters ``axes`` [px] passes of waves [1/px]: 2 J1(v) / v."""
    v = np.pi * np.hypot(axes[0] * along, axes[1] * scan)
    return np.asarray(np.where(v > 1e-6, 2 * scipy.special.j1(v) / np.maximum(v, 1e-6), 1.0))


@lru_cache(maxsize=64)
def disc_points(axes: Axes) -> tuple[Floats, Floats]:
    """Give points (2, point) along line and scan [px], and the variance (2,) of a Gaussian about each [px^2].

    All count alike. With the Gaussians they have the disc's mean and variance, a sixteenth of its diameters squared.
    Small discs are one Gaussian; of very wide ones the edge is blurred.
    """
    radii = _rings(max(axes))
    counts = [1, *(6 * (ring + 1) for ring in range(len(radii)))]
    radius = np.repeat([0.0, *radii], counts)
    turn = np.concatenate([np.arange(count) * (2 * np.pi / count) + 0.3 * ring for ring, count in enumerate(counts)])
    size = np.array(axes) / 2
    found: Floats = size[:, None] * radius * np.stack([np.cos(turn), np.sin(turn)])
    return found, np.maximum(size**2 * (0.25 - (radius**2).mean() / 2), 0.0)


def _rings(diameter: float) -> tuple[float, ...]:
    """Radii over the disc's: each ring in the middle of as much of the disc's area as it has points, or nearly."""
    for most, radii in _FITTED:
        if diameter <= most:
            return radii
    wanted = math.ceil(diameter / _PX_A_RING)
    rings = min(wanted, _MOST_RINGS)
    ends = np.array([3 * ring * (ring + 1) + 1 for ring in range(rings + 1)], np.float64)
    middle, left = (ends[:-1] + ends[1:]) / 2 / ends[-1], 0.5 / ends[-1]
    if wanted > rings:
        left = max(left, 2 * (_SMOOTH / (rings + 0.5)) ** 2)
    return tuple(np.sqrt(np.maximum(middle - left, 0.0)).tolist())
