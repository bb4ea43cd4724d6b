"""Pointing errors of the mirror: staircase, lag, jitter, hysteresis, drift, errors of whole sweeps.

The mirror's own faults (jitter, hysteresis, thermal drift) follow from a rig's numbers. Pointing errors put whole
sweeps, each by itself, beside the places that the mirror reports: what registration is there to find.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterable
from dataclasses import dataclass
from fractions import Fraction
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.mirror import position_to_normal
from spectralzoom.pipeline.geometry.scan import Floats, Sweep, line_positions, points_of_scan
from spectralzoom.pipeline.simulator.effects.effect import Aim, Bound, SweepBlock, stream_of
from spectralzoom.pipeline.simulator.effects.probe import Probe
from spectralzoom.pipeline.simulator.rig_model import MirrorMotion, Rig

EXCEEDED = 1e-3  # probability that any line of a survey lies beyond the bound
_MODES = 6


def end_gains(sweep: Sweep, camera: LineCamera) -> Floats:
    """Return the derivatives of a line's ends and centre (along, scan) by those of its centre, (line, point, 2, 2).

    At the end of 320 px a centre that moves by 1 px along the line moves the point by .034 px along the scan.
    """
    slopes = np.array([-0.5, 0.0, 0.5]) * camera.samples * camera.ifov_rad
    centre = sweep.line_px()[:, None]

    def points(swath: float, scan: float) -> Floats:
        return np.stack(points_of_scan(sweep.swath_px + swath, camera, centre + scan, slopes), axis=-1)

    by_swath, by_scan = (points(1, 0) - points(-1, 0)) / 2, (points(0, 1) - points(0, -1)) / 2
    return np.stack([by_swath, by_scan], axis=-1)


def at_line_ends(sweeps: Iterable[Sweep], camera: LineCamera, along: float, scan: float) -> tuple[float, float]:
    """Bound how far any point of any line moves, for centres that move by up to so much. [px]"""
    gains = [np.abs(end_gains(sweep, camera)).max(axis=(0, 1)) for sweep in sweeps if sweep.lines]
    moved = np.max([np.eye(2), *gains], axis=0) @ [along, scan]
    return float(moved[0]), float(moved[1])


class Jitter(Aim):
    """A normal deviate of the tilt about either axis, anew for every line.

    At rest the view moves by 2 sigma in the plane of incidence, along the scan, and by sqrt(2) sigma along the line.
    Elsewhere the derivatives of the exact reflection say how far.
    """

    name = "jitter"
    cost_ns = MappingProxyType({"exact": 0.15})

    def aim(self, block: SweepBlock, variant: str) -> Floats:
        drawn = np.array([block.stream(self.name, number).standard_normal(2) for number in block.numbers.tolist()])
        shift: Floats = (tilt_to_scene(block.normals) * drawn.reshape(-1, 1, 2)).sum(axis=-1) * _sigma_px(block.rig)
        return shift[:, None]

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound what the worst of all lines' deviates changes; with a probability of 1e-3 a survey goes beyond.

        A line changes by at most its slope's share in the two tilts times the length of the two deviates. Any of n
        lines exceeds m with a probability of at most n exp(-m^2 / 2), so m is sqrt(2 ln(n / 1e-3)), 5.4 for 2560 lines.
        """
        sigma = _sigma_px(rig)
        lines = probe.lines
        if sigma == 0 or lines == 0:
            return Bound(0.0, "the mirror comes back to the same tilt")
        worst = np.zeros(2)
        for sweep in probe.sweeps:
            if sweep.lines:
                tilt = tilt_to_scene(position_to_normal(line_positions(sweep, rig.camera)))
                gain = end_gains(sweep, rig.camera) @ tilt[:, None]
                worst = np.maximum(worst, np.sqrt((gain**2).sum(axis=-1)).max(axis=(0, 1)))
        along, scan = (sigma * worst).tolist()
        most = math.sqrt(2 * math.log(lines / EXCEEDED))
        why = f"lines jump by {scan:.2f} px rms along the scan and {along:.2f} along the line"
        return Bound(probe.moved(most * along, most * scan), f"{why}, one of {lines} by {most:.1f} times that")


