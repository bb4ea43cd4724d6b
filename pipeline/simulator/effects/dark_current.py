"""Dark current: electrons that warmth sets free, with their own shot noise.

References
----------
.. [1] Janesick, "Scientific Charge-Coupled Devices", SPIE Press, 2001: dark current of a depleted sensor goes with
   T^1.5 exp(-Eg / 2kT), and Eg by Varshni's formula.
.. [2] Widenhorn, Blouke, Weber, Rest and Bodegom, "Temperature dependence of dark current in a CCD", Proceedings of
   SPIE 4669, 2002. doi:10.1117/12.463446
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from pipeline.simulator.effects.effect import OFF, Bound
from pipeline.simulator.noise import told_apart
from pipeline.simulator.probe import Probe
from pipeline.simulator.rig_model import Rig

REFERENCE_DEG_C = 25.0
ZERO_DEG_C_K = 273.15
BOLTZMANN_EV_PER_K = 8.617333e-5


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
