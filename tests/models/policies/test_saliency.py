"""Saliency of an image: what stands out, and what must not count (brightness, order of bands, what is not finite)."""

from __future__ import annotations

import sys
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from models.policies.policies import fine_grained, grey_image, spectral_residual
from pipeline.errors import SettingsError

Measure = Callable[[NDArray[np.floating]], NDArray[np.float64]]
both = pytest.mark.parametrize("measure", [fine_grained, spectral_residual])


def _noise(shape: tuple[int, ...] = (40, 56, 5), seed: int = 0) -> NDArray[np.float64]:
    return np.random.default_rng(seed).random(shape)


@both
def test_an_odd_patch_stands_out(measure: Measure):
    """The one bright patch holds the greatest saliency, and the ground at the median less than half of that."""
    image = 0.01 * _noise((64, 80, 1))
    image[30:34, 50:54] += 1
    found = measure(image)
    assert found.shape == (64, 80)
    assert found[30:34, 50:54].max() == found.max()
    assert np.median(found) < found.max() / 2


@both
def test_the_order_of_bands_does_not_count(measure: Measure):
    """Any permutation gives the same numbers, to the bit."""
    image = _noise()
    assert (measure(image[..., [3, 0, 4, 2, 1]]) == measure(image)).all()


@both
def test_brightness_does_not_count(measure: Measure):
    """Each band times a factor of its own changes nothing; with an offset of its own only rounding."""
    image = _noise()
    assert (measure(image * 2.0 ** np.arange(-2, 3)) == measure(image)).all()
    np.testing.assert_allclose(measure(3.7 * image + np.arange(5)), measure(image), atol=0.02)


@both
@pytest.mark.parametrize("level", [0.0, 0.3, -2e6])
def test_an_image_without_contrast_is_flat(measure: Measure, level: float):
    """Bands alike everywhere, but for rounding, give 0 everywhere, whatever their level."""
    image = np.full((20, 30, 3), level) * (1 + 1e-9 * _noise((20, 30, 3)))
    assert not measure(image).any()


@both
def test_a_band_without_contrast_adds_nothing(measure: Measure):
    """Neither a plain band nor one in which nothing is finite changes the result."""
    image = _noise()
    more = np.concatenate([image, np.full((40, 56, 1), 7.0), np.full((40, 56, 1), np.nan)], axis=-1)
    assert (measure(more) == measure(image)).all()


@both
def test_what_is_not_finite_takes_the_median(measure: Measure):
    """NaN and infinities do not spread: the result is that of their band's median in their place."""
    image, filled = _noise((41, 57, 1)), _noise((41, 57, 1))
    image[3, 4], image[20, 20], image[39, 1] = np.nan, np.inf, -np.inf
    filled[[3, 20, 39], [4, 20, 1]] = np.median(image[np.isfinite(image)])
    found = measure(image)
    assert np.isfinite(found).all()
    np.testing.assert_allclose(found, measure(filled), atol=0.02)


@both
@pytest.mark.parametrize("shape", [(1, 1), (1, 2), (2, 1), (1, 37), (53, 1), (2, 2), (3, 5), (31, 7)])
def test_any_size_will_do(measure: Measure, shape: tuple[int, int]):
    """From one pixel on there is a finite number from 0 to 1 for each, the same every time."""
    image = _noise((*shape, 2))
    found = measure(image)
    assert found.shape == shape
    assert np.isfinite(found).all()
    assert 0 <= found.min() <= found.max() <= 1
    assert (measure(image) == found).all()


@both
def test_a_regular_pattern_leaves_no_nan(measure: Measure):
    """A chessboard, of which most of the spectrum is exactly nothing, gives finite numbers."""
    board = (np.indices((32, 32)).sum(axis=0) % 2)[..., None].astype(float)
    assert np.isfinite(measure(board)).all()


def test_grey_is_the_mean_of_bands_in_their_own_ranges():
    """By hand: 0 and 1 stand for a band's ends, however wide it is; what is alike in all bands stays in its order."""
    ramp = np.linspace(0, 1, 12).reshape(3, 4)
    grey = grey_image(np.stack([ramp, 50 + 1000 * ramp], axis=-1))
    assert grey == pytest.approx(ramp, abs=0.002)
    assert grey_image(np.stack([ramp, -ramp], axis=-1)[:, :, :0]) is None


def test_something_small_on_a_plain_ground_is_seen():
    """Less than a thousandth of the pixels, the rest alike: the range is that of all values, not of percentiles."""
    image = np.zeros((100, 100, 1))
    image[40, 60] = 1e-3
    grey = grey_image(image)
    assert grey is not None
    assert grey[40, 60] == 1
    assert grey.sum() == 1


def test_opencv_without_contrib_is_said(monkeypatch: pytest.MonkeyPatch):
    """The message names the package to install and the policies that need it."""
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(SettingsError, match=r"saliency and spectral-residual need OpenCV .* opencv-contrib-py"):
        fine_grained(np.zeros((4, 4, 1)))
