"""Tap weights: the closed form against sums over fine steps, Gaussians against a sum of steps, tables against both."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.geometry.camera import footprint_kernel
from pipeline.simulator.optics.tap_sums import SCALE_STEP, TapTable, blurred_weight, box_weight

DISTANCE = np.linspace(-5, 5, 401)


@pytest.mark.parametrize("width", [0.3, 1.0, 2.7, 4.4])
def test_box_is_the_mean_of_the_kernel(width: float) -> None:
    """The closed form is the mean of linear interpolation's kernel over a thousand points of the box."""
    inside = (np.arange(1000) + 0.5) / 1000 - 0.5
    wanted = np.interp(DISTANCE[:, None] + inside * width, [-1, 0, 1], [0, 1, 0]).mean(axis=1)
    np.testing.assert_allclose(box_weight(DISTANCE, width), wanted, atol=2e-6)


@pytest.mark.parametrize("width", [1.0, 2.7])
def test_box_at_pixel_centres_is_the_camera_s_kernel(width: float) -> None:
    """At whole distances it is the operator by which every pass looks at light."""
    kernel = footprint_kernel(width)
    places = np.arange(len(kernel)) - len(kernel) // 2
    np.testing.assert_allclose(box_weight(places.astype(float), width), kernel, atol=1e-14)


@given(st.floats(0, 6), st.integers(1, 8), st.floats(-1, 1))
def test_weights_of_all_pixels_sum_to_one(width: float, held: int, place: float) -> None:
    """A flat scene stays flat, wherever it is looked at; no weight is below 0."""
    weight = box_weight(place + np.arange(-20.0, 21.0), width, held)
    assert weight.sum() == pytest.approx(1, abs=1e-9)
    assert weight.min() >= 0


@pytest.mark.parametrize("held", [1, 4])
def test_gaussian_is_that_of_many_steps(held: int) -> None:
    """Kernels with Gaussians are means of the sharp one over thousands of even steps."""
    step = np.arange(-8, 8, 0.002)
    share = np.exp(-(step**2) / 2)
    variance = np.array([0.0, 0.08, 0.5])
    distance, weight = blurred_weight(2.7, variance, held)
    some = slice(0, len(distance), 37)
    for one, row in zip(variance, weight[:, some], strict=True):
        wanted = box_weight(distance[some, None] + step * np.sqrt(one), 2.7, held) @ (share / share.sum())
        np.testing.assert_allclose(row, wanted, atol=1e-7)


@settings(max_examples=30, deadline=None)
@given(width=st.sampled_from([0.0, 0.9, 2.7]), blur=st.floats(0, 1), scale=st.floats(0.99, 1.04), off=st.floats(-1, 1))
def test_table_is_the_kernel_at_any_place_and_scale(width: float, blur: float, scale: float, off: float) -> None:
    """Weights out of the table sum to 1 and are those of the kernel, by place and by scale right to a thousandth."""
    variance = np.array([0.0, blur**2])
    table = TapTable.of(width, variance, 1, (0.99, 1.04), 0.5)
    place = np.array([off], np.float32)[None, None]
    weight = table.read(np.repeat(place, 2, axis=0), table.scale_rows(np.full((2, 1), scale)))[..., 0, 0]
    apart = table.left + off - np.arange(table.taps)
    distance, kernels = blurred_weight(width * scale, variance * scale**2)
    wanted = np.stack([np.interp(apart, distance, kernel, 0.0, 0.0) for kernel in kernels], axis=1)
    np.testing.assert_allclose(weight.sum(axis=0), 1, atol=1e-6)
    np.testing.assert_allclose(weight, wanted, atol=2e-3)


def test_scale_in_the_middle_of_two_is_off_by_little() -> None:
    """Half a step of scale changes no weight by more than a thousandth, exact scales change none."""
    table = TapTable.of(2.7, np.array([0.1]), 1, (1.0, 1.03), 0.0)
    off = np.zeros((1, 1, 1), np.float32)
    for number, most in ((3.0, 2e-5), (3.5, 1e-3)):
        scale = np.array([table.least_scale + number * SCALE_STEP])
        weight = table.read(off, table.scale_rows(scale[None]))[:, 0, 0, 0]
        distance, kernel = blurred_weight(2.7 * scale[0], np.array([0.1 * scale[0] ** 2]))
        wanted = np.interp(table.left - np.arange(table.taps), distance, kernel[0])
        assert np.abs(weight - wanted).max() < most
