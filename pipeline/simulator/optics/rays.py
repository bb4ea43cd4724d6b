"""Rays of the camera over the mirror: where they meet the scene plane, how they spread there, and the pupil they pass.

The aperture is the mirror's disc, foreshortened in the plane of incidence, which holds the scan at rest. The pupil is
then an ellipse: the whole diameter along the line, and |n_z| of it, 0.71, along the scan. So diffraction is wider along
the scan, defocus wider along the line.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.mirror import direction_to_normal, scene_to_direction
from spectralzoom.pipeline.geometry.scan import Floats, Sweep

REST_NORMAL: Floats = np.array([np.sqrt(0.5), 0.0, -np.sqrt(0.5)])


@dataclass(frozen=True)
class RayViews:
    """Directions of samples, and how far the scene point moves per px of the camera, along and across; (n,) each."""

    along: Floats  # tangent or px
    scan: Floats
    along_run: Floats  # px of the scene over px of the camera, for a ray moved along the line
    scan_run: Floats
    along_turn: Floats  # for one moved across it
    scan_turn: Floats

    def __getitem__(self, which: slice | NDArray[np.intp]) -> RayViews:
        return RayViews(*(getattr(self, one.name)[which] for one in fields(self)))

    def thinned(self, level: int, before: int) -> RayViews:
        """Return the same places in px of a scene thinned to every ``level``-th pixel after ``before`` others."""
        if level == 1:
            return self
        return replace(self, along=self.along / level + before, scan=self.scan / level + before)

    def table(self) -> Floats:
        """Return all values as rows, (6, n), in the order of the fields."""
        return np.stack([np.asarray(getattr(self, one.name), np.float64) for one in fields(self)])

    def flat(self) -> RayViews:
        return RayViews(*(np.ravel(getattr(self, one.name)) for one in fields(self)))


def exact_views(normal: Floats, across: Floats | float, slopes: Floats) -> RayViews:
    """Return the points of the scene that camera rays (across, slope, 1) meet after the mirror, as tangents.

    ``normal`` is (..., 3), of arrays that broadcast. The reflection is written out for the two tangents, whose
    derivatives follow by the rule for quotients.
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


def spread_of_waves(normal: Floats | None = None) -> Floats:
    """Return the variance that diffraction has along (line, scan), (..., 2), over that of a round pupil.

    A pupil |n_z| wide along (n_x, n_y) and 1 across spreads waves by 1 / n_z^2 and 1. On the camera's own axes that is
    1 + n_y^2 / n_z^2 and 1 + n_x^2 / n_z^2. The covariance n_x n_y / n_z^2 is left out: it is 0 at rest.
    ``normal``: (..., 3) mirror normals in the camera frame; None is the mirror at rest.
    """
    n = REST_NORMAL if normal is None else np.asarray(normal, np.float64)
    return 1 + (n[..., 1::-1] / n[..., 2:]) ** 2


def spread_of_rays(normal: Floats | None = None) -> Floats:
    """Return the variance of the pupil along (line, scan), over that of a round one: 1 - n_y^2 and 1 - n_x^2, (..., 2).

    The covariance -n_x n_y is left out: it is 0 at rest.
    """
    n = REST_NORMAL if normal is None else np.asarray(normal, np.float64)
    return 1 - n[..., 1::-1] ** 2


def pupil_contrast(u: Floats) -> Floats:
    """Return the transmission of u cycles per lambda / D by a round pupil: its autocorrelation, 0 from u = 1 on.

    2 / pi (acos u - u sqrt(1 - u^2)) (Goodman, Introduction to Fourier Optics, section 6.3). An elliptic pupil passes a
    wave as a round one does when u is counted along its own axes. A band's 6 nm change no contrast by more than 1e-5.
    """
    inside = np.minimum(np.abs(u), 1.0)
    return np.asarray(2 / np.pi * (np.arccos(inside) - inside * np.sqrt(1 - inside * inside)))


def extreme_normals(sweeps: Iterable[Sweep], camera: LineCamera) -> Floats:
    """Return the mirror's normals at rest and at both ends of every sweep, (n, 3).

    Both spreads are monotonic along a sweep: in scene tangents n_x / n_z = 1 / (eta - sqrt(1 + xi^2 + eta^2)).
    """
    ends = [(sweep.swath_px, scan) for sweep in sweeps if sweep.lines > 0 for scan in sweep.held_px().ravel()[[0, -1]]]
    tangents = np.array(ends, np.float64).reshape(-1, 2) * camera.ifov_rad
    return np.concatenate([REST_NORMAL[None], direction_to_normal(scene_to_direction(tangents))])


def middle_normal(sweep: Sweep, camera: LineCamera) -> Floats:
    """Return the mirror's normal in the middle of a sweep, (3,): one kernel for all its lines, whatever the block."""
    middle = sweep.start_px + ((sweep.lines - 1) * sweep.step + sweep.positions - 1) / 2
    return direction_to_normal(scene_to_direction(np.array([sweep.swath_px, middle]) * camera.ifov_rad))
