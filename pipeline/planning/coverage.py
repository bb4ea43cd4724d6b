"""Lay sweeps that cover a whole scene, find the pixels and patches that they show, and compute their time and bytes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.errors import BudgetError, PoseError, SettingsError
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.pipeline.geometry.scan import (
    Axis,
    CostModel,
    Sweep,
    points_of_scan,
    scan_of_points,
    scene_to_sweep,
    sweep_positions,
    sweep_to_scene,
)

TAPS_BEFORE, TAPS_AFTER = 1, 2  # lines that the resampling kernel reads beside the one at or before a point
BYTES_PER_SAMPLE = 2  # raw samples are uint16
ROUNDING_PX = 1e-6
BEYOND = "beyond the mirror's range; use a smaller scene or a smaller angle per pixel"
_PROBES = 65  # scan positions at which a swath's reach is computed; it changes by 1e-3 px between two


def full_sweeps(
    grid: SceneGrid, camera: LineCamera, along: Axis, *, step: int = 1, overlap_px: float = 0
) -> list[Sweep]:
    """Cover the whole scene with the fewest swaths of lines of ``step`` held positions along one axis.

    ``overlap_px`` is the least width that neighbouring swaths share, and half of it beyond either end of the field, in
    px of the full resolution.

    Raises PoseError: the field is beyond the mirror's range.
    Raises SettingsError: the overlap is negative or as wide as a line.
    """
    if not 0 <= overlap_px < camera.samples // step * step:
        raise SettingsError(
            f"swaths of lines of {camera.samples} samples can overlap by 0 px or more and less than a line, "
            f"got {overlap_px} px; choose a smaller overlap"
        )
    across, scan = field_px(grid, along)
    cells = -(-across // step)
    low, high = -across / 2, cells * step - across / 2
    sweeps = []
    for number, swath in enumerate(_swath_centres((low, high), scan, camera, step, overlap_px)):
        seen = np.clip(swath + reach_px(swath, scan, camera, step), low + step / 2, high - step / 2)
        start, lines = _scan_range(float(swath), seen, scan, camera, step)
        sweeps.append(Sweep(f"full-{number}", "fine", along, float(swath), start, lines, step))
    check_reach(sweeps, camera)
    return sweeps


def uniform_sweeps(
    grid: SceneGrid,
    camera: LineCamera,
    along: Axis,
    *,
    step: int,
    exposure_ms: float | None = None,
    overlap_px: float = 0,
) -> list[Sweep]:
    """Return `full_sweeps` as a uniform scan, raising as they do; ``exposure_ms`` None takes the camera's."""
    return [
        replace(sweep, name=f"scan-{number}", kind="coarse", exposure_ms=exposure_ms)
        for number, sweep in enumerate(full_sweeps(grid, camera, along, step=step, overlap_px=overlap_px))
    ]


def cheapest_full(
    grid: SceneGrid,
    camera: LineCamera,
    cost: CostModel,
    *,
    overlap_px: float = 0,
    cut: Callable[[list[Sweep]], list[Sweep]] = lambda sweeps: sweeps,
    axes: Sequence[Axis] = ("x", "y"),
) -> tuple[Axis, list[Sweep], float]:
    """Return the faster orientation of the full scan: axis of the lines, sweeps, seconds.

    ``cut`` keeps the part of the sweeps that is captured; ``axes`` are the axes that lines may lie along.

    Raises PoseError: no orientation is within the mirror's range.
    """
    found: list[tuple[Axis, list[Sweep], float]] = []
    for along in axes:
        try:
            sweeps = cut(full_sweeps(grid, camera, along, overlap_px=overlap_px))
        except PoseError:
            if along == axes[-1] and not found:
                raise
            continue
        found.append((along, sweeps, cost.seconds(sweeps, camera)))
    return min(found, key=lambda option: option[2])


