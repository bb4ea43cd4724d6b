"""All effects that the simulator knows, in the order of the chain."""

from __future__ import annotations

from types import MappingProxyType

from pipeline.simulator.effects.aberration import ABERRATION
from pipeline.simulator.effects.absorption import ABSORPTION
from pipeline.simulator.effects.brdf import BRDF
from pipeline.simulator.effects.cloud import CLOUD
from pipeline.simulator.effects.dark_current import DARK_CURRENT
from pipeline.simulator.effects.defects import DEFECTS
from pipeline.simulator.effects.defocus import DEFOCUS
from pipeline.simulator.effects.diffraction import DIFFRACTION
from pipeline.simulator.effects.drift import DRIFT
from pipeline.simulator.effects.effect import Effect
from pipeline.simulator.effects.fixed_pattern import PRNU, STRIPING
from pipeline.simulator.effects.hysteresis import HYSTERESIS, THERMAL_DRIFT
from pipeline.simulator.effects.jitter import JITTER
from pipeline.simulator.effects.keystone import KEYSTONE
from pipeline.simulator.effects.lag import LAG
from pipeline.simulator.effects.parallax import PARALLAX
from pipeline.simulator.effects.path_radiance import PATH_RADIANCE
from pipeline.simulator.effects.polarisation import POLARISATION
from pipeline.simulator.effects.quantisation import QUANTISATION
from pipeline.simulator.effects.read_noise import READ_NOISE
from pipeline.simulator.effects.response import RESPONSE
from pipeline.simulator.effects.rotation import ROTATION
from pipeline.simulator.effects.saturation import SATURATION
from pipeline.simulator.effects.shot import SHOT
from pipeline.simulator.effects.slit import SLIT
from pipeline.simulator.effects.smear import SMEAR
from pipeline.simulator.effects.smile import SMILE
from pipeline.simulator.effects.staircase import STAIRCASE
from pipeline.simulator.effects.stray_light import STRAY_LIGHT
from pipeline.simulator.effects.turbulence import TURBULENCE
from pipeline.simulator.effects.vignetting import VIGNETTING
from pipeline.simulator.effects.wind import WIND

AIMS: tuple[Effect, ...] = (STAIRCASE, LAG, JITTER, HYSTERESIS, THERMAL_DRIFT, TURBULENCE)
RAYS: tuple[Effect, ...] = (ROTATION, PARALLAX, WIND)
FOOTPRINT: tuple[Effect, ...] = (SLIT, SMEAR, DIFFRACTION, DEFOCUS, ABERRATION, KEYSTONE)
LIGHT: tuple[Effect, ...] = (
    DRIFT, CLOUD, BRDF, PATH_RADIANCE, ABSORPTION, RESPONSE, SMILE, VIGNETTING, POLARISATION, STRAY_LIGHT, PRNU,
    STRIPING,
)  # fmt: skip
READOUT: tuple[Effect, ...] = (DARK_CURRENT, DEFECTS, SHOT, READ_NOISE, SATURATION, QUANTISATION)

EFFECTS: tuple[Effect, ...] = (*AIMS, *RAYS, *FOOTPRINT, *LIGHT, *READOUT)
BY_NAME = MappingProxyType({effect.name: effect for effect in EFFECTS})
