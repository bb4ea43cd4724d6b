"""Elements of one sensor: dark current, defects, and gains of their own (fixed pattern)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from pipeline.simulator.block import SweepBlock, unit_stream
from pipeline.simulator.effects.effect import Bound, Effect, Gain
from pipeline.simulator.effects.gain_range import GainRange
from pipeline.simulator.effects.noise import normal_deviates, told_apart
from pipeline.simulator.effects.probe import Probe
from pipeline.simulator.rig_model import Rig

REFERENCE_DEG_C = 25.0
ZERO_DEG_C_K = 273.15
BOLTZMANN_EV_PER_K = 8.617333e-5
Light = NDArray[np.float32]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class DarkCurrent(Effect):
    """Electrons that warmth sets free, as many in every element; they take part in the shot noise.

    References
    ----------
    .. [1] Janesick, "Scientific Charge-Coupled Devices", SPIE Press, 2001: dark current of a depleted sensor goes with
       T^1.5 exp(-Eg / 2kT), and Eg by Varshni's formula.
    .. [2] Widenhorn, Blouke, Weber, Rest and Bodegom, "Temperature dependence of dark current in a CCD", Proceedings of
       SPIE 4669, 2002. doi:10.1117/12.463446
    """

    name = "dark-current"
    cost_ns = MappingProxyType({"exact": 0.1})

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound it where least noise hides it: its mean, and what its spread adds to the noise."""
        electrons = dark_electrons(rig)
        if electrons == 0:
            return Bound(0.0, "the sensor has none")
        sd = float(np.hypot(rig.camera.read_noise_e, np.sqrt(max(probe.darkest_e, 0.0))))
        spread = told_apart(float(np.hypot(sd, np.sqrt(electrons))), sd)
        if probe.unit == "dn":
            summed = float(np.sqrt(probe.binning))  # the spread of a sum over that of a sample
            spread *= summed * float(np.hypot(sd, np.sqrt(electrons))) / rig.camera.electrons_per_dn
        warm = rig.detector.temperature_deg_c
        why = f"{electrons:.3g} e- in {rig.camera.exposure_ms:g} ms at {warm:g} deg C, beside {sd:.3g} e- of noise"
        return Bound(probe.added(electrons, rig.camera.electrons_per_dn) + spread, why)


DARK_CURRENT = DarkCurrent()


def warmth(temperature_deg_c: float) -> float:
    """By how much more dark current flows than at 25 deg C, where the rig's numbers are stated.

    Electrons set free in silicon's depleted layer [1]: twice as many 8.4 deg C above 25, and 3.6 deg C above -80. Valid
    from -80 to 50 deg C, which settings are held to: in warmer sensors current that diffuses from the bulk takes over,
    which goes with the whole gap instead of half of it [2], and sensors differ in how much of it they collect.
    """
    return math.exp(_log_generation(temperature_deg_c) - _log_generation(REFERENCE_DEG_C))


def band_gap_ev(kelvin: float) -> float:
    """Silicon's band gap by Varshni's formula with the constants of [1]. [eV]"""
    return 1.1557 - 7.021e-4 * kelvin**2 / (1108 + kelvin)


def _log_generation(temperature_deg_c: float) -> float:
    kelvin = temperature_deg_c + ZERO_DEG_C_K
    return 1.5 * math.log(kelvin) - band_gap_ev(kelvin) / (2 * BOLTZMANN_EV_PER_K * kelvin)


def dark_electrons(rig: Rig) -> float:
    """Give the expected dark electrons of one exposure in a sound element; 0 in an ideal sensor. [e-]"""
    if rig.detector.noiseless:
        return 0.0
    seconds = rig.camera.exposure_ms * 1e-3
    return rig.detector.dark_e_per_s * seconds * warmth(rig.detector.temperature_deg_c)


@dataclass(frozen=True)
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
        gained = min(electrons, rig.camera.full_well_e)  # the converter's end
        why = f"{dead.sum()} dead and {(hot > 0).sum()} hot elements of {dead.size}, these with {electrons:.3g} e- more"
        added = probe.added(gained, rig.camera.electrons_per_dn) if gained else 0.0
        return Bound(max(lost, added), why)


DEFECTS = Defects()


def dead_elements(rig: Rig, bands: int) -> Mask:
    """Give the elements without response, (sample, band) of the whole camera."""
    return _mask(rig.detector.unit, "dead", rig.camera.samples, bands, share=rig.detector.dead_share)


