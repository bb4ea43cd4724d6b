"""Geolocation grid: error against reflected rays, and time per pixel compared with the nearest sample of a KD-tree."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from measure import Row, Timing, ns_of, ratio, time_in_turn
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pipeline.geometry import mirror
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import points_of_scan
from pipeline.rectify.geolocation import path_geolocation
from pipeline.rectify.placed import TieTable, tie_table
from pipeline.rectify.scan_paths import make_scan_paths
from tests.pipeline.geometry.paper_equations import line_rotation

CAMERA = LineCamera()
SWATH = 2450.0
LINES = 640
GRID: dict[str, Any] = {"origin_px": (90.0, SWATH - 300), "spacing_px": 1.0, "shape": (430, 600)}
PIXELS = 430 * 600
TILE_ROWS = 64

Floats = NDArray[np.float64]


def rows() -> list[Row]:
    """Return the rows for error and time of the tie points."""
    tangents = np.stack(np.broadcast_arrays(SWATH, np.arange(float(LINES))), axis=-1) * CAMERA.ifov_rad
    position = mirror.direction_to_position(mirror.scene_to_direction(tangents))
    (scan_path,) = make_scan_paths(position, CAMERA, step_px=1.0)
    truth = _by_reflected_rays(path_geolocation(scan_path, CAMERA, _pixels(), along="x"))
    samples = _samples()
    pixels = _pixels()
    tree = cKDTree(samples)
    calls: dict[str, Callable[[], object]] = {
        "tree": lambda: cKDTree(samples).query(pixels, workers=1),
        "query": lambda: tree.query(pixels, workers=1),
        "ties 16": lambda: _read(tie_table(scan_path, CAMERA, along="x", tie=16, tolerance_px=np.inf, **GRID)),
    }
    clocks = time_in_turn(calls, rounds=5)
    table = tie_table(scan_path, CAMERA, along="x", **GRID)
    off = _worst(_whole(table), truth)
    ends = np.array([[SWATH, 0.0], [SWATH, LINES]]) * CAMERA.ifov_rad
    turn = np.rad2deg(line_rotation(mirror.scene_to_direction(ends)))
    what = f"geolocation grid of {PIXELS} px by ties, lines turned by {turn[0]:.1f}-{turn[1]:.1f} deg: error"
    met = off < 2e-3 and off <= table.bound_px
    error = Row(what, f"{off:.2g} px (bound {table.bound_px:.2g})", "< 2e-3 px", met)
    return [error, *_against_tree(table, truth, clocks)]


def _pixels() -> Floats:
    y, x = (at + GRID["spacing_px"] * np.arange(n) for at, n in zip(GRID["origin_px"], GRID["shape"], strict=True))
    return np.stack(np.broadcast_arrays(y[:, None], x[None, :]), axis=-1)


def _samples() -> Floats:
    """Return the scene position of every sample of every line, (line * sample, 2) y and x [px], for the tree."""
    x, y = points_of_scan(SWATH, CAMERA, np.arange(float(LINES))[:, None], CAMERA.pixel_slopes()[None, :])
    return np.stack([y, x], axis=-1).reshape(-1, 2)


def _read(table: TieTable) -> None:
    for first in range(0, GRID["shape"][0], TILE_ROWS):
        table.coordinates(slice(first, first + TILE_ROWS), slice(None))


def _whole(table: TieTable) -> Floats:
    return table.coordinates(slice(None), slice(None))


def _see(at: Floats) -> Floats:
    """Return the points (..., 2) that the camera's rays at knot and sample meet, by mirror, normal and reflection."""
    tangents = np.stack(np.broadcast_arrays(SWATH, at[..., 0]), axis=-1) * CAMERA.ifov_rad
    normal = mirror.position_to_normal(mirror.direction_to_position(mirror.scene_to_direction(tangents)))
    slope = (at[..., 1] + 0.5 - CAMERA.samples / 2) * CAMERA.ifov_rad
    ray = np.stack([np.zeros_like(slope), slope, np.ones_like(slope)], axis=-1)
    return mirror.direction_to_scene(mirror.reflect(ray, normal))[..., ::-1] / CAMERA.ifov_rad


def _by_reflected_rays(start: Floats) -> Floats:
    """Return knots and samples whose reflected rays meet the pixels, by Newton steps on the forward model alone."""
    at = start.copy()
    pixels = _pixels()
    h = 0.5
    for _ in range(2):
        miss = _see(at) - pixels
        by_knot, by_sample = ((_see(at + step) - _see(at - step)) / (2 * h) for step in h * np.eye(2))
        size = by_knot[..., 0] * by_sample[..., 1] - by_knot[..., 1] * by_sample[..., 0]
        at[..., 0] -= (miss[..., 0] * by_sample[..., 1] - miss[..., 1] * by_sample[..., 0]) / size
        at[..., 1] -= (by_knot[..., 0] * miss[..., 1] - by_knot[..., 1] * miss[..., 0]) / size
    return at


def _worst(found: Floats, truth: Floats) -> float:
    """Return the largest error [px]; infinite if other pixels are covered, except for rounding at a sweep's edge."""
    apart = np.isfinite(found) != np.isfinite(truth)
    return float(np.nanmax(np.abs(found - truth))) if apart.mean() < 1e-4 else np.inf


def _against_tree(table: TieTable, truth: Floats, clocks: dict[str, Timing]) -> list[Row]:
    _, nearest = cKDTree(_samples()).query(_pixels(), workers=1)
    tree_off = _worst(np.stack(np.divmod(nearest, CAMERA.samples), axis=-1).astype(np.float64), truth)
    faster, closer = ratio(clocks, "tree", "ties 16"), tree_off / _worst(_whole(table), truth)
    tree, query, ties = (ns_of(clocks[name], PIXELS) for name in ("tree", "query", "ties 16"))
    peer = f"scipy cKDTree, one worker: {tree:.0f} ns/px with building, {query:.0f} without"
    made = "geolocation grid by ties"
    spent = f"{ties:.2g} ns/px, 1/{faster:.0f} of the tree"
    return [
        Row(f"{made}, made and read: processor time", spent, ">= 10x less", faster >= 10, peer),
        Row(f"{made}: closer than the tree", f"{closer:.0f}x", ">= 100x", closer >= 100, f"{tree_off:.2g} px"),
    ]
