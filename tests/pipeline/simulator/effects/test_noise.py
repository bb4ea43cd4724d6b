"""Draws of noise: deviates are normal, counts are Poisson, and cheap counts are so within their bounds."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import stats

from spectralzoom.pipeline.simulator.compiled_loops import draw_pairs, read_merged
from spectralzoom.pipeline.simulator.effects import counting

DRAWS = 200_000
DARK_DN = 1000.0
LEVELS = (1.0, 3.0, 10.0, 29.5, 30.0, 50.0, 100.0, 300.0, 1000.0, 3000.0, 10_000.0, 30_000.0, 60_000.0)
Radiance = NDArray[np.float32]


def deviates(count: int = DRAWS, seed: int = 0) -> Radiance:
    """Return standard normal numbers of one seed."""
    return counting.normal_deviates(np.random.Generator(np.random.Philox(seed)), count)


def even(level: float, count: int = DRAWS) -> Radiance:
    """Return light that is the same everywhere."""
    return np.full(count, level, np.float32)


def read(light: Radiance, deviate: Radiance, added: Radiance | None = None) -> NDArray[np.float64]:
    """Return numbers of light with shot noise and 20 e- of read noise, at 1 e- each, from `DARK_DN` upwards."""
    raw = np.empty(len(light), np.uint16)
    more = np.zeros(1, np.float32) if added is None else added
    assert read_merged(light, more, deviate, 20.0, 1.0, DARK_DN, 65_535, raw)
    return raw.astype(np.float64)


def fit(counts: Radiance, edges: NDArray[np.float64], chances: NDArray[np.float64]) -> float:
    """Return the p-value of a chi-square test of numbers in classes up to and including each edge."""
    seen = np.bincount(np.searchsorted(edges, counts), minlength=len(edges) + 1)
    return float(stats.chisquare(seen, chances / chances.sum() * len(counts)).pvalue)


def poisson_fit(counts: Radiance, level: float) -> float:
    """Return the p-value of counts against Poisson, in about 200 classes with tails of 1e-4."""
    edges = np.unique(stats.poisson.ppf(np.r_[1e-4, 1e-3, np.linspace(0.005, 0.995, 199), 0.9999], level))
    return fit(counts, edges, np.diff(stats.poisson.cdf(edges, level), prepend=0, append=1))


def test_deviates_are_normal() -> None:
    """A million deviates pass a chi-square test in 1000 classes; their first four moments are within 4 sigma."""
    drawn = deviates(1_000_000)
    assert fit(drawn, stats.norm.ppf(np.arange(1, 1000) / 1000), np.full(1000, 1e-3)) > 1e-3
    z = drawn.astype(np.float64)
    for moment, truth, sd in ((1, 0, 1), (2, 1, 2**0.5), (3, 0, 15**0.5), (4, 3, 96**0.5)):
        assert abs((z**moment).mean() - truth) < 4 * sd / 1000


def test_deviates_are_uncorrelated() -> None:
    """Neighbours, the two deviates of a pair, and their squares are not correlated."""
    drawn = deviates(2 * counting.PIECE)
    for lag in (1, 2, counting.PIECE // 2, counting.PIECE):
        one, other = drawn[:-lag], drawn[lag:]
        assert abs(np.corrcoef(one, other)[0, 1]) < 4 / np.sqrt(len(one))
        assert abs(np.corrcoef(one**2, other**2)[0, 1]) < 4 / np.sqrt(len(one))


@pytest.mark.parametrize("level", LEVELS)
def test_exact_counts_are_poisson(level: float) -> None:
    """Counts pass a chi-square test at 1e-3; mean and variance over the level are within 3 sigma, or 1 %, of 1."""
    level = float(np.float32(level))
    counts = counting.photon_counts(even(level), deviates(seed=int(level)))
    assert poisson_fit(counts, level) > 1e-3
    assert abs(counts.mean(dtype=np.float64) / level - 1) < 3 / np.sqrt(DRAWS * level)
    assert abs(counts.var(dtype=np.float64) / level - 1) < max(0.01, 3 * np.sqrt((2 + 1 / level) / DRAWS))


@settings(max_examples=30, deadline=None)
@given(level=st.floats(2**-7, 2.0**17, width=32), z=st.floats(-6.5, 6.5, width=32))
def test_exact_counts_are_the_quantile(level: float, z: float) -> None:
    """The count is the smallest k with F(k) >= Phi(z)."""
    (count,) = counting.photon_counts(even(level, 1), even(z, 1))
    below, upto = stats.poisson.cdf([count - 1, count], level), stats.norm.cdf(z)
    above, least = stats.poisson.sf([count - 1, count], level), stats.norm.sf(z)
    slack = 1e-9  # relative, of the nearer tail
    assert below[0] < upto * (1 + slack) or above[0] > least * (1 - slack)
    assert below[1] >= upto * (1 - slack) or above[1] <= least * (1 + slack)


def test_counts_of_extreme_light_are_finite() -> None:
    """Light of 0, below 0 or tiny gives 0; 1e9 e- and more give finite numbers near the expected ones."""
    light = np.array([0, -3, 1e-30, 1e9, 1e20], np.float32)
    counts = counting.photon_counts(light, np.array([5, 5, 5, 1, 1], np.float32))
    np.testing.assert_allclose(counts, [0, 0, 0, 1e9 + 1e4**1.125, 1e20], rtol=1e-6)
    assert not counting.photon_counts(light[:3], even(6.7, 3)).any()


def test_counts_never_fall_with_more_light() -> None:
    """With one deviate this holds through small and large means."""
    light = np.geomspace(0.1, 1e5, 20_001).astype(np.float32)
    for z in (-4.0, -1.0, 0.0, 0.7, 5.0):
        assert (np.diff(counting.photon_counts(light, even(z, len(light)))) >= 0).all()


@pytest.mark.parametrize("level", [700.0, 1000.0, 3000.0, 10_000.0, 60_000.0])
def test_rounded_counts_are_poisson_where_the_bound_holds(level: float) -> None:
    """From the least expected electrons upwards, 2e5 draws pass the test of exact counts and differ by at most 1."""
    assert level >= counting.least_expected(0.0)
    z = deviates(seed=int(level))
    counts, exact = counting.rounded_counts(even(level), z), counting.photon_counts(even(level), z)
    assert poisson_fit(counts, level) > 1e-3
    assert np.abs(counts - exact).max() <= 1
    assert abs(counts.var(dtype=np.float64) / level - 1) < max(0.01, 3 * np.sqrt(2 / DRAWS))


@pytest.mark.parametrize("level", [0.0, 20.0, 150.0, 400.0, 3000.0, 60_000.0])
def test_merged_noise_has_the_cumulants_of_both(level: float) -> None:
    """Mean, variance and third cumulant are those of Poisson, normal (20 e-) and rounding, within 4 sigma."""
    drawn = read(even(level, 1_000_000), deviates(1_000_000)).astype(np.float64) - level - DARK_DN
    variance = level + 400 + 1 / 12
    assert abs(drawn.mean()) < 4 * np.sqrt(variance / 1e6)
    assert abs(drawn.var() / variance - 1) < 4 * np.sqrt(2 / 1e6)
    assert abs((drawn**3).mean() - level) < 4 * np.sqrt(15 * variance**3 / 1e6)


def test_compiled_loops_match_their_formulae() -> None:
    """Deviates are those of Box and Muller's logarithm, sine and cosine to 2e-5, and numbers those of the series.

    Close to a half float32 decides: less than one number in a hundred is 1 off.
    """
    count = 3 * counting.PIECE + 8
    words = np.random.SFC64(4).random_raw(count // 2).view(np.uint32)
    words[:4] = [0, 1, 2**32 - 1, 2**31]
    drawn = np.empty(count, np.float32)
    draw_pairs(words, counting.PIECE, drawn)
    wanted = []
    for start in range(0, count, counting.PIECE):
        radius, turn = np.split(words[start : start + counting.PIECE].astype(np.float64), 2)
        radius, turn = np.sqrt(-2 * np.log((radius + 0.5) / 2**32)), turn * (2 * np.pi / 2**32)
        wanted += [radius * np.cos(turn), radius * np.sin(turn)]
    np.testing.assert_allclose(drawn, np.concatenate(wanted), atol=2e-5)
    light = np.random.default_rng(2).uniform(-100, 60_000, count).astype(np.float32)
    mean = np.maximum(light, 0).astype(np.float64)
    z = drawn.astype(np.float64)
    skew = mean / (mean + 400) / 6
    numbers = np.rint(np.clip(mean + np.sqrt(mean + 400) * z + skew * (z * z - 1) + DARK_DN, 0, 65_535))
    apart = np.abs(read(light, drawn) - numbers)
    assert apart.max() <= 1
    assert (apart > 0).mean() < 1e-2


@pytest.mark.parametrize("value", [np.inf, np.nan, -np.inf])
def test_loop_reports_non_finite_light(value: float) -> None:
    """NaN and infinity are found in the last place; minus infinity is dark."""
    light = even(100.0, 1030)
    raw = np.empty(1030, np.uint16)
    light[-1] = value
    told = read_merged(light, np.zeros(1, np.float32), deviates(1030), 20.0, 1.0, DARK_DN, 65_535, raw)
    assert told == (value == -np.inf)


def merged_chances(level: float, read: float, edges: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the probability that the cheap draw lies below each edge, by solving its square for the deviate."""
    variance = level + read**2
    bend = level / (6 * variance)
    slope = np.sqrt(variance)
    if bend == 0:
        return np.asarray(stats.norm.cdf((edges - level) / slope))
    root = np.sqrt(np.maximum(slope**2 + 4 * bend * (edges - level + bend), 0))
    return np.asarray(stats.norm.cdf((-slope + root) / (2 * bend)) - stats.norm.cdf((-slope - root) / (2 * bend)))


