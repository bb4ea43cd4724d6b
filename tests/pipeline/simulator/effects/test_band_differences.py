"""Differences over bands: exact on parabolas at any distance, and no difference across detectors."""

from __future__ import annotations

import numpy as np

from pipeline.simulator.effects.probe import (
    difference_rates,
    rising_gaps,
    rising_runs,
    second_difference,
    steepest_difference,
)


def test_second_difference_is_exact_on_parabolas():
    """3 x^2 has a second derivative of 6 on uneven bands; both ends, which have one neighbour, give 0."""
    x = np.array([0.0, 1.0, 1.5, 4.0, 4.25])
    np.testing.assert_allclose(second_difference(3 * x**2 + 5 * x - 1, x), [0, 6, 6, 6, 0], atol=1e-12)


def test_steeper_neighbour_counts():
    """Steps of 2 over 1 nm and 9 over 3 nm: slopes 2 and 3, the middle band takes the greater."""
    found = steepest_difference(np.array([[0.0, 2.0, 11.0]]), np.array([400.0, 401.0, 404.0]))
    np.testing.assert_allclose(found, [[2, 3, 3]])


def test_bands_of_two_detectors_are_not_neighbours():
    """Where wavelengths fall back or repeat, a run ends: finite numbers, and none across."""
    nm = np.array([400.0, 402.0, 404.0, 403.0, 405.0, 405.0])
    spectrum = np.array([1.0, 3.0, 1.0, 50.0, 52.0, 9e9])
    assert rising_runs(nm) == [slice(0, 3), slice(3, 5), slice(5, 6)]
    np.testing.assert_array_equal(rising_gaps(nm), [2, 2, 2])
    np.testing.assert_allclose(steepest_difference(spectrum, nm), [1, 1, 1, 1, 1, 0])
    np.testing.assert_allclose(second_difference(spectrum, nm), [0, -1, 0, 0, 0, 0])


def test_one_band_has_no_neighbours():
    """One band, or two, have no second difference; one has no first."""
    one, two = np.array([500.0]), np.array([500.0, 501.0])
    assert not steepest_difference(np.ones((3, 1), np.float32), one).any()
    assert not difference_rates(one).any()
    assert not difference_rates(two).any()
    assert second_difference(np.ones((3, 2), np.float32), two).dtype == np.float32
