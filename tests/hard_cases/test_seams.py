"""Hard overlaps for registration: empty, flat, periodic, one edge, holes, and shifts beyond the prior."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from spectralzoom.pipeline.rectify.registration.alignment import pair_shift

Field = tuple[np.ndarray, np.ndarray]


def texture(seed: int, shape: tuple[int, int], down: int = 0, right: int = 0) -> Field:
    """Return two crops of one random image, shifted by whole pixels, with noise of 2 %."""
    rng = np.random.default_rng(seed)
    whole = gaussian_filter(rng.normal(size=(shape[0] + 160, shape[1] + 160)), 1.5)
    whole /= whole.std()
    one = whole[80 : 80 + shape[0], 80 : 80 + shape[1]]
    other = whole[80 + down : 80 + down + shape[0], 80 + right : 80 + right + shape[1]]
    return one + rng.normal(size=shape) / 50, other + rng.normal(size=shape) / 50


@pytest.mark.parametrize("fill", [np.nan, np.inf])
def test_overlap_without_common_pixels_is_empty(fill: float):
    """One sweep without values is enough, and so are two sweeps without a common pixel within the prior."""
    one, other = texture(0, (100, 60))
    assert pair_shift(one, np.full_like(other, fill), prior_px=5).status == "empty"
    one[:, 20:], other[:, :40] = fill, fill
    assert pair_shift(one, other, prior_px=5).status == "empty"


@pytest.mark.parametrize("level", [0.0, 1.0, 1e-30, 3e4])
def test_constant_overlap_is_flat(level: float):
    """A constant image is flat without noise, with noise of 2 %, and against a texture."""
    flat = np.full((200, 64), level)
    assert pair_shift(flat, flat, prior_px=10).status == "flat"
    noise = np.random.default_rng(1).normal(size=(2, 200, 64)) * (level or 1.0) / 50
    assert pair_shift(flat + noise[0], flat + noise[1], prior_px=10).status == "flat"
    assert pair_shift(texture(0, (200, 64))[0], flat, prior_px=10).status == "flat"


@pytest.mark.parametrize("period", [4.0, 12.0, 12.37, 31.0])
def test_periodic_texture_is_undecidable(period: float):
    """The pattern repeats in both directions within the prior, with periods of 4 to 31 px, with and without noise."""
    y, x = np.mgrid[:256, :128].astype(float)
    for noise in (0.0, 0.02, 0.3):
        rng = np.random.default_rng(2)
        views = [
            np.sin(2 * np.pi * (y + move) / period) * np.sin(2 * np.pi * (x - move) / period)
            + noise * rng.normal(size=y.shape)
            for move in (0.0, 1.3)
        ]
        assert pair_shift(*views, prior_px=36).status == "undecidable"


def test_single_straight_edge_is_undecidable():
    """One straight edge fixes the shift across it and leaves the shift along it open."""
    rng = np.random.default_rng(4)
    y, x = np.mgrid[:256, :80].astype(float)
    for across in (x, y - 88, (x + y) / np.sqrt(2) - 90):
        views = [1 / (1 + np.exp(-(across - 40 + move) / 1.5)) for move in (0.0, 2.0)]
        assert pair_shift(*views, prior_px=10).status == "undecidable"
        noisy = [view + rng.normal(size=view.shape) / 50 for view in views]
        assert pair_shift(*noisy, prior_px=10).status == "undecidable"


def test_corner_of_two_edges_fixes_the_shift():
    """A step edge that turns a corner fixes both directions to 0.05 px."""
    y, x = np.mgrid[:256, :80].astype(float)
    rng = np.random.default_rng(5)
    views = []
    for down, right in ((0.0, 0.0), (3.4, -2.2)):
        left, below = (1 / (1 + np.exp(-part / 1.5)) for part in (x + right - 40, y + down - 128))
        views.append(left * below + rng.normal(size=x.shape) / 50)
    np.testing.assert_allclose(pair_shift(*views, prior_px=10).shift, [3.4, -2.2], atol=0.05)


def test_non_finite_pixels_in_the_overlap_are_ignored():
    """Holes and lost lines of either image reduce the pixel count; the shift stays right to 0.02 px."""
    one, other = texture(6, (256, 80), 5, -2)
    clean = pair_shift(one, other, prior_px=8)
    one[100:108], other[:, 30:33], other[7, 60] = np.nan, np.nan, np.inf
    one[40:60, 10:30] = np.nan
    found = pair_shift(one, other, prior_px=8)
    np.testing.assert_allclose(found.shift, [5, -2], atol=0.02)
    assert found.pixels < clean.pixels


def test_shift_beyond_the_prior_is_undecidable():
    """A prior of 10 px finds neither the shift of 14 px nor a wrong one; a prior of 16 px finds it."""
    for seed in range(4):
        views = texture(seed, (256, 96), 14, 0)
        assert pair_shift(*views, prior_px=10).status == "undecidable"
        np.testing.assert_allclose(pair_shift(*views, prior_px=16).shift, [14, 0], atol=0.02)


@pytest.mark.parametrize("lines", [1, 2, 8])
def test_few_common_lines_are_undecidable(lines: int):
    """One, two or eight common lines are too few for a shift; without a common line the overlap may also be empty."""
    one, other = texture(7, (100, 64), 1, 2)
    assert pair_shift(one[:lines], other[:lines], prior_px=10).status == "undecidable"
    one[lines:], other[: 100 - lines] = np.nan, np.nan
    assert pair_shift(one, other, prior_px=0).status in ("undecidable", "empty")


def test_single_pixel_is_flat_and_float32_agrees_with_float64():
    """One pixel contains no shift; float32 images give the shift of float64 images to 1e-4 px."""
    assert pair_shift(np.ones((1, 1)), np.ones((1, 1)), prior_px=3).status == "flat"
    one, other = texture(8, (128, 64), 3, 1)
    half = pair_shift(one.astype(np.float32), other.astype(np.float32), prior_px=5)
    np.testing.assert_allclose(half.shift, pair_shift(one, other, prior_px=5).shift, atol=1e-4)
