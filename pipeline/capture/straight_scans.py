"""Positions of recorded lines, the `Sweep` that they describe, the field it covers, and scans without a mirror.

The rectification places lines by their positions alone. From a `Sweep` it takes ``along`` (the axis of a line),
``binning`` (pixels per sample), ``step`` (the line spacing) and ``name``. Planning and the choice of recorded lines use
``swath_px``, ``start_px`` and ``lines``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.errors import SceneError
from spectralzoom.pipeline.geometry import mirror
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.scan import Axis, Floats, Sweep, points_of_scan

MOST_DEG = 89.0  # a direction at a larger angle misses the scene plane


def angles_to_positions(angles_deg: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the mirror positions (line, 2) of viewing angles (line, 2), and whether the mirror reaches them (line,).

    An angle is that between the undeflected direction and the view, projected on the line's axis and on the scan. Its
    tangent is the scene tangent. Positions beyond the mirror's reach are NaN. The mirror turns the view by 50 deg along
    the scan, and by 35.6 deg across it where the scan is at 0.
    """
    positions = np.full(angles_deg.shape, np.nan)
    ahead = (np.abs(angles_deg) < MOST_DEG).all(axis=1)
    direction = mirror.scene_to_direction(np.tan(np.deg2rad(angles_deg[ahead])))
    device = mirror.normal_to_device(mirror.direction_to_normal(direction))
    straight = 2 * device[:, 2] ** 2 - 1  # of the beam that falls along the rest normal, after the reflection
    lateral = 2 * device[:, 2] * np.hypot(device[:, 0], device[:, 1])
    reached = np.zeros(len(angles_deg), np.bool_)
    reached[ahead] = (device[:, 2] > 0) & (straight > 0) & (lateral <= mirror.REST_TANGENT * straight)
    positions[reached] = mirror.direction_to_position(direction[reached[ahead]])
    return positions, reached


EDGE_PX = 0.05  # of their pixel that the outermost lines and samples of a field may lack
MOST_BEND = 1 / 16  # largest distance of line centres from their swath, as a fraction of a line's length
MOST_BACK = 8.0  # line spacings that a scan may go back before it counts as turned
UNEVEN = 0.1  # of the line spacing: lines off by less keep to it
MOST_EVEN = 0.9  # of the lines: in a scan with gaps more than this keep to the spacing
GAP = 1.5  # least distance of two consecutive lines with a gap between them, in line spacings
STANDING_PX = 1e-3  # a scan that moves less from line to line stands still
STATED_DIGITS = 6  # of derived coordinates [px], so that a planned sweep comes back as it was
FLAT_PX = 0.01  # largest stretch or shift at the ends of a line without a mirror


@dataclass(frozen=True)
class StraightScan:
    """A sweep derived from positions, with the line spacing of the scan."""

    sweep: Sweep
    distance_px: float  # of consecutive lines; ``sweep.step`` is the nearest whole number from 1
    note: str = ""  # on a gap


def fit_sweep(
    position: Floats,
    camera: LineCamera,
    *,
    name: str,
    samples: int,
    along: Axis = "x",
    valid: NDArray[np.bool_] | None = None,
) -> StraightScan:
    """Derive the sweep of positions (line, 2): swath, start and step by medians, which outliers do not move.

    The start is the median of the remainders. The binning is ``camera.samples`` over the ``samples`` of a recorded
    line. Coordinates are rounded to 1e-6 px. A backward scan gets the sweep of the same lines forward.

    Raises SceneError: there are fewer than two valid lines, the samples do not divide the camera's, the scan stands
    still or turns back, or line centres are not on a straight line. Raises PoseError: a valid position is beyond the
    mirror.
    """
    binning = camera.samples // max(samples, 1)
    if camera.samples // max(binning, 1) != samples:
        raise SceneError(
            f"sweep {name} has lines of {samples} samples, no whole part of the camera's {camera.samples}; set "
            "camera.samples to those of a line that is not binned"
        )
    lines = np.arange(len(position)) if valid is None else np.flatnonzero(valid)
    if len(lines) < 2:
        raise SceneError(
            f"sweep {name} has too few valid lines ({len(lines)}), a scan takes at least 2: leave it out, record more "
            "lines, or survey its file with --scene"
        )
    across, scan = (mirror.direction_to_scene(mirror.position_to_direction(position[lines])) / camera.ifov_rad).T
    distance, note = line_spacing(scan, lines)
    _check_path(name, lines, across, scan, distance, MOST_BEND * camera.samples)
    step = max(round(abs(distance)), 1)
    first = float(np.median(scan - distance * lines))
    sweep = Sweep(
        name,
        "fine" if step == binning == 1 else "coarse",
        along,
        swath_px=_stated(float(np.median(across))),
        start_px=_stated(min(first, first + distance * (len(position) - 1)) - (step - 1) / 2),
        lines=len(position),
        step=step,
        binning=binning,
    )
    return StraightScan(sweep, abs(distance), note)


