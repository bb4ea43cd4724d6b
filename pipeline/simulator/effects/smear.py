"""Motion smear: the mirror moves on while a line is exposed, held position by held position."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from pipeline.scan import Sweep
from pipeline.simulator.block import SweepBlock
from pipeline.simulator.effects.effect import OFF, Bound
from pipeline.simulator.effects.lag import transient
from pipeline.simulator.effects.line_ends import at_line_ends, end_gains
from pipeline.simulator.effects.parallax import PARALLAX, greatest_share
from pipeline.simulator.effects.staircase import beside_plan
from pipeline.simulator.effects.wind import sway_gradient
from pipeline.simulator.probe import Probe
from pipeline.simulator.rig_model import Rig

POSITIONS, FOLDED = "positions", "folded"

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Smear:
    """The positions held within an exposure. Off, the mirror stands at mid exposure.

    ``folded`` takes them into the footprint, as if all lines of an exposure lay as its middle one does.
    """

    name = "smear"
    variants = (POSITIONS, FOLDED)
    cost_ns = MappingProxyType({POSITIONS: 15.0, FOLDED: 5.2})

    def bound(self, probe: Probe, rig: Rig, variant: str = OFF) -> Bound:
        """Bound what a blur of the positions' variance changes; 0 where every line has one position.

        They vary as the mirror runs: without them its course within an exposure is left out as well.
        """
        most = max((sweep.step for sweep in probe.sweeps), default=1)
        variance = held_variance(most)
        if variant == POSITIONS or variance == 0:
            return Bound(0.0, "the mirror stands still while a line is exposed" if variance == 0 else "exact")
        if variant == FOLDED:
            along, scan = _beside(probe.sweeps, rig)
            along, scan = along + sway_gradient(rig), scan + sway_gradient(rig) + greatest_share(rig.air)
            way, area = np.abs(np.arange(most) - (most - 1) / 2).mean(), 2 * variance
            by_scan = np.minimum(probe.slope[1] * way, probe.curvature[1] * area) * scan
            course = at_line_ends(probe.sweeps, rig.camera, 0.0, _uneven_course(probe.sweeps, rig))
            by_course = probe.slope[0] * course[0] + probe.slope[1] * course[1]
            change = np.minimum(probe.slope[0] * way * along + by_scan + by_course, probe.span)
            # at a step of the relief up to half of the positions see the other depth, at most twice as far off
            step = PARALLAX.bound(probe, rig).value if rig.air.relief == "step" else 0.0
            return Bound(float(change.max(initial=0.0)) + step, f"lines of an exposure lie as one, {most} px")
        both = np.zeros(probe.slope.shape)
        both[1] = max(variance, _greatest_variance(probe.sweeps, rig))
        return Bound(probe.blurred(both), f"the mirror moves {most} px in an exposure")


SMEAR = Smear()


def _uneven_course(sweeps: tuple[Sweep, ...], rig: Rig) -> float:
    """Greatest mean way of held positions from where the mirror's mean in the exposure would have them. [px]"""
    uneven = (np.abs(ways - ways.mean(axis=1, keepdims=True)).mean(axis=1) for ways in _courses(sweeps, rig))
    return max((float(one.max()) for one in uneven), default=0.0)


def _greatest_variance(sweeps: tuple[Sweep, ...], rig: Rig) -> float:
    """Greatest variance of the positions of an exposure as the mirror runs, not as planned. [px^2]"""
    held = ((ways + np.arange(ways.shape[1])).var(axis=1) for ways in _courses(sweeps, rig))
    return max((float(one.max()) for one in held), default=0.0)


def _courses(sweeps: tuple[Sweep, ...], rig: Rig) -> Iterator[Floats]:
    """Ways of held positions beside their plan, (line, step), of each kind of sweep that has several. [px]"""
    for sweep in {(one.lines, one.step): one for one in sweeps if one.lines and one.step > 1}.values():
        numbers = np.arange(sweep.lines)
        yield transient(rig, sweep, numbers) + beside_plan(rig.mirror.positions_per_line, sweep.step, numbers)


def held_variance(positions: int) -> float:
    """Variance of positions 1 px apart [px^2]."""
    return (positions**2 - 1) / 12


def smeared_positions(block: SweepBlock, variant: str) -> Floats:
    """Give the mirror positions (line, step, 2) at which a footprint stands in an exposure."""
    if variant == POSITIONS and block.sweep.step > 1:
        return block.positions
    return block.middle[:, None]


def folded_positions(sweep: Sweep, variant: str) -> int:
    """Give how many held positions the footprint itself holds, 1 px apart along the scan."""
    return sweep.step if variant == FOLDED else 1


def _beside(sweeps: tuple[Sweep, ...], rig: Rig) -> tuple[float, float]:
    """Greatest way beside its place, along the line and the scan, of any point per px that the line's centre moves."""
    found = np.zeros(2)
    for sweep in sweeps:
        if sweep.lines and sweep.step > 1:
            moved = end_gains(sweep, rig.camera)[..., 1] - [0.0, 1.0]
            found = np.maximum(found, np.abs(moved).max(axis=(0, 1)))
    return float(found[0]), float(found[1])
