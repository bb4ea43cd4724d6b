"""Registration of two images of one overlap, crop rows included, and of all sweeps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter1d

from spectralzoom.pipeline.rectify.registration.alignment import SweepShift, WindowShift, pair_shift, solve_sweeps
from tests.pipeline.rectify.made_views import row_views, wave_views

SIZE = (120, 150)
REACH = 12.0


@pytest.mark.parametrize("periods", [(4, 40), (40, 400)])
def test_narrow_overlaps_are_registered_to_three_hundredths_of_a_pixel(periods: tuple[float, float]):
    """Over 64 px at an SNR of 50 the shift is right to 0.03 px, for fine and for broad texture."""
    for seed in range(2):
        shift = np.random.default_rng(seed).uniform(-6, 6, 2)
        found = pair_shift(*wave_views(seed, (512, 64), shift, 50, periods), prior_px=7)
        np.testing.assert_allclose(found.shift, shift, atol=0.03)


def test_gain_and_offset_do_not_change_the_shift():
    """A view with another light has the same shift to 1e-6 px."""
    one, other = wave_views(3, (128, 64), np.array([2.3, -1.6]), 50, (6, 40))
    plain, lit = pair_shift(one, other, prior_px=4), pair_shift(one, 7 + 0.2 * other, prior_px=4)
    np.testing.assert_allclose(lit.shift, plain.shift, atol=1e-6)


@settings(max_examples=8, deadline=None)
@given(st.integers(-9, 9), st.integers(-9, 9), st.integers(0, 5))
def test_whole_shifts_are_exact_and_antisymmetric(down: int, right: int, seed: int):
    """Parts of one image that are whole pixels apart have that shift to rounding. Swapped views have its negative."""
    image = gaussian_filter1d(np.random.default_rng(seed).normal(size=(120, 90)), 1.5, axis=0)
    one, other = image[10:-10, 10:-10], image[10 + down : 110 + down, 10 + right : 80 + right]
    forth, back = pair_shift(one, other, prior_px=9), pair_shift(other, one, prior_px=9)
    np.testing.assert_allclose(forth.shift, [down, right], atol=1e-6)
    np.testing.assert_allclose(back.shift, -forth.shift, atol=1e-6)


def test_crop_rows_with_gaps_are_registered_to_the_right_row():
    """Bare places identify the rows, so that a shift of up to two rows is found."""
    for seed in range(5):
        shift = np.random.default_rng(seed).uniform(-25, 25, 2)
        found = pair_shift(*row_views(seed, (256, 64), shift, 50, 0.2), prior_px=26)
        np.testing.assert_allclose(found.shift, shift, atol=0.1)


@pytest.mark.parametrize("turned", [False, True])
def test_crop_rows_without_gaps_are_undecidable(turned: bool):
    """Purely periodic rows have no shift, for either direction and any noise."""
    for seed, snr in enumerate((50, 50, 5, 1)):
        views = row_views(seed, (256, 64), np.random.default_rng(seed).uniform(-25, 25, 2), snr, 0)
        found = pair_shift(*(view.T if turned else view for view in views), prior_px=26)
        assert found.status == "undecidable"
        assert np.isnan(found.shift).all()


def test_stated_error_is_the_scatter_of_the_shift():
    """Over noisy views of one overlap both agree to a third."""
    shift = np.array([2.3, -1.4])
    drawn = np.random.default_rng(9)
    clean = wave_views(3, (96, 96), shift, np.inf, (8, 60))
    found = [pair_shift(*(view + drawn.normal(0, 0.5, view.shape) for view in clean), prior_px=5) for _ in range(40)]
    scatter = np.sqrt(np.mean([(each.shift - shift) ** 2 for each in found], axis=0))
    np.testing.assert_allclose(np.mean([each.error_px for each in found], axis=0), scatter, rtol=0.35)


def test_an_image_and_its_negative_are_not_registered():
    """An overlap that is bright in one sweep and dark in the other is undecidable."""
    for seed in range(2):
        one, other = wave_views(seed, (128, 96), np.array([1.2, -0.7]), 50, (30, 300))
        assert pair_shift(one, other, prior_px=4).status == "found"
        assert pair_shift(one, -other, prior_px=4).status == "undecidable"


LINES = 3000
NAMES = ("a", "b", "c", "d", "e")


def truths(rng: np.random.Generator) -> list[SweepShift]:
    """Return offsets of up to 50 px and drifts of up to 2 px over half a sweep; the middle sweep has none."""
    drawn = [SweepShift(name, rng.uniform(-50, 50, 2), rng.uniform(-2, 2, 2) / 1500) for name in NAMES]
    return [*drawn[:2], SweepShift("c", np.zeros(2), np.zeros(2)), *drawn[3:]]


def windows_of(truth: list[SweepShift], rng: np.random.Generator, noise: float) -> list[WindowShift]:
    """Return six windows along every overlap of neighbours, with errors of ``noise`` px."""
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
    """Return the largest difference of any line's shift."""
    return max(float(np.abs(a.of_lines(LINES) - b.of_lines(LINES)).max()) for a, b in zip(found, wanted, strict=True))