def tilt_to_scene(normals: Floats) -> Floats:
    """Return the derivatives of scene tangents with respect to tilts of the mirror, (..., 2, 2).

    ``normals``: (..., 3) unit normals. Rows are along the line and along the scan. Columns are a tilt about the axis
    most nearly in the plane of incidence, which moves the view across it, and one about y. At rest diag(sqrt(2), 2).
    """
    within = np.stack([normals[..., 2], np.zeros_like(normals[..., 0]), -normals[..., 0]], axis=-1)  # y x n
    within /= np.hypot(normals[..., 2], normals[..., 0])[..., None]
    tilts = np.stack([np.cross(normals, within), within], axis=-2)  # (..., tilt, 3)
    # o = k - 2 (n . k) n with k = (0, 0, 1)
    view = -2 * normals[..., 2:] * normals
    view[..., 2] += 1
    turned = -2 * (tilts[..., 2:] * normals[..., None, :] + normals[..., None, 2:] * tilts)
    ahead = view[..., None, :1]
    return np.swapaxes((turned[..., 1:] - turned[..., :1] * view[..., None, 1:] / ahead) / ahead, -1, -2)


def _sigma_px(rig: Rig) -> float:
    return rig.mirror.repeatability_urad * 1e-6 / rig.camera.ifov_rad


class Hysteresis(Aim):
    """A smooth error over the disk, at most ``hysteresis_px``, for each copy of the rig; its sign is the scan's."""

    name = "hysteresis"
    cost_ns = MappingProxyType({"exact": 0.07})

    def aim(self, block: SweepBlock, variant: str) -> Floats:
        return _course(block.rig, block.sweep, block.middle)[:, None]

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        if rig.mirror.hysteresis_px == 0 or not probe.sweeps:
            return Bound(0.0, "the mirror comes to the same place from either side")
        ways = [_course(rig, sweep, line_positions(sweep, rig.camera)) for sweep in probe.sweeps]
        along, scan = np.abs(np.concatenate(ways)).max(axis=0, initial=0.0)
        why = f"lines lie up to {along:.2g} px off along the line and {scan:.2g} px along the scan"
        return Bound(probe.moved(*at_line_ends(probe.sweeps, rig.camera, along, scan)), why)


class ThermalDrift(Aim):
    """The view walks in one direction as the unit warms up; each copy of the rig has a direction of its own."""

    name = "thermal-drift"
    cost_ns = MappingProxyType({"exact": 0.06})

    def aim(self, block: SweepBlock, variant: str) -> Floats:
        walked = block.rig.mirror.drift_px_per_min / 60 * block.time_s
        return np.stack([walked * one for one in _along_and_scan(block.rig)], axis=-1)[:, None]

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound by slope times the way walked until the last line."""
        rate = rig.mirror.drift_px_per_min
        if rate == 0 or not probe.sweeps:
            return Bound(0.0, "the view does not drift")
        walked = rate / 60 * (probe.seconds + rig.camera.frame_ms * 1e-3)
        along, scan = (walked * abs(one) for one in _along_and_scan(rig))
        why = f"the view drifts by {walked:.2g} px, {rate:g} px/min for {probe.seconds:.3g} s"
        return Bound(probe.moved(*at_line_ends(probe.sweeps, rig.camera, along, scan)), why)


def pointing_field(unit: int, position: Floats) -> Floats:
    """Return a smooth field over the disk, (..., 2) for positions (..., 2); between -1 and 1 on it. [-]

    It is a sum of the six Zernike polynomials up to degree 2 in the disk's own coordinates, each at most 1 in size.
    Their weights are normal deviates, scaled so that their sizes sum to 1.
    """
    x, y = position[..., 0], position[..., 1]
    modes = np.stack([np.ones_like(x), x, y, 2 * (x * x + y * y) - 1, x * x - y * y, 2 * x * y], axis=-1)
    weights = stream_of(unit, Hysteresis.name).standard_normal((_MODES, 2))
    return np.asarray((modes[..., None] * (weights / np.abs(weights).sum(axis=0))).sum(axis=-2))


def _course(rig: Rig, sweep: Sweep, position: Floats) -> Floats:
    """Return shift (line, 2) of lines at some positions of a sweep. [px]"""
    held = sweep.held_px().ravel()
    sign = -1.0 if len(held) > 1 and held[-1] < held[0] else 1.0  # 1 too where the mirror stands still
    return rig.mirror.hysteresis_px * sign * pointing_field(rig.detector.unit, position)


def _along_and_scan(rig: Rig) -> tuple[float, float]:
    turn = stream_of(rig.detector.unit, ThermalDrift.name).uniform(0, 2 * math.pi)
    return math.cos(turn), math.sin(turn)


@dataclass(frozen=True)
class PointingErrors(Aim):
    """An aim of the chain, on wherever there is one: the mirror looks beside the places that it reports.

    Every sweep has an offset drawn evenly from ``-offset_px`` to ``offset_px`` along the line and the scan, from a
    stream of its own, keyed (seed, sweep name).
    """

    offset_px: float
    seed: int = 0
    name = "pointing"
    cost_ns = MappingProxyType({"exact": 0.2})

    def aim(self, block: SweepBlock, variant: str) -> Floats:
        return np.tile(self.offset(block.sweep.name), (len(block.lines), 1, 1))

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound by slope times the greatest error in either axis."""
        most = self.offset_px
        why = f"the mirror looks up to {most:.2g} px beside along the line and {most:.2g} px along the scan"
        return Bound(probe.moved(*at_line_ends(probe.sweeps, rig.camera, most, most)), why)

    def offset(self, sweep_name: str) -> Floats:
        """Return the systematic error of a sweep, (2,) along the line and the scan [px]."""
        key = np.random.SeedSequence(entropy=self.seed, spawn_key=(zlib.crc32(sweep_name.encode()),))
        return np.random.Generator(np.random.Philox(key)).uniform(-self.offset_px, self.offset_px, 2)


