"""Jitter: the mirror does not come to the same tilt twice; every line looks a little beside its place."""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from pipeline.mirror import position_to_normal
from pipeline.scan import line_positions
from pipeline.simulator.block import SweepBlock
from pipeline.simulator.effects.effect import OFF, Bound
from pipeline.simulator.effects.line_ends import end_gains
from pipeline.simulator.probe import Probe
from pipeline.simulator.rig_model import Rig

Floats = NDArray[np.float64]
EXCEEDED = 1e-3  # probability that any line of a survey lies beyond the bound


@dataclass(frozen=True)
class Jitter:
    """A normal deviate of the tilt about either axis, anew for every line.

    At rest the view moves by 2 sigma in the plane of incidence, which is the scan's axis, and by sqrt(2) sigma across
    it, along the line; elsewhere by the derivatives of the exact reflection.
    """

    name = "jitter"
    variants = ("exact",)
    cost_ns = MappingProxyType({"exact": 0.15})

    def aim(self, block: SweepBlock, variant: str) -> Floats:
        """Give the shift, (line, 1, 2) along the line and the scan. [px]"""
        drawn = np.array([block.stream(self.name, number).standard_normal(2) for number in block.numbers.tolist()])
        shift: Floats = (tilt_to_scene(block.normals) * drawn.reshape(-1, 1, 2)).sum(axis=-1) * _sigma_px(block.rig)
        return shift[:, None]

    def bound(self, probe: Probe, rig: Rig, variant: str = OFF) -> Bound:
        """Bound what the worst of all lines' deviates changes; with a probability of 1e-3 a survey goes beyond.

        A line changes by at most its slope's share in the two tilts times the length of the two deviates. That length
        exceeds m with probability exp(-m^2 / 2), so any of n lines' does with at most n exp(-m^2 / 2): m is
        sqrt(2 ln(n / 1e-3)), 5.4 for 2560 lines.
        """
        sigma, lines = _sigma_px(rig), probe.lines
        if variant != OFF or sigma == 0 or lines == 0:
            return Bound(0.0, "the mirror comes back to the same tilt" if variant == OFF else "exact")
        along, scan, common = _spreads(probe, rig)
        most = math.sqrt(2 * math.log(lines / EXCEEDED))
        g, h = probe.slope[0] * along, probe.slope[1] * scan
        value = np.minimum(most * sigma * np.sqrt(g * g + h * h + 2 * common * g * h), probe.span).max(initial=0.0)
        why = f"lines jump by {sigma * scan:.2f} px rms along the scan and {sigma * along:.2f} along the line"
        return Bound(float(value), f"{why}, one of {lines} by {most:.1f} times that")


JITTER = Jitter()


def tilt_to_scene(normals: Floats) -> Floats:
    """Give the derivatives of scene tangents with respect to tilts of the mirror, (..., 2, 2).

    Parameters
    ----------
    normals
        (..., 3) unit normals.

    Returns
    -------
    Rows are along the line and along the scan; columns a tilt about the axis most nearly in the plane of incidence,
    which moves the view across that plane, and one about y, which moves it within. At rest diag(sqrt(2), 2).
    """
    within = np.stack([normals[..., 2], np.zeros_like(normals[..., 0]), -normals[..., 0]], axis=-1)  # y x n
    within /= np.hypot(normals[..., 2], normals[..., 0])[..., None]
    across = np.cross(normals, within)
    tilts = np.stack([across, within], axis=-2)  # (..., tilt, 3)
    # o = k - 2 (n . k) n with k = (0, 0, 1)
    view = -2 * normals[..., 2:] * normals
    view[..., 2] += 1
    turned = -2 * (tilts[..., 2:] * normals[..., None, :] + normals[..., None, 2:] * tilts)
    ahead = view[..., None, :1]
    tangents = (turned[..., 1:] - turned[..., :1] * view[..., None, 1:] / ahead) / ahead
    gains: Floats = np.swapaxes(tangents, -1, -2)
    return gains


def _sigma_px(rig: Rig) -> float:
    return rig.mirror.repeatability_urad * 1e-6 / rig.camera.ifov_rad


def _spreads(probe: Probe, rig: Rig) -> tuple[float, float, float]:
    """Greatest px along the line and along the scan for 1 px of tilt, and the greatest correlation of the two."""
    worst = np.zeros(3)
    for sweep in probe.sweeps:
        if sweep.lines:
            tilt = tilt_to_scene(position_to_normal(line_positions(sweep, rig.camera)))
            gain = end_gains(sweep, rig.camera) @ tilt[:, None]
            size = np.sqrt((gain**2).sum(axis=-1))
            common = np.abs((gain[..., 0, :] * gain[..., 1, :]).sum(axis=-1)) / size.prod(axis=-1)
            worst = np.maximum(worst, [size[..., 0].max(), size[..., 1].max(), common.max()])
    return float(worst[0]), float(worst[1]), float(worst[2])
