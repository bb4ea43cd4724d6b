"""Rays of the camera to the scene plane, over the mirror or as if lines lay straight, and how they spread there."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class RayViews:
    """Where samples look, and how far the scene point moves per px of the camera, along the line and across; (n,) each.

    ``along`` and ``scan`` are tangents or px; the others are px of the scene over px of the camera: ``along_run`` and
    ``scan_run`` for a ray moved along the line, ``along_turn`` and ``scan_turn`` for one moved across it.
    """

    along: Floats
    scan: Floats
    along_run: Floats
    scan_run: Floats
    along_turn: Floats
    scan_turn: Floats

    def __getitem__(self, which: slice | NDArray[np.intp]) -> RayViews:
        """Some of the samples."""
        return RayViews(*(getattr(self, one.name)[which] for one in fields(self)))

    def thinned(self, level: int) -> RayViews:
        """The same places in px of a scene of which every ``level``-th pixel is left, the first one first."""
        return self if level == 1 else replace(self, along=self.along / level, scan=self.scan / level)

    def flat(self) -> RayViews:
        """All in one row."""
        return RayViews(*(np.ravel(getattr(self, one.name)) for one in fields(self)))


def exact_views(normal: Floats, across: Floats | float, slopes: Floats) -> RayViews:
    """Give where camera rays (across, slope, 1) meet the scene after the mirror, as tangents.

    ``normal`` is (..., 3), of arrays that broadcast. The reflection is written out for the two tangents; the ray's
    length cancels. Their derivatives follow by the rule for quotients.
    """
    x, y, z = normal[..., 0], normal[..., 1], normal[..., 2]
    twice = 2 * (x * across + y * slopes + z)
    ahead = across - twice * x
    along, scan = (slopes - twice * y) / ahead, (1 - twice * z) / ahead
    forward_turn, forward_run = 1 - 2 * x * x, -2 * x * y
    return RayViews(
        along,
        scan,
        (1 - 2 * y * y - along * forward_run) / ahead,
        (-2 * y * z - scan * forward_run) / ahead,
        (-2 * x * y - along * forward_turn) / ahead,
        (-2 * x * z - scan * forward_turn) / ahead,
    )


def straight_views(centre: Floats, across: Floats | float, slopes: Floats) -> RayViews:
    """Give where the same rays would look if lines lay straight along their axis, for line centres (..., 2)."""
    along = centre[..., 0] + slopes
    one, none = np.ones(along.shape), np.zeros(along.shape)
    return RayViews(along, np.broadcast_to(centre[..., 1] + across, along.shape), one, none, none, one)
