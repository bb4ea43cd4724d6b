"""How the mirror follows its commands: the staircase of the vector memory, and lag and overshoot."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from fractions import Fraction
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.scan import Sweep
from pipeline.simulator.effects.effect import Aim, Bound, SweepBlock
from pipeline.simulator.effects.pointing import at_line_ends
from pipeline.simulator.effects.probe import Probe
from pipeline.simulator.rig_model import MirrorMotion, Rig

Floats = NDArray[np.float64]
EXACT, CENTRES = "exact", "centres"
MOST_PARTS = 8  # of an exposure; a jump of h px within a part goes unseen as a blur of at most h^2/32 px^2
_SERIES_BELOW = 0.5  # of (1 + 2 zeta) tau; 20 terms then leave less than 1e-20
_TERMS = 20
_RAMP = 64  # steps of a line that are as good as a ramp


@dataclass(frozen=True)
class Staircase(Aim):
    """Sample and hold with any number of positions per px of path. Off, each px of the path has its one position.

    The memory is played at a steady rate while lines are exposed, timed so that in the long run lines lie where they
    are planned. ``exact`` gives the mean position in equal parts of the exposure, so many that no position changes
    within a part where :data:`MOST_PARTS` are enough; ``centres`` that of the whole exposure, or of each px of path.
    """

    name = "staircase"
    cost_ns = MappingProxyType({EXACT: 27.0, CENTRES: 0.01})  # exact: five positions a line instead of one

    def aim(self, block: SweepBlock, variant: str) -> Floats:
        positions = block.rig.mirror.positions_per_line
        scan = beside_plan(positions, block.sweep.step, block.numbers, _parts(positions, block.sweep.step, variant))
        return np.stack([np.zeros_like(scan), scan], axis=-1)

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound by what a shift of the mean and a blur of the second moment change, or slope times the mean way."""
        positions = rig.mirror.positions_per_line
        if positions == 1 or not probe.sweeps:
            return Bound(0.0, "each px of the path has its one position")
        mean, size, square = _moments(positions, probe.sweeps, variant)
        both = np.zeros(probe.slope.shape)
        ends = [at_line_ends(probe.sweeps, rig.camera, 0.0, way) for way in (size, mean, square**0.5)]
        both[:] = np.square(ends[2])[:, None]
        value = min(probe.moved(*ends[0]), probe.moved(*ends[1]) + probe.blurred(both))
        return Bound(value, f"lines lie up to {mean:.3f} px off, held positions {square**0.5:.2f} px rms")


def beside_plan(positions: float, step: int, numbers: NDArray[np.int64], parts: int = 1) -> Floats:
    """Give the mean position less the planned one in each part of each held px of path, (line, step * parts). [px]

    Held positions are ``1 / positions`` px apart. Within a time t, counted in px of path, the mirror lags the ramp by
    frac(positions * t) / positions; what that has of its mean is the result.
    """
    edges = np.arange(step * parts + 1) / parts
    place = positions * (numbers[:, None] * float(step) + edges)
    whole = np.floor(place)
    part = place - whole
    # Integral of frac: one half for each whole, and half the square of the rest.
    area = np.diff(whole, axis=1) / 2 + np.diff(part**2, axis=1) / 2
    lag = area * parts / positions
    middle = np.tile((np.arange(parts) + 0.5) / parts - 0.5, step)
    return middle + (0.5 - lag) / positions


def _parts(positions: float, step: int, variant: str) -> int:
    """Equal parts of an exposure; positions a / b change at multiples of 1 / a of it."""
    if variant == CENTRES or step > 1:
        return 1
    ratio = Fraction(positions).limit_denominator(1000)
    return min(ratio.numerator, MOST_PARTS) if abs(ratio - Fraction(positions)) < 1e-9 else MOST_PARTS


def _moments(positions: float, sweeps: tuple[Sweep, ...], variant: str) -> tuple[float, float, float]:
    worst = np.zeros(3)
    for step in {sweep.step for sweep in sweeps}:
        numbers = np.arange(max(sweep.lines for sweep in sweeps if sweep.step == step))
        ways = beside_plan(positions, step, numbers, _parts(positions, step, EXACT))
        if variant == CENTRES:
            ways = ways - (ways.mean(axis=1, keepdims=True) if step == 1 else ways)
        size = np.abs(ways).mean(axis=1)
        # Ways of the several px of a line meet slopes of their own: they do not cancel.
        mean = np.abs(ways.mean(axis=1)) if step == 1 else size
        worst = np.maximum(worst, [one.max(initial=0.0) for one in (mean, size, (ways**2).mean(axis=1))])
    return float(worst[0]), float(worst[1]), float(worst[2])


@dataclass(frozen=True)
class Lag(Aim):
    """Mirror lag and overshoot: what is left of the start of a sweep, as the mean shift over each held position.

    The mirror follows its commands as a second-order system, x'' + 2 zeta x' + x = 0 in units of 1 / natural frequency.
    Calibration takes away the way that one in steady motion lies behind; what is left is the free oscillation between
    it and a mirror that starts from rest. Before a sweep it has flown back by the sweep's length, has had ``settled_s``
    to come to rest one held position ahead, and takes the first step as line 0 begins.
    """

    name = "lag"
    cost_ns = MappingProxyType({EXACT: 0.15})

    def aim(self, block: SweepBlock, variant: str) -> Floats:
        scan = transient(block.rig, block.sweep, block.numbers)
        return np.stack([np.zeros_like(scan), scan], axis=-1)

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        worst = greatest_lag_px(rig, probe.sweeps)
        moved = at_line_ends(probe.sweeps, rig.camera, 0.0, worst)
        pace = f"{rig.camera.frame_ms:g} ms a line, {rig.mirror.natural_hz:g} Hz"
        why = f"while the mirror gets up to speed ({pace})"
        return Bound(probe.moved(*moved), f"lines lie up to {worst:.2g} px off {why}")


