"""The decision checked afterwards: the worst chips of the scene rendered with and without what was left out."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import BoundError
from pipeline.simulator.block import Block
from pipeline.simulator.chips import Units
from pipeline.simulator.choice import Decision, Taken
from pipeline.simulator.effects.effect import OFF, Effect, Light
from pipeline.simulator.manifest import TOTAL, UNIT_WORDS
from pipeline.simulator.options import acts_on_light

Floats = NDArray[np.float64]
Render = Callable[[Block, Mapping[Effect, str]], Light]

ROUNDING = 4e-6  # of the light: float32 sums over the rays of a footprint


@dataclass(frozen=True)
class _Chip:
    """A chip with everything on, and what a unit of the tolerance is at each of its samples [e-]."""

    name: str
    block: Block
    light: Light
    unit: NDArray[np.floating]


@dataclass(frozen=True)
class _Change:
    """The greatest change on a chip in units of the tolerance, what of it float32 may have made, and where it is."""

    change: float
    rounding: float = 0.0
    place: str = ""


def verify(decision: Decision, render: Render, chips: Mapping[str, Block], units: Units) -> dict[str, float]:
    """Measure on chips what every effect that is off or cheapened changes, and all together, against everything on.

    Draws are paired: streams are keyed by seed, sweep, line and effect, so that the difference is the effect's alone.
    Effects of the readout change distributions, not expected light, and are not measured here.

    Parameters
    ----------
    render
        Expected electrons (line, sample, band) of a block with some effects on.
    chips
        By name, as `chips.worst_chips` chooses them.
    units
        From expected electrons with everything on to one unit of the tolerance at each. [e-]

    Returns
    -------
    Greatest change in the unit of the tolerance: by the name of each effect that is not exact, and of `TOTAL`.

    Raises
    ------
    BoundError : a change exceeds the bound that the decision counted on; names effect, bound, change and place.
    """
    full = []
    for name, block in _once_each(chips).items():
        light = render(block, decision.exact)
        full.append(_Chip(name, block, light, np.broadcast_to(units(light), light.shape)))
    changed = [one for one in decision.taken if _changes_light(one)]
    trials = [(one.name, [one]) for one in changed] + [(TOTAL, changed)]
    measured: dict[str, float] = {}
    for name, inexact in trials:
        bound, chosen = math.fsum(one.option.error for one in inexact), _with(decision, inexact)
        found = [_greatest_change(chip, render(chip.block, chosen)) for chip in full] if inexact else []
        worst = max(found, key=lambda one: math.inf if math.isnan(one.change) else one.change, default=_Change(0.0))
        if not worst.change <= bound + worst.rounding:
            raise BoundError(_complaint(name, worst, bound, decision))
        measured[name] = worst.change
    return measured


def _once_each(chips: Mapping[str, Block]) -> dict[str, Block]:
    """Join the names of chips that are the same lines: the brightest is often the steepest as well."""
    names: dict[tuple[str, range], list[str]] = {}
    for name, block in chips.items():
        names.setdefault((block.sweep.name, block.lines), []).append(name)
    return {" and ".join(said): chips[said[0]] for said in names.values()}


def _changes_light(one: Taken) -> bool:
    return acts_on_light(one.menu.effect) and one.menu.present and one.option is not one.menu.exact


def _with(decision: Decision, inexact: Sequence[Taken]) -> dict[Effect, str]:
    """Everything exact but these, in the order of the chain."""
    instead = {one.name: one.option.variant for one in inexact}
    variants = {effect: instead.get(effect.name, variant) for effect, variant in decision.exact.items()}
    return {effect: variant for effect, variant in variants.items() if variant != OFF}


def _greatest_change(chip: _Chip, light: Light) -> _Change:
    change = np.abs(light.astype(np.float64) - chip.light) / chip.unit
    if not change.size:
        return _Change(0.0)
    line, sample, band = np.unravel_index(int(np.argmax(change)), change.shape)  # the first NaN, if there is one
    block = chip.block
    place = f"sweep {block.sweep.name}, line {block.numbers[line]}, sample {block.columns[sample]}, band {band}"
    rounding = ROUNDING * float(np.max(np.abs(chip.light) / chip.unit))
    return _Change(float(change[line, sample, band]), rounding, f"{place} of the {chip.name} chip")


def _complaint(name: str, worst: _Change, bound: float, decision: Decision) -> str:
    return (
        f"{name}: what was left out changes light by {worst.change:.3g} {UNIT_WORDS[decision.unit]} at {worst.place},"
        f" above its bound of {bound:.3g}; the probe missed how bright or steep the scene is there: simulate with"
        " --tol 0 or --effects all, and please report it with the rig's settings"
    )
