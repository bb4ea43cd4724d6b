"""Cloud shadow: soft-edged shadows sweep over the scene and take a share of the light."""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from pipeline.scan import points_of_scan
from pipeline.simulator.block import SweepBlock
from pipeline.simulator.effects.effect import OFF, Bound, Light
from pipeline.simulator.gain_range import GainRange
from pipeline.simulator.probe import Probe
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.streams import sweep_stream

Floats = NDArray[np.float64]
EDGE_SHARE = 0.1  # width of a shadow's edge, over the shadow's size (assumed)


@dataclass(frozen=True)
class Cloud:
    """Straight bands of shadow, as wide as the gaps between them, that drift over the scene at a constant speed.

    Direction and place follow from the seed alone, so that all sweeps of a survey lie under the same clouds. The edge
    is a smooth step: the light is never broken off. All bands lose the same share.
    """

    name = "cloud"
    variants = ("shadow",)
    cost_ns = MappingProxyType({"shadow": 0.3})

    def bound(self, probe: Probe, rig: Rig, variant: str = OFF) -> Bound:
        """Bound by level times the share that a cloud takes; whether a shadow comes is up to the seed."""
        sky = rig.sky
        if sky.cloud_share == 0:
            return Bound(0.0, "the sky is clear")
        if variant != OFF:
            return Bound(0.0, "every sample at its own place")
        why = f"a shadow takes {sky.cloud_share:.0%} of the light and moves {sky.cloud_px_per_s:g} px/s over the scene"
        return Bound(probe.scaled(sky.cloud_share), why)

    def gain_range(self, probe: Probe, rig: Rig) -> GainRange:
        """Give 1 less a cloud's share, to 1."""
        share = rig.sky.cloud_share
        return GainRange.between(1 - share, 1.0, len(probe.wavelength_nm), uneven=share)

    def gain(self, block: SweepBlock, variant: str) -> Light:
        """Give (line, sample, 1)."""
        sky = block.rig.sky
        if sky.cloud_share == 0:
            return np.ones((1, 1, 1), np.float32)
        sweep = block.sweep
        along, scan = points_of_scan(sweep.strip_px, block.rig.camera, block.scan_px[:, None], block.slopes)
        x, y = (along, scan) if sweep.along == "x" else (scan, along)
        heading, place = self._course(block.seed, sky.cloud_size_px)
        way = x * math.cos(heading) + y * math.sin(heading) - sky.cloud_px_per_s * block.time_s[:, None] + place
        return (1 - sky.cloud_share * shadow(way, sky.cloud_size_px))[..., None].astype(np.float32)

    def _course(self, seed: int, size_px: float) -> tuple[float, float]:
        """Direction [rad] in which the shadows move, and where they are when the survey starts [px]."""
        turn, place = sweep_stream(seed, "", self.name).random(2)  # no sweep's name: the whole survey's
        return 2 * math.pi * float(turn), 2 * size_px * float(place)


CLOUD = Cloud()


def shadow(way_px: Floats, size_px: float) -> Floats:
    """Give how much of a cloud lies between the sun and points so far along its way, 0 to 1; the period is 2 sizes.

    It is 1 about every even multiple of the size, 0 about the odd ones, 1/2 in the middle of an edge.
    """
    from_middle = np.abs((way_px + size_px) % (2 * size_px) - size_px)
    t = np.clip((size_px / 2 - from_middle) / (EDGE_SHARE * size_px) + 0.5, 0.0, 1.0)
    smooth: Floats = t * t * (3 - 2 * t)
    return smooth
