"""Geolocation inverts the exact rays for any path over the whole disk; a geolocation grid keeps to its error bound."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from spectralzoom.pipeline.geometry.mirror import direction_to_scene, position_to_normal, reflect
from spectralzoom.pipeline.geometry.scan import Axis, points_of_scan
from spectralzoom.pipeline.rectify.geolocation import path_geolocation
from spectralzoom.pipeline.rectify.placed import PixelGrid, tie_table
from spectralzoom.pipeline.rectify.resample import resample
from spectralzoom.pipeline.rectify.scan_paths import ScanPath, make_scan_paths
from tests.pipeline.rectify.aiming import CAMERA, aim, geolocation

GRID = PixelGrid((-20.0, 2250.0), 1.0, (170, 700))
EVERYTHING = (slice(None), slice(None))


def see(position: np.ndarray, sample: np.ndarray, binning: int = 1) -> np.ndarray:
    """Return scene points (n, 2), y and x in px, that samples see from positions, by reflecting the camera's rays."""
    slope = ((sample + 0.5) * binning - CAMERA.samples / 2) * CAMERA.ifov_rad
    ray = np.stack([np.zeros_like(slope), slope, np.ones_like(slope)], axis=-1)
    return direction_to_scene(reflect(ray, position_to_normal(position)))[:, ::-1] / CAMERA.ifov_rad


@given(st.floats(-5000, 5000), st.floats(-5000, 4600), st.sampled_from([1, 2, 4]), st.integers(0, 99))
@settings(max_examples=15, deadline=None)
def test_geolocation_inverts_the_rays(swath: float, start: float, binning: int, seed: int) -> None:
    """The view of a sample between lines is found at that line and sample to 1e-7 px, anywhere in the disk."""
    rng = np.random.default_rng(seed)
    lines, samples = 60, CAMERA.samples // binning
    at = np.stack([rng.uniform(0, lines - 1, 30), rng.uniform(0, samples - 1, 30)], axis=-1)
    points = see(aim(swath, start + at[:, 0]), at[:, 1], binning)
    found = geolocation(aim(swath, start + np.arange(float(lines))), CAMERA, points, along="x", binning=binning)
    np.testing.assert_allclose(found, at, atol=1e-7)


def test_points_outside_of_the_sweep_are_nan() -> None:
    """A sweep reaches half a line and half a sample beyond its outermost centres. Points further away are NaN."""
    position = aim(0.0, np.arange(10.0))
    inside = np.array([[-0.49, 0], [9.49, 0], [4, 319.9], [4, -319.9]])
    outside = np.array([[-0.6, 0], [9.6, 0], [4, 321], [4, -321], [9000, 9000], [4, 11_000], [-9000, -11_000]])
    assert np.isfinite(geolocation(position, CAMERA, inside, along="x")).all()
    assert np.isnan(geolocation(position, CAMERA, outside, along="x")).all()


@given(st.floats(-5000, 5000), st.integers(0, 99))
@settings(max_examples=15, deadline=None)
def test_geolocated_points_lie_on_their_rays(swath: float, seed: int) -> None:
    """In a field wider than the mirror's disk, the ray of every found line and sample passes its point."""
    scan = np.linspace(-5000, 4500, 300)
    points = np.random.default_rng(seed).uniform(-20_000, 20_000, (20_000, 2))
    found = geolocation(aim(swath, scan), CAMERA, points, along="x")
    hit = np.isfinite(found[:, 0])
    centre = np.interp(found[hit, 0], np.arange(300), scan)
    inner = (found[hit, 0] >= 0) & (found[hit, 0] <= 299)
    seen = see(aim(swath, centre[inner]), found[hit, 1][inner])
    np.testing.assert_allclose(seen, points[hit][inner], atol=1e-5)
    assert inner.sum() > 20


@given(st.integers(0, 999), st.floats(0, 0.4), st.sampled_from([0.0, 2600.0, -4000.0]))
@settings(max_examples=15, deadline=None)
def test_a_linear_scene_is_recovered_from_any_path(seed: int, amount: float, swath: float) -> None:
    """Lines at uneven distances and next to their swath, which see y and x, are resampled to y and x, to float32."""
    off = np.random.default_rng(seed).uniform(-amount, amount, (2, 120))
    (scan_path,) = make_scan_paths(aim(swath + off[0], np.arange(120.0) + off[1]), CAMERA, step_px=1.0)
    across, scan = scan_path.across[:, None] / CAMERA.ifov_rad, scan_path.scan[:, None] / CAMERA.ifov_rad
    x, y = points_of_scan(across, CAMERA, scan, CAMERA.pixel_slopes())  # of all samples, (knot, sample) each
    points = np.random.default_rng(seed).uniform((5, swath - 310), (115, swath + 310), (4000, 2))
    at = path_geolocation(scan_path, CAMERA, points, along="x")
    taps = np.floor(np.nan_to_num(at)).astype(int)[:, :, None] + np.arange(-1, 3)
    whole = np.isfinite(at[:, 0]) & (taps >= 0).all(axis=(1, 2)) & (taps[:, 0] < len(scan_path)).all(axis=1)
    whole &= (taps[:, 1] < 640).all(axis=1) & scan_path.seen[np.minimum(taps[:, 0], len(scan_path) - 1)].all(axis=1)
    values = np.stack([y - 60, x - swath], axis=-1).astype(np.float32)
    found, _ = resample(values, np.ones(y.shape, np.bool_), at[whole])
    np.testing.assert_allclose(found, points[whole] - [60, swath], atol=2e-4)
    assert whole.sum() > 500


