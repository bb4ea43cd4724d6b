"""How lines may come to lie turned, and what the probe says of footprints that do not turn with them."""

from __future__ import annotations

import math

from pipeline.simulator.effects.lag import greatest_lag_px
from pipeline.simulator.effects.turbulence import turbulence_px
from pipeline.simulator.probe import Probe
from pipeline.simulator.rig_model import Rig

MARGIN = 1.5  # over what the probe measured at the roughest places found
UPRIGHT = "1x1"  # the slit's variant of one box that does not lie turned
_RAY_PER_TILT = 2.6  # a ray turns by twice the tilt; the scene plane is oblique to it by up to 30 deg


def beside_plan_px(probe: Probe, rig: Rig) -> tuple[float, float]:
    """Give how far beside its plan the rig may look by drift, hysteresis, jitter, turbulence and lag. [px]

    Along the line and the scan. Lines lie turned by where the mirror looks: the farther from the middle, the more.
    """
    mirror, lines = rig.mirror, max(probe.lines, 1)
    drift = mirror.drift_px_per_min / 60 * (probe.seconds + rig.camera.frame_ms * 1e-3)
    jitter = _RAY_PER_TILT * mirror.repeatability_urad * 1e-6 / rig.camera.ifov_rad
    drawn = (jitter + turbulence_px(rig)) * math.sqrt(2 * math.log(lines / 1e-3))
    way = drift + mirror.hysteresis_px + drawn
    return way, way + greatest_lag_px(rig, probe.sweeps)
