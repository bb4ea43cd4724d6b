"""Lookup: error against reflected rays and time a pixel, beside the nearest sample out of a KD-tree."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from measure import Row, Timing, ratio, time_in_turn
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.mirror import (
    direction_to_position,
    direction_to_scene,
    line_rotation,
    position_to_normal,
    reflect,
    scene_to_direction,
)
from pipeline.geometry.scan import points_of_scan
from pipeline.rectify.geolocation import KnotCurve, path_geolocation
from pipeline.rectify.placed import TieTable, tie_table
from pipeline.rectify.scan_paths import ScanPath, make_scan_paths

CAMERA = LineCamera()
SWATH, LINES = 2450.0, 640
GRID: dict[str, Any] = {"origin_px": (90.0, SWATH - 300), "spacing_px": 1.0, "shape": (430, 600)}
PIXELS = 430 * 600
TILE_ROWS = 64

Floats = NDArray[np.float64]


def rows() -> list[Row]:
    """Error and time of the ties, their spacing, the field, uneven paths."""
    scan_path = _scan_path(SWATH, np.arange(float(LINES)))
    truth = _by_reflected_rays(path_geolocation(scan_path, CAMERA, _pixels(), along="x"))
    clocks = time_in_turn(_calls(scan_path), rounds=5)
    table = tie_table(scan_path, CAMERA, along="x", **GRID)
    return [
        _error(table, truth),
        *_against_tree(scan_path, table, truth, clocks),
        _closed_form(scan_path, truth, clocks),
        *(_spacing(scan_path, truth, tie, clocks) for tie in (8, 16, 32, 64)),
        _field(),
        _uneven(clocks),
    ]


def _scan_path(along_px: Floats | float, scan_px: Floats) -> ScanPath:
    tangents = np.stack(np.broadcast_arrays(along_px, scan_px), axis=-1) * CAMERA.ifov_rad
    (scan_path,) = make_scan_paths(direction_to_position(scene_to_direction(tangents)), CAMERA, step_px=1.0)
    return scan_path


def _jittered() -> ScanPath:
    off = np.random.default_rng(0).uniform(-0.25, 0.25, (2, LINES))
    return _scan_path(SWATH + off[0], np.arange(LINES) + off[1])


def _pixels(**grid: Any) -> Floats:
    grid = GRID | grid
    y, x = (
        start + grid["spacing_px"] * np.arange(n) for start, n in zip(grid["origin_px"], grid["shape"], strict=True)
    )
    return np.stack(np.broadcast_arrays(y[:, None], x[None, :]), axis=-1)


def _samples() -> Floats:
    """Where every sample of every line looks, (line * sample, 2) y and x [px]: what the tree is built of."""
    x, y = points_of_scan(SWATH, CAMERA, np.arange(float(LINES))[:, None], CAMERA.pixel_slopes()[None, :])
    return np.stack([y, x], axis=-1).reshape(-1, 2)


def _calls(scan_path: ScanPath) -> dict[str, Callable[[], object]]:
    samples, pixels = _samples(), _pixels()
    tree, wild = cKDTree(samples), _jittered()
    calls: dict[str, Callable[[], object]] = {
        "closed form": partial(path_geolocation, scan_path, CAMERA, pixels, along="x"),
        "tree": lambda: cKDTree(samples).query(pixels, workers=1),
        "query": lambda: tree.query(pixels, workers=1),
        "Newton": partial(path_geolocation, wild, CAMERA, pixels, along="x"),
    }
    for tie in (8, 16, 32, 64):
        calls[f"ties {tie}"] = lambda tie=tie: _read(_tie_points(scan_path, tie))
    return calls


def _tie_points(scan_path: ScanPath, tie: int) -> TieTable:
    return tie_table(scan_path, CAMERA, along="x", tie=tie, tolerance_px=np.inf, **GRID)


def _read(table: TieTable) -> None:
    for first in range(0, GRID["shape"][0], TILE_ROWS):
        table.coordinates(slice(first, first + TILE_ROWS), slice(None))


def _whole(table: TieTable) -> Floats:
    return table.coordinates(slice(None), slice(None))


def _see(at: Floats) -> Floats:
    """Points (..., 2) that the camera's rays at knot and sample meet: mirror, normal, reflection, one by one."""
    tangents = np.stack(np.broadcast_arrays(SWATH, at[..., 0]), axis=-1) * CAMERA.ifov_rad
    normal = position_to_normal(direction_to_position(scene_to_direction(tangents)))
    slope = (at[..., 1] + 0.5 - CAMERA.samples / 2) * CAMERA.ifov_rad
    ray = np.stack([np.zeros_like(slope), slope, np.ones_like(slope)], axis=-1)
    return direction_to_scene(reflect(ray, normal))[..., ::-1] / CAMERA.ifov_rad


def _by_reflected_rays(start: Floats) -> Floats:
    """Knots and samples whose reflected rays meet the pixels, by Newton with differences: the forward model alone."""
    at, pixels, h = start.copy(), _pixels(), 0.5
    for _ in range(2):
        miss = _see(at) - pixels
        by_knot, by_sample = (
            (_see(at + step) - _see(at - step)) / (2 * h) for step in (np.array([h, 0.0]), np.array([0.0, h]))
        )
        size = by_knot[..., 0] * by_sample[..., 1] - by_knot[..., 1] * by_sample[..., 0]
        at[..., 0] -= (miss[..., 0] * by_sample[..., 1] - miss[..., 1] * by_sample[..., 0]) / size
        at[..., 1] -= (by_knot[..., 0] * miss[..., 1] - by_knot[..., 1] * miss[..., 0]) / size
    return at


