"""Defocus: a point beside the distance of focus is an image of the pupil, a disc foreshortened along the scan."""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from pipeline.simulator.effects.blurring import blurred_bound, even
from pipeline.simulator.effects.diffraction import AIRY, DIFFRACTION
from pipeline.simulator.effects.effect import OFF, Bound, Merged, Moments
from pipeline.simulator.effects.pupil import normals_met, spread_of_rays
from pipeline.simulator.probe import Probe
from pipeline.simulator.rig_model import Rig

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Defocus:
    """Blur by the distance from the plane of focus: that of ``air.distance_m`` for all of the scene."""

    name = "defocus"
    variants = ("disc",)
    cost_ns = MappingProxyType({"disc": 0.3})

    def merged(self, rig: Rig) -> Merged:
        """Give what it costs in the kernels that diffraction needs anyway."""
        return Merged(DIFFRACTION.name, AIRY, 0.1)

    def moments(self, rig: Rig, wavelength_nm: Floats, variant: str, normal: Floats | None = None) -> Moments:
        """Give the blur, equal in all bands; ``normal`` (3,) is the mirror's in the camera frame, None at rest."""
        return even(_variance(rig, rig.air.distance_m, normal), len(wavelength_nm))

    def bound(self, probe: Probe, rig: Rig, variant: str = OFF) -> Bound:
        """Bound the error of no blur over all positions of the sweeps."""
        if variant != OFF:
            return Bound(0.0, "exact")
        if rig.distances_m is None:
            return Bound(0.0, "the scene has no distance")
        worst = np.max([_variance(rig, rig.air.distance_m, normal) for normal in normals_met(probe, rig)], axis=0)
        cause = f"defocus at {rig.air.distance_m:g} m, focused at {rig.optics.focus_m:g} m"
        return blurred_bound(probe, even(worst, len(probe.wavelength_nm)).variance, cause)


DEFOCUS = Defocus()


def defocus_px(rig: Rig, distance_m: float | None, normal: Floats | None = None) -> Floats:
    """Give the axes of the blur's disc, (2,) along line and scan: pupil |1/d - 1/d_f| / IFOV; 0 without a distance."""
    if distance_m is None or distance_m == rig.optics.focus_m:
        return np.zeros(2)
    round_px = rig.optics.aperture_mm * 1e-3 * abs(1 / distance_m - 1 / rig.optics.focus_m) / rig.camera.ifov_rad
    return round_px * np.sqrt(spread_of_rays(normal))


def _variance(rig: Rig, distance_m: float | None, normal: Floats | None) -> Floats:
    """(2,) along line and scan: an even disc has a sixteenth of its diameter squared. [px^2]"""
    variance: Floats = defocus_px(rig, distance_m, normal) ** 2 / 16
    return variance
