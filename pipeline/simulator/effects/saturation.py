"""Saturation: wells overflow, and the converter has an end."""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from pipeline.simulator.effects.dark_current import dark_electrons
from pipeline.simulator.effects.defects import most_hot_electrons
from pipeline.simulator.effects.effect import OFF, Bound
from pipeline.simulator.probe import Probe
from pipeline.simulator.rig_model import Rig

REACH = 6.0  # deviations of the noise that the brightest sample may lie above its mean


@dataclass(frozen=True)
class Saturation:
    """What is above the well or the converter's full scale is lost. Off, the converter clips all the same.

    Raw lines are numbers of so many bits, so every line is clipped whatever a probe of a few lines found.
    """

    name = "saturation"
    variants = ("exact",)
    cost_ns = MappingProxyType({"exact": 0.1})

    def bound(self, probe: Probe, rig: Rig, variant: str = OFF) -> Bound:
        """Bound it by how far the brightest sample, 6 deviations up, reaches above the lower of both limits."""
        limit = min(rig.camera.full_well_e, rig.detector.well_e)
        camera, brightest = rig.camera, max(probe.brightest_e, 0.0)
        expected = brightest + dark_electrons(rig) + most_hot_electrons(rig)
        sd = 0.0 if rig.detector.noiseless else float(np.hypot(np.sqrt(expected), camera.read_noise_e))
        over = max(expected + REACH * sd - limit, 0.0)
        if variant != OFF:
            return Bound(0.0, "exact")
        if over == 0:
            return Bound(0.0, f"{expected:.3g} e- and 6 x {sd:.3g} e- of noise stay below {limit:.3g} e-")
        why = f"{expected:.3g} e- and 6 x {sd:.3g} e- of noise reach {over:.3g} e- above the limit of {limit:.3g} e-"
        unit_dn = probe.unit_least_dn
        if probe.unit == "sigma" and sd > 0 and not rig.detector.hot_share:  # what is lost, is lost where it is bright
            of_sample = float(np.hypot(np.sqrt(brightest), camera.read_noise_e)) / camera.electrons_per_dn
            unit_dn = of_sample / np.sqrt(probe.binning)
        return Bound(over / camera.electrons_per_dn / unit_dn, why)


SATURATION = Saturation()


def well_reached(rig: Rig, read_noise_e: float) -> bool:
    """Whether a well overflows before the converter ends, 8 deviations of the read noise counted in."""
    camera = rig.camera
    end_e = (camera.full_scale_dn + 1 - camera.dark_dn) * camera.electrons_per_dn
    return rig.detector.well_e < end_e + 8 * read_noise_e
