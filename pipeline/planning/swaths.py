"""Find the lines that each patch needs, swaths at every useful offset, and the mirror's reach."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.errors import SettingsError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.mirror import scene_to_direction
from pipeline.geometry.scan import Axis, Sweep, points_of_scan, scene_to_sweep
from pipeline.planning.coverage import ROUNDING_PX, TAPS_AFTER, TAPS_BEFORE, field_px, reach_px

PatchIndex = NDArray[np.intp]

RIM_TILT = float(np.cos(np.deg2rad(25.0)))  # of the mirror's normal from rest, where its disk ends
RIM_MARGIN = 1e-9
_PROBES = 9


@dataclass(frozen=True)
class Views:
    """All views of patches: swath s shows patch i on lines ``first`` to ``stop``.

    Lines of all swaths count from the first line that any swath needs; there are ``lines`` of them. ``swaths[s]``
    sweeps from line 0. Views are sorted by swath: those of s are ``edges[s]`` to ``edges[s + 1]``.
    """

    swaths: tuple[Sweep, ...]
    lines: int
    edges: NDArray[np.intp]  # (strip + 1,)
    patch_number: NDArray[np.intp]  # (view,) number of the patch
    first: NDArray[np.intp]  # (view,)
    stop: NDArray[np.intp]  # (view,)

    @property
    def swath(self) -> NDArray[np.intp]:
        """Return the swath of each view, (view,)."""
        return np.repeat(np.arange(len(self.swaths)), np.diff(self.edges))


def patch_lines(
    grid: SceneGrid, camera: LineCamera, sweep: Sweep, patch_index: NDArray[np.integer], *, margin_px: float = 0.0
) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Return the lines of a sweep of step 1 that each patch needs, resampling taps included.

    Lines count from the sweep's first and need not exist: compare with ``sweep.lines``. Only pixels on the scene count.
    ``margin_px`` is the distance beside the plan that the mirror may look, which adds lines and samples all around.

    The result is (patch, 2) first line and the one after the last, and (patch,) whether the samples reach all pixels.
    A patch without a pixel on the scene is never reached.
    """
    origin, size = grid.patch_origin(patch_index), np.array([grid.height, grid.width])
    middle = (size - 1) / 2
    low, high = origin - middle, np.minimum(origin + grid.patch, size) - 1 - middle  # first and last pixel centre
    on_scene = np.all(origin < size, axis=-1)
    along, scan = (1, 0) if sweep.along == "x" else (0, 1)
    # Line and sample of a point are monotone in either coordinate, so a rectangle's corners hold the extremes.
    corners_along = np.stack([low, low, high, high])[..., along]
    corners_scan = np.stack([low, high, low, high])[..., scan]
    at = scene_to_sweep(sweep, camera, corners_along, corners_scan)
    more = int(np.ceil(margin_px)) + 1 if margin_px else 0  # a line that is shifted turns as well, by less than a pixel
    first = np.floor(at[..., 0].min(axis=0) + ROUNDING_PX).astype(np.intp) - TAPS_BEFORE - more
    stop = np.floor(at[..., 0].max(axis=0) + ROUNDING_PX).astype(np.intp) + TAPS_AFTER + 1 + more
    reached = (at[..., 1].min(axis=0) >= more - 0.5) & (at[..., 1].max(axis=0) <= camera.samples - 0.5 - more)
    return np.stack([first, stop], axis=-1), reached & on_scene


def covered_patches(
    grid: SceneGrid, camera: LineCamera, sweeps: Sequence[Sweep], *, margin_px: float = 0.0
) -> PatchIndex:
    """Return the valid patches that lie wholly, taps and margin included, in one of the fine sweeps, ascending."""
    shown = np.zeros(int(np.prod(grid.patch_shape)), bool)
    for sweep in sweeps:
        patch_index = patches_near(grid, camera, sweep)
        lines, reached = patch_lines(grid, camera, sweep, patch_index, margin_px=margin_px)
        shown[patch_index[reached & (lines[:, 0] >= 0) & (lines[:, 1] <= sweep.lines)]] = True
    return np.flatnonzero(shown)