def test_offsets_and_drifts_are_recovered():
    """Exact windows give every offset and drift to 1e-3 px. Windows with noise of 0.05 px err by less than 0.3 px."""
    rng = np.random.default_rng(0)
    truth = truths(rng)
    exact = solve_sweeps(windows_of(truth, rng, 1e-9), NAMES, [LINES] * 5)
    assert (exact.reference, exact.untied) == (2, ())
    assert farthest(exact.shifts, truth) < 1e-3  # the weak prior on drift
    assert farthest(solve_sweeps(windows_of(truth, rng, 0.05), NAMES, [LINES] * 5).shifts, truth) < 0.3


def test_one_wrong_window_hardly_moves_the_sweeps():
    """A window that errs by 12 px moves no line by more than 0.1 px, and its residual shows the error."""
    rng = np.random.default_rng(1)
    windows = windows_of(truths(rng), rng, 0.05)
    right = solve_sweeps(windows, NAMES, [LINES] * 5)
    for number in (2, 8, 13):
        wrong = list(windows)
        wrong[number] = replace(wrong[number], shift=wrong[number].shift + np.array([0.0, 12.0]))
        found = solve_sweeps(wrong, NAMES, [LINES] * 5)
        assert farthest(found.shifts, right.shifts) < 0.1
        assert found.residual[number, 1] == pytest.approx(12, abs=0.5)


def test_the_turn_of_the_line_is_part_of_the_model():
    """A window at a line's end gives the offset of the line's centre, not of the end."""
    turn = np.array([[1.0, 0.0], [0.034, 1.0]])
    shift = np.array([50.0, -20.0])
    turns = np.stack([np.eye(2), turn])
    windows = [WindowShift(0, 1, (line, line), turns, turn @ shift, np.full(2, 0.05)) for line in (100.0, 900.0)]
    found = solve_sweeps(windows, ("a", "b"), (1000, 1000), reference=0)
    np.testing.assert_allclose(found.shifts[1].offset, shift, atol=1e-3)


def test_sweeps_without_windows_stay_and_are_named():
    """A sweep without a window keeps 0; a group apart from the reference has a mean of 0. Both count as untied."""
    rng = np.random.default_rng(2)
    windows = [w for w in windows_of(truths(rng), rng, 0.05) if 2 not in (w.reference, w.moving)]
    found = solve_sweeps(windows, NAMES, [LINES] * 5)
    assert (found.reference, found.untied) == (1, (2, 3, 4))
    np.testing.assert_array_equal(found.shifts[2].of_lines(LINES), 0)
    np.testing.assert_allclose(found.shifts[3].offset + found.shifts[4].offset, 0, atol=1e-6)
    nothing = solve_sweeps([], NAMES, [LINES] * 5)
    assert nothing.untied == (1, 2, 3, 4)
    assert nothing.residual.shape == (0, 2)


def test_one_window_gives_an_offset_without_drift():
    """One window cannot separate drift from offset, so the drift stays below 1e-3 px."""
    window = WindowShift(0, 1, (499.5, 499.5), np.stack([np.eye(2)] * 2), np.array([7.0, -3.0]), np.full(2, 0.02))
    found = solve_sweeps([window], ("a", "b"), (1000, 1000), reference=0)
    np.testing.assert_allclose(found.shifts[1].of_lines(1000), [[7.0, -3.0]] * 1000, atol=1e-3)
