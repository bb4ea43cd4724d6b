"""Read noise: the amplifier's own, the same whatever the light."""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from pipeline.simulator.effects.effect import OFF, Bound, Merged
from pipeline.simulator.effects.saturation import well_reached
from pipeline.simulator.effects.shot import GAUSSIAN, SHOT, in_unit
from pipeline.simulator.noise import LEAST_MERGED_READ_E, told_apart
from pipeline.simulator.probe import Probe
from pipeline.simulator.rig_model import Rig


@dataclass(frozen=True)
class ReadNoise:
    """Normal, with the camera's standard deviation. In one draw with the shot noise where that is not exact.

    Noise counts twice the total variation between the distributions of a sample with and without: see `told_apart`.
    """

    name = "read-noise"
    variants = ("exact",)
    cost_ns = MappingProxyType({"exact": 3.2})

    def merged(self, rig: Rig) -> Merged | None:
        """Give what it costs in the shot noise's draw: nothing, where no well comes between them."""
        if rig.camera.read_noise_e < LEAST_MERGED_READ_E or well_reached(rig, rig.camera.read_noise_e):
            return None
        return Merged(SHOT.name, GAUSSIAN, 0.0)

    def bound(self, probe: Probe, rig: Rig, variant: str = OFF) -> Bound:
        """Bound it at the darkest sample, where it is the greatest share of all noise."""
        read = rig.camera.read_noise_e
        if rig.detector.noiseless:
            return Bound(0.0, "the sensor is ideal")
        if variant != OFF or read == 0:
            return Bound(0.0, "exact" if variant != OFF else "the camera has none")
        shot = float(np.sqrt(max(probe.darkest_e, 0.0)))
        total = float(np.hypot(shot, read))
        why = f"{read:.3g} e- beside at least {shot:.3g} e- of shot noise make {total:.3g} e-"
        return Bound(in_unit(told_apart(total, shot), total, probe, rig), why)


READ_NOISE = ReadNoise()
