"""The slit and the pixel: a box as wide as the slit's image and a pixel long."""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from pipeline.simulator.effects.effect import OFF, Bound
from pipeline.simulator.effects.turned import MARGIN, UPRIGHT, beside_plan_px
from pipeline.simulator.parting import Parts, fewest_parts
from pipeline.simulator.probe import Probe
from pipeline.simulator.rays import RayViews
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.tap_tables import BETWEEN_ROWS, SCALE_STEP, TABULATED

_COUNTED: dict[str, Parts] = {"9x3": (9, 3), "5x2": (5, 2), "3x1": (3, 1), UPRIGHT: (1, 1)}
_STATED = {"1-percent": 0.01, "3-percent": 0.03}  # of the light that a sweep's boxes may misplace


@dataclass(frozen=True)
class SlitBox:
    """The footprint of slit and pixel. Off, a sample sees what its middle ray meets.

    The box is in closed form over the scene's pixels, as long as it does not lie turned among them. Variants tell into
    how many boxes that do not, across and along, it is parted; from two across on they have its covariance. Those of a
    stated error take, for each sweep, as few as misplace no more of the light than that anywhere in the sweep.
    """

    name = "slit"
    variants = ("9x3", "5x2", "3x1", "1-percent", "3-percent", UPRIGHT)
    # Beside the rig's blurs, which need eleven kernels whatever the slit, at strips of +-960 px; at +-320 less of them.
    cost_ns = MappingProxyType({"9x3": 38.0, "5x2": 10.0, "3x1": 1.8, "1-percent": 1.4, "3-percent": 1.3, UPRIGHT: 0.3})

    def bound(self, probe: Probe, rig: Rig, variant: str = OFF) -> Bound:
        """Bound by half as much again as the probe measured; where it has not, by the box's variance and the span.

        How a variant errs depends on what the scene holds within the footprint, which no derivative of the image
        behind it tells. It was measured beside the rig's blurs: leaving one out is bounded by itself, for any slit.
        What is rounded in tables, and what lines turn more where the mirror looks beside its plan, add a little.
        """
        if variant == self.variants[0]:
            return Bound(0.0, "exact")
        width, bands = rig.camera.slit_px, len(probe.wavelength_nm)
        why = f"{_words(variant)} in place of a footprint {width:.2g} px wide and 1 px long"
        box = np.array([[1.0], [width**2]]) / 12
        whole = probe.blurred(np.repeat(box, bands, axis=1))
        if variant not in probe.slit_errors:
            return Bound(whole, why)
        value = MARGIN * probe.slit_errors[variant]
        if variant != OFF:
            turned = max(beside_plan_px(probe, rig)) * rig.camera.ifov_rad * (width**2 + 1) / 12
            value += probe.blurred(np.repeat(SCALE_STEP * box + BETWEEN_ROWS, bands, axis=1))
            value += probe.blurred(np.full((2, bands), turned)) + TABULATED * float(probe.span.max(initial=0.0))
        return Bound(value, f"{why}, measured where the scene is roughest")


SLIT = SlitBox()


def box_parts(variant: str, rig: Rig, views: RayViews) -> Parts:
    """Give into how many boxes a variant parts the footprint, across and along, for views all over a sweep."""
    if variant in _STATED:
        return fewest_parts(_STATED[variant], box_of(variant, rig), views)
    return _COUNTED.get(variant, (1, 1))


def box_of(variant: str, rig: Rig) -> tuple[float, float]:
    """Give the widths of slit and pixel; 0 where the footprint is off. [px]"""
    return (0.0, 0.0) if variant == OFF else (rig.camera.slit_px, 1.0)


def _words(variant: str) -> str:
    if variant == OFF:
        return "its middle ray"
    if variant in _STATED:
        return f"boxes that are not turned and misplace at most {_STATED[variant]:.0%} of the light"
    return f"{variant.replace('x', ' x ')} boxes that are not turned"