def patches_near(grid: SceneGrid, camera: LineCamera, sweep: Sweep) -> PatchIndex:
    """Return the valid patches that the rectangle around a sweep's footprint touches, ascending."""
    edges = np.array([-camera.samples / 2, camera.samples / 2]) * camera.ifov_rad
    scan = np.linspace(sweep.start_px, sweep.start_px + max(sweep.lines, 1), _PROBES)
    if scan[0] < 0 < scan[-1]:
        scan = np.append(scan, 0.0)  # the line's image is shortest there
    ends = points_of_scan(sweep.swath_px, camera, scan[:, None], edges)
    axes = (ends[1], ends[0]) if sweep.along == "x" else (ends[0], ends[1])
    span = []
    for places, size in zip(axes, (grid.height, grid.width), strict=True):
        first = int(np.floor((places.min() + (size - 1) / 2) / grid.patch)) - 1
        last = int(np.floor((places.max() + (size - 1) / 2) / grid.patch)) + 1
        span.append(np.arange(max(first, 0), min(last + 1, -(-size // grid.patch))))
    return (span[0][:, None] * grid.patch_shape[1] + span[1]).ravel()


def swaths_at_patches(grid: SceneGrid, camera: LineCamera, along: Axis, *, margin_px: float = 0.0) -> list[Sweep]:
    """Return a swath with its lower end at the edge of each patch column, kept on the scene where possible.

    A margin moves the ends that far outside the columns and the scene. A line shows whole patches only, so a swath
    between two such offsets shows no patch that one of them does not. The sweeps have no lines yet; they start on the
    scene's first row, ascending along the line.

    Raises SettingsError: a patch is wider than a line.
    """
    if camera.samples < grid.patch + 2 * margin_px:
        beside = f" and {margin_px:g} px on either side" if margin_px else ""
        raise SettingsError(
            f"a patch of {grid.patch} px{beside} is wider than a line of {camera.samples}; take a smaller one"
        )
    across, scan = field_px(grid, along)
    start = -(scan - 1) / 2
    found: list[Sweep] = []
    for column in range(-(-across // grid.patch)):
        low = column * grid.patch - across / 2
        swath = _swath_from(low - margin_px, across / 2 + margin_px, scan, camera)
        if found and swath <= found[-1].swath_px + ROUNDING_PX:
            break
        found.append(Sweep(f"fine-{column:03d}", "fine", along, swath, start, 0, 1))
    return found


def _swath_from(low: float, end: float, scan: int, camera: LineCamera) -> float:
    """Return the centre of a swath whose lines reach down to ``low`` all along the scan, on the field if possible.

    Reach changes slowly with the offset: three rounds are exact to 1e-3 px.
    """
    if 2 * end <= camera.samples:
        return 0.0
    centre = low + camera.samples / 2
    for _ in range(3):
        below, above = reach_px(centre, scan, camera, 1).tolist()
        centre = min(low - below, end - above)
    return centre


def edges_from(
    grid: SceneGrid, camera: LineCamera, swaths: Sequence[Sweep], wanted: NDArray[np.bool_], *, margin_px: float = 0.0
) -> Views:
    """List the views of the ``wanted`` (patch,) patches that swaths have with lines within the mirror's range.

    The swaths are sweeps of one axis with the same start; their number of lines does not matter.
    """
    parts = []
    for number, swath in enumerate(swaths):
        _, scan = field_px(grid, swath.along)  # columns that the lines may reach, wherever they stand along the scan
        patch_index = patches_near(grid, camera, replace(swath, start_px=-0.75 * scan, lines=int(1.5 * scan) + 1))
        patch_index = patch_index[wanted[patch_index]]
        needs, reached = patch_lines(grid, camera, swath, patch_index, margin_px=margin_px)
        ends = swath.start_px + needs[reached] - np.array([0, 1])
        fits = np.all(within_reach(swath.swath_px, ends, camera), axis=-1)
        parts.append((np.full(int(fits.sum()), number), patch_index[reached][fits], needs[reached][fits]))
    swath_of = np.concatenate([part[0] for part in parts])
    needs = np.concatenate([part[2] for part in parts])
    origin = int(needs[:, 0].min(initial=0))
    edges = np.searchsorted(swath_of, np.arange(len(swaths) + 1))
    lines = int(needs[:, 1].max(initial=0)) - origin
    laid = tuple(replace(swath, start_px=swath.start_px + origin, lines=lines) for swath in swaths)
    return Views(laid, lines, edges, np.concatenate([part[1] for part in parts]), *(needs - origin).T)


def within_reach(swath_px: ArrayLike, scan_px: ArrayLike, camera: LineCamera) -> NDArray[np.bool_]:
    """Return which line centres, (along, scan) px that broadcast, lie within the mirror's rim.

    The normal n ~ o - k is at most 25 deg from rest. A line at the very rim (1e-9) counts as beyond.
    """
    along, scan = np.broadcast_arrays(np.asarray(swath_px, np.float64), np.asarray(scan_px, np.float64))
    o = scene_to_direction(np.stack([along, scan], axis=-1) * camera.ifov_rad)
    cosine = (o[..., 0] + 1 - o[..., 2]) / (2 * np.sqrt(1 - o[..., 2]))
    return np.asarray(cosine >= RIM_TILT + RIM_MARGIN)