def with_margin(sweeps: Sequence[Sweep], camera: LineCamera, margin_px: float) -> list[Sweep]:
    """Extend every sweep by a margin at either end, for a mirror that may look beside the plan.

    Raises PoseError: a sweep then leaves the mirror's range.
    """
    more = (int(-(-margin_px // sweep.step)) for sweep in sweeps)
    grown = [some_lines(sweep, -count, sweep.lines + count) for sweep, count in zip(sweeps, more, strict=True)]
    check_reach(grown, camera)
    return grown


def on_scene(shape: tuple[int, int], camera: LineCamera, sweep: Sweep) -> NDArray[np.bool_]:
    """Return which (binned) samples (line, sample) of a sweep show a pixel of a (y, x) scene.

    The rays at mid exposure are exact, with line rotation and stretch.
    """
    across, scan = shape[::-1] if sweep.along == "x" else shape
    along_px, scan_px = sweep_to_scene(sweep, camera)
    inside = np.ones(along_px.shape, bool)
    for place, size in ((along_px, across), (scan_px, scan)):
        # Half open: a sample on the border between two pixels belongs to the second, whatever the rounding.
        pixel = np.floor(place + size / 2 + ROUNDING_PX)
        inside &= (pixel >= 0) & (pixel < size)
    return inside


def field_px(grid: SceneGrid, along: Axis) -> tuple[int, int]:
    """Return the scene's size along the line and along the scan [px]."""
    return (grid.width, grid.height) if along == "x" else (grid.height, grid.width)


def _swath_centres(
    field: tuple[float, float], scan: int, camera: LineCamera, binning: int, least_overlap: float
) -> NDArray[np.float64]:
    """Place the fewest swaths that cover ``field``, with equal overlaps and half as much beyond either end.

    A swath's reach depends on its place, since the line's image is stretched away from the axis. Hence the fixed-point
    iteration; it moves swaths by less than 1 % and converges at once.

    Raises PoseError: no number of swaths covers the field, which is far beyond the mirror's range.
    """
    low, high = field
    most = 2 + int(4 * (high - low) / (camera.samples // binning * binning - least_overlap))
    for count in range(1, most + 1):
        centres = low + (np.arange(count) + 0.5) * (high - low) / count
        for _ in range(8):
            reach = np.stack([reach_px(float(centre), scan, camera, binning) for centre in centres])
            width = reach[:, 1] - reach[:, 0]
            overlap = (width.sum() - (high - low)) / count
            if not overlap >= least_overlap - ROUNDING_PX:
                break
            centres = low - overlap / 2 + np.concatenate([[0.0], np.cumsum(width - overlap)[:-1]]) - reach[:, 0]
        else:
            return centres
    raise PoseError(f"a field of {high - low:g} px across the swaths is {BEYOND}")


def reach_px(swath: float, scan: int, camera: LineCamera, binning: int) -> NDArray[np.float64]:
    """Return the least distance from a line's centre to the edges of its samples, (2,) below and above 0 [px]."""
    edges = (np.array([0, camera.samples // binning * binning]) - camera.samples / 2) * camera.ifov_rad
    probes = np.append(np.linspace(-scan / 2, scan / 2, _PROBES), 0.0)
    along, _ = points_of_scan(swath, camera, probes[:, None], edges)
    return np.array([along[:, 0].max(), along[:, 1].min()]) - swath


def _scan_range(swath: float, seen: NDArray[np.float64], scan: int, camera: LineCamera, step: int) -> tuple[float, int]:
    """Return the first held position [px] and number of lines that show all rows of ``seen``, with rotation and taps.

    Lines lie on the scene's own rows, so that a swath through the axis needs no interpolation along the scan.
    """
    origin = (step - 1 - (scan - 1)) / 2  # centre of the first (coarse) row
    centres, _ = scan_of_points(swath, camera, seen[:, None], origin + step * np.array([0, -(-scan // step) - 1]))
    if not np.isfinite(centres).all():
        raise PoseError(f"a field of {scan:g} px along the scan is {BEYOND}")
    # The line through a point moves one way with either coordinate, so the corners hold the extremes.
    first = int(np.floor((centres.min() - origin) / step + ROUNDING_PX)) - TAPS_BEFORE
    last = int(np.floor((centres.max() - origin) / step + ROUNDING_PX)) + TAPS_AFTER
    return -(scan - 1) / 2 + first * step, last - first + 1


def check_reach(sweeps: Sequence[Sweep], camera: LineCamera) -> None:
    """Raise PoseError, naming the sweep, if one of its held positions is beyond the mirror's disk."""
    for sweep in sweeps:
        try:
            sweep_positions(sweep, camera)
        except PoseError as error:
            end = float(np.abs(sweep.held_px()).max())
            raise PoseError(
                f"sweep {sweep.name} needs lines centred at {sweep.swath_px:.0f} px along and up to {end:.0f} px "
                f"across, beyond the mirror's range: {error}; use a smaller scene or a smaller angle per pixel"
            ) from error


def sweeps_over(sweeps: Sequence[Sweep], grid: SceneGrid, camera: LineCamera, shown: NDArray[np.bool_]) -> list[Sweep]:
    """Return the lines of sweeps that show some of the ``shown`` (patch,) patches; sweeps that show none are left out.

    Lines keep their place and order. All lines between the first and the last needed one are included, also those that
    resampling reads beside a pixel.
    """
    cut = ((sweep, lines_showing(sweep, grid, camera, np.flatnonzero(shown))) for sweep in sweeps)
    return [some_lines(sweep, *lines) for sweep, lines in cut if lines is not None]


def some_lines(sweep: Sweep, first: int, stop: int) -> Sweep:
    """Return a sweep with its lines from ``first`` to before ``stop`` only, at their place."""
    return replace(sweep, start_px=sweep.start_px + first * sweep.step, lines=stop - first)


def lines_showing(
    sweep: Sweep, grid: SceneGrid, camera: LineCamera, patch_index: NDArray[np.intp]
) -> tuple[int, int] | None:
    """Return the first line that shows part of the patches and the one after the last; None if no line does."""
    at = _corners_on(sweep, grid, camera, patch_index)
    ends = -0.5 - TAPS_BEFORE, camera.samples // sweep.binning - 0.5 + TAPS_AFTER
    seen = (at[..., 1].max(axis=0) >= ends[0]) & (at[..., 1].min(axis=0) <= ends[1])
    if not seen.any():
        return None
    lines = at[:, seen, 0]
    first = max(int(np.floor(lines.min() + ROUNDING_PX)) - TAPS_BEFORE, 0)
    stop = min(int(np.floor(lines.max() + ROUNDING_PX)) + TAPS_AFTER + 1, sweep.lines)
    return (first, stop) if first < stop else None


def patches_shown(sweeps: Sequence[Sweep], grid: SceneGrid, camera: LineCamera) -> NDArray[np.bool_]:
    """Return which patches (patch,) the samples of some sweeps show, without the taps of resampling."""
    patch_index = grid.every_patch()
    shown = np.zeros(len(patch_index), np.bool_)
    for sweep in sweeps:
        at = _corners_on(sweep, grid, camera, patch_index)
        ends = sweep.lines - 0.5, camera.samples // sweep.binning - 0.5
        shown |= ((at.max(axis=0) > -0.5) & (at.min(axis=0) < ends)).all(axis=-1)
    return shown


def _corners_on(
    sweep: Sweep, grid: SceneGrid, camera: LineCamera, patch_index: NDArray[np.intp]
) -> NDArray[np.float64]:
    """Return line and sample of the corners of patches on a sweep, (corner, patch, 2).

    Both are monotone in either coordinate, so that a rectangle's corners hold its extremes.
    """
    origin = grid.patch_origin(patch_index)
    size = np.array([grid.height, grid.width])
    low, high = origin - size / 2, np.minimum(origin + grid.patch, size) - size / 2
    along, scan = (1, 0) if sweep.along == "x" else (0, 1)
    corners_along = np.stack([low, low, high, high])[..., along]
    return scene_to_sweep(sweep, camera, corners_along, np.stack([low, high, low, high])[..., scan])


def select_patches(score: NDArray[np.floating], count: int) -> NDArray[np.intp]:
    """Return the ``count`` patches with the highest ``score`` (patch,), best first.

    Equal scores go to the lowest number, +inf comes first, NaN and -inf last. A smaller count gives the first patches
    of a larger one.
    """
    given = np.asarray(score, np.float64)
    return np.argsort(np.where(np.isnan(given), np.inf, -given), kind="stable")[:count]


def frame_patches(score: NDArray[np.floating], fraction: float) -> NDArray[np.intp]:
    """Return a fraction of the patches, chosen by `select_patches`; half a patch is rounded up.

    Raises BudgetError: the fraction is not a number from 0 to 1.
    """
    if not 0 <= fraction <= 1:  # NaN too
        raise BudgetError(
            f"the fraction of patches to buy must be from 0 to 1, got {fraction} (of {len(score)} patches)"
        )
    return select_patches(score, int(np.floor(fraction * len(score) + 0.5)))


@dataclass(frozen=True)
class SavingEntry:
    """One line of the receipt's savings: the capture's value, and the predicted one of full resolution."""

    done: float
    full: float

    def as_dict(self) -> dict[str, float | str | None]:
        """Return the entry in the receipt's form; the ratio is None where full is 0."""
        ratio = self.done / self.full if self.full else None
        return {"done": self.done, "full": self.full, "ratio": ratio, "full_is": "predicted"}


def count_samples(sweeps: Sequence[Sweep], camera: LineCamera, grid: SceneGrid) -> int:
    """Count the (binned) samples that show the scene; those beside it are left out."""
    shape = (grid.height, grid.width)
    return sum(int(np.count_nonzero(on_scene(shape, camera, sweep))) for sweep in sweeps)


def raw_bytes(sweeps: Sequence[Sweep], camera: LineCamera, bands: int) -> int:
    """Count the bytes of the captured lines, with all of their samples."""
    return sum(sweep.lines * (camera.samples // sweep.binning) for sweep in sweeps) * bands * BYTES_PER_SAMPLE


def capture_savings(
    done: Sequence[Sweep], full: Sequence[Sweep], camera: LineCamera, grid: SceneGrid
) -> dict[str, SavingEntry]:
    """Compare sweeps with those of a full scan: lines, and samples on the scene."""
    return {
        "lines": SavingEntry(sum(one.lines for one in done), sum(one.lines for one in full)),
        "samples": SavingEntry(count_samples(done, camera, grid), count_samples(full, camera, grid)),
    }
