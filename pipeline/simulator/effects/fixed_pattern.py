"""Fixed pattern: elements of one sensor respond unevenly, each for itself (PRNU) and column by column (striping)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from pipeline.simulator.block import SweepBlock
from pipeline.simulator.effects.effect import OFF, Bound
from pipeline.simulator.gain_range import GainRange
from pipeline.simulator.noise import normal_deviates
from pipeline.simulator.probe import Probe
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.streams import unit_stream

Light = NDArray[np.float32]


@dataclass(frozen=True)
class Prnu:
    """Every element has a gain of its own, normal about 1, never below 0."""

    name = "prnu"
    variants = ("exact",)
    cost_ns = MappingProxyType({"exact": 0.2})

    def bound(self, probe: Probe, rig: Rig, variant: str = OFF) -> Bound:
        """Bound it by the greatest signal of each band times the greatest gain beside 1 that the sensor has there."""
        share = rig.detector.response_share
        if variant != OFF or share == 0:
            return Bound(0.0, "exact" if variant != OFF else "all elements respond alike")
        off = np.abs(response_gain(rig, len(probe.wavelength_nm)) - 1).max(axis=0)
        return Bound(probe.scaled(off), f"gains differ by {share:.2%} (sd), {off.max():.2%} at most")

    def gain_range(self, probe: Probe, rig: Rig) -> GainRange:
        """Give the sensor's least and greatest gain."""
        gains, bands = response_gain(rig, len(probe.wavelength_nm)), len(probe.wavelength_nm)
        least, greatest = float(gains.min(initial=1.0)), float(gains.max(initial=1.0))
        return GainRange.between(least, greatest, bands, uneven=greatest - least)

    def gain(self, block: SweepBlock, variant: str) -> Light:
        """Give the gain of each element, (1, sample, band)."""
        return response_gain(block.rig, len(block.wavelength_nm))[None, block.columns]


@dataclass(frozen=True)
class Striping:
    """All bands of a sample share a gain, normal about 1, never below 0: stripes along the scan."""

    name = "striping"
    variants = ("exact",)
    cost_ns = MappingProxyType({"exact": 0.2})

    def bound(self, probe: Probe, rig: Rig, variant: str = OFF) -> Bound:
        """Bound it by the greatest signal times the greatest gain beside 1 that the sensor has."""
        share = rig.detector.stripe_share
        if variant != OFF or share == 0:
            return Bound(0.0, "exact" if variant != OFF else "all columns respond alike")
        off = float(np.abs(stripe_gain(rig) - 1).max())
        return Bound(probe.scaled(off), f"gains of columns differ by {share:.2%} (sd), {off:.2%} at most")

    def gain_range(self, probe: Probe, rig: Rig) -> GainRange:
        """Give the sensor's least and greatest gain."""
        gains, bands = stripe_gain(rig), len(probe.wavelength_nm)
        least, greatest = float(gains.min(initial=1.0)), float(gains.max(initial=1.0))
        return GainRange.between(least, greatest, bands, uneven=greatest - least)

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


@lru_cache(maxsize=8)
def _gains(unit: int, kind: str, samples: int, bands: int, *, share: float) -> Light:
    """Gains band by band, each out of draws of its own: more bands keep those there were."""
    stream = unit_stream(unit, kind)
    drawn = np.stack([normal_deviates(stream, samples) for _ in range(bands)], axis=1)
    gains: Light = np.maximum(1 + np.float32(share) * drawn, 0)
    gains.setflags(write=False)
    return gains
