"""The staircase of the path: positions of the vector memory that do not fall together with the lines."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from pipeline.scan import Sweep
from pipeline.simulator.block import SweepBlock
from pipeline.simulator.effects.effect import OFF, Bound
from pipeline.simulator.effects.line_ends import at_line_ends
from pipeline.simulator.probe import Probe
from pipeline.simulator.rig_model import Rig

Floats = NDArray[np.float64]
EXACT, CENTRES = "exact", "centres"
MOST_PARTS = 8  # of an exposure; a jump of h px within a part goes unseen as a blur of at most h^2/32 px^2


@dataclass(frozen=True)
class Staircase:
    """Sample and hold with any number of positions per px of path. Off, each px of the path has its one position.

    The memory is played at a steady rate while lines are exposed and stands still while they are read out; it is
    timed so that in the long run lines lie where they are planned. ``exact`` gives the mean position in equal parts of
    the exposure, chosen so that no position changes within a part wherever :data:`MOST_PARTS` are enough; ``centres``
    gives the mean of the whole exposure. A line that holds several px of path has one part for each in either variant.
    """

    name = "staircase"
    variants = (EXACT, CENTRES)
    cost_ns = MappingProxyType({EXACT: 18.0, CENTRES: 0.01})  # exact: five positions a line instead of one

    def aim(self, block: SweepBlock, variant: str) -> Floats:
        """Give how far beside the plan the mirror stands, (line, part, 2) along the line and the scan. [px]"""
        positions = block.rig.mirror.positions_per_line
        scan = beside_plan(positions, block.sweep.step, block.numbers, _parts(positions, block.sweep.step, variant))
        return np.stack([np.zeros_like(scan), scan], axis=-1)

    def bound(self, probe: Probe, rig: Rig, variant: str = OFF) -> Bound:
        """Bound by what a shift of the mean and a blur of the second moment change, or slope times the mean way."""
        positions = rig.mirror.positions_per_line
        if variant == EXACT or positions == 1 or not probe.sweeps:
            return Bound(0.0, "exact" if variant == EXACT else "each px of the path has its one position")
        mean, size, square = _moments(positions, probe.sweeps, variant)
        both = np.zeros(probe.slope.shape)
        ends = [at_line_ends(probe.sweeps, rig.camera, 0.0, way) for way in (size, mean, square**0.5)]
        both[:] = np.square(ends[2])[:, None]
        value = min(probe.moved(*ends[0]), probe.moved(*ends[1]) + probe.blurred(both))
        return Bound(value, f"lines lie up to {mean:.3f} px off, held positions {square**0.5:.2f} px rms")


STAIRCASE = Staircase()


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
    shift: Floats = middle + (0.5 - lag) / positions
    return shift


def _parts(positions: float, step: int, variant: str) -> int:
    """Equal parts of an exposure; positions a / b change at multiples of 1 / a of it."""
    if variant == CENTRES or step > 1:
        return 1
    ratio = Fraction(positions).limit_denominator(1000)
    return min(ratio.numerator, MOST_PARTS) if abs(ratio - Fraction(positions)) < 1e-9 else MOST_PARTS


def _moments(positions: float, sweeps: tuple[Sweep, ...], variant: str) -> tuple[float, float, float]:
    """Greatest mean way, mean size of the way and mean square of it over all lines, beside the plan or a variant."""
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
