"""Draws of the readout: normal deviates that do not depend on the light, and what shot and read noise make of them.

Every element takes one deviate, whatever its light. The count of photons grows with both: two images of nearly the same
light have nearly the same noise, and their difference is that of the light.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
import scipy
from numpy.typing import NDArray

from pipeline.lazy import deferred

if TYPE_CHECKING:  # numba takes half a second to import: a plan of a survey never needs it
    from pipeline.simulator import compiled_loops
else:
    compiled_loops = deferred("pipeline.simulator.compiled_loops")

Floats = NDArray[np.float64]
Radiance = NDArray[np.float32]
CHIP_SAMPLES = 1_000_000  # numbers of a patch that later stages judge as one: 61 x 61 px of 270 bands
MOST_VARIATION = 0.05  # total variation between a patch of cheap draws and one of exact draws
LEAST_MERGED_READ_E = 1.0  # below, the whole numbers of the counts show through the read noise
SERIES_FROM_E = 30.0  # expected counts from which the expansion of the quantile holds
PIECE = 16384  # elements at a time, so that temporaries stay in the cache


def normal_deviates(rng: np.random.Generator, count: int) -> Radiance:
    """Draw ``count`` standard normal deviates by pairs out of 32-bit words, (count,) float32; none exceeds 6.8.

    The words come from the bit generator as they are: every deviate takes as many, and the stream may be counted.

    [1] Box, Muller, "A note on the generation of random normal deviates", Ann. Math. Stat. 29, 1958.
           doi:10.1214/aoms/1177706645
    """
    drawn = np.empty(count + count % 2, np.float32)
    compiled_loops.draw_pairs(rng.bit_generator.random_raw(len(drawn) // 2).view(np.uint32), PIECE, drawn)
    return drawn[:count]


def photon_counts(expected: Radiance, deviate: Radiance) -> Radiance:
    """Give exact Poisson counts: the quantile of each deviate's probability; 0 where 0 or less is expected.

    ``expected``: Electrons, any shape, finite. [e-]
    ``deviate``: Standard normal, the same shape.
    Returns the same shape, whole numbers (above 2^24 as near as float32 comes). [e-]
    """
    counts = np.zeros(expected.size, np.float32)
    mean, normal = expected.reshape(-1), deviate.reshape(-1)
    for start in range(0, len(counts), PIECE):
        part = slice(start, start + PIECE)
        light, z = mean[part].astype(np.float64), normal[part].astype(np.float64)
        if light.max() >= SERIES_FROM_E:
            counts[part] = _series_quantile(np.maximum(light, SERIES_FROM_E), z)
    all_dim = np.flatnonzero(mean < SERIES_FROM_E)
    for start in range(0, len(all_dim), PIECE):
        dim = all_dim[start : start + PIECE]
        light, z = mean[dim].astype(np.float64), normal[dim].astype(np.float64)
        counts[dim] = _summed_quantile(np.maximum(light, 0), z)
    return counts.reshape(expected.shape)


def rounded_counts(expected: Radiance, deviate: Radiance) -> Radiance:
    """Give nearly Poisson counts: mean, variance and third cumulant are right; for `least_expected` on.

    The first terms of the quantile's expansion, as `photon_counts` has it. Rounding and the square add 5/36 to the
    variance, which is taken off before.
    """
    spread: Radiance = np.sqrt(np.maximum(expected - np.float32(5 / 36), 0))
    spread += deviate * np.float32(1 / 6)
    spread *= deviate
    spread += expected
    spread -= np.float32(1 / 6)
    np.maximum(np.rint(spread, out=spread), 0, out=spread)
    return spread


def divergence(expected: Floats, read_noise_e: float) -> Floats:
    """Bound how far one cheap draw's distribution is from the exact one's (chi-square divergence).

    The leading terms of its Gram-Charlier expansion: c2^2 / 2 + c4^2 / 24 of the differences of variance and fourth
    cumulant, in units of the standard deviation. Without read noise that is 1 / (216 expected^2).
    """
    variance = np.maximum(expected + read_noise_e**2, np.finfo(float).tiny)
    fraction = expected / variance
    fourth = fraction / variance * (1 - 4 / 3 * fraction)
    second = fraction**2 / (18 * variance) if read_noise_e else 0.0
    return np.asarray(second**2 / 2 + fourth**2 / 24, np.float64)


@lru_cache
def least_expected(read_noise_e: float) -> float:
    """Give from how many expected electrons on cheap draws may stand for exact ones; 0 is at any light.

    From there on, a patch of `CHIP_SAMPLES` cheap numbers and one of exact ones have a total variation of at most
    sqrt(N divergence) / 2 <= `MOST_VARIATION`.
    """
    levels = np.geomspace(1e-3, 1e6, 4096)
    too_far = divergence(levels, read_noise_e) * CHIP_SAMPLES > (2 * MOST_VARIATION) ** 2
    return float(levels[min(np.flatnonzero(too_far)[-1] + 1, len(levels) - 1)]) if too_far.any() else 0.0


def chip_variation(read_noise_e: float) -> float:
    """Give the greatest total variation between a patch of cheap numbers and one of exact ones, where cheap is used."""
    levels = np.geomspace(max(least_expected(read_noise_e), 1e-3), 1e6, 4096)
    return float(np.sqrt(CHIP_SAMPLES * divergence(levels, read_noise_e).max()) / 2)


def separable(sd: float, other: float) -> float:
    """Twice the total variation between two normal distributions of one mean: the deviations that noise counts.

    0 where both are alike, 2 where one has no spread. Their densities cross at x^2 = 2 ln(a / b) / (1 / b^2 - 1 / a^2).
    """
    wide, narrow = max(sd, other), min(sd, other)
    if wide == narrow:
        return 0.0
    if narrow <= 1e-9 * wide:
        return 2.0
    ratio = wide / narrow
    cross = math.sqrt(2 * math.log1p(ratio - 1) / ((ratio - 1) * (ratio + 1)))  # over the wide one's sd
    return 2 * (math.erf(cross * ratio / math.sqrt(2)) - math.erf(cross / math.sqrt(2)))


def _series_quantile(mean: Floats, z: Floats) -> Floats:
    """Poisson quantile at Phi(z) for means from `SERIES_FROM_E` on.

    C(x) = Gamma(x, mean) / Gamma(x) runs smoothly through the distribution, F(k) = C(k + 1): where C(x) = Phi(z), the
    quantile is floor(x). x is expanded in 1 / sqrt(mean) [1]; where it comes as near to a whole number as the expansion
    may err, the distribution itself is asked.

    [1] Giles, "Algorithm 955: approximation of the inverse Poisson cumulative distribution function", ACM Trans.
           Math. Softw. 42, 2016. doi:10.1145/2699466
    """
    root, square = np.sqrt(mean), z * z
    x = mean + root * z
    x += 1 / 3 + square / 6
    x -= z * (1 / 36 + square / 72) / root
    x += (square * (7 / 810 + square / 270) - 8 / 405) / mean
    whole = np.rint(x)
    unsure = np.flatnonzero(np.abs(x - whole) * mean < 1 / 40 + square * (1 / 80 + square / 160))
    counts = np.floor(x)
    if unsure.size:
        step = np.maximum(whole[unsure], 1)
        counts[unsure] = step - (scipy.special.ndtr(z[unsure]) <= scipy.special.gammaincc(step, mean[unsure]))
    return counts


def _summed_quantile(mean: Floats, z: Floats) -> Floats:
    """Poisson quantile at Phi(z) for small means: how many of the sums of probabilities lie below."""
    counts = np.zeros_like(mean)
    asked = scipy.special.ndtr(z)
    chance = np.exp(-mean)
    summed = chance.copy()
    for k in range(1, int(mean.max() + 12 * np.sqrt(mean.max()) + 20)):
        above = asked > summed
        if not above.any():
            break
        counts += above
        chance *= mean / k
        summed += chance
    return counts
