"""Aberration: what the lens itself blurs, as a Gaussian of one width in all bands and both directions."""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from pipeline.simulator.effects.blurring import blurred_bound, even
from pipeline.simulator.effects.effect import OFF, Bound, Moments
from pipeline.simulator.probe import Probe
from pipeline.simulator.rig_model import Rig

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Aberration:
    """Blur of ``optics.aberration_px`` standard deviation."""

    name = "aberration"
    variants = ("gaussian",)
    cost_ns = MappingProxyType({"gaussian": 0.3})

    def moments(self, rig: Rig, wavelength_nm: Floats, variant: str, normal: Floats | None = None) -> Moments:
        """Give the blur, equal in all bands."""
        return even(np.full(2, rig.optics.aberration_px**2), len(wavelength_nm))

    def bound(self, probe: Probe, rig: Rig, variant: str = OFF) -> Bound:
        """Bound the error of no blur."""
        if variant != OFF:
            return Bound(0.0, "exact")
        return blurred_bound(probe, self.moments(rig, probe.wavelength_nm, variant).variance, "blur of the lens")


ABERRATION = Aberration()
