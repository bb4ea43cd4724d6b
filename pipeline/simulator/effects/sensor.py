"""Light on the detector: gains of its elements and columns (fixed pattern), and stray light over all of a line."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from pipeline.simulator.effects.effect import Bound, Gain, LightChange, SweepBlock, unit_stream
from pipeline.simulator.effects.noise import normal_deviates
from pipeline.simulator.effects.probe import GainRange, Probe
from pipeline.simulator.rig_model import Optics, Rig

Radiance = NDArray[np.float32]
LEAST_MODE = 1e-8  # of a wide Gaussian's cosines; fainter ones are below float32


@dataclass(frozen=True)
class Prnu(Gain):
    """Every element has a gain of its own, normal about 1, never below 0."""

    name = "prnu"
    cost_ns = MappingProxyType({"exact": 0.2})

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound it by the greatest signal of each band times the greatest gain beside 1 that the sensor has there."""
        fraction = rig.detector.prnu_std
        if fraction == 0:
            return Bound(0.0, "all elements respond alike")
        off = np.abs(response_gain(rig, len(probe.wavelength_nm)) - 1).max(axis=0)
        return Bound(probe.scaled(off), f"gains differ by {fraction:.2%} (sd), {off.max():.2%} at most")

    def gain_range(self, probe: Probe, rig: Rig) -> GainRange:
        return _range_of(response_gain(rig, len(probe.wavelength_nm)), probe)

    def gain(self, block: SweepBlock, variant: str) -> Radiance:
        return response_gain(block.rig, len(block.wavelength_nm))[None]


@dataclass(frozen=True)
class Striping(Gain):
    """All bands of a sample share a gain, normal about 1, never below 0: stripes along the scan."""

    name = "striping"
    cost_ns = MappingProxyType({"exact": 0.2})

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound it by the greatest signal times the greatest gain beside 1 that the sensor has."""
        fraction = rig.detector.striping_std
        if fraction == 0:
            return Bound(0.0, "all columns respond alike")
        off = float(np.abs(stripe_gain(rig) - 1).max())
        return Bound(probe.scaled(off), f"gains of columns differ by {fraction:.2%} (sd), {off:.2%} at most")

    def gain_range(self, probe: Probe, rig: Rig) -> GainRange:
        return _range_of(stripe_gain(rig), probe)

    def gain(self, block: SweepBlock, variant: str) -> Radiance:
        return stripe_gain(block.rig)[None]


def response_gain(rig: Rig, bands: int) -> Radiance:
    """Give the gains of the sensor's elements, (sample, band) of the whole camera."""
    return _gains(rig.detector.unit, "prnu", rig.camera.samples, bands, fraction=rig.detector.prnu_std)


def stripe_gain(rig: Rig) -> Radiance:
    """Give the gains of the sensor's columns, (sample, 1) of the whole camera."""
    return _gains(rig.detector.unit, "striping", rig.camera.samples, 1, fraction=rig.detector.striping_std)


def _range_of(gains: Radiance, probe: Probe) -> GainRange:
    least, greatest = float(gains.min(initial=1.0)), float(gains.max(initial=1.0))
    return GainRange.between(least, greatest, len(probe.wavelength_nm), uneven=greatest - least)


@lru_cache(maxsize=8)
def _gains(unit: int, kind: str, samples: int, bands: int, *, fraction: float) -> Radiance:
    stream = unit_stream(unit, kind)
    drawn = np.stack([normal_deviates(stream, samples) for _ in range(bands)], axis=1)
    gains: Radiance = np.maximum(1 + np.float32(fraction) * drawn, 0)
    gains.setflags(write=False)
    return gains