def hot_electrons(rig: Rig, bands: int) -> Light:
    """Give what hot elements add in one exposure, (sample, band) of the whole camera. [e-]"""
    detector = rig.detector
    mask = _mask(detector.unit, "hot", rig.camera.samples, bands, share=detector.hot_share)
    return mask * np.float32(most_hot_electrons(rig))


def most_hot_electrons(rig: Rig) -> float:
    """Give what a hot element adds in one exposure; 0 where the sensor has none, or is ideal. [e-]"""
    detector = rig.detector
    if detector.noiseless or not detector.hot_share:
        return 0.0
    return detector.hot_e_per_s * rig.camera.exposure_ms * 1e-3 * warmth(detector.temperature_deg_c)


@lru_cache(maxsize=8)
def _mask(unit: int, kind: str, samples: int, bands: int, *, share: float) -> Mask:
    """Elements below a share of uniform draws, band by band: more bands or a larger share keep those there were."""
    below = unit_stream(unit, kind).random((bands, samples)) < share
    mask: Mask = np.ascontiguousarray(below.T)
    mask.setflags(write=False)
    return mask


@dataclass(frozen=True)
class Prnu(Gain):
    """Every element has a gain of its own, normal about 1, never below 0."""

    name = "prnu"
    cost_ns = MappingProxyType({"exact": 0.2})

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound it by the greatest signal of each band times the greatest gain beside 1 that the sensor has there."""
        share = rig.detector.response_share
        if share == 0:
            return Bound(0.0, "all elements respond alike")
        off = np.abs(response_gain(rig, len(probe.wavelength_nm)) - 1).max(axis=0)
        return Bound(probe.scaled(off), f"gains differ by {share:.2%} (sd), {off.max():.2%} at most")

    def gain_range(self, probe: Probe, rig: Rig) -> GainRange:
        """Give the sensor's least and greatest gain."""
        return _range_of(response_gain(rig, len(probe.wavelength_nm)), probe)

    def gain(self, block: SweepBlock, variant: str) -> Light:
        """Give the gain of each element, (1, sample, band)."""
        return response_gain(block.rig, len(block.wavelength_nm))[None, block.columns]


@dataclass(frozen=True)
class Striping(Gain):
    """All bands of a sample share a gain, normal about 1, never below 0: stripes along the scan."""

    name = "striping"
    cost_ns = MappingProxyType({"exact": 0.2})

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound it by the greatest signal times the greatest gain beside 1 that the sensor has."""
        share = rig.detector.stripe_share
        if share == 0:
            return Bound(0.0, "all columns respond alike")
        off = float(np.abs(stripe_gain(rig) - 1).max())
        return Bound(probe.scaled(off), f"gains of columns differ by {share:.2%} (sd), {off:.2%} at most")

    def gain_range(self, probe: Probe, rig: Rig) -> GainRange:
        """Give the sensor's least and greatest gain."""
        return _range_of(stripe_gain(rig), probe)

    def gain(self, block: SweepBlock, variant: str) -> Light:
        """Give the gain of each column, (1, sample, 1)."""
        return stripe_gain(block.rig)[None, block.columns]


PRNU = Prnu()

STRIPING = Striping()


def response_gain(rig: Rig, bands: int) -> Light:
    """Give the gains of the sensor's elements, (sample, band) of the whole camera."""
    return _gains(rig.detector.unit, "prnu", rig.camera.samples, bands, share=rig.detector.response_share)


def stripe_gain(rig: Rig) -> Light:
    """Give the gains of the sensor's columns, (sample, 1) of the whole camera."""
    return _gains(rig.detector.unit, "striping", rig.camera.samples, 1, share=rig.detector.stripe_share)


def _range_of(gains: Light, probe: Probe) -> GainRange:
    least, greatest = float(gains.min(initial=1.0)), float(gains.max(initial=1.0))
    return GainRange.between(least, greatest, len(probe.wavelength_nm), uneven=greatest - least)


@lru_cache(maxsize=8)
def _gains(unit: int, kind: str, samples: int, bands: int, *, share: float) -> Light:
    """Gains band by band, each out of draws of its own: more bands keep those there were."""
    stream = unit_stream(unit, kind)
    drawn = np.stack([normal_deviates(stream, samples) for _ in range(bands)], axis=1)
    gains: Light = np.maximum(1 + np.float32(share) * drawn, 0)
    gains.setflags(write=False)
    return gains
