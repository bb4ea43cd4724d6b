"""Keystone: the spectrograph images a line longer at one wavelength than at another, here as a shift along the line.

Sign: at the last wavelength a sample sees the scene ``keystone_px / 2`` further along the line (towards higher sample
numbers) than the mirror model says, at the first as much less far; so a red image lies at lower sample numbers than a
blue one. The shift is linear from 400 to 1000 nm, whatever bands the scene has of these, and stays at its ends beyond.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from pipeline.simulator.effects.blurring import UNITS
from pipeline.simulator.effects.diffraction import AIRY, DIFFRACTION
from pipeline.simulator.effects.effect import OFF, Bound, Merged, Moments
from pipeline.simulator.probe import Probe
from pipeline.simulator.rig_model import Rig

Floats = NDArray[np.float64]

FIRST_NM, LAST_NM = 400.0, 1000.0  # of the spectrograph


@dataclass(frozen=True)
class Keystone:
    """Shift of the footprint along the line, of its own in each band."""

    name = "keystone"
    variants = ("linear",)
    cost_ns = MappingProxyType({"linear": 2.6})

    def merged(self, rig: Rig) -> Merged:
        """Give what it costs beside diffraction, whose several widths have to be shifted each."""
        return Merged(DIFFRACTION.name, AIRY, 5.6)

    def moments(self, rig: Rig, wavelength_nm: Floats, variant: str, normal: Floats | None = None) -> Moments:
        """Give the shift of each band."""
        shift = np.zeros((2, len(wavelength_nm)))
        shift[0] = keystone_shift(rig, wavelength_nm)
        return Moments(shift, np.zeros_like(shift))

    def bound(self, probe: Probe, rig: Rig, variant: str = OFF) -> Bound:
        """Bound the error of no shift: slope along the line times shift, never more than the span, band by band."""
        if variant != OFF:
            return Bound(0.0, "exact")
        shift = np.abs(keystone_shift(rig, probe.wavelength_nm))
        change = np.minimum(probe.slope[0] * shift, probe.span)
        if not shift.any():
            return Bound(0.0, "no shift along the line")
        band = int(np.argmax(change))
        return Bound(
            float(change[band]),
            f"{shift[band]:.2g} px along the line at {probe.wavelength_nm[band]:.0f} nm,"
            f" on edges of at most {probe.slope[0, band]:.3g} {UNITS[probe.unit]}/px",
        )


KEYSTONE = Keystone()


def keystone_shift(rig: Rig, wavelength_nm: Floats) -> Floats:
    """Give how far along the line each band sees beside the mirror model's place, (band,) from -k/2 to k/2. [px]"""
    share = (np.asarray(wavelength_nm, np.float64) - FIRST_NM) / (LAST_NM - FIRST_NM)
    shift: Floats = rig.optics.keystone_px * (np.clip(share, 0.0, 1.0) - 0.5)
    return shift