@dataclass(frozen=True)
class StrayLight(LightChange):
    """A fraction of all the light in a line is scattered over its detector: (1 - f) S + f K S. A band is a row.

    Of it ``stray_even`` falls evenly, the rest as a Gaussian ``stray_halo_px`` wide (sd), reflected at the detector's
    edges. K has no weight below 0 and keeps all light.

    The Gaussian passes only the slowest cosines of a frame, so it is a product with few of them.
    """

    name = "stray-light"
    cost_ns = MappingProxyType({"halo": 1.2})

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound it by f (S - mean), were all to fall evenly, and what the halo differs from that."""
        optics = rig.optics
        if optics.stray_fraction == 0:
            return Bound(0.0, "no light is scattered")
        spread = float(np.max(probe.spread, initial=0))
        halo = optics.stray_fraction * (1 - optics.stray_even) * _most_halo(probe, rig, spread)
        why = f"{optics.stray_fraction:.2g} of a line's light, signals up to {spread:.3g} {probe.unit} from its mean"
        return Bound(optics.stray_fraction * spread + halo, why)

    def change(self, light: Radiance, block: SweepBlock, variant: str) -> Radiance:
        """Give the light after scattering; works in place."""
        optics = block.rig.optics
        if optics.stray_fraction == 0:
            return light
        for line in light:  # line by line: rounding, too, does not depend on the block
            scattered = _scattered(line, optics)
            line *= np.float32(1 - optics.stray_fraction)
            line += scattered
        return light


def _most_halo(probe: Probe, rig: Rig, spread: float) -> float:
    """Bound |H - mean| over the unit at any sample, H the halo's own light.

    It is at most the light that the kernel takes elsewhere than an even one would, times the range of signals: the
    brightest less the darkest, and never more than twice the greatest way from the mean. That is ``spread`` units,
    each no more than the unit at the brightest sample.
    """
    elsewhere = _uneven_fraction((rig.camera.samples, len(probe.wavelength_nm)), rig.optics.stray_halo_px)
    per_dn = rig.camera.electrons_per_dn
    range_e, least_e = max(probe.brightest_e - probe.darkest_e, 0.0), probe.unit_least_dn * per_dn
    most = math.sqrt(1 + range_e / (probe.binning * least_e**2)) if probe.unit == "sigma" else 1.0
    return min(elsewhere * probe.added(range_e, per_dn), min(2 * elsewhere, 1) * spread * most)


@lru_cache(maxsize=16)
def _uneven_fraction(counts: tuple[int, ...], sd_px: float) -> float:
    """Greatest fraction of a sample's halo that comes from elsewhere than if it were even: 1 narrow, 0 endless."""
    even = 1.0
    for count in counts:
        waves, passed = _cosines(count, sd_px)
        kernel = (waves.T * passed) @ waves
        even *= 1 - float(np.abs(kernel - 1 / count).sum(axis=1).max()) / 2
    return 1 - even


def _scattered(line: Radiance, optics: Optics) -> Radiance:
    """Take a frame to its slowest cosines, weaken them as the kernel f K does, and back: f K S, (sample, band)."""
    along, along_kept = _cosines(line.shape[0], optics.stray_halo_px)
    across, across_kept = _cosines(line.shape[1], optics.stray_halo_px)
    kept = np.outer(along_kept, across_kept) * (1 - optics.stray_even)
    kept[0, 0] = 1
    modes = along @ (line @ across.T) * (optics.stray_fraction * kept).astype(np.float32)
    return np.asarray((along.T @ modes) @ across)


@lru_cache(maxsize=16)
def _cosines(count: int, sd_px: float) -> tuple[Radiance, NDArray[np.float64]]:
    """Orthonormal cosines (mode, count) that a Gaussian reflected at both ends passes, and the fraction it passes."""
    passed = np.exp(-((np.pi * sd_px / count * np.arange(count)) ** 2) / 2)
    modes = np.arange(count)[passed > LEAST_MODE]
    waves = np.cos(np.pi / count * np.outer(modes, np.arange(count) + 0.5))
    waves *= np.sqrt(np.where(modes == 0, 1, 2) / count)[:, None]
    return waves.astype(np.float32), passed[modes]


PRNU, STRIPING, STRAY_LIGHT = Prnu(), Striping(), StrayLight()
