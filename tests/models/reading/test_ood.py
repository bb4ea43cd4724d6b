"""How far spectra lie from what training saw: laws of the distance, and known rates of Gaussian data."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy
from hypothesis import given, settings
from hypothesis import strategies as st

from models.network.spectral import LineSpec
from models.reading.ood import Limits, OodDetector

COLUMNS = 5


def some_limits(distance: float = 2.0) -> Limits:
    """The same distance for both rates, all light and both steps."""
    return Limits(np.array([0.001, 0.01]), np.array([0.03, 1.0]), (1, 2), np.full((2, 2, 2), distance))


def some_ood(seed: int = 0, components: int = 3, **changed: Any) -> OodDetector:
    """Components far from each other, with covariances of their own, and noise."""
    rng = np.random.default_rng(seed)
    mixing = rng.normal(0, 1, (components, COLUMNS, COLUMNS))
    covariance = mixing @ mixing.swapaxes(1, 2) + 0.1 * np.eye(COLUMNS)
    parts: dict[str, Any] = {
        "centres": rng.normal(0, 100, (components, COLUMNS)),
        "covariance": covariance,
        "shot": np.stack([0.1 * np.eye(COLUMNS)] * components),
        "read": 0.01 * np.eye(COLUMNS),
        "limits": some_limits(),
        "bands": 10,
    }
    return OodDetector(**{**parts, **changed})


def spectra_of(ood_detector: OodDetector, count: int, seed: int = 1, light: float = 1.0) -> np.ndarray:
    """Spectra drawn from the components, in their order, with the noise of the light."""
    rng, noise = np.random.default_rng(seed), ood_detector.shot / light + ood_detector.read / light**2
    drawn = [
        rng.multivariate_normal(m, c + n, count)
        for m, c, n in zip(ood_detector.centres, ood_detector.covariance, noise, strict=True)
    ]
    return np.concatenate(drawn)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 1000), st.floats(0.03, 1.0), st.integers(1, 4))
def test_the_distance_is_that_of_mahalanobis(seed: int, light: float, readings: int) -> None:
    """In float64, by a solution with the whole covariance, of spectra whose component is known."""
    ood_detector = some_ood(seed)
    pixels = spectra_of(ood_detector, 20, seed)
    noise, wanted = (ood_detector.shot / light + ood_detector.read / light**2) / readings, []
    for number, pixel in enumerate(pixels):
        apart = pixel - ood_detector.centres[number // 20]
        spread = ood_detector.covariance[number // 20] + noise[number // 20]
        wanted.append(apart @ scipy.linalg.solve(spread, apart, assume_a="pos") / COLUMNS)
    np.testing.assert_allclose(ood_detector.lit(light, readings).distance(pixels), wanted, rtol=2e-3, atol=1e-4)


@pytest.mark.parametrize("light", [1.0, 0.1])
def test_gaussian_spectra_lie_beyond_a_limit_as_often_as_chi_squared_says(light: float) -> None:
    """In the light that they are seen in: 1 % of them beyond what one in a hundred goes beyond."""
    beyond = float(scipy.stats.chi2.ppf(0.99, COLUMNS)) / COLUMNS
    ood_detector = some_ood(limits=some_limits(beyond))
    pixels = spectra_of(ood_detector, 4000, light=light)
    assert 0.007 < ood_detector.unknown(pixels, rate=0.005, capture=LineSpec(light), bands=10).mean() < 0.013


def test_fewer_bands_are_read_as_noisier_ones() -> None:
    """A spectrum beyond the noise of all bands may be within that of some; more than in training help nothing."""
    ood_detector = some_ood(covariance=np.stack([0.01 * np.eye(COLUMNS)] * 3))
    pixel = ood_detector.centres[:1] + 0.7
    told = [ood_detector.unknown(pixel, rate=0.005, capture=LineSpec(), bands=bands)[0] for bands in (1, 10, 20)]
    assert told == [False, True, True]


def test_a_pixel_without_columns_is_not_unknown() -> None:
    """It was not captured, which is another thing; what was, however far away, is."""
    ood_detector, pixels = some_ood(), np.array([[np.nan] * COLUMNS, [np.inf] * COLUMNS, [1e6] * COLUMNS])
    told = ood_detector.unknown(pixels, rate=0.005, capture=LineSpec(binned=4), bands=10)
    assert told.tolist() == [False, False, True]
    assert ood_detector.unknown(pixels[:0], rate=0.005, capture=LineSpec(), bands=10).shape == (0,)


def test_a_capture_is_held_against_its_own_limit() -> None:
    """Lines between two spacings that were measured count as the wider."""
    fine = np.array([1.0, 3.0])[:, None, None] * np.ones((2, 2, 2))
    limits = Limits(np.array([0.001, 0.01]), np.array([0.03, 1.0]), (1, 2), fine)
    even, silent = np.stack([np.eye(COLUMNS)] * 3), np.zeros((3, COLUMNS, COLUMNS))
    ood_detector = some_ood(covariance=even, shot=silent, read=silent[0], limits=limits)
    pixels = ood_detector.centres[0] + np.sqrt([[0.9], [2.0], [5.0], [7.0]])  # so far away, squared
    captures = [LineSpec(), LineSpec(step=1.5), LineSpec(step=2)]
    told = [ood_detector.unknown(pixels, rate=0.01, capture=one, bands=10).sum() for one in captures]
    assert told == [3, 2, 2]


def test_limits_lie_between_those_that_were_measured() -> None:
    """By the logarithms of rate and light; beyond them the nearest; a step between two counts as the wider."""
    fine = np.array([[[4.0, 2.0], [3.0, 1.0]], [[8.0, 6.0], [7.0, 5.0]]])
    limits = Limits(np.array([0.001, 0.1]), np.array([0.01, 1.0]), (1, 4), fine)
    assert limits.at(0.001, 0.01, 1) == 4
    assert limits.at(0.01, 0.1, 1) == pytest.approx(2.5)
    assert limits.at(0.5, 0.001, 2) == 6
    assert limits.at(0.1, 5.0, 8) == 5
