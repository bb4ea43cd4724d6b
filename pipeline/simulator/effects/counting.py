"""Draws of shot and read noise, and the readout's effects: dark current, defects, saturation, quantisation.

Every element takes one deviate, whatever its light. The count of photons grows with both. So two images of nearly the
same light have nearly the same noise, and their difference is that of the light.
"""

from __future__ import annotations

import math
from functools import lru_cache
from types import MappingProxyType

import numpy as np
import scipy
from numpy.typing import NDArray

from spectralzoom.pipeline.simulator.effects.effect import Bound, Effect, Radiance, stream_of
from spectralzoom.pipeline.simulator.effects.probe import Probe
from spectralzoom.pipeline.simulator.rig_model import Rig

Floats = NDArray[np.float64]
CHIP_SAMPLES = 1_000_000  # numbers of a patch that later stages judge as one: 61 x 61 px of 270 bands
MOST_VARIATION = 0.05  # total variation between a patch of cheap draws and one of exact draws
LEAST_MERGED_READ_E = 1.0  # below, the whole numbers of the counts show through the read noise
SERIES_FROM_E = 30.0  # expected counts from which the expansion of the quantile holds
PIECE = 16384  # elements at a time, so that temporaries stay in the cache


def normal_deviates(rng: np.random.Generator, count: int) -> Radiance:
    """Draw ``count`` standard normal deviates by pairs [1] of the generator's words, (count,) float32, at most 6.8.

    [1] Box, Muller, "A note on the generation of random normal deviates", Ann. Math. Stat. 29, 1958.
           doi:10.1214/aoms/1177706645
    """
    from spectralzoom.pipeline.simulator import compiled_loops

    drawn = np.empty(count + count % 2, np.float32)
    compiled_loops.draw_pairs(rng.bit_generator.random_raw(len(drawn) // 2).view(np.uint32), PIECE, drawn)
    return drawn[:count]


def photon_counts(expected: Radiance, deviate: Radiance) -> Radiance:
    """Return exact Poisson counts: the quantile of each deviate's probability; 0 where 0 or less is expected.

    ``expected``: of any shape, finite [e-]; ``deviate``: standard normal. Returns the same shape, whole numbers (above
    2^24 as near as float32 comes). [e-]
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
    """Return nearly Poisson counts: mean, variance and third cumulant are right; for `least_expected` on.

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

    These are the leading terms of its Gram-Charlier expansion, c2^2 / 2 + c4^2 / 24. Here c2 and c4 are the differences
    of variance and fourth cumulant over the standard deviation. Without read noise that is 1 / (216 expected^2).
    """
    variance = np.maximum(expected + read_noise_e**2, np.finfo(float).tiny)
    fraction = expected / variance
    fourth = fraction / variance * (1 - 4 / 3 * fraction)
    second = fraction**2 / (18 * variance) if read_noise_e else 0.0
    return np.asarray(second**2 / 2 + fourth**2 / 24, np.float64)


@lru_cache
def least_expected(read_noise_e: float) -> float:
    """Return from how many expected electrons on cheap draws may stand for exact ones; 0 is at any light.

    From there on, patches of `CHIP_SAMPLES` differ by a total variation of sqrt(N divergence) / 2 <= `MOST_VARIATION`.
    """
    levels = np.geomspace(1e-3, 1e6, 4096)
    too_far = divergence(levels, read_noise_e) * CHIP_SAMPLES > (2 * MOST_VARIATION) ** 2
    return float(levels[min(np.flatnonzero(too_far)[-1] + 1, len(levels) - 1)]) if too_far.any() else 0.0


def chip_variation(read_noise_e: float) -> float:
    """Return the greatest total variation between a patch of cheap numbers, where these are used, and an exact one."""
    levels = np.geomspace(max(least_expected(read_noise_e), 1e-3), 1e6, 4096)
    return float(np.sqrt(CHIP_SAMPLES * divergence(levels, read_noise_e).max()) / 2)


def separable(sd: float, other: float) -> float:
    """Return twice the total variation of two normal distributions of one mean, by their deviations: 0 to 2.

    Their densities cross at x^2 = 2 ln(a / b) / (1 / b^2 - 1 / a^2).
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
    """Return the Poisson quantile at Phi(z) for means from `SERIES_FROM_E` on.

    It is floor(x) where Gamma(x, mean) / Gamma(x) = Phi(z), with x expanded in 1 / sqrt(mean) [1]. If x comes as near
    to a whole number as the expansion may err, the distribution itself is asked.

    [1] Giles, "Algorithm 955: approximation of the inverse Poisson cumulative distribution function", ACM Trans. Math.
    Softw. 42, 2016. doi:10.1145/2699466
    """
    root = np.sqrt(mean)
    square = z * z
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
    """Return the Poisson quantile at Phi(z) for small means: the number of cumulative probabilities below it."""
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


REACH = 6.0  # deviations of the noise that the brightest sample may lie above its mean
EXACT, GAUSSIAN = "exact", "gaussian"
Mask = NDArray[np.bool_]


class DarkCurrent(Effect):
    """Electrons that warmth sets free, as many in every element; they take part in the shot noise."""

    name = "dark-current"
    cost_ns = MappingProxyType({"exact": 0.1})

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound it where least noise hides it: its mean, and what its spread adds to the noise."""
        electrons = dark_electrons(rig)
        if electrons == 0:
            return Bound(0.0, "the sensor has none")
        sd = float(np.hypot(rig.camera.read_noise_e, np.sqrt(max(probe.darkest_e, 0.0))))
        spread = separable(float(np.hypot(sd, np.sqrt(electrons))), sd)
        if probe.unit == "dn":
            spread *= float(np.hypot(sd, np.sqrt(electrons))) / rig.camera.electrons_per_dn
        why = f"{electrons:.3g} e- in {rig.camera.exposure_ms:g} ms, beside {sd:.3g} e- of noise"
        return Bound(probe.added(electrons, rig.camera.electrons_per_dn) + spread, why)


def dark_electrons(rig: Rig) -> float:
    """Return the expected dark electrons of one exposure in a sound element; 0 in an ideal sensor. [e-]"""
    if rig.detector.noiseless:
        return 0.0
    return rig.detector.dark_e_per_s * (rig.camera.exposure_ms * 1e-3)


class Defects(Effect):
    """Dead elements gather no light; hot ones add electrons, with their shot noise. An element may be both."""

    name = "defects"
    cost_ns = MappingProxyType({"exact": 0.3})

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound it by the greatest signal of bands with dead elements, and the electrons of hot ones."""
        bands = len(probe.wavelength_nm)
        dead, hot = dead_elements(rig, bands), hot_electrons(rig, bands)
        if not (dead.any() or hot.any()):
            return Bound(0.0, "no element is dead or hot")
        lost = probe.scaled(dead.any(axis=0).astype(np.float64))
        electrons = float(hot.max())
        gained = min(electrons, rig.camera.full_scale_e)  # the converter's end
        why = f"{dead.sum()} dead and {(hot > 0).sum()} hot elements of {dead.size}, these with {electrons:.3g} e- more"
        return Bound(max(lost, probe.added(gained, rig.camera.electrons_per_dn) if gained else 0.0), why)


def dead_elements(rig: Rig, bands: int) -> Mask:
    """Return the elements without response, (sample, band) of the whole camera."""
    return _mask(rig.detector.unit, "dead", rig.camera.samples, bands, fraction=rig.detector.dead_fraction)


def hot_electrons(rig: Rig, bands: int) -> Radiance:
    """Return the electrons that hot elements add in one exposure, (sample, band) of the whole camera [e-]."""
    mask = _mask(rig.detector.unit, "hot", rig.camera.samples, bands, fraction=rig.detector.hot_fraction)
    return mask * np.float32(most_hot_electrons(rig))


def most_hot_electrons(rig: Rig) -> float:
    """Return the electrons that a hot element adds in one exposure [e-]; 0 where the sensor has none, or is ideal."""
    detector = rig.detector
    if detector.noiseless or not detector.hot_fraction:
        return 0.0
    return detector.hot_e_per_s * rig.camera.exposure_ms * 1e-3


@lru_cache(maxsize=8)
def _mask(unit: int, kind: str, samples: int, bands: int, *, fraction: float) -> Mask:
    mask: Mask = np.ascontiguousarray((stream_of(unit, kind).random((bands, samples)) < fraction).T)
    mask.setflags(write=False)
    return mask


class Saturation(Effect):
    """Light above the converter's full scale is lost: raw lines are numbers of so many bits, also where it is off."""

    name = "saturation"
    cost_ns = MappingProxyType({"exact": 0.1})

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound it by how far the brightest sample, 6 deviations up, reaches above full scale."""
        camera = rig.camera
        limit = camera.full_scale_e
        expected = max(probe.brightest_e, 0.0) + dark_electrons(rig) + most_hot_electrons(rig)
        sd = 0.0 if rig.detector.noiseless else float(np.hypot(np.sqrt(expected), camera.read_noise_e))
        over = max(expected + REACH * sd - limit, 0.0)
        if over == 0:
            return Bound(0.0, f"{expected:.3g} e- and 6 x {sd:.3g} e- of noise stay below {limit:.3g} e-")
        why = f"{expected:.3g} e- and 6 x {sd:.3g} e- of noise reach {over:.3g} e- above the limit of {limit:.3g} e-"
        return Bound(probe.added(over, camera.electrons_per_dn), why)


class Shot(Effect):
    """Poisson counts. ``gaussian`` has their first three cumulants, and takes the read noise into the same draw.

    It is exact where a patch of so few expected electrons could be told from an exact one. Noise counts as `separable`.
    """

    name = "shot"
    cost_ns = MappingProxyType({EXACT: 10.0, GAUSSIAN: 3.9})  # of light above `SERIES_FROM_E`

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound it at the brightest sample, where it is the greatest fraction of all noise."""
        brightest = max(probe.brightest_e, 0.0) + dark_electrons(rig) + most_hot_electrons(rig)
        if rig.detector.noiseless:
            return Bound(0.0, "the sensor is ideal")
        if brightest == 0:
            return Bound(0.0, "no electrons are expected")
        read = rig.camera.read_noise_e
        total = float(np.hypot(np.sqrt(brightest), read))
        if variant == GAUSSIAN:
            worst = max(chip_variation(0.0), chip_variation(read))
            apart = 2 * worst / np.sqrt(CHIP_SAMPLES)  # for one sample: 2 TV <= sqrt(divergence)
            return Bound(
                in_unit(apart, total, probe, rig),
                f"{CHIP_SAMPLES:.0e} numbers have a total variation of at most {worst:.2g} from exact ones"
                f" (limit {MOST_VARIATION:.2g}); exact below {least_expected(read):.3g} e-, without read noise"
                f" {least_expected(0.0):.3g} e-",
            )
        why = f"{total:.3g} e- of noise at {brightest:.3g} e-, {read:.3g} e- without"
        return Bound(in_unit(separable(total, read), total, probe, rig), why)


def in_unit(deviations: float, sd_e: float, probe: Probe, rig: Rig) -> float:
    """Return deviations of a noise of ``sd_e`` in each sample [e-] in the unit of the probe."""
    return deviations if probe.unit == "sigma" else deviations * sd_e / rig.camera.electrons_per_dn


class ReadNoise(Effect):
    """Normal noise of the camera's deviation; one draw with shot noise where that is not exact. See `separable`."""

    name = "read-noise"
    cost_ns = MappingProxyType({"exact": 0.0})  # 3.2 where shot noise is exact or off

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound it at the darkest sample, where it is the greatest fraction of all noise."""
        read = rig.camera.read_noise_e
        if rig.detector.noiseless:
            return Bound(0.0, "the sensor is ideal")
        if read == 0:
            return Bound(0.0, "the camera has none")
        shot = float(np.sqrt(max(probe.darkest_e, 0.0)))
        total = float(np.hypot(shot, read))
        why = f"{read:.3g} e- beside at least {shot:.3g} e- of shot noise make {total:.3g} e-"
        return Bound(in_unit(separable(total, shot), total, probe, rig), why)


class Quantisation(Effect):
    """Rounding half to even. Raw lines are whole numbers, so it is never left out."""

    name = "quantisation"
    cost_ns = MappingProxyType({"exact": 0.4})

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        value = probe.added(0.5 * rig.camera.electrons_per_dn, rig.camera.electrons_per_dn)
        return Bound(value, f"0.5 DN of {rig.camera.electrons_per_dn:g} e-")


DARK_CURRENT, DEFECTS, SHOT = DarkCurrent(), Defects(), Shot()
READ_NOISE, SATURATION, QUANTISATION = ReadNoise(), Saturation(), Quantisation()
READOUT: tuple[Effect, ...] = (DARK_CURRENT, DEFECTS, SHOT, READ_NOISE, SATURATION, QUANTISATION)
