"""The slit and the pixel: a box as wide as the slit's image and a pixel long, integrated by a few rays."""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from pipeline.simulator.effects.effect import OFF, Bound
from pipeline.simulator.footprint import Footprint, fold
from pipeline.simulator.probe import Probe
from pipeline.simulator.rig_model import Rig

_RAYS_PER_PX = {"8-per-px": 8}
MARGIN = 1.5  # over what was measured at the roughest places found
_RAYS = {"8x4": (8, 4), "4x3": (4, 3), "4x2": (4, 2), "3x1": (3, 1)}


@dataclass(frozen=True)
class SlitBox:
    """The footprint of slit and pixel. Off, a sample sees what its middle ray meets."""

    name = "slit"
    variants = ("8-per-px", "8x4", "4x3", "4x2", "3x1")
    cost_ns = MappingProxyType({"8-per-px": 72.0, "8x4": 9.8, "4x3": 3.9, "4x2": 2.6, "3x1": 1.0})

    def bound(self, probe: Probe, rig: Rig, variant: str = OFF) -> Bound:
        """Bound by half as much again as the probe measured; where it has not, by the box's variance and the span.

        How a variant's few rays err depends on what the scene holds between them, which no derivative of the image
        behind the footprint tells.
        """
        if variant == self.variants[0]:
            return Bound(0.0, "exact")
        width = rig.camera.slit_px
        rays = "its middle ray" if variant == OFF else f"{variant.replace('x', ' x ')} rays"
        why = f"{rays} in place of a footprint {width:.2g} px wide and 1 px long"
        if variant in probe.slit_errors:
            return Bound(MARGIN * probe.slit_errors[variant], f"{why}, measured where the scene is roughest")
        box = np.array([[1.0], [width**2]]) / 12
        return Bound(probe.blurred(np.repeat(box, len(probe.wavelength_nm), axis=1)), why)


SLIT = SlitBox()


def box_rays(variant: str, slit_px: float) -> tuple[int, int]:
    """Give how many rays a variant takes across and along the slit; one where the footprint is off."""
    if variant == OFF:
        return 1, 1
    if variant in _RAYS:
        return _RAYS[variant]
    density = _RAYS_PER_PX[variant]
    return max(math.ceil(density * slit_px), 1), density


def slit_footprint(variant: str, slit_px: float) -> Footprint:
    """Give the rays of slit and pixel alone, the same in all bands: weights (ray, 1)."""
    boxes = (0.0, 0.0) if variant == OFF else (slit_px, 1.0)
    return fold(boxes, box_rays(variant, slit_px), np.zeros((2, 1)), np.zeros((2, 1)))
