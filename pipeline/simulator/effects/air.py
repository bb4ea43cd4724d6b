"""Air and depth: how far away samples see the scene, parallax, and air that moves: turbulence, wind in the crop."""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.scan import points_of_scan
from pipeline.simulator.effects.effect import Aim, Bound, Displacement, SweepBlock, sweep_stream
from pipeline.simulator.effects.probe import UNITS, Probe
from pipeline.simulator.rig_model import Air, Rig

Floats = NDArray[np.float64]
PLANE = 2.91  # angle of arrival of a star's light [1]
NEAR_POINTS = 3 / 8  # of it from a path's end: the mean of (z / d)^(5/3); r0 [2] is (8/3)^(3/5) times as wide
RISK = 1e-3  # fraction of the surveys in which a line may stray further than the bound says
_REST = math.sqrt(0.5)
GUST_M = 3.0  # length of the waves that run over a canopy; assumed
FARTHEST_M = 1e7  # infinity: nothing passes so much air


@dataclass(frozen=True)
class Turbulence(Aim):
    """Jitter of the lines, normal and equal in both directions: warm air bends the light, anew for every line.

    [1] Andrews and Phillips, "Laser Beam Propagation through Random Media", 2nd edition, SPIE Press, 2005, chapters 6,
        8.
    [2] Fried, Journal of the Optical Society of America 56, 1966. doi:10.1364/JOSA.56.001372
    """

    name = "turbulence"
    cost_ns = MappingProxyType({"jitter": 0.13})

    def aim(self, block: SweepBlock, variant: str) -> Floats:
        sigma = turbulence_px(block.rig)
        draws = [block.stream(self.name, int(number)).standard_normal(2) for number in block.numbers]
        return sigma * np.array(draws, np.float64).reshape(-1, 1, 2)

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound for all lines at once, but in one survey of 1000: no line of N exceeds sqrt(2 ln(N / risk)) sigma."""
        sigma = turbulence_px(rig)
        if not sigma:
            return Bound(0.0, "no distance or no turbulence")
        farthest = sigma * math.sqrt(2 * math.log(max(probe.lines, 1) / RISK))
        near = probe.within(farthest)
        steep = np.hypot(*near.slope)
        change = float(np.minimum(steep * farthest, near.span).max(initial=0.0))
        strength = rytov_variance(rig, float(np.min(probe.wavelength_nm, initial=np.inf)))
        beyond = f"; a guess, beyond weak turbulence (Rytov variance {strength:.2g})" if strength > 1 else ""
        return Bound(
            change,
            f"{sigma:.2g} px (sd) per line, at most {farthest:.2g} px in {probe.lines} lines,"
            f" on edges of at most {steep.max(initial=0.0):.3g} {UNITS[probe.unit]}/px{beyond}",
        )


def turbulence_px(rig: Rig) -> float:
    """Give the deviation of the angle of arrival per axis, sqrt(1.09 Cn2 d D^(-1/3)), from the farthest part. [px]

    Spherical waves: air near the point tilts them less than air near the aperture, by (z / d)^(5/3) a length of way, so
    that 3/8 of a plane wave's 2.91 are left [1]. D is the aperture as seen at rest, 10.6 mm of 15. Valid for
    Kolmogorov's spectrum with one Cn2 all along the way, for D between inner and outer scale, sqrt(lambda d) not much
    wider than D, and weak turbulence, `rytov_variance` up to 1. 0 without a distance; no way is longer than
    `FARTHEST_M`.
    """
    metres = _way_m(rig)
    aperture_m = rig.optics.aperture_mm * 1e-3 * _REST
    angle = math.sqrt(NEAR_POINTS * PLANE * rig.air.turbulence_cn2 * metres * aperture_m ** (-1 / 3))
    return angle / rig.camera.ifov_rad


def rytov_variance(rig: Rig, wavelength_nm: float) -> float:
    """Give how strong the turbulence is: of the light's logarithm in spherical waves, 0.5 Cn2 k^(7/6) d^(11/6) [1]."""
    waves_per_m = 2 * math.pi / (wavelength_nm * 1e-9)
    return float(0.5 * rig.air.turbulence_cn2 * waves_per_m ** (7 / 6) * _way_m(rig) ** (11 / 6))


def _way_m(rig: Rig) -> float:
    return 0.0 if rig.distances_m is None else min(max(rig.distances_m), FARTHEST_M)


