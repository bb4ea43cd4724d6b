"""The slit and the pixel: a box as wide as the slit's image and a pixel long."""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from pipeline.simulator.effects.effect import OFF, Bound
from pipeline.simulator.probe import Probe
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.tap_tables import SCALE_STEP

MARGIN = 1.2  # over what was measured at the roughest places found
_PARTS = {"9x3": (9, 3), "4x2": (4, 2), "3x1": (3, 1), "2x1": (2, 1), "1x1": (1, 1)}


@dataclass(frozen=True)
class SlitBox:
    """The footprint of slit and pixel. Off, a sample sees what its middle ray meets.

    The box is in closed form over the scene's pixels, as long as it does not lie turned among them. Variants tell into
    how many boxes that do not, across and along, it is parted; from two across on they have its covariance.
    """

    name = "slit"
    variants = ("9x3", "4x2", "3x1", "2x1", "1x1")
    # With the rig's blurs; without a quarter of it, for there is one kernel and not four.
    cost_ns = MappingProxyType({"9x3": 34.8, "4x2": 12.0, "3x1": 8.0, "2x1": 7.7, "1x1": 6.1})

    def bound(self, probe: Probe, rig: Rig, variant: str = OFF) -> Bound:
        """Bound by half as much again as the probe measured; where it has not, by the box's variance and
        the span. Scales that are rounded to tabulated ones add a little.

        How a variant errs depends on what the scene holds within the footprint, which no derivative of the image
        behind it tells.
        """
        if variant == self.variants[0]:
            return Bound(0.0, "exact")
        width = rig.camera.slit_px
        boxes = "its middle ray" if variant == OFF else f"{variant.replace('x', ' x ')} boxes that are not turned"
        why = f"{boxes} in place of a footprint {width:.2g} px wide and 1 px long"
        box = np.array([[1.0], [width**2]]) / 12
        if variant in probe.slit_errors:
            rounded = probe.blurred(np.repeat(SCALE_STEP * box, len(probe.wavelength_nm), axis=1))
            value = MARGIN * probe.slit_errors[variant] + (rounded if variant != OFF else 0.0)
            return Bound(value, f"{why}, measured where the scene is roughest")
        return Bound(probe.blurred(np.repeat(box, len(probe.wavelength_nm), axis=1)), why)


SLIT = SlitBox()


def box_parts(variant: str) -> tuple[int, int]:
    """Give into how many boxes a variant parts the footprint, across and along; one where it is off."""
    return _PARTS.get(variant, (1, 1))


def box_of(variant: str, rig: Rig) -> tuple[float, float]:
    """Give the widths of slit and pixel; 0 where the footprint is off. [px]"""
    return (0.0, 0.0) if variant == OFF else (rig.camera.slit_px, 1.0)
