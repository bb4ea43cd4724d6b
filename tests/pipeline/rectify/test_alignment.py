"""Alignment of sweeps by least squares: truth recovered, wrong windows bounded, what nothing ties left alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.errors import SettingsError, ShapeError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.mirror import direction_to_scene, position_to_direction
from pipeline.geometry.scan import Sweep, line_positions, shifted_position
from pipeline.rectify.registration.alignment import SweepShift, WindowShift, solve_sweeps

LINES = 3000
NAMES = ("a", "b", "c", "d", "e")


def truths(rng: np.random.Generator) -> list[SweepShift]:
    """Offsets of up to 50 px and drifts of up to 2 px over half a sweep; the middle sweep has none."""
    drawn = [SweepShift(name, rng.uniform(-50, 50, 2), rng.uniform(-2, 2, 2) / 1500) for name in NAMES]
    return [*drawn[:2], SweepShift("c", np.zeros(2), np.zeros(2)), *drawn[3:]]


def windows_of(truth: list[SweepShift], rng: np.random.Generator, noise: float) -> list[WindowShift]:
    """Six windows along every overlap of neighbours, with errors of ``noise`` px."""
    lines = [shift.of_lines(LINES) for shift in truth]
    return [
        WindowShift(
            one,
            one + 1,
            (line, line),
            np.stack([np.eye(2)] * 2),
            lines[one + 1][line] - lines[one][line] + rng.normal(0, noise, 2),
            np.full(2, noise),
        )
        for one in range(len(truth) - 1)
        for line in range(250, LINES, 500)
    ]


def farthest(found: tuple[SweepShift, ...], wanted: tuple[SweepShift, ...] | list[SweepShift]) -> float:
    """Largest difference of any line's shift."""
    pairs = zip(found, wanted, strict=True)
    return max(float(np.abs(a.of_lines(LINES) - b.of_lines(LINES)).max()) for a, b in pairs)


def test_truth_is_recovered():
    """Exact windows give back every offset and drift; noise comes through no larger than it went in."""
    rng = np.random.default_rng(0)
    truth = truths(rng)
    exact = solve_sweeps(windows_of(truth, rng, 1e-9), NAMES, [LINES] * 5)
    assert (exact.reference, exact.untied) == (2, ())
    assert farthest(exact.shifts, truth) < 1e-3  # the weak prior on drift
    assert farthest(solve_sweeps(windows_of(truth, rng, 0.05), NAMES, [LINES] * 5).shifts, truth) < 0.3


def test_one_wrong_window_hardly_moves_the_rest():
    """A window wrong by 12 px moves no line by more than 0.1 px, and its residual shows it."""
    rng = np.random.default_rng(1)
    windows = windows_of(truths(rng), rng, 0.05)
    right = solve_sweeps(windows, NAMES, [LINES] * 5)
    for number in (2, 8, 13):
        wrong = list(windows)
        wrong[number] = replace(wrong[number], shift=wrong[number].shift + np.array([0.0, 12.0]))
        found = solve_sweeps(wrong, NAMES, [LINES] * 5)
        assert farthest(found.shifts, right.shifts) < 0.1
        assert found.residual[number, 1] == pytest.approx(12, abs=0.5)


def test_turn_of_the_line_is_part_of_the_model():
    """A window that sees a line's end tells the offset of its centre, not of the place that the end sees."""
    turn = np.array([[1.0, 0.0], [0.034, 1.0]])
    shift = np.array([50.0, -20.0])
    windows = [
        WindowShift(0, 1, (line, line), np.stack([np.eye(2), turn]), turn @ shift, np.full(2, 0.05))
        for line in (100.0, 900.0)
    ]
    found = solve_sweeps(windows, ("a", "b"), (1000, 1000), reference=0)
    np.testing.assert_allclose(found.shifts[1].offset, shift, atol=1e-3)


def test_sweeps_without_windows_stay_and_are_named():
    """A sweep in no window keeps 0; a group apart from the reference keeps 0 on average; both are untied."""
    rng = np.random.default_rng(2)
    windows = [w for w in windows_of(truths(rng), rng, 0.05) if 2 not in (w.reference, w.moving)]
    found = solve_sweeps(windows, NAMES, [LINES] * 5)
    assert (found.reference, found.untied) == (1, (2, 3, 4))
    np.testing.assert_array_equal(found.shifts[2].of_lines(LINES), 0)
    np.testing.assert_allclose(found.shifts[3].offset + found.shifts[4].offset, 0, atol=1e-6)
    nothing = solve_sweeps([], NAMES, [LINES] * 5)
    assert nothing.untied == (1, 2, 3, 4)
    assert nothing.residual.shape == (0, 2)


def test_one_window_gives_an_offset_and_no_drift():
    """Where one window alone would have to tell drift from offset, the drift is small beside it."""
    window = WindowShift(0, 1, (499.5, 499.5), np.stack([np.eye(2)] * 2), np.array([7.0, -3.0]), np.full(2, 0.02))
    found = solve_sweeps([window], ("a", "b"), (1000, 1000), reference=0)
    np.testing.assert_allclose(found.shifts[1].of_lines(1000), [[7.0, -3.0]] * 1000, atol=1e-3)


def test_drift_leaves_the_middle_of_a_sweep():
    """Of an even or odd number of lines, those either side of the middle drift by as much, the other way."""
    shift = SweepShift("a", np.array([1.0, -2.0]), np.array([0.5, 0.25]))
    np.testing.assert_array_equal(shift.of_lines(2), [[0.75, -2.125], [1.25, -1.875]])
    np.testing.assert_array_equal(shift.of_lines(3), [[0.5, -2.25], [1.0, -2.0], [1.5, -1.75]])


def test_positions_shift_as_the_scene_does():
    """Line centres of shifted positions lie beside the old ones by the shift."""
    camera = LineCamera()
    position = line_positions(Sweep("s", "fine", "x", 2000.0, -1500.0, 50), camera)
    shift = np.random.default_rng(3).uniform(-50, 50, (50, 2))
    before, after = (
        direction_to_scene(position_to_direction(p)) / camera.ifov_rad
        for p in (position, shifted_position(position, shift, camera))
    )
    np.testing.assert_allclose(after - before, shift, atol=1e-8)


def test_windows_of_sweeps_that_are_not_there_are_refused():
    """Numbers beyond the sweeps, and a reference beyond them, are named."""
    window = WindowShift(0, 3, (0.0, 0.0), np.stack([np.eye(2)] * 2), np.zeros(2), np.ones(2))
    with pytest.raises(ShapeError, match="joins sweeps 0 and 3; there are 2"):
        solve_sweeps([window], ("a", "b"), (10, 10))
    with pytest.raises(SettingsError, match="one of the sweeps 0 to 1, got 2"):
        solve_sweeps([], ("a", "b"), (10, 10), reference=2)