@dataclass(frozen=True)
class Wind(Displacement):
    """Crop motion: the scene sways by a travelling wave along the wind, its phase and direction drawn for a survey.

    All of the scene sways, as one that stands at mid exposure; where f t_frame is above one half, a fast sway shows as
    a slow one. The smear within an exposure is neither modelled nor counted: up to 2 pi f t_exp of the amplitude, 2 %
    of it at 1 Hz in 3 ms and 62 % in 100 ms. ``why`` tells how many px that are.
    """

    name = "wind"
    cost_ns = MappingProxyType({"exact": 0.9})

    def displaced(self, block: SweepBlock, along_px: Floats, scan_px: Floats, variant: str) -> tuple[Floats, Floats]:
        """Give the crop's sway at scene points (line, sample): along the line and the scan. [px]

        A plane wave A sin(2 pi (f t - way / gust) + phase), its way and its motion along the wind's heading.
        """
        sway, air = sway_px(block.rig), block.rig.air
        if sway == 0 or air.distance_m is None:
            return np.zeros_like(along_px), np.zeros_like(scan_px)
        phase, heading = sweep_stream(block.seed, "", self.name).uniform(0, 2 * math.pi, 2)
        x, y = (along_px, scan_px) if block.sweep.along == "x" else (scan_px, along_px)
        downwind = (x * math.cos(heading) + y * math.sin(heading)) * block.rig.camera.ifov_rad * air.distance_m
        turns = air.wind_hz * block.time_s[:, None] - downwind / GUST_M
        moved = sway * np.sin(2 * math.pi * turns + phase)
        right, down = moved * math.cos(heading), moved * math.sin(heading)
        return (right, down) if block.sweep.along == "x" else (down, right)

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound by the amplitude times the length of the steepest gradient, whichever way the wind blows."""
        sway = sway_px(rig)
        if sway == 0:
            return Bound(0.0, "the air is calm")
        near = probe.within(sway)
        steep = sway * np.hypot(*near.slope)
        aliased = ", too fast for the lines to follow" if sways_per_line(rig) > 0.5 else ""
        smeared = f"up to {within_exposure_px(rig):.2g} px of smear within an exposure are not modelled"
        return Bound(
            float(np.minimum(steep, near.span).max(initial=0.0)),
            f"the crop sways by {sway:.2g} px, {line_to_line_px(rig):.2g} px from line to line{aliased}; {smeared}",
        )


def sway_px(rig: Rig) -> float:
    """Give the amplitude of the canopy's sway, A / (d IFOV); 0 for a scene without a distance. [px]"""
    air = rig.air
    return 0.0 if air.distance_m is None else air.wind_amplitude_m / (air.distance_m * rig.camera.ifov_rad)


def sway_gradient(rig: Rig) -> float:
    """Give by how much the sway differs from one px to the next at most, 2 pi A over the length of a gust."""
    return 2 * math.pi * rig.air.wind_amplitude_m / GUST_M if sway_px(rig) else 0.0


def line_to_line_px(rig: Rig) -> float:
    """Give the most that the crop moves from one line to the next, 2 A |sin(pi f t_frame)| / (d IFOV). [px]"""
    return 2 * sway_px(rig) * abs(math.sin(math.pi * sways_per_line(rig)))


def within_exposure_px(rig: Rig) -> float:
    """Give the most that the crop moves while a line is exposed, 2 A |sin(pi f t_exp)| / (d IFOV) up to 2 A. [px]"""
    sways = min(rig.air.wind_hz * rig.camera.exposure_ms * 1e-3, 0.5)
    return 2 * sway_px(rig) * math.sin(math.pi * sways)


def sways_per_line(rig: Rig) -> float:
    return rig.air.wind_hz * rig.camera.frame_ms * 1e-3


