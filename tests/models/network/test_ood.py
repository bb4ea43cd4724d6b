"""The out-of-distribution detector: laws of its distance, and known rates for Gaussian data."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy
from hypothesis import given, settings
from hypothesis import strategies as st

from models.network.ood import Limits, OodDetector
from models.network.spectral import LineSpec

COLUMNS = 5


def some_limits(distance: float = 2.0) -> Limits:
    """Return limits with the same distance for both rates, all light and both steps."""
    return Limits(np.array([0.001, 0.01]), np.array([0.03, 1.0]), (1, 2), np.full((2, 2, 2), distance))


def some_ood(seed: int = 0, components: int = 3, **changed: Any) -> OodDetector:
    """Return a detector of components far from each other, each with its own covariance, and noise."""
    rng = np.random.default_rng(seed)
    mixing = rng.normal(0, 1, (components, COLUMNS, COLUMNS))
    parts: dict[str, Any] = {
        "centres": rng.normal(0, 100, (components, COLUMNS)),
        "covariance": mixing @ mixing.swapaxes(1, 2) + 0.1 * np.eye(COLUMNS),
        "shot": np.stack([0.1 * np.eye(COLUMNS)] * components),
        "read": 0.01 * np.eye(COLUMNS),
        "limits": some_limits(),
        "bands": 10,
    }
    return OodDetector(**{**parts, **changed})


def spectra_of(ood_detector: OodDetector, count: int, seed: int = 1, light: float = 1.0) -> np.ndarray:
    """Return spectra drawn from the components, in their order, with the noise of the light."""
    rng = np.random.default_rng(seed)
    noise = ood_detector.shot / light + ood_detector.read / light**2
    drawn = [
        rng.multivariate_normal(m, c + n, count)
        for m, c, n in zip(ood_detector.centres, ood_detector.covariance, noise, strict=True)
    ]
    return np.concatenate(drawn)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 1000), st.floats(0.03, 1.0), st.integers(1, 4))
def test_distance_is_the_mahalanobis_distance(seed: int, light: float, readings: int) -> None:
    """The distance equals a float64 solution with the whole covariance, for spectra whose component is known."""
    ood_detector = some_ood(seed)
    pixels = spectra_of(ood_detector, 20, seed)
    noise = (ood_detector.shot / light + ood_detector.read / light**2) / readings
    wanted = []
    for number, pixel in enumerate(pixels):
        apart = pixel - ood_detector.centres[number // 20]
        spread = ood_detector.covariance[number // 20] + noise[number // 20]
        wanted.append(apart @ scipy.linalg.solve(spread, apart, assume_a="pos") / COLUMNS)
    np.testing.assert_allclose(ood_detector.lit(light, readings).distance(pixels), wanted, rtol=2e-3, atol=1e-4)


@pytest.mark.parametrize("light", [1.0, 0.1])
def test_unknown_rate_of_gaussian_spectra_follows_chi_squared(light: float) -> None:
    """With the limit at the 99 % quantile about 1 % are unknown, in full light and in a tenth of it."""
    beyond = float(scipy.stats.chi2.ppf(0.99, COLUMNS)) / COLUMNS
    ood_detector = some_ood(limits=some_limits(beyond))
    pixels = spectra_of(ood_detector, 4000, light=light)
    assert 0.007 < ood_detector.unknown(pixels, rate=0.005, capture=LineSpec(light), bands=10).mean() < 0.013


def test_fewer_bands_count_as_noisier() -> None:
    """A spectrum beyond the noise of all bands may be within that of some; more bands than in training do not help."""
    ood_detector = some_ood(covariance=np.stack([0.01 * np.eye(COLUMNS)] * 3))
    pixel = ood_detector.centres[:1] + 0.7
    told = [ood_detector.unknown(pixel, rate=0.005, capture=LineSpec(), bands=bands)[0] for bands in (1, 10, 20)]
    assert told == [False, True, True]


def test_a_pixel_without_columns_is_not_unknown() -> None:
    """A pixel without columns was not captured; a captured pixel far from all components is unknown."""
    ood_detector = some_ood()
    pixels = np.array([[np.nan] * COLUMNS, [np.inf] * COLUMNS, [1e6] * COLUMNS])
    told = ood_detector.unknown(pixels, rate=0.005, capture=LineSpec(binned=4), bands=10)
    assert told.tolist() == [False, False, True]
    assert ood_detector.unknown(pixels[:0], rate=0.005, capture=LineSpec(), bands=10).shape == (0,)


def test_a_capture_is_compared_with_its_own_limit() -> None:
    """A line spacing between two measured ones counts as the wider."""
    fine = np.array([1.0, 3.0])[:, None, None] * np.ones((2, 2, 2))
    limits = Limits(np.array([0.001, 0.01]), np.array([0.03, 1.0]), (1, 2), fine)
    even, silent = np.stack([np.eye(COLUMNS)] * 3), np.zeros((3, COLUMNS, COLUMNS))
    ood_detector = some_ood(covariance=even, shot=silent, read=silent[0], limits=limits)
    pixels = ood_detector.centres[0] + np.sqrt([[0.9], [2.0], [5.0], [7.0]])  # squared distances
    captures = [LineSpec(), LineSpec(step=1.5), LineSpec(step=2)]
    assert [ood_detector.unknown(pixels, rate=0.01, capture=one, bands=10).sum() for one in captures] == [3, 2, 2]


def test_limits_are_interpolated_between_measured_ones() -> None:
    """Rate and light are interpolated by logarithms and clamped; a step between two measured ones is the wider one."""
    fine = np.array([[[4.0, 2.0], [3.0, 1.0]], [[8.0, 6.0], [7.0, 5.0]]])
    limits = Limits(np.array([0.001, 0.1]), np.array([0.01, 1.0]), (1, 4), fine)
    assert limits.at(0.001, 0.01, 1) == 4
    assert limits.at(0.01, 0.1, 1) == pytest.approx(2.5)
    assert limits.at(0.5, 0.001, 2) == 6
    assert limits.at(0.1, 5.0, 8) == 5
