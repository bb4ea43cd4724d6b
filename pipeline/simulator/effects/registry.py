"""All effects that the simulator knows, in the order of the chain, and the usual ones."""

from __future__ import annotations

from types import MappingProxyType

from pipeline.errors import SettingsError
from pipeline.simulator.effects.air import PARALLAX, TURBULENCE, WIND
from pipeline.simulator.effects.blurs import ABERRATION, DEFOCUS, DIFFRACTION, KEYSTONE
from pipeline.simulator.effects.counting import (
    DARK_CURRENT,
    DEFECTS,
    GAUSSIAN,
    QUANTISATION,
    READ_NOISE,
    SATURATION,
    SHOT,
)
from pipeline.simulator.effects.effect import Effect
from pipeline.simulator.effects.haze import ABSORPTION, PATH_RADIANCE
from pipeline.simulator.effects.lighting import BRDF, CLOUD, DRIFT
from pipeline.simulator.effects.line import FOLDED, ROTATION, SLIT, SMEAR
from pipeline.simulator.effects.mirror_path import LAG, STAIRCASE
from pipeline.simulator.effects.mirror_throughput import POLARISATION, VIGNETTING
from pipeline.simulator.effects.pointing import HYSTERESIS, JITTER, THERMAL_DRIFT
from pipeline.simulator.effects.sensor import PRNU, STRAY_LIGHT, STRIPING
from pipeline.simulator.effects.spectrometer import RESPONSE, SMILE
from pipeline.simulator.render import Choice

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
# Of any camera behind a mirror, without noise and with; cheap: beside exact ones a farm changes by .015 sigma at most.
QUIET = Choice.of({ROTATION: "rays", SLIT: "3x1", SMEAR: FOLDED, VIGNETTING: "held"})
USUAL = Choice((*QUIET.effects, (SHOT, GAUSSIAN), (READ_NOISE, "exact")))


def effects_on(*names: str) -> Choice:
    """Give effects by their names, in the order of the chain: exact ones, but for shot noise, which is cheap.

    Cheap shot noise may stand for the exact one: see `counting.Shot`.

    Raises SettingsError: there is no such effect.
    """
    unknown = sorted(set(names) - set(BY_NAME))
    if unknown:
        raise SettingsError(f"unknown effects {unknown}; choose from {', '.join(BY_NAME)}")
    return Choice(tuple((one, GAUSSIAN if one is SHOT else one.variants[0]) for one in EFFECTS if one.name in names))