@dataclass(frozen=True)
class Parallax(Displacement):
    """Displacement of what is not at the scene's distance, for which scale and geometry are right.

    The virtual pinhole lies a lever L behind the pivot on the chief ray. A ray meets a surface at distance d, taken
    along the chief ray, L (1/d - 1/d0) times its way from the line's centre beside the point of distance d0, where
    depth is read. Occlusion is left out: within a displacement of a step a sample may see the other depth, within the
    bound.
    """

    name = "parallax"
    cost_ns = MappingProxyType({"exact": 0.2})

    def displaced(self, block: SweepBlock, along_px: Floats, scan_px: Floats, variant: str) -> tuple[Floats, Floats]:
        air, sweep = block.rig.air, block.sweep
        if air.distance_m is None:
            return np.zeros_like(along_px), np.zeros_like(scan_px)
        row, size = (scan_px, block.shape[0]) if sweep.along == "x" else (along_px, block.shape[0])
        fraction = air.lever_m * (closeness(air, row / max((size - 1) / 2, 0.5)) - 1 / air.distance_m)
        return fraction * (along_px - sweep.swath_px), fraction * (scan_px - block.scan_px[:, None])

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound by the slope times the greatest displacement: at a line's ends, at the nearest or farthest surface."""
        fraction = greatest_fraction(rig.air)
        if fraction == 0 or not probe.sweeps:
            return Bound(0.0, "all of the scene is at one distance")
        half = np.zeros(2)  # greatest way from a line's centre to its ends, slit and pixel included
        ends = np.array([-1.0, 1.0]) * rig.camera.samples / 2 * rig.camera.ifov_rad
        for sweep in probe.sweeps:
            centre = sweep.line_px()[:, None]
            along, scan = points_of_scan(sweep.swath_px, rig.camera, centre, ends)
            beside = np.abs(along - sweep.swath_px).max(initial=0.0), np.abs(scan - centre).max(initial=0.0)
            half = np.maximum(half, beside)
        most_along, most_scan = (fraction * half).tolist()
        near, far = rig.distances_m or (0.0, 0.0)
        why = f"at the lines' ends {most_along:.2g} px between {near:g} and {far:g} m ({rig.air.relief})"
        return Bound(probe.moved(most_along, most_scan), why)


def closeness(air: Air, row: Floats) -> Floats:
    """Give 1 / distance at rows of the scene, -1 its first and 1 its last. [1/m]

    A ``step`` is farthest up to the middle row and nearest from there on; along a ``plane`` it runs evenly between
    them.
    """
    if air.distance_m is None:
        return np.zeros_like(row)
    near, far = 1 / (air.nearest_m or air.distance_m), 1 / (air.farthest_m or air.distance_m)
    if air.relief == "flat":
        return np.full_like(row, 1 / air.distance_m)
    if air.relief == "step":
        return np.where(row < 0, far, near)
    fraction = (np.clip(row, -1, 1) + 1) / 2
    return far * (1 - fraction) + near * fraction


def greatest_fraction(air: Air) -> float:
    """Greatest displacement per px of way from the line's centre."""
    if air.distance_m is None:
        return 0.0
    ends = closeness(air, np.array([-1.0, 1.0])) - 1 / air.distance_m
    return air.lever_m * float(np.abs(ends).max())


def reach_m(rig: Rig) -> tuple[float, float] | None:
    """Give the nearest and the farthest distance that the scene's relief has [m]; None for one without a distance."""
    ends = rig.distances_m
    if ends is None or rig.air.distance_m is None:
        return None
    if rig.air.relief == "flat":
        ends = (rig.air.distance_m, rig.air.distance_m)
    return min(*ends, FARTHEST_M), min(max(ends), FARTHEST_M)


def has_relief(rig: Rig) -> bool:
    reach = reach_m(rig)
    return reach is not None and reach[0] != reach[1]


def sample_distances(block: SweepBlock) -> Floats:
    """Give the distance where each sample looks by the plan, (line, sample) [m]; (1, 1) where all of it is the same."""
    ends = reach_m(block.rig)
    if ends is None or ends[0] == ends[1]:
        return np.full((1, 1), FARTHEST_M if ends is None else ends[0])
    sweep = block.sweep
    along, scan = points_of_scan(sweep.swath_px, block.rig.camera, block.scan_px[:, None], block.slopes)
    row = scan if sweep.along == "x" else along
    inverse = closeness(block.rig.air, row / max((block.shape[0] - 1) / 2, 0.5))
    return 1 / np.clip(inverse, 1 / ends[1], 1 / ends[0])


def spoken_reach(ends: tuple[float, float]) -> str:
    return f"{ends[1]:g} m" if ends[0] == ends[1] else f"{ends[0]:g} to {ends[1]:g} m"


TURBULENCE, WIND, PARALLAX = Turbulence(), Wind(), Parallax()
