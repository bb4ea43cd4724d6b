"""Sweeps fitted to positions equal the planned ones, bent scans are refused, and mirror angles become positions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from spectralzoom.pipeline.capture.straight_scans import angles_to_positions, covered_field, fit_sweep, flat_camera
from spectralzoom.pipeline.errors import SceneError
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.pipeline.geometry.mirror import direction_to_scene, position_to_direction
from spectralzoom.pipeline.geometry.scan import (
    CostModel,
    Sweep,
    line_positions,
    points_of_scan,
    scan_positions,
    shifted_position,
)
from spectralzoom.pipeline.planning.coverage import cheapest_full

CAMERA = LineCamera()


@given(
    st.integers(-2000, 2000),
    st.integers(-3000, 2000),
    st.integers(2, 400),
    st.sampled_from([(1, 1), (4, 4), (8, 2), (1, 4)]),
)
def test_fit_recovers_a_planned_sweep(swath: int, start: int, lines: int, shape: tuple[int, int]) -> None:
    """The fit returns exactly the planned sweep. Reversed positions give the same sweep."""
    step, binning = shape
    sweep = Sweep("s", "fine" if step == binning == 1 else "coarse", "x", swath / 2, start / 2, lines, step, binning)
    position = line_positions(sweep, CAMERA)
    forward = fit_sweep(position, CAMERA, name="s", samples=640 // binning)
    back = fit_sweep(position[::-1], CAMERA, name="s", samples=640 // binning)
    assert forward.sweep == back.sweep == sweep


def test_noise_and_lost_lines_do_not_move_the_fitted_sweep() -> None:
    """With 0.7 px of noise and a tenth of the lines lost, the sweep is found to a fifth of a pixel."""
    sweep = Sweep("s", "fine", "x", 320.0, -400.0, 800)
    rng = np.random.default_rng(2)
    position = shifted_position(line_positions(sweep, CAMERA), rng.normal(0, 0.7, (800, 2)), CAMERA)
    valid = rng.random(800) > 0.1
    position[~valid] = 0.0
    found = fit_sweep(position, CAMERA, name="s", samples=640, valid=valid)
    assert (found.sweep.step, found.sweep.lines) == (1, 800)
    assert abs(found.sweep.swath_px - 320) < 0.2
    assert abs(found.sweep.start_px + 400) < 0.2
    assert abs(found.distance_px - 1) < 1e-3


@pytest.mark.parametrize(("first", "stop"), [(30, 50), (4, 24), (70, 71), (41, 44)])
def test_a_gap_does_not_change_the_line_spacing(first: int, stop: int) -> None:
    """A scan that pauses anywhere, for 1 to 20 px, keeps its line spacing of 1 px, and the note names the gap."""
    position = np.delete(line_positions(Sweep("s", "fine", "x", 0.0, -42.0, 84), CAMERA), np.s_[first:stop], axis=0)
    found = fit_sweep(position, CAMERA, name="s", samples=640)
    assert (found.sweep.step, found.sweep.lines) == (1, 84 - stop + first)
    assert found.distance_px == pytest.approx(1, abs=1e-6)
    assert found.note == f"lines {first - 1} and {first} lie {stop - first + 1} px apart"


@pytest.mark.parametrize(
    ("along", "scan", "message"),
    [
        (np.linspace(0, 200, 50), np.arange(50.0), r"line 0 lies 100 px beside the swath at 100 px, and at most 40 px"),
        (np.zeros(50), np.full(50, 3.0), "stands still"),
        (np.zeros(50), np.concatenate([np.arange(35.0), np.arange(34.0, 19, -1)]), "turns back at line 4[23]"),
    ],
)
def test_positions_that_are_no_straight_scan_are_refused(along: np.ndarray, scan: np.ndarray, message: str) -> None:
    """A bent scan, a mirror at rest and a scan that turns back are refused, each with its own message."""
    position = shifted_position(np.zeros((len(scan), 2)), np.stack([along, scan], axis=-1), CAMERA)
    with pytest.raises(SceneError, match=message):
        fit_sweep(position, CAMERA, name="s", samples=640)


def test_too_few_lines_and_a_wrong_number_of_samples_are_refused() -> None:
    """One valid line is no scan, and 500 samples are no binning of 640."""
    position = line_positions(Sweep("s", "fine", "x", 0.0, 0.0, 4), CAMERA)
    with pytest.raises(SceneError, match=r"has too few valid lines \(1\)"):
        fit_sweep(position, CAMERA, name="s", samples=640, valid=np.arange(4) == 2)
    with pytest.raises(SceneError, match=r"lines of 500 samples, no whole part of the camera's 640"):
        fit_sweep(position, CAMERA, name="s", samples=500)


def test_the_covered_field_of_a_full_scan_is_the_field() -> None:
    """Sweeps planned for a field cover it along the scan to 4 px, and along the line at least to its ends."""
    along, sweeps, _ = cheapest_full(SceneGrid(700, 1500, 64), CAMERA, CostModel(), overlap_px=0.0)
    tangents = [direction_to_scene(position_to_direction(line_positions(sweep, CAMERA))) for sweep in sweeps]
    shape, centre_px = covered_field(sweeps, tangents, CAMERA)
    scan, line = (0, 1) if along == "x" else (1, 0)
    wanted = (700, 1500)
    assert abs(shape[scan] - wanted[scan]) <= 8
    assert abs(centre_px[scan]) <= 4
    assert abs(centre_px[line]) + wanted[line] / 2 <= shape[line] / 2


def test_the_covered_field_of_one_straight_scan_is_its_size() -> None:
    """100 lines of 640 samples cover (100, 640) px, centred on the lines. Lines without a position are ignored."""
    sweep = Sweep("s", "fine", "x", 0.0, 10.0, 100)
    tangents = direction_to_scene(position_to_direction(line_positions(sweep, CAMERA)))
    shape, centre_px = covered_field([sweep], [tangents], CAMERA)
    assert shape == (100, 640)
    np.testing.assert_allclose(centre_px, (59.5, 0.0), atol=1e-6)
    assert covered_field([replace(sweep, along="y")], [tangents], CAMERA)[0] == (640, 100)
    beside = replace(sweep, swath_px=0.4)  # the lines turn by too little to see
    tangents = direction_to_scene(position_to_direction(line_positions(beside, CAMERA)))
    tracks = [np.full((4, 2), np.nan), tangents]  # one without a position
    shape, centre_px = covered_field([sweep, beside], tracks, CAMERA)
    assert (shape, round(centre_px[1], 6)) == ((100, 640), 0.4)
    with pytest.raises(SceneError, match="no line of the recording has a position"):
        covered_field([sweep], [np.full((4, 2), np.nan)], CAMERA)


def test_swaths_without_a_common_part_of_the_scan_are_refused() -> None:
    """Two swaths whose scans do not overlap are refused, and so are swaths along different axes."""
    sweeps = [Sweep("a", "fine", "x", 0.0, 0.0, 50), Sweep("b", "fine", "x", 640.0, 900.0, 50)]
    tangents = [direction_to_scene(position_to_direction(line_positions(sweep, CAMERA))) for sweep in sweeps]
    with pytest.raises(SceneError, match="no part of the scan in common"):
        covered_field(sweeps, tangents, CAMERA)
    with pytest.raises(SceneError, match="along x and along y"):
        covered_field([sweeps[0], replace(sweeps[1], along="y")], tangents, CAMERA)


@pytest.mark.parametrize("extent_px", [100.0, 5000.0, 40000.0])
def test_lines_of_a_scan_without_a_mirror_are_parallel(extent_px: float) -> None:
    """Every sample lies within 0.011 px of a parallel line, and the scan keeps its length."""
    flat = flat_camera(CAMERA, extent_px)
    scan = np.linspace(-extent_px, extent_px, 9)
    tangents = direction_to_scene(position_to_direction(scan_positions(0.0, scan, flat))) / flat.ifov_rad
    np.testing.assert_allclose(tangents, np.stack([np.zeros(9), scan], axis=-1), atol=1e-6)
    along, across = points_of_scan(0.0, flat, scan[:, None], flat.pixel_slopes())
    np.testing.assert_allclose(along, np.broadcast_to(np.arange(640) - 319.5, along.shape), atol=0.011)
    np.testing.assert_allclose(across, np.broadcast_to(scan[:, None], across.shape), atol=1e-6)
    assert flat.slit_px == CAMERA.slit_px


def test_positions_of_angles_view_along_these_angles() -> None:
    """The scene tangents of a position are the tangents of its two angles."""
    angles = np.array([[12.0, -20.0], [-30.0, 5.0], [33.0, 12.0]])
    positions, reached = angles_to_positions(angles)
    assert reached.all()
    seen = np.rad2deg(np.arctan(direction_to_scene(position_to_direction(positions))))
    np.testing.assert_allclose(seen, angles, atol=1e-10)


def test_angles_beyond_the_mirror_are_reported() -> None:
    """The rim is at 50 deg along the scan and at 35.6 deg across it. Angles beyond it, to 120 deg, become NaN."""
    positions, reached = angles_to_positions(np.array([[0, 50.01], [35.6, 0], [35.7, 0], [0, 90], [120, 0]], float))
    assert reached.tolist() == [False, True, False, False, False]
    assert np.isnan(positions[~reached]).all()
