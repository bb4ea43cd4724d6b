"""Hard overlaps: nothing in common, nothing to see, rows without end, one edge, holes, and shifts out of reach."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from pipeline.rectify.registration.alignment import pair_shift

Field = tuple[np.ndarray, np.ndarray]


def texture(seed: int, shape: tuple[int, int], down: int = 0, right: int = 0) -> Field:
    """Two cuts of one random image, a whole shift apart, with noise of 2 %."""
    rng = np.random.default_rng(seed)
    whole = gaussian_filter(rng.normal(size=(shape[0] + 160, shape[1] + 160)), 1.5)
    whole /= whole.std()
    one = whole[80 : 80 + shape[0], 80 : 80 + shape[1]]
    other = whole[80 + down : 80 + down + shape[0], 80 + right : 80 + right + shape[1]]
    return one + rng.normal(size=shape) / 50, other + rng.normal(size=shape) / 50


@pytest.mark.parametrize("fill", [np.nan, np.inf])
def test_empty_overlap(fill: float):
    """Where one sweep saw nothing, or both never the same pixel within the prior, the overlap is empty."""
    one, other = texture(0, (100, 60))
    assert pair_shift(one, np.full_like(other, fill), prior_px=5).status == "empty"
    one[:, 20:], other[:, :40] = fill, fill
    assert pair_shift(one, other, prior_px=5).status == "empty"


@pytest.mark.parametrize("level", [0.0, 1.0, 1e-30, 3e4])
def test_flat_overlap(level: float):
    """A constant overlap is flat, with noise on it or without."""
    flat = np.full((200, 64), level)
    assert pair_shift(flat, flat, prior_px=10).status == "flat"
    noise = np.random.default_rng(1).normal(size=(2, 200, 64)) * (level or 1.0) / 50
    assert pair_shift(flat + noise[0], flat + noise[1], prior_px=10).status == "flat"
    assert pair_shift(texture(0, (200, 64))[0], flat, prior_px=10).status == "flat"


@pytest.mark.parametrize("period", [4.0, 12.0, 12.37, 31.0])
def test_periodic_texture(period: float):
    """A pattern that repeats in both directions within the prior is undecidable at any period, noise or none."""
    y, x = np.mgrid[:256, :128].astype(float)
    for noise in (0.0, 0.02, 0.3):
        rng = np.random.default_rng(2)
        views = [
            np.sin(2 * np.pi * (y + move) / period) * np.sin(2 * np.pi * (x - move) / period)
            + noise * rng.normal(size=y.shape)
            for move in (0.0, 1.3)
        ]
        found = pair_shift(*views, prior_px=36)
        assert found.status == "undecidable"


def test_step_edge():
    """One straight edge fixes the shift across it and leaves the one along it open: undecidable."""
    rng = np.random.default_rng(4)
    y, x = np.mgrid[:256, :80].astype(float)
    for across in (x, y - 88, (x + y) / np.sqrt(2) - 90):
        views = [1 / (1 + np.exp(-(across - 40 + move) / 1.5)) for move in (0.0, 2.0)]
        assert pair_shift(*views, prior_px=10).status == "undecidable"
        noisy = [view + rng.normal(size=view.shape) / 50 for view in views]
        assert pair_shift(*noisy, prior_px=10).status == "undecidable"


def test_corner_of_two_edges_is_enough():
    """A step edge that turns a corner fixes both directions."""
    y, x = np.mgrid[:256, :80].astype(float)
    rng, views = np.random.default_rng(5), []
    for down, right in ((0.0, 0.0), (3.4, -2.2)):
        left, below = (1 / (1 + np.exp(-part / 1.5)) for part in (x + right - 40, y + down - 128))
        views.append(left * below + rng.normal(size=x.shape) / 50)
    np.testing.assert_allclose(pair_shift(*views, prior_px=10).shift, [3.4, -2.2], atol=0.05)


def test_nan_inside_the_overlap():
    """Holes and lost lines of either image count nothing; what lies in them does not matter."""
    one, other = texture(6, (256, 80), 5, -2)
    clean = pair_shift(one, other, prior_px=8)
    one[100:108], other[:, 30:33], other[7, 60] = np.nan, np.nan, np.inf
    one[40:60, 10:30] = np.nan
    found = pair_shift(one, other, prior_px=8)
    np.testing.assert_allclose(found.shift, [5, -2], atol=0.02)
    assert found.pixels < clean.pixels


def test_shift_beyond_the_prior():
    """A shift that the prior rules out is not found, nor is another found in its place."""
    for seed in range(4):
        views = texture(seed, (256, 96), 14, 0)
        assert pair_shift(*views, prior_px=10).status == "undecidable"
        np.testing.assert_allclose(pair_shift(*views, prior_px=16).shift, [14, 0], atol=0.02)


@pytest.mark.parametrize("lines", [1, 2, 8])
def test_one_common_line(lines: int):
    """One line in common, or a few, is too little to tell a shift from; nothing fails."""
    one, other = texture(7, (100, 64), 1, 2)
    assert pair_shift(one[:lines], other[:lines], prior_px=10).status == "undecidable"
    one[lines:], other[: 100 - lines] = np.nan, np.nan
    assert pair_shift(one, other, prior_px=0).status in ("undecidable", "empty")


def test_single_pixel_and_integer_types():
    """One pixel is no overlap to tell anything from, and float32 images give what float64 ones give."""
    assert pair_shift(np.ones((1, 1)), np.ones((1, 1)), prior_px=3).status == "flat"
    one, other = texture(8, (128, 64), 3, 1)
    half = pair_shift(one.astype(np.float32), other.astype(np.float32), prior_px=5)
    np.testing.assert_allclose(half.shift, pair_shift(one, other, prior_px=5).shift, atol=1e-4)
