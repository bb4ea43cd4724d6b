"""All effects that the simulator knows, in the order of the chain."""

from __future__ import annotations

from types import MappingProxyType

from pipeline.simulator.effects.blurs import ABERRATION, DEFOCUS, DIFFRACTION, KEYSTONE
from pipeline.simulator.effects.counting import QUANTISATION, READ_NOISE, SATURATION, SHOT
from pipeline.simulator.effects.effect import Effect
from pipeline.simulator.effects.haze import ABSORPTION, PATH_RADIANCE
from pipeline.simulator.effects.lighting import BRDF, CLOUD, DRIFT
from pipeline.simulator.effects.line import ROTATION, SLIT, SMEAR
from pipeline.simulator.effects.mirror_path import LAG, STAIRCASE
from pipeline.simulator.effects.mirror_pointing import HYSTERESIS, JITTER, THERMAL_DRIFT
from pipeline.simulator.effects.mirror_throughput import POLARISATION, VIGNETTING
from pipeline.simulator.effects.moving_air import TURBULENCE, WIND
from pipeline.simulator.effects.relief import PARALLAX
from pipeline.simulator.effects.sensor import DARK_CURRENT, DEFECTS, PRNU, STRIPING
from pipeline.simulator.effects.spectrometer import RESPONSE, SMILE
from pipeline.simulator.effects.stray_light import STRAY_LIGHT

AIMS: tuple[Effect, ...] = (STAIRCASE, LAG, JITTER, HYSTERESIS, THERMAL_DRIFT, TURBULENCE)
RAYS: tuple[Effect, ...] = (ROTATION, PARALLAX, WIND)
FOOTPRINT: tuple[Effect, ...] = (SLIT, SMEAR, DIFFRACTION, DEFOCUS, ABERRATION, KEYSTONE)
LIGHT: tuple[Effect, ...] = (
    *(DRIFT, CLOUD, BRDF, PATH_RADIANCE, ABSORPTION),
    *(RESPONSE, SMILE, VIGNETTING, POLARISATION, STRAY_LIGHT, PRNU, STRIPING),
)
READOUT: tuple[Effect, ...] = (DARK_CURRENT, DEFECTS, SHOT, READ_NOISE, SATURATION, QUANTISATION)
EFFECTS: tuple[Effect, ...] = (*AIMS, *RAYS, *FOOTPRINT, *LIGHT, *READOUT)
BY_NAME = MappingProxyType({effect.name: effect for effect in EFFECTS})
