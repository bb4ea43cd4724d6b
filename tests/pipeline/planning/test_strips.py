"""Strips: the lines of a seat, offsets worth trying, what they show, and the mirror's reach."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.errors import PoseError, ShapeError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import Sweep, line_positions, scene_to_sweep
from pipeline.planning.coverage import full_sweeps
from pipeline.planning.strips import covered_seats, look_from, seat_lines, seats_near, strips_at_seats, within_reach

CAMERA = LineCamera()
GRID = SceneGrid(200, 900, 32, 4)


def everywhere(grid: SceneGrid) -> np.ndarray:
    """All seats wanted."""
    return grid.valid_share().ravel() > 0


@pytest.mark.parametrize("along", ["x", "y"])
def test_seat_lines_hold_every_pixel_with_its_taps(along: str):
    """The interval is the least that holds the kernel's lines of every pixel on the scene."""
    grid = SceneGrid(100, 150, 32, 2)
    path = Sweep("a", "fine", along, 1500.0, -900.0, 1800)
    seats = grid.valid_seats()
    lines, reached = seat_lines(grid, CAMERA, path, seats)
    assert not reached.any()
    for (y, x), (first, stop) in zip(grid.seat_origin(seats), lines, strict=True):
        rows, columns = np.mgrid[y : min(y + 32, 100), x : min(x + 32, 150)]
        points = (columns - 149 / 2, rows - 99 / 2) if along == "x" else (rows - 99 / 2, columns - 149 / 2)
        at = np.floor(scene_to_sweep(path, CAMERA, *points)[..., 0] + 1e-6)
        assert (first, stop) == (at.min() - 1, at.max() + 3)


def test_seats_beyond_the_samples_are_not_reached():
    """Of a 900 px scene one strip reaches the seats whose pixels all fall on its samples."""
    (low, high) = full_sweeps(GRID, CAMERA, "x")
    seats = GRID.valid_seats()
    reached = np.stack([seat_lines(GRID, CAMERA, path, seats)[1] for path in (low, high)])
    assert reached.any(axis=0).all()
    assert 0 < reached[0].sum() < len(seats)
    padding = np.setdiff1d(np.arange(np.prod(GRID.seat_shape)), seats)
    assert not seat_lines(GRID, CAMERA, low, padding)[1].any()


def test_seats_are_cut_from_fine_sweeps_only():
    """A coarse sweep has no lines of seats."""
    with pytest.raises(ShapeError, match="step 4"):
        seat_lines(GRID, CAMERA, Sweep("c", "coarse", "x", 0.0, 0.0, 9, 4, 4), GRID.valid_seats())


@settings(max_examples=40, deadline=None)
@given(st.integers(-4000, 4000), st.integers(-4000, 4000), st.integers(1, 900), st.sampled_from(["x", "y"]))
def test_no_shown_seat_lies_beyond_the_rectangle(strip: int, start: int, lines: int, along: str):
    """Seats shown by a sweep anywhere in a wide field are among those near its footprint."""
    grid = SceneGrid(8000, 7000, 100, 1)
    sweep = Sweep("a", "fine", along, float(strip), float(start), lines)
    seats = grid.valid_seats()
    needs, reached = seat_lines(grid, CAMERA, sweep, seats)
    shown = seats[reached & (needs[:, 0] >= 0) & (needs[:, 1] <= lines)]
    assert np.isin(shown, seats_near(grid, CAMERA, sweep)).all()
    assert covered_seats(grid, CAMERA, [sweep]).tolist() == shown.tolist()


@pytest.mark.parametrize("width", [30, 600, 640, 641, 900, 1280, 1296])
def test_strips_begin_at_seat_edges_and_end_with_the_field(width: int):
    """One strip where a line holds the field, else one for each column that is not the last strip's."""
    grid = SceneGrid(100, width, 32, 2)
    strips = strips_at_seats(grid, CAMERA, "x")
    views = look_from(grid, CAMERA, strips, everywhere(grid))
    assert np.unique(views.seat).tolist() == grid.valid_seats().tolist()
    assert len(strips) == (1 if width <= 640 else -(-(width - 640) // 32) + 1)
    assert np.all(np.diff([strip.strip_px for strip in strips]) > 0)


def test_a_strip_far_off_shows_more_columns_than_one_on_the_axis():
    """Lines are stretched away from the axis: 640 samples show 24 columns of 32 px at the side of a wide field."""
    grid = SceneGrid(3200, 9600, 32, 1)
    views = look_from(grid, CAMERA, strips_at_seats(grid, CAMERA, "x"), everywhere(grid))
    columns = [len(np.unique(views.seat[views.strip == s] % grid.seat_shape[1])) for s in (0, 140)]
    assert columns == [22, 20]


def test_views_agree_with_sweeps_cut_from_the_strips():
    """A run of a strip's lines shows exactly the seats whose views lie in it."""
    views = look_from(GRID, CAMERA, strips_at_seats(GRID, CAMERA, "x"), everywhere(GRID))
    strip = views.strips[3]
    cut = replace(strip, start_px=strip.start_px + 20, lines=90)
    inside = (views.strip == 3) & (views.first >= 20) & (views.stop <= 110)
    assert sorted(views.seat[inside].tolist()) == covered_seats(GRID, CAMERA, [cut]).tolist()
    assert views.first.min() == 0
    assert views.stop.max() == views.lines


@given(st.floats(-12_000, 12_000), st.floats(-12_000, 12_000))
def test_reach_is_the_mirrors_disk(strip: float, scan: float):
    """Line centres within reach have a position on the device's disk; those beyond by a millionth have none."""
    sweep = Sweep("a", "fine", "x", strip, scan, 1)
    inside = bool(within_reach(strip, scan, CAMERA))
    try:
        line_positions(sweep, CAMERA)
    except PoseError:
        assert not inside
    else:
        assert inside or not within_reach(strip * (1 + 1e-6), scan * (1 + 1e-6), CAMERA)


def test_seats_that_only_lines_beyond_the_rim_show_have_no_view():
    """In a field wider than the disk the corner has no view, the middle has."""
    grid = SceneGrid(15_000, 15_000, 300, 1)
    views = look_from(grid, CAMERA, strips_at_seats(grid, CAMERA, "x"), everywhere(grid))
    assert 0 not in views.seat
    assert 25 * 50 + 25 in views.seat
