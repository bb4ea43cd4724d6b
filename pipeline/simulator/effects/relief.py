"""How far away the scene is that samples see, and parallax: near and far parts lie apart in a line."""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.scan import points_of_scan
from pipeline.simulator.block import SweepBlock
from pipeline.simulator.effects.effect import Bound, Displacement
from pipeline.simulator.effects.probe import Probe
from pipeline.simulator.rig_model import Air, Rig

Floats = NDArray[np.float64]
FARTHEST_M = 1e7  # infinity: nothing passes so much air


@dataclass(frozen=True)
class Parallax(Displacement):
    """Displacement of what is not at the scene's distance, for which scale and geometry are right.

    The virtual pinhole lies a lever L behind the pivot on the chief ray, which itself passes through the pivot at any
    tilt. A ray meets a surface at distance d, taken along the chief ray, L (1/d - 1/d0) times its way from the line's
    centre beside the point of distance d0. Depth is read where the ray of d0 falls. Occlusion is left out: within
    one displacement of a step a sample may see the other depth, wrong by no more than the bound; nothing is hidden.
    """

    name = "parallax"
    cost_ns = MappingProxyType({"exact": 0.2})

    def displaced(self, block: SweepBlock, along_px: Floats, scan_px: Floats, variant: str) -> tuple[Floats, Floats]:
        """Give what to add to points (line, sample), along the line and along the scan. [px]"""
        air, sweep = block.rig.air, block.sweep
        if air.distance_m is None:
            return np.zeros_like(along_px), np.zeros_like(scan_px)
        row, size = (scan_px, block.shape[0]) if sweep.along == "x" else (along_px, block.shape[0])
        share = air.lever_m * (closeness(air, row / max((size - 1) / 2, 0.5)) - 1 / air.distance_m)
        return share * (along_px - sweep.strip_px), share * (scan_px - block.scan_px[:, None])

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound by slope times the displacement at the lines' ends of the part farthest from the scene's distance."""
        share = greatest_share(rig.air)
        if share == 0 or not probe.sweeps:
            return Bound(0.0, "all of the scene is at one distance")
        along, scan = (share * half for half in _half_lines(probe, rig))
        near, far = rig.distances_m or (0.0, 0.0)
        why = f"at the lines' ends {along:.2g} px between {near:g} and {far:g} m ({rig.air.relief})"
        return Bound(probe.moved(along, scan), why)


PARALLAX = Parallax()


def closeness(air: Air, row: Floats) -> Floats:
    """Give 1 / distance at rows of the scene, -1 its first and 1 its last. [1/m]

    ``flat`` is all at ``distance_m``. A ``step`` has its farthest part up to the middle row and its nearest from there
    on. Along a ``plane``, seen in perspective, 1 / distance runs evenly from the farthest to the nearest.
    """
    if air.distance_m is None:
        return np.zeros_like(row)
    near, far = 1 / (air.nearest_m or air.distance_m), 1 / (air.farthest_m or air.distance_m)
    if air.relief == "flat":
        return np.full_like(row, 1 / air.distance_m)
    if air.relief == "step":
        return np.where(row < 0, far, near)
    share = (np.clip(row, -1, 1) + 1) / 2
    inverse: Floats = far * (1 - share) + near * share
    return inverse


def greatest_share(air: Air) -> float:
    """Greatest displacement per px of way from the line's centre."""
    if air.distance_m is None:
        return 0.0
    ends = closeness(air, np.array([-1.0, 1.0])) - 1 / air.distance_m
    return air.lever_m * float(np.abs(ends).max())


def _half_lines(probe: Probe, rig: Rig) -> tuple[float, float]:
    """Greatest way from a line's centre to its ends, slit and pixel included: along the line and the scan. [px]"""
    camera, worst = rig.camera, np.zeros(2)
    ends = np.array([-1.0, 1.0]) * camera.samples / 2 * camera.ifov_rad
    for sweep in probe.sweeps:
        centre = sweep.line_px()[:, None]
        along, scan = points_of_scan(sweep.strip_px, camera, centre, ends)
        found = [np.abs(along - sweep.strip_px).max(initial=0.0), np.abs(scan - centre).max(initial=0.0)]
        worst = np.maximum(worst, found)
    return float(worst[0]), float(worst[1])


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