def scan_path_of(along_px: np.ndarray | float, scan_px: np.ndarray) -> ScanPath:
    """Return the single scan path of lines that look at points given in px along the line and the scan."""
    (scan_path,) = make_scan_paths(aim(along_px, scan_px), CAMERA)
    return scan_path


def exact(scan_path: ScanPath, along: Axis = "x", grid: PixelGrid = GRID) -> np.ndarray:
    """Return the grid's coordinates, geolocated point by point."""
    return path_geolocation(scan_path, CAMERA, grid.points(*map(slice, (0, 0), grid.shape)), along=along)


LINES = np.arange(130.0)
PATHS = {
    "even": (2600.0, LINES),
    "drifting": (2600 + 0.02 * LINES, 1.0007 * LINES),
    "faster and faster": (2600.0, LINES + 2e-4 * LINES**2),
    "curved": (2600 + np.sin(LINES / 60), LINES),
    "one line out of place": (2600.0, LINES + 0.01 * (LINES == 71)),
    "jittered": (2600 + np.sin(7 * LINES**2) / 4, LINES + np.sin(5 * LINES**2) / 4),
}


@pytest.mark.parametrize(("name", "spacing"), [("even", 16), ("drifting", 16), ("faster and faster", 4), ("curved", 4)])
def test_interpolation_error_is_within_the_bound(name: str, spacing: int) -> None:
    """On every kind of path the error of a pixel is within the stated bound, and the bound within the tolerance."""
    scan_path = scan_path_of(*PATHS[name])
    table = tie_table(scan_path, CAMERA, GRID, along="x")
    assert table.spacing == spacing
    error = np.abs(table.coordinates(*EVERYTHING) - exact(scan_path))
    assert np.nanmax(error) <= table.bound_px + 1e-12 <= 2e-3
    assert np.isfinite(error).mean() > 0.4


@pytest.mark.parametrize("name", ["one line out of place", "jittered"])
def test_uneven_paths_have_no_tie_points(name: str) -> None:
    """A single line out of place between tie points is found."""
    assert tie_table(scan_path_of(*PATHS[name]), CAMERA, GRID, along="x") is None


@given(st.floats(-4500, 4500), st.floats(-4500, 4000), st.sampled_from(["x", "y"]), st.sampled_from([1.0, 3.0]))
@settings(max_examples=15, deadline=None)
def test_error_bound_holds_over_the_field(swath: float, start: float, along: Axis, spacing: float) -> None:
    """The interpolation error keeps to its bound in both orientations, and no pixel well inside of a sweep is lost."""
    scan_path = scan_path_of(swath, start + LINES)
    corner = (start - 9.3, swath - 330.7) if along == "x" else (swath - 330.7, start - 9.3)
    size = (int(150 / spacing), int(660 / spacing))
    grid = PixelGrid(corner, spacing, size if along == "x" else size[::-1])
    table = tie_table(scan_path, CAMERA, grid, along=along)
    found, truth = table.coordinates(*EVERYTHING), exact(scan_path, along, grid)
    assert np.nanmax(np.abs(found - truth), initial=0) <= table.bound_px + 1e-12 <= 2e-3
    inside = (np.abs(truth - [64.5, 319.5]) < np.array([65, 320]) - 0.01).all(axis=-1)
    assert np.isfinite(found[inside]).all()


def test_lost_lines_are_nan_in_the_geolocation_grid() -> None:
    """Around lost lines the interpolated coordinates are NaN for the same pixels as the exact ones."""
    scan_path = scan_path_of(2600.0, LINES[(LINES < 40) | (LINES > 44)])
    table = tie_table(scan_path, CAMERA, GRID, along="x")
    assert table.spacing == 16
    assert (np.isnan(table.coordinates(*EVERYTHING)) != np.isnan(exact(scan_path))).mean() < 1e-4


def test_a_scan_path_smaller_than_a_cell_is_found() -> None:
    """A single line between two rows of tie points is found, and its cells count for the bound."""
    scan_path = scan_path_of(2600.0, np.array([24.0]))
    table = tie_table(scan_path, CAMERA, GRID, along="x")
    found = table.coordinates(*EVERYTHING)
    assert np.isfinite(found[..., 0]).sum() > 450
    assert np.nanmax(np.abs(found - exact(scan_path))) <= table.bound_px


def test_only_the_part_near_the_scan_path_is_kept() -> None:
    """Less than a quarter of a large grid is kept, and pixels of the rest are NaN."""
    scan_path = scan_path_of(*PATHS["even"])
    grid = PixelGrid((-400.0, 1900.0), 1.0, (1000, 1500))
    table = tie_table(scan_path, CAMERA, grid, along="x")
    assert table.kept[0] * table.kept[1] < 0.25 * 1000 * 1500
    truth = exact(scan_path, grid=grid)
    for rows, columns in (EVERYTHING, (slice(0, 90), slice(0, 80)), (slice(300, 320), slice(0, 1500))):
        np.testing.assert_allclose(table.coordinates(rows, columns), truth[rows, columns], atol=2e-3)