def _check_path(name: str, lines: NDArray[np.intp], across: Floats, scan: Floats, apart_px: float, most: float) -> None:
    """Refuse lines ``apart_px`` apart that stand still, turn back or bend by more than ``most`` [px] (SceneError)."""
    if abs(apart_px) < STANDING_PX:
        raise SceneError(
            f"sweep {name} stands still: its lines move by {abs(apart_px):.2g} px from one to the next; give the "
            "positions of a scan, with one sweep for each way that it goes"
        )
    way = scan if apart_px > 0 else -scan
    turned = np.maximum.accumulate(way) - way > MOST_BACK * abs(apart_px)
    if turned.any():
        raise SceneError(
            f"sweep {name} turns back at line {lines[np.argmax(turned)]}; give each way of the scan a sweep of its "
            "own, by a column 'sweep' in the pointing table"
        )
    swath = float(np.median(across))
    bend = np.abs(across - swath)
    if bend.max() > most:
        worst = int(np.argmax(bend))
        raise SceneError(
            f"sweep {name} is not straight: line {lines[worst]} lies {bend[worst]:.4g} px beside the swath at "
            f"{swath:.4g} px, and at most {most:g} px are allowed; cut the scan into straighter parts by a column "
            "'sweep', or mark single wrong lines with valid = 0"
        )


def line_spacing(scan: Floats, lines: NDArray[np.intp]) -> tuple[float, str]:
    """Return the signed distance of consecutive lines [px], and a note on a gap.

    It is the median over pairs half the scan apart, which averages noise. A gap would change it. If some lines lie
    farther apart and nearly all others are evenly spaced, it is the median of consecutive lines.
    """
    half = len(lines) // 2
    distance = float(np.median((scan[half:] - scan[:-half]) / (lines[half:] - lines[:-half])))
    steps = np.diff(scan) / np.diff(lines)
    near = float(np.median(steps))
    even = float(np.mean(np.abs(steps - near) <= UNEVEN * abs(near)))
    at = int(np.argmax(np.abs(steps)))
    if abs(near) > STANDING_PX and even > MOST_EVEN and abs(steps[at]) > GAP * abs(near):
        return near, f"lines {lines[at]} and {lines[at + 1]} lie {abs(scan[at + 1] - scan[at]):.4g} px apart"
    return distance, ""


def _stated(value: float) -> float:
    return round(value, STATED_DIGITS) + 0.0  # no -0.0


def covered_field(
    sweeps: Sequence[Sweep], tangents: Sequence[Floats], camera: LineCamera
) -> tuple[tuple[int, int], tuple[float, float]]:
    """Return the largest rectangle in whole pixels that the scans cover together, with turned lines.

    Returns its (y, x) size, and (y, x) of its centre from the undeflected direction [px].

    ``tangents`` are the line centres of each sweep, (line, 2) along the line and the scan. Along the line adjacent
    swaths add up; along the scan their intersection counts. Gaps between swaths are not detected.

    Raises SceneError: the swaths have no part of the scan in common, or lines lie along both axes.
    """
    axes = {sweep.along for sweep in sweeps}
    if len(axes) != 1:
        raise SceneError("the recording has lines along x and along y; state the field's size in px")
    ends = np.array([-0.5, 0.5]) * camera.samples
    parts: dict[int, list[tuple[float, float]]] = {}
    across: list[float] = []
    for sweep, centres in zip(sweeps, tangents, strict=True):
        known = centres[np.isfinite(centres).all(axis=1)] / camera.ifov_rad
        if not len(known):
            continue
        outer = np.array([known[:, 1].min(), known[:, 1].max()])[:, None]
        _, seen = points_of_scan(sweep.swath_px, camera, outer, ends * camera.ifov_rad)
        across.append(sweep.swath_px)
        parts.setdefault(round(sweep.swath_px), []).append((float(seen[0].max()), float(seen[1].min())))
    if not parts:
        raise SceneError("no line of the recording has a position; capture it again, or correct its pointing")
    begin = max(min(low for low, _ in part) for part in parts.values()) - 0.5
    end = min(max(high for _, high in part) for part in parts.values()) + 0.5
    if end - begin < 1:
        raise SceneError("the swaths of the recording have no part of the scan in common; state the field's size in px")
    low, high = min(across) + ends[0], max(across) + ends[1]
    size = (int(end - begin + EDGE_PX), int(high - low + EDGE_PX))
    centre = ((begin + end) / 2, (low + high) / 2)
    return (size[::-1], centre[::-1]) if axes == {"y"} else (size, centre)


def flat_camera(camera: LineCamera, extent_px: float) -> LineCamera:
    """Return the camera whose lines stay parallel over ``extent_px`` from the centre, for scans without a mirror.

    With a stage, a conveyor or a drone all lines are parallel and of one length, as with an infinite focal length. The
    focal length chosen here keeps the ends of lines within 0.01 px of that. Pixels of such a camera are real, its
    angles are not.
    """
    half = camera.samples / 2
    tangent = np.sqrt(2 * FLAT_PX / half)  # a line at the tangent e is sqrt(1 + e^2) times as long
    ifov_rad = min(camera.ifov_rad, float(tangent) / max(extent_px, half))
    return replace(camera, focal_length_mm=camera.pitch_um * 1e-3 / ifov_rad)
