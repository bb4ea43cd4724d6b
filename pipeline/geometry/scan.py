"""Define sweeps of lines: their places on the scene, their capture time, and their share of the mirror's memory.

Points of a sweep are (along, scan) in px from the undeflected direction: (x, y) of the scene for ``along="x"``,
(y, x) for ``along="y"``. A line is the straight image of the slit, so the mapping between scene and sweep is a closed
form.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spectralzoom.pipeline.errors import SettingsError
from spectralzoom.pipeline.geometry import mirror
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.setting_fields import settings_table, stated

Axis = Literal["x", "y"]
Floats = NDArray[np.float64]
Ends = Literal["exclusive", "inclusive"]


@dataclass(frozen=True)
class Sweep:
    """A run of lines, straight in the scene: all line centres lie on one parallel to the scan axis.

    Scene coordinates are in px from the scene's centre, the undeflected direction. The mirror holds ``positions``
    positions, 1 px apart, during each exposure. These are as many as lines are apart (a staircase from its vector
    memory), or ``held`` of them. ``held=1`` holds one position for each line, so that later lines fit between.
    """

    name: str
    kind: Literal["coarse", "fine"]
    along: Axis  # scene axis that the line lies along; the scan goes along the other
    swath_px: float  # of the line centres, on the axis along the line
    start_px: float  # of the first held position, on the scan axis
    lines: int
    step: int = 1
    binning: int = 1
    exposure_ms: float | None = None  # of a line; None: the camera's
    held: int | None = None  # positions of an exposure; None: ``step``

    @property
    def positions(self) -> int:
        """Return how many positions the mirror holds during each exposure."""
        return self.held or self.step

    def held_px(self) -> NDArray[np.float64]:
        """Return the scan coordinate of every held position, (line, position) [px]."""
        starts = np.arange(self.lines, dtype=np.float64) * self.step
        return self.start_px + (starts[:, None] + np.arange(self.positions))

    def line_px(self) -> NDArray[np.float64]:
        """Return the scan coordinate at mid exposure of every line, (line,) [px]."""
        return self.start_px + (self.positions - 1) / 2 + np.arange(self.lines, dtype=np.float64) * self.step


def exposing(camera: LineCamera, sweep: Sweep) -> LineCamera:
    """Return the camera with the exposure of a sweep, if the sweep has its own."""
    return camera if sweep.exposure_ms in (None, camera.exposure_ms) else replace(camera, exposure_ms=sweep.exposure_ms)


def merged_ms(exposure_ms: ArrayLike, weights: Sequence[float] | None = None) -> float:
    """Return the exposure [ms] of lines of several exposures: its read noise is the mean of theirs, as a variance."""
    return float(np.average(np.asarray(exposure_ms, np.float64) ** -2.0, weights=weights) ** -0.5)


@settings_table
class CostModel:
    """Capture time of a plan. Values are assumed until measured on a rig."""

    slew_s: float = stated(0.05, "Time to turn the mirror to a sweep's first line", "s", 0, 10)
    settle_frames: float = stated(2.0, "Frames that the mirror takes to come to rest", "", 0, 1000)
    capture_start_s: float = stated(0.2, "Time to start a capture", "s", 0, 60)
    reload_s: float = stated(1.6, "Time to load vector_pairs positions into the mirror's memory", "s", 0, 60)
    vector_pairs: int = stated(1500, "Positions that the mirror's memory holds", "", 1, 10_000_000)

    def setup_seconds(self, camera: LineCamera) -> float:
        """Return the time of slew, settling and start of one sweep [s]."""
        return self.slew_s + self.capture_start_s + self.settle_frames * camera.frame_ms * 1e-3

    def seconds(self, sweeps: list[Sweep], camera: LineCamera) -> float:
        """Return the time of the sweeps in the given order [s]: lines, set-ups, and reloads of the vector memory."""
        counts: dict[LineCamera, tuple[int, int]] = {}
        for sweep in sweeps:
            exposed = exposing(camera, sweep)
            lines, count = counts.get(exposed, (0, 0))
            counts[exposed] = lines + sweep.lines, count + 1
        return self.line_seconds(counts) + len(memory_loads(sweeps, self.vector_pairs)) * self.reload_s

    def line_seconds(self, counts: Mapping[LineCamera, tuple[int, int]]) -> float:
        """Return the time of so many lines and sweeps of each exposure, set-ups included [s]."""
        return sum(
            exposed.scan_seconds(lines) + sweeps * self.setup_seconds(exposed)
            for exposed, (lines, sweeps) in counts.items()
        )


def sweep_positions(sweep: Sweep, camera: LineCamera) -> Floats:
    """Return the mirror positions that a sweep holds, (line, step, 2) device X and Y.

    Raises PoseError: a position is beyond the mirror's disk.
    """
    return scan_positions(sweep.swath_px, sweep.held_px(), camera)


def line_positions(sweep: Sweep, camera: LineCamera) -> Floats:
    """Return the mirror position at mid exposure of every line, (line, 2) device X and Y.

    Raises PoseError: a position is beyond the mirror's disk.
    """
    return scan_positions(sweep.swath_px, sweep.line_px(), camera)


def scan_positions(swath_px: float, scan_px: Floats, camera: LineCamera) -> Floats:
    """Return the mirror positions (..., 2) of lines centred on ``swath_px``, at ``scan_px`` on the scan axis.

    Raises PoseError: a position is beyond the mirror's disk.
    """
    tangents = np.stack([np.full_like(scan_px, swath_px), scan_px], axis=-1) * camera.ifov_rad
    return mirror.direction_to_position(mirror.scene_to_direction(tangents))


def shifted_position(position: Floats, shift_px: Floats, camera: LineCamera) -> Floats:
    """Return positions whose line centres are shifted by ``shift_px`` (along the line and the scan) from ``position``.

    Both are (..., 2) and broadcast.

    Raises PoseError: a position is beyond the rim, before or after the shift.
    """
    tangents = mirror.direction_to_scene(mirror.position_to_direction(position)) + shift_px * camera.ifov_rad
    return mirror.direction_to_position(mirror.scene_to_direction(tangents))


def scan_of_points(
    swath_px: float, camera: LineCamera, along_px: ArrayLike, scan_px: ArrayLike
) -> tuple[Floats, Floats]:
    """Return the line through scene points and their place on it, for line centres on ``swath_px``.

    The result is the scan coordinate of the line's centre [px], and the slope k_y / k_z at which the camera sees the
    point. The points ``along_px`` and ``scan_px`` broadcast [px].
    """
    xi0 = swath_px * camera.ifov_rad
    xi, eta = np.asarray(along_px, np.float64) * camera.ifov_rad, np.asarray(scan_px, np.float64) * camera.ifov_rad
    centre = mirror.line_centre(xi, eta, xi0)
    return centre / camera.ifov_rad, mirror.camera_slope(xi, eta, xi0, centre)


def points_of_scan(swath_px: float, camera: LineCamera, scan_px: ArrayLike, slope: ArrayLike) -> tuple[Floats, Floats]:
    """Return the scene points (along, scan) [px] that rays of ``slope`` see from line centres at ``scan_px``.

    The inverse of ``scan_of_points``. Let xi0 be the swath's tangent, e the scan tangent of the line's centre,
    N = sqrt(1 + xi0^2 + e^2) and q = N - e. The line is eta = e + (xi - xi0) xi0 / q; its slope is tan psi.
    """
    xi0 = swath_px * camera.ifov_rad
    e = np.asarray(scan_px, np.float64) * camera.ifov_rad
    u = np.asarray(slope, np.float64)
    size = np.sqrt(1 + xi0**2 + e**2)
    q = np.where(e > 0, (1 + xi0**2) / (size + np.maximum(e, 0)), size - np.minimum(e, 0))  # nothing cancels
    d = u * size * q / (q - u * xi0)
    return (xi0 + d) / camera.ifov_rad, (e + d * xi0 / q) / camera.ifov_rad


def scene_to_sweep(sweep: Sweep, camera: LineCamera, along_px: ArrayLike, scan_px: ArrayLike) -> Floats:
    """Return continuous (line, sample) of scene points on a planned sweep, (..., 2) float64; integers are centres."""
    centre, slope = scan_of_points(sweep.swath_px, camera, along_px, scan_px)
    line = (centre - sweep.start_px - (sweep.positions - 1) / 2) / sweep.step
    return np.stack([line, camera.sample_at(slope, sweep.binning)], axis=-1)


def sweep_to_scene(sweep: Sweep, camera: LineCamera) -> tuple[Floats, Floats]:
    """Return the scene points of every sample at mid exposure: along and scan, (line, sample) each [px]."""
    return points_of_scan(sweep.swath_px, camera, sweep.line_px()[:, None], camera.pixel_slopes(sweep.binning)[None, :])


@dataclass(frozen=True)
class MemoryPart:
    """Lines ``lines[0]`` to ``lines[1]`` of a sweep in a load, half open."""

    sweep: int  # place in the list of sweeps
    lines: tuple[int, int]


@dataclass(frozen=True)
class Load:
    """One content of the memory. A position is a pair of X and Y; both channels lie in one vector, Y behind X."""

    parts: tuple[MemoryPart, ...]


def memory_loads(sweeps: Sequence[Sweep], vector_pairs: int) -> list[Load]:
    """Lay the positions of sweeps into a memory of ``vector_pairs`` pairs, each load as full as whole lines allow.

    A load takes the rest of one sweep and begins the next; the positions of one line stay in one load.

    Raises SettingsError: the positions of one line do not fit the memory.
    """
    loads: list[list[MemoryPart]] = [[]]
    used = 0
    for number, sweep in enumerate(sweeps):
        if sweep.positions > vector_pairs:
            raise SettingsError(
                f"sweep {sweep.name} holds {sweep.positions} positions in each line, the mirror's vector memory "
                f"{vector_pairs} pairs; give cost.vector_pairs of at least {sweep.positions}"
            )
        line = 0
        while line < sweep.lines:
            room = (vector_pairs - used) // sweep.positions
            if room == 0:
                loads.append([])
                used = 0
                continue
            taken = min(room, sweep.lines - line)
            loads[-1].append(MemoryPart(number, (line, line + taken)))
            line += taken
            used += taken * sweep.positions
    return [Load(tuple(parts)) for parts in loads if parts]


def device_range(cells: tuple[int, int], ends: Ends) -> tuple[int, int]:
    """Return a half-open range as the device counts it: the end is the cell after the last, or the last itself.

    The device's convention is not confirmed (erratum E14), so it is a setting of the driver; all other ranges are half
    open.

    Raises SettingsError: the range is empty or begins below 0.
    """
    start, stop = cells
    if start < 0 or stop <= start:
        raise SettingsError(f"a channel plays at least one cell from 0 on, got the half-open range {start}:{stop}")
    return start, stop if ends == "exclusive" else stop - 1
