"""Scan paths: sweeps of lines through the mirror, where their lines fall on the scene, and what they cost in seconds.

Points of a sweep are (along, scan) in px from the undeflected direction: (x, y) of the scene for ``along="x"``,
(y, x) for ``along="y"``. A line is the straight image of the slit, so scene and sweep map to each other in closed form.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.errors import ShapeError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.mirror import (
    camera_slope,
    direction_to_position,
    direction_to_scene,
    line_centre,
    position_to_direction,
    scene_to_direction,
)
from pipeline.geometry.vector_memory import count_loads
from pipeline.stated import stated

Axis = Literal["x", "y"]
Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Sweep:
    """A run of lines, straight in the scene: all line centres lie on one parallel to the scan axis.

    Scene coordinates are in px from the scene's centre, the undeflected direction. The mirror holds ``step``
    positions, 1 px apart, during each exposure (a staircase from its vector memory): ``step=1`` stares.
    """

    name: str
    kind: Literal["coarse", "fine"]
    along: Axis  # scene axis that the line lies along; the scan goes along the other
    strip_px: float  # of the line centres, on the axis along the line
    start_px: float  # of the first held position, on the scan axis
    lines: int
    step: int = 1
    binning: int = 1

    def held_px(self) -> NDArray[np.float64]:
        """Scan coordinate of every held position, (line, step) [px]."""
        return self.start_px + np.arange(self.lines * self.step, dtype=np.float64).reshape(self.lines, self.step)

    def line_px(self) -> NDArray[np.float64]:
        """Scan coordinate at mid exposure of every line, (line,) [px]."""
        return self.start_px + (self.step - 1) / 2 + np.arange(self.lines, dtype=np.float64) * self.step


@dataclass(frozen=True)
class CostModel:
    """Seconds that a plan takes. Assumed until measured on a rig; settings carry the provenance."""

    slew_s: float = stated(0.05, "Time to turn the mirror to a sweep's first line", "s", 0, 10)
    settle_frames: float = stated(2.0, "Frames that the mirror takes to come to rest", "", 0, 1000)
    capture_start_s: float = stated(0.2, "Time to start a capture", "s", 0, 60)
    reload_s: float = stated(1.6, "Time to load vector_pairs positions into the mirror's memory", "s", 0, 60)
    vector_pairs: int = stated(1500, "Positions that the mirror's memory holds", "", 1, 10_000_000)
    provenance: str = stated("assumed", "Where measured values come from")

    def setup_seconds(self, camera: LineCamera) -> float:
        """Slew, settling and start of one sweep [s]."""
        return self.slew_s + self.capture_start_s + self.settle_frames * camera.frame_ms * 1e-3

    def seconds(self, sweeps: list[Sweep], camera: LineCamera) -> float:
        """Price of the sweeps in the given order [s]: lines, a set-up each, and reloads of the vector memory."""
        lines = sum(sweep.lines for sweep in sweeps)
        reloads = count_loads(sweeps, self.vector_pairs)
        return camera.scan_seconds(lines) + len(sweeps) * self.setup_seconds(camera) + reloads * self.reload_s


def sweep_positions(sweep: Sweep, camera: LineCamera) -> Floats:
    """Give the mirror positions that a sweep holds, (line, step, 2) device X and Y.

    Raises
    ------
    PoseError : a position is beyond the mirror's disk.
    """
    return _aim(sweep, camera, sweep.held_px())


def line_positions(sweep: Sweep, camera: LineCamera) -> Floats:
    """Give the mirror position at mid exposure of every line, (line, 2) device X and Y.

    Raises
    ------
    PoseError : a position is beyond the mirror's disk.
    """
    return _aim(sweep, camera, sweep.line_px())


def _aim(sweep: Sweep, camera: LineCamera, scan_px: Floats) -> Floats:
    tangents = np.stack([np.full_like(scan_px, sweep.strip_px), scan_px], axis=-1) * camera.ifov_rad
    return direction_to_position(scene_to_direction(tangents))


def shifted_position(position: Floats, shift_px: Floats, camera: LineCamera) -> Floats:
    """Give the mirror positions whose line centres lie ``shift_px`` beside those of ``position``.

    Parameters
    ----------
    position
        (..., 2) device X and Y.
    shift_px
        (..., 2) along the line and the scan; broadcasts. [px]

    Raises
    ------
    PoseError : a position is beyond the rim, before or after the shift.
    """
    tangents = direction_to_scene(position_to_direction(position)) + shift_px * camera.ifov_rad
    return direction_to_position(scene_to_direction(tangents))


def scan_of_points(
    strip_px: float, camera: LineCamera, along_px: ArrayLike, scan_px: ArrayLike
) -> tuple[Floats, Floats]:
    """Give the line through scene points and where on it they lie, for line centres on ``strip_px``.

    Parameters
    ----------
    along_px, scan_px
        Scene points; arrays that broadcast. [px]

    Returns
    -------
    Scan coordinate of the line's centre [px], and the slope k_y / k_z at which the camera sees the point.
    """
    xi0 = strip_px * camera.ifov_rad
    xi, eta = np.asarray(along_px, np.float64) * camera.ifov_rad, np.asarray(scan_px, np.float64) * camera.ifov_rad
    centre = line_centre(xi, eta, xi0)
    return centre / camera.ifov_rad, camera_slope(xi, eta, xi0, centre)


def points_of_scan(strip_px: float, camera: LineCamera, scan_px: ArrayLike, slope: ArrayLike) -> tuple[Floats, Floats]:
    """Give the scene points (along, scan) [px] that rays of ``slope`` see from line centres at ``scan_px``.

    The inverse of ``scan_of_points``. With xi0 the strip, e the scan tangent of the line's centre,
    N = sqrt(1 + xi0^2 + e^2) and q = N - e, the line is eta = e + (xi - xi0) xi0 / q (its slope is tan psi).
    """
    xi0 = strip_px * camera.ifov_rad
    e, u = np.asarray(scan_px, np.float64) * camera.ifov_rad, np.asarray(slope, np.float64)
    size = np.sqrt(1 + xi0**2 + e**2)
    q = np.where(e > 0, (1 + xi0**2) / (size + np.maximum(e, 0)), size - np.minimum(e, 0))  # nothing cancels
    d = u * size * q / (q - u * xi0)
    return (xi0 + d) / camera.ifov_rad, (e + d * xi0 / q) / camera.ifov_rad


def scene_to_sweep(sweep: Sweep, camera: LineCamera, along_px: ArrayLike, scan_px: ArrayLike) -> Floats:
    """Give continuous (line, sample) of scene points on a sweep as planned, (..., 2) float64; integers are centres."""
    centre, slope = scan_of_points(sweep.strip_px, camera, along_px, scan_px)
    line = (centre - sweep.start_px - (sweep.step - 1) / 2) / sweep.step
    return np.stack([line, camera.sample_at(slope, sweep.binning)], axis=-1)


def sweep_to_scene(sweep: Sweep, camera: LineCamera) -> tuple[Floats, Floats]:
    """Give the scene points of every sample at mid exposure: along and scan, (line, sample) each [px]."""
    slopes = camera.pixel_slopes(sweep.binning)
    return points_of_scan(sweep.strip_px, camera, sweep.line_px()[:, None], slopes[None, :])


@dataclass(frozen=True)
class CaptureOption:
    """One way to spend a fixed time on one strip, and what it gives up."""

    name: str
    lines: int
    exposure_ms: float
    field_px: float  # length of the scan
    line_px: float  # distance between lines; 1 px is square pixels
    seconds: float
    gives_up: str


def capture_options(camera: LineCamera, lines: int, factor: int = 2) -> list[CaptureOption]:
    """List three ways to use the time of ``lines`` aligned lines (the paper's worked case, errata E12 and E13).

    Square pixels; ``factor`` times fewer lines with a longer exposure; ``factor`` times the field with as many lines.
    All take the same seconds: 640 x 600 at 100 ms, 640 x 300 at 200 ms and twice the field take 60 s each.

    Raises
    ------
    ShapeError : ``lines`` is not a positive multiple of ``factor``.
    """
    if lines < 1 or factor < 1 or lines % factor:
        raise ShapeError(f"expected a positive number of lines that divides by the factor {factor}, got {lines}")
    slow = replace(camera, exposure_ms=factor * camera.frame_ms - camera.readout_ms)
    few = lines // factor
    seconds, slow_seconds = camera.scan_seconds(lines), slow.scan_seconds(few)
    wide = f"lines {factor} px apart: {factor} times coarser along the scan"
    return [
        CaptureOption("aligned", lines, camera.exposure_ms, lines, 1.0, seconds, "nothing"),
        CaptureOption("long exposure", few, slow.exposure_ms, lines, factor, slow_seconds, f"{wide}, less data"),
        CaptureOption("wide field", lines, camera.exposure_ms, lines * factor, factor, seconds, wide),
    ]
