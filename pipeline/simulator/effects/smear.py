"""Motion smear: the mirror moves on while a line is exposed, held position by held position."""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from pipeline.scan import shifted_position
from pipeline.simulator.block import Block
from pipeline.simulator.effects.effect import OFF, Bound
from pipeline.simulator.footprint import quadrature
from pipeline.simulator.probe import Probe
from pipeline.simulator.rig_model import Rig

POSITIONS, FOLDED = "positions", "folded"

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Smear:
    """The positions held within an exposure. Off, the mirror stands at mid exposure."""

    name = "smear"
    variants = (POSITIONS, FOLDED)
    cost_ns = MappingProxyType({POSITIONS: 7.8, FOLDED: 5.2})

    def bound(self, probe: Probe, rig: Rig, variant: str = OFF) -> Bound:
        """Bound what a blur of the positions' variance changes; 0 where every line has one position."""
        most = max((sweep.step for sweep in probe.sweeps), default=1)
        variance = held_variance(most)
        if variant == POSITIONS or variance == 0:
            return Bound(0.0, "the mirror stands still while a line is exposed" if variance == 0 else "exact")
        if variant == FOLDED:
            way, area = np.max([_apart(sweep.step, rig.camera.slit_px) for sweep in probe.sweeps], axis=0)
            change = np.minimum(np.minimum(probe.slope[1] * way, probe.curvature[1] * area), probe.span)
            return Bound(float(change.max(initial=0.0)), f"light lies {way:.2g} px beside its place, mean 0")
        both = np.zeros(probe.slope.shape)
        both[1] = variance
        return Bound(probe.blurred(both), f"the mirror moves {most} px in an exposure")


SMEAR = Smear()


def held_variance(positions: int) -> float:
    """Variance of positions 1 px apart [px^2]."""
    return (positions**2 - 1) / 12


def smeared_positions(block: Block, variant: str) -> tuple[Floats, Floats]:
    """Give the mirror positions (line, step, 2) that stand for an exposure, and (step,) weights of sum 1."""
    count = block.sweep.step
    if variant == OFF or count == 1:
        return block.middle[:, None], np.ones(1)
    if variant == POSITIONS:
        return block.positions, np.full(count, 1 / count)
    offset, weight = fewer_positions(count, block.rig.camera.slit_px)
    shift = np.stack([np.zeros_like(offset), offset], axis=-1)
    return shifted_position(block.middle[:, None], shift, block.rig.camera), weight


def fewer_positions(count: int, slit_px: float) -> tuple[Floats, Floats]:
    """Give offsets from mid exposure [px] and weights of Gauss's quadrature for ``count`` positions 1 px apart.

    They lie a slit's width apart at the ends and less within, so that no part of the scene falls between.
    """
    place: Floats = np.arange(count, dtype=np.float64) - (count - 1) / 2
    return quadrature(place, np.full(count, 1 / count), min(count, math.ceil(count / max(slit_px, 1.0)) + 1))


def _apart(count: int, slit_px: float) -> tuple[float, float]:
    """Give what slope [px] and curvature [px^2] are multiplied by to bound the error of fewer positions.

    The integrals of the size of the first and second antiderivative of the difference of both kernels (Peano).
    """
    offset, weight = fewer_positions(count, slit_px)
    exact = np.arange(count, dtype=np.float64) - (count - 1) / 2
    grid = np.linspace(-count / 2, count / 2, 200 * count + 1)
    less = (grid[:, None] >= offset) @ weight - (grid[:, None] >= exact).mean(axis=1)
    step = float(grid[1] - grid[0])
    return float(np.abs(less).sum() * step), float(np.abs(np.cumsum(less)).sum() * step**2)
