"""How a line lies in the scene: turned and stretched by the mirror, as exact rays have it."""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import Sweep, points_of_scan
from pipeline.simulator.effects.effect import OFF, Bound
from pipeline.simulator.effects.turned import MARGIN, UPRIGHT, beside_plan_px
from pipeline.simulator.probe import Probe
from pipeline.simulator.rig_model import Rig

Floats = NDArray[np.float64]
_LOOKS = 33  # lines of a sweep and samples of a line at which its course is taken; both are smooth


@dataclass(frozen=True)
class Rotation:
    """Line rotation and projective scale. Off, every line lies straight along its axis at nominal scale."""

    name = "rotation"
    variants = ("rays",)
    cost_ns = MappingProxyType({"rays": 0.0})  # straight lines take as long

    def bound(self, probe: Probe, rig: Rig, variant: str = OFF) -> Bound:
        """Bound by slope times the greatest way between where rays meet the scene and where straight lines would."""
        if variant != OFF:
            return Bound(0.0, "rays are exact")
        along, scan = _farthest(probe.sweeps, rig.camera, beside_plan_px(probe, rig))
        most = f"{round(along, 9):.3g} px along and {round(scan, 9):.3g} px along the scan"
        why = f"lines are turned and stretched by at most {most}"
        # The footprint does not lie turned either: the same as one box that does not.
        shape = MARGIN * probe.slit_errors.get(UPRIGHT, 0.0)
        return Bound(probe.moved(along, scan) + shape, why)


ROTATION = Rotation()


def _farthest(sweeps: tuple[Sweep, ...], camera: LineCamera, beside: tuple[float, float]) -> tuple[float, float]:
    """Greatest difference along the line and the scan over all sweeps, wherever the mirror may look. [px]"""
    ways = [
        _course(sweep, camera, (along, scan))
        for sweep in sweeps
        if sweep.lines
        for along in {-beside[0], 0.0, beside[0]}
        for scan in {-beside[1], 0.0, beside[1]}
    ]
    return (max(way[0] for way in ways), max(way[1] for way in ways)) if ways else (0.0, 0.0)


def _course(sweep: Sweep, camera: LineCamera, beside: tuple[float, float]) -> tuple[float, float]:
    slopes = camera.pixel_slopes()
    slopes = slopes[np.unique(np.linspace(0, len(slopes) - 1, _LOOKS).round().astype(int))]
    numbers = np.unique(np.linspace(0, sweep.lines - 1, _LOOKS).round().astype(int))
    strip, scan = sweep.strip_px + beside[0], sweep.line_px()[numbers][:, None] + beside[1]
    along_px, scan_px = points_of_scan(strip, camera, scan, slopes)
    straight = strip + slopes / camera.ifov_rad
    return float(np.abs(along_px - straight).max()), float(np.abs(scan_px - scan).max())