@pytest.mark.parametrize(
    ("level", "read"),
    [
        (level, read)
        for read in (5.0, 10.0, 20.0, 40.0)
        for level in (2.0, 40.0, 200.0, 700.0, 5000.0)
        if level >= counting.least_expected(read)
    ],
)
def test_divergence_of_the_cheap_draw_is_within_its_bound(level: float, read: float) -> None:
    """The chi-square divergence of its DN from the exact draw's is at most 1.2 times the stated divergence."""
    reach = 12 * np.sqrt(level + read**2)
    edges = np.arange((level - reach) // 5, (level + reach) // 5) * 5.0 + 2.5
    counts = np.arange(max(int(level - 12 * np.sqrt(level)), 0), int(level + 12 * np.sqrt(level) + 30))
    exact = stats.norm.cdf((edges[:, None] - counts) / read) @ stats.poisson.pmf(counts, level)
    p, q = np.diff(exact), np.diff(merged_chances(level, read, edges))
    met = p > 1e-14
    found = float(((q - p)[met] ** 2 / p[met]).sum())
    assert found <= 1.2 * float(counting.divergence(np.array(level), read)) + 1e-12


def test_least_expected_keeps_a_patch_within_its_variation() -> None:
    """Cheap draws suit any light at the default read noise, and light from about 700 e- without read noise."""
    assert counting.least_expected(20.0) == 0
    assert 600 < counting.least_expected(0.0) < 3000
    for read in (0.0, 1.0, 5.0, 20.0):
        assert counting.chip_variation(read) <= counting.MOST_VARIATION
    light = np.array(counting.least_expected(0.0))
    variation = np.sqrt(counting.CHIP_SAMPLES * counting.divergence(light, 0.0)) / 2
    assert variation == pytest.approx(counting.MOST_VARIATION, rel=0.01)