def _worst(found: Floats, truth: Floats) -> float:
    """Greatest error [px]; infinite where pixels of one are not in the other, but for rounding at a sweep's edge."""
    apart = np.isfinite(found) != np.isfinite(truth)
    return float(np.nanmax(np.abs(found - truth))) if apart.mean() < 1e-4 else np.inf


def _ns(clock: Timing) -> float:
    return 1e9 * clock.cpu_min_s / PIXELS


def _error(table: TieTable, truth: Floats) -> Row:
    off = _worst(_whole(table), truth)
    turn = np.rad2deg(line_rotation(scene_to_direction(np.array([[SWATH, 0.0], [SWATH, LINES]]) * CAMERA.ifov_rad)))
    what = f"geolocation grid of {PIXELS} px by ties, lines turned by {turn[0]:.1f}-{turn[1]:.1f} deg: error against reflected rays"
    return Row(what, f"{off:.2g} px (bound {table.bound_px:.2g})", "< 2e-3 px", off < 2e-3 and off <= table.bound_px)


def _against_tree(scan_path: ScanPath, table: TieTable, truth: Floats, clocks: dict[str, Timing]) -> list[Row]:
    _, nearest = cKDTree(_samples()).query(_pixels(), workers=1)
    tree_off = _worst(np.stack(np.divmod(nearest, CAMERA.samples), axis=-1).astype(np.float64), truth)
    faster, closer = ratio(clocks, "tree", "ties 16"), tree_off / _worst(_whole(table), truth)
    peer = (
        f"scipy cKDTree, one worker: {_ns(clocks['tree']):.0f} ns/px with building, {_ns(clocks['query']):.0f} without"
    )
    return [
        Row(
            "geolocation grid by ties, made and read: processor time",
            f"{_ns(clocks['ties 16']):.2g} ns/px, 1/{faster:.0f} of the tree",
            ">= 10x less",
            faster >= 10,
            peer,
        ),
        Row(
            "geolocation grid by ties: closer than the tree",
            f"{closer:.0f}x",
            ">= 100x",
            closer >= 100,
            f"{tree_off:.2g} px",
        ),
    ]


def _closed_form(scan_path: ScanPath, truth: Floats, clocks: dict[str, Timing]) -> Row:
    off = _worst(path_geolocation(scan_path, CAMERA, _pixels(), along="x"), truth)
    return Row("geolocation grid in closed form, every pixel", f"{_ns(clocks['closed form']):.3g} ns/px, {off:.1g} px")


def _spacing(scan_path: ScanPath, truth: Floats, tie: int, clocks: dict[str, Timing]) -> Row:
    table = _tie_points(scan_path, tie)
    found = f"{_ns(clocks[f'ties {tie}']):.2g} ns/px, {_worst(_whole(table), truth):.2g} px"
    return Row(f"ties every {tie} px, whatever the tolerance", found, peers=f"bound {table.bound_px:.2g} px")


def _field() -> Row:
    """Sweeps of 200 lines all over a field of 10240 px: the bound, the error, and the spacing that it takes."""
    worst, over, spacings = 0.0, 0, []
    for swath in np.arange(-4800, 4801, 1600.0):
        for start in np.arange(-5120, 5000, 1900.0):
            if np.hypot(swath, start) > 5900:
                continue
            scan_path = _scan_path(swath, start + np.arange(200.0))
            grid = {"origin_px": (start - 20, swath - 330), "spacing_px": 1.0, "shape": (240, 660)}
            table = tie_table(scan_path, CAMERA, along="x", **grid)
            off = _worst(_whole(table), path_geolocation(scan_path, CAMERA, _pixels(**grid), along="x"))
            worst, over = max(worst, off), over + (off > table.bound_px)
            spacings.append(table.spacing)
    fraction = np.mean(np.array(spacings) == 16)
    what = f"ties at {len(spacings)} places of a field of 10240 px: worst error; places over their bound"
    return Row(
        what,
        f"{worst:.2g} px; {over}",
        "< 2e-3 px; none",
        worst < 2e-3 and not over,
        f"16 px apart at {fraction:.0%} of the places, {min(spacings)} at the least",
    )


def _uneven(clocks: dict[str, Timing]) -> Row:
    scan_path = _jittered()
    at = path_geolocation(scan_path, CAMERA, _pixels(), along="x")
    on = np.isfinite(at[..., 0])
    scan, _, across, _ = KnotCurve(scan_path).at(at[on, 0])
    slope = (at[on, 1] + 0.5 - CAMERA.samples / 2) * CAMERA.ifov_rad
    x, y = points_of_scan(across / CAMERA.ifov_rad, CAMERA, scan / CAMERA.ifov_rad, slope)  # type: ignore[arg-type]
    off = np.abs(np.stack([y, x], axis=-1) - _pixels()[on]).max()
    return Row(
        "Newton on a path 0.25 px out of even, every pixel",
        f"{_ns(clocks['Newton']):.3g} ns/px, {off:.1g} px",
        "< 2e-3 px",
        bool(off < 2e-3),
        f"{1 - on.mean():.2%} of the pixels in gaps above 1.5 steps",
    )