def greatest_lag_px(rig: Rig, sweeps: Iterable[Sweep]) -> float:
    """Give the greatest shift along the scan of any line. [px]"""
    worst = 0.0
    for sweep in {(one.lines, one.step): one for one in sweeps if one.lines}.values():
        numbers = np.arange(sweep.lines)
        off = transient(rig, sweep, numbers)
        worst = max(worst, float(np.abs(off).mean(axis=1).max()))
    return worst


def transient(rig: Rig, sweep: Sweep, numbers: NDArray[np.int64]) -> Floats:
    """Give the mean shift along the scan over each held position of some lines, (line, step). [px]"""
    camera, mirror = rig.camera, rig.mirror
    pace = 2 * math.pi * mirror.natural_hz * 1e-3  # [1/ms]
    period, held = pace * camera.frame_ms, pace * camera.exposure_ms / sweep.step
    start = _at_start(mirror, sweep, period, held)
    time = numbers[:, None] * period + np.arange(sweep.step) * held
    impulse, rise = responses(time, mirror.damping)
    place: Floats = start[0] * (1 - rise) + start[1] * impulse
    rate = -start[0] * impulse + start[1] * (1 - rise - 2 * mirror.damping * impulse)
    if held == 0:
        return place
    impulse, rise = responses(np.array([held]), mirror.damping)
    mean: Floats = (place * (impulse + 2 * mirror.damping * rise) + rate * rise) / held
    return mean


def responses(time: Floats, damping: float) -> tuple[Floats, Floats]:
    """Give the responses to a unit impulse and to a unit step, of a system with natural frequency 1 rad/s.

    ``time`` (...) is times that frequency, from 0 on [rad]. With g the first and h the second, the matrix exponential
    of the free system is [[1 - h, g], [-g, 1 - h - 2 zeta g]]; by expm1 and sinc right below, at and above damping 1.
    """
    impulse = _impulse(time, damping)
    with np.errstate(under="ignore"):
        if damping <= 1:
            turn = math.sqrt((1 - damping) * (1 + damping)) * time
            rest = np.exp(-damping * time) * np.cos(turn) + damping * impulse
        else:
            slow = _slow_rate(damping)
            rest = np.exp(-slow * time) + slow * impulse
    early = time * (1 + 2 * damping) < _SERIES_BELOW
    return impulse, np.where(early, _early_rise(np.where(early, time, 0.0), damping), 1 - rest)


def _impulse(time: Floats, damping: float) -> Floats:
    with np.errstate(under="ignore"):
        if damping <= 1:
            turn = math.sqrt((1 - damping) * (1 + damping)) * time
            return np.exp(-damping * time) * time * np.sinc(turn / np.pi)
        apart = 2 * math.sqrt((damping - 1) * (damping + 1)) * time
        fraction = np.where(apart > 0, -np.expm1(-apart) / np.where(apart > 0, apart, 1.0), 1.0)
        return np.exp(-_slow_rate(damping) * time) * time * fraction


def _slow_rate(damping: float) -> float:
    """The smaller of the two rates of an overdamped system, zeta - sqrt(zeta^2 - 1) without its cancellation."""
    return 1 / (damping + math.sqrt((damping - 1) * (damping + 1)))


def _early_rise(time: Floats, damping: float) -> Floats:
    """The step response by its Taylor series, from h'' + 2 zeta h' + h = 1: where 1 - rest would cancel."""
    before, term = np.zeros_like(time), time**2 / 2
    total = term.copy()
    for order in range(3, _TERMS):
        before, term = term, -(2 * damping * time * term + time**2 / (order - 1) * before) / order
        total += term
    return total


def _at_start(mirror: MirrorMotion, sweep: Sweep, period: float, held: float) -> Floats:
    """State (place [px], rate) as line 0 begins: at rest, less steady motion; and what is left of the way back.

    A mirror in steady motion has the errors of all steps before: a geometric series over lines, I - exp(A period) its
    denominator, whose determinant h^2 + 2 zeta h g + g^2 is a sum.
    """
    damping = mirror.damping
    times, height, every = _steps(mirror, sweep, period, held)
    impulse, rise = responses(times, damping)
    place, rate = height * float((1 - rise).sum()), -height * float(impulse.sum())
    g, h = (one.item() for one in responses(np.array([every]), damping))
    size = h * h + 2 * damping * h * g + g * g
    steady = np.array([(h + 2 * damping * g) * place + g * rate, -g * place + h * rate]) / size
    flown = float(sweep.lines * sweep.step)
    settled = np.array([2 * math.pi * mirror.natural_hz * mirror.settled_s])
    g, h = (one.item() for one in responses(settled, damping))
    return steady + flown * np.array([1 - h, -g])


def _steps(mirror: MirrorMotion, sweep: Sweep, period: float, held: float) -> tuple[Floats, float, float]:
    """Times from the steps of one pattern before the sweep to its start, the steps' height, the pattern's length.

    A pattern is a line with its number of positions, rounded, or one position that is held for several lines.
    """
    wanted = mirror.positions_per_line * sweep.step
    if wanted < 1:
        return np.array([period / wanted]), sweep.step / wanted, period / wanted
    count = min(max(round(wanted), 1), _RAMP)
    exposed = held * sweep.step
    return period - np.arange(count) * exposed / count, sweep.step / count, period


STAIRCASE, LAG = Staircase(), Lag()