JITTER, HYSTERESIS, THERMAL_DRIFT = Jitter(), Hysteresis(), ThermalDrift()


MOST_PARTS = 8  # of an exposure; a jump of h px within a part goes unseen as a blur of at most h^2/32 px^2
_RAMP = 64  # steps of a line that are as good as a ramp


class Staircase(Aim):
    """Sample and hold with any number of positions per px of path. Off, each px of the path has its one position.

    The memory is played at a steady rate while lines are exposed, timed so that in the long run lines lie where they
    are planned. It is the mean position in equal parts of the exposure, within which no position changes, at most
    :data:`MOST_PARTS`.
    """

    name = "staircase"
    cost_ns = MappingProxyType({"exact": 27.0})  # five positions a line instead of one

    def aim(self, block: SweepBlock, variant: str) -> Floats:
        positions = block.rig.mirror.positions_per_line
        held = block.sweep.positions
        scan = beside_plan(positions, held, block.numbers, _parts(positions, held))
        return np.stack([np.zeros_like(scan), scan], axis=-1)

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound by slope times the mean way of the held positions beside their plan."""
        positions = rig.mirror.positions_per_line
        if positions == 1 or not probe.sweeps:
            return Bound(0.0, "each px of the path has its one position")
        size = 0.0
        for step in {sweep.positions for sweep in probe.sweeps}:
            numbers = np.arange(max(sweep.lines for sweep in probe.sweeps if sweep.positions == step))
            ways = beside_plan(positions, step, numbers, _parts(positions, step))
            size = max(size, float(np.abs(ways).mean(axis=1).max(initial=0.0)))
        moved = probe.moved(*at_line_ends(probe.sweeps, rig.camera, 0.0, size))
        return Bound(moved, f"held positions lie {size:.3f} px off on average, in the worst line")


def beside_plan(positions: float, step: int, numbers: NDArray[np.int64], parts: int = 1) -> Floats:
    """Return the mean position less the planned one in each part of each held px of path, (line, step * parts). [px]

    Held positions are ``1 / positions`` px apart. At a time t, counted in px of path, the mirror lags the ramp by
    frac(positions * t) / positions; the mean of that is taken off.
    """
    edges = np.arange(step * parts + 1) / parts
    place = positions * (numbers[:, None] * float(step) + edges)
    whole = np.floor(place)
    # Integral of frac: one half for each whole, and half the square of the rest.
    area = np.diff(whole, axis=1) / 2 + np.diff((place - whole) ** 2, axis=1) / 2
    lag = area * parts / positions
    middle = np.tile((np.arange(parts) + 0.5) / parts - 0.5, step)
    return middle + (0.5 - lag) / positions


def _parts(positions: float, step: int) -> int:
    """Return how many equal parts an exposure has; positions a / b change at multiples of 1 / a of it."""
    if step > 1:
        return 1
    ratio = Fraction(positions).limit_denominator(1000)
    return min(ratio.numerator, MOST_PARTS) if abs(ratio - Fraction(positions)) < 1e-9 else MOST_PARTS


class Lag(Aim):
    """Mirror lag and overshoot: what is left of the start of a sweep, as the mean shift over each held position.

    The mirror follows its commands as a second-order system, x'' + 2 zeta x' + x = 0 in units of 1 / natural frequency.
    Calibration takes away the way that one in steady motion lies behind; the free oscillation from rest remains.
    Before a sweep it has flown back by the sweep's length, and has had ``settled_s`` to come to rest one held position
    ahead. It takes the first step as line 0 begins.
    """

    name = "lag"
    cost_ns = MappingProxyType({"exact": 0.15})

    def aim(self, block: SweepBlock, variant: str) -> Floats:
        scan = transient(block.rig, block.sweep, block.numbers)
        return np.stack([np.zeros_like(scan), scan], axis=-1)

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        worst = greatest_lag_px(rig, probe.sweeps)
        pace = f"{rig.camera.frame_ms:g} ms a line, {rig.mirror.natural_hz:g} Hz"
        why = f"lines lie up to {worst:.2g} px off while the mirror gets up to speed ({pace})"
        return Bound(probe.moved(*at_line_ends(probe.sweeps, rig.camera, 0.0, worst)), why)


def greatest_lag_px(rig: Rig, sweeps: Iterable[Sweep]) -> float:
    """Return the greatest shift along the scan of any line. [px]"""
    worst = 0.0
    for sweep in {(one.lines, one.step, one.positions): one for one in sweeps if one.lines}.values():
        worst = max(worst, float(np.abs(transient(rig, sweep, np.arange(sweep.lines))).mean(axis=1).max()))
    return worst


def transient(rig: Rig, sweep: Sweep, numbers: NDArray[np.int64]) -> Floats:
    """Return the mean shift along the scan over each held position of some lines, (line, step). [px]"""
    mirror = rig.mirror
    pace = 2 * math.pi * mirror.natural_hz * 1e-3  # [1/ms]
    period, held = pace * rig.camera.frame_ms, pace * rig.camera.exposure_ms / sweep.positions
    start = _at_start(mirror, sweep, period, held)
    impulse, rise = responses(numbers[:, None] * period + np.arange(sweep.positions) * held, mirror.damping)
    place: Floats = start[0] * (1 - rise) + start[1] * impulse
    rate = -start[0] * impulse + start[1] * (1 - rise - 2 * mirror.damping * impulse)
    impulse, rise = responses(np.array([held]), mirror.damping)
    return np.asarray((place * (impulse + 2 * mirror.damping * rise) + rate * rise) / held)


def responses(time: Floats, damping: float) -> tuple[Floats, Floats]:
    """Return the responses to a unit impulse and to a unit step, of a system with natural frequency 1 rad/s.

    ``time`` (...) is times that frequency, from 0 on [rad]. With g the first and h the second, the matrix exponential
    of the free system is [[1 - h, g], [-g, 1 - h - 2 zeta g]]. They are right to 1e-15 below, at and above damping 1.
    """
    with np.errstate(under="ignore"):
        if damping <= 1:
            turn = math.sqrt((1 - damping) * (1 + damping)) * time
            decay = np.exp(-damping * time)
            impulse = decay * time * np.sinc(turn / np.pi)
            rest = decay * np.cos(turn) + damping * impulse
        else:
            root = math.sqrt((damping - 1) * (damping + 1))
            slow = 1 / (damping + root)  # zeta - sqrt(zeta^2 - 1) without its cancellation
            apart = 2 * root * time
            decay = np.exp(-slow * time)
            impulse = decay * time * np.where(apart > 0, -np.expm1(-apart) / np.where(apart > 0, apart, 1.0), 1.0)
            rest = decay + slow * impulse
    return impulse, 1 - rest


def _at_start(mirror: MirrorMotion, sweep: Sweep, period: float, held: float) -> Floats:
    """Return state (place [px], rate) as line 0 begins: at rest, less steady motion; and the rest of the way back."""
    damping = mirror.damping  # steady motion has the errors of all steps before, a geometric series over lines
    times, height, every = _steps(mirror, sweep, period, held)
    impulse, rise = responses(times, damping)
    place, rate = height * float((1 - rise).sum()), -height * float(impulse.sum())
    g, h = (one.item() for one in responses(np.array([every]), damping))
    size = h * h + 2 * damping * h * g + g * g
    steady = np.array([(h + 2 * damping * g) * place + g * rate, -g * place + h * rate]) / size
    g, h = (one.item() for one in responses(np.array([2 * math.pi * mirror.natural_hz * mirror.settled_s]), damping))
    return steady + float(sweep.lines * sweep.step) * np.array([1 - h, -g])  # the way flown back


def _steps(mirror: MirrorMotion, sweep: Sweep, period: float, held: float) -> tuple[Floats, float, float]:
    """Return times from the steps of the pattern before a sweep to its start, their heights, and its length."""
    wanted = mirror.positions_per_line * sweep.positions  # of a line, rounded
    if wanted < 1:  # one position is held for several lines
        return np.array([period / wanted]), sweep.step / wanted, period / wanted
    count = min(max(round(wanted), 1), _RAMP)
    return period - np.arange(count) * (held * sweep.positions) / count, sweep.step / count, period


STAIRCASE, LAG = Staircase(), Lag()
