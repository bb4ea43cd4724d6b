"""Dark current: electrons that warmth sets free, with their own shot noise."""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from pipeline.simulator.effects.effect import OFF, Bound
from pipeline.simulator.noise import told_apart
from pipeline.simulator.probe import Probe
from pipeline.simulator.rig_model import Rig

REFERENCE_DEG_C = 25.0
DOUBLES_DEG_C = 7.0  # of silicon: simulation.md 4.2


@dataclass(frozen=True)
class DarkCurrent:
    """As many electrons in every element; they take part in the shot noise."""

    name = "dark-current"
    variants = ("exact",)
    cost_ns = MappingProxyType({"exact": 0.1})

    def bound(self, probe: Probe, rig: Rig, variant: str = OFF) -> Bound:
        """Bound it where least noise hides it: its mean, and what its spread adds to the noise."""
        electrons = dark_electrons(rig)
        if variant != OFF or electrons == 0:
            return Bound(0.0, "exact" if variant != OFF else "the sensor has none")
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
    """By how much more dark current flows than at 25 deg C: twice as much every 7 deg C."""
    return float(2 ** ((temperature_deg_c - REFERENCE_DEG_C) / DOUBLES_DEG_C))


def dark_electrons(rig: Rig) -> float:
    """Give the expected dark electrons of one exposure in a sound element; 0 in an ideal sensor. [e-]"""
    if rig.detector.noiseless:
        return 0.0
    seconds = rig.camera.exposure_ms * 1e-3
    return rig.detector.dark_e_per_s * seconds * warmth(rig.detector.temperature_deg_c)
