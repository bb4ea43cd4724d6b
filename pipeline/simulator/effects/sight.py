"""How far away the scene is that samples see: the length of the air in their way."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.scan import points_of_scan
from pipeline.simulator.block import SweepBlock
from pipeline.simulator.effects.parallax import closeness
from pipeline.simulator.rig_model import Rig

Floats = NDArray[np.float64]
FARTHEST_M = 1e7  # infinity: nothing passes so much air


def reach_m(rig: Rig) -> tuple[float, float] | None:
    """Give the nearest and the farthest distance that the scene's relief has [m]; None for one without a distance."""
    ends = rig.distances_m
    if ends is None or rig.air.distance_m is None:
        return None
    if rig.air.relief == "flat":
        ends = (rig.air.distance_m, rig.air.distance_m)
    return min(*ends, FARTHEST_M), min(max(ends), FARTHEST_M)


def has_relief(rig: Rig) -> bool:
    """Whether samples see the scene at more than one distance."""
    reach = reach_m(rig)
    return reach is not None and reach[0] != reach[1]


def sample_distances(block: SweepBlock) -> Floats:
    """Give the distance where each sample looks by the plan, (line, sample) [m]; (1, 1) where all of it is the same."""
    ends = reach_m(block.rig)
    if ends is None or ends[0] == ends[1]:
        return np.full((1, 1), FARTHEST_M if ends is None else ends[0])
    sweep = block.sweep
    along, scan = points_of_scan(sweep.strip_px, block.rig.camera, block.scan_px[:, None], block.slopes)
    row = scan if sweep.along == "x" else along
    inverse = closeness(block.rig.air, row / max((block.shape[0] - 1) / 2, 0.5))
    metres: Floats = 1 / np.clip(inverse, 1 / ends[1], 1 / ends[0])
    return metres


def spoken_reach(ends: tuple[float, float]) -> str:
    """Say it in words."""
    return f"{ends[1]:g} m" if ends[0] == ends[1] else f"{ends[0]:g} to {ends[1]:g} m"
