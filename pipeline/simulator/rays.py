"""Rays of the camera to the scene plane, over the mirror or as if lines lay straight."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def exact_tangents(normal: Floats, across: Floats | float, slopes: Floats) -> tuple[Floats, Floats]:
    """Give the tangents along the line and the scan of camera rays (across, slope, 1) after the mirror.

    ``normal`` is (..., 3), of arrays that broadcast. The reflection is written out for the two tangents; the ray's
    length cancels.
    """
    twice = 2 * (normal[..., 0] * across + normal[..., 1] * slopes + normal[..., 2])
    ahead = across - twice * normal[..., 0]
    return (slopes - twice * normal[..., 1]) / ahead, (1 - twice * normal[..., 2]) / ahead


def straight_tangents(centre: Floats, across: Floats | float, slopes: Floats) -> tuple[Floats, Floats]:
    """Give the tangents of the same rays if lines lay straight along their axis, for line centres (..., 2)."""
    along = centre[..., 0] + slopes
    return along, np.broadcast_to(centre[..., 1] + across, along.shape)
