"""Hard scan paths: repeated, standing, turning and lost lines are each used once at their place, or not at all."""

from __future__ import annotations

import numpy as np
import pytest

from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.scan import points_of_scan
from spectralzoom.pipeline.rectify.geolocation import path_geolocation
from spectralzoom.pipeline.rectify.scan_paths import judge_stamps, make_scan_paths
from tests.pipeline.rectify.aiming import CAMERA, aim

SWATH = 2600.0


def points_between(first: float, last: float) -> np.ndarray:
    """Return points (400, 2) that lines between two scan positions see, in the middle half of the line."""
    rng = np.random.default_rng(7)
    x, y = points_of_scan(SWATH, CAMERA, rng.uniform(first, last, 400), rng.uniform(-0.016, 0.016, 400))
    return np.stack([y, x], axis=-1)


def test_lines_at_one_position_form_one_knot() -> None:
    """Groups of one to four lines make 40 uniform knots, each of exactly its own lines; no step has length 0."""
    (scan_path,) = make_scan_paths(aim(SWATH, np.repeat(np.arange(40.0), [2, 3, 4, 1] * 10)), CAMERA)
    assert scan_path.uniform
    assert len(scan_path) == 40
    assert np.diff(scan_path.starts, append=100).tolist() == [2, 3, 4, 1] * 10


def test_lines_that_stand_still_belong_to_a_knot() -> None:
    """Lines that stand at the turn and at the end are all used: both paths have 30 knots and finite coordinates."""
    drift = 1e-9 * np.arange(6)  # any of the standing lines may be the highest
    scan = np.concatenate([np.arange(30.0), 29 + drift, np.arange(28.0, -1, -1), np.zeros(5)])
    scan_paths = make_scan_paths(aim(SWATH, scan), CAMERA)
    assert [len(scan_path) for scan_path in scan_paths] == [30, 30]
    assert len(scan_paths[0].lines) == 30
    assert sum(len(scan_path.lines) for scan_path in scan_paths) == len(scan)
    for scan_path in scan_paths:
        assert np.isfinite(path_geolocation(scan_path, CAMERA, points_between(-0.4, 29.4), along="x")).all()


def test_sweep_at_rest_is_one_line() -> None:
    """All lines of a mirror at rest form one knot that is as wide as one binned sample."""
    (scan_path,) = make_scan_paths(aim(SWATH, np.full(20, 5.0)), CAMERA, binning=2)
    assert len(scan_path) == 1
    np.testing.assert_array_equal(scan_path.lines, np.arange(20))
    points = np.array([[5.0, SWATH], [5.9, SWATH], [6.1, SWATH], [3.9, SWATH]])
    found = path_geolocation(scan_path, CAMERA, points, along="x", binning=2)
    np.testing.assert_array_equal(np.isfinite(found[:, 0]), [True, True, False, False])


def test_single_line_covers_half_a_line_to_both_sides() -> None:
    """Points within half a line of the line are found; no line, or no usable line, makes no path."""
    (scan_path,) = make_scan_paths(aim(SWATH, np.array([7.0])), CAMERA)
    found = path_geolocation(scan_path, CAMERA, np.array([[6.51, SWATH], [7.0, SWATH], [7.6, SWATH]]), along="x")
    np.testing.assert_allclose(found, [[-0.49, 319.5], [0, 319.5], [np.nan, np.nan]], atol=1e-6)
    assert make_scan_paths(aim(SWATH, np.zeros(0)), CAMERA) == ()
    assert make_scan_paths(aim(SWATH, np.zeros(3)), CAMERA, usable=np.zeros(3, np.bool_)) == ()


@pytest.mark.parametrize(("samples", "binning"), [(1, 1), (640, 640), (1, 2)])
def test_camera_with_one_sample_has_a_geolocation(samples: int, binning: int) -> None:
    """One sample, native or binned from 640, is found; a single sample that binning by 2 drops shows nothing."""
    camera = LineCamera(samples=samples)
    (scan_path,) = make_scan_paths(aim(SWATH, np.arange(10.0)), camera, binning=binning)
    x, y = points_of_scan(SWATH, camera, 4.0, np.array([0, 0.4 * samples, 700]) * camera.ifov_rad)
    found = path_geolocation(scan_path, camera, np.stack([y, x], axis=-1), along="x", binning=binning)
    np.testing.assert_array_equal(np.isfinite(found[:, 1]), [samples >= binning] * 2 + [False])


def test_lost_frames_leave_a_gap_without_geolocation() -> None:
    """Twelve lost frames leave NaN from half a step beyond the last line; all points outside of the gap are found."""
    scan = np.concatenate([np.arange(30.0), np.arange(42.0, 80)])
    assert judge_stamps(scan * 0.1, 0.1).lost == 12
    (scan_path,) = make_scan_paths(aim(SWATH, scan), CAMERA)
    rest = np.vstack([points_between(2, 29.49), points_between(41.51, 77)])
    assert np.isnan(path_geolocation(scan_path, CAMERA, points_between(29.51, 41.49), along="x")).all()
    assert np.isfinite(path_geolocation(scan_path, CAMERA, rest, along="x")).all()
