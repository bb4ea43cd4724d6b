"""Check of the decision: the worst blocks of lines are rendered with and without what was left out."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import BoundError, ShapeError
from pipeline.geometry.scan import scene_to_sweep
from pipeline.simulator.effects.effect import OFF, Effect, Radiance, SweepBlock
from pipeline.simulator.effects.line import SLIT, SMEAR
from pipeline.simulator.effects.probe import stored_mean
from pipeline.simulator.optics.scene_radiance import TABULATED
from pipeline.simulator.selection.choice import TOTAL, UNIT_NAMES, Decision
from pipeline.simulator.selection.options import acts_on_light

Floats = NDArray[np.float64]
Units = Callable[[Radiance, int], NDArray[np.floating]]  # of the mean light of so many samples that a number sums
Render = Callable[[SweepBlock, Mapping[Effect, str]], Radiance]
HARDLY = 1e-3  # units: an effect that changes less is measured together with the others alone
VERIFIED_LINES = 3  # whole ones, for stray light comes from all of a line
MOST_CANDIDATES = 40
ROUNDING = 4e-6  # of the brightest light of some lines: float32 sums
KERNELS = 4e-3  # of the light's range, by which two sets of kernels that are fitted to the same blurs may differ


def candidate_blocks(whole: Sequence[SweepBlock], places: Floats, *, lines: int = VERIFIED_LINES) -> list[SweepBlock]:
    """Return blocks of few lines about places of the scene and about the first, middle and last line of every sweep.

    ``whole``: every sweep as one block of all its lines; ``places``: (place, 2) rows and columns that are steep, bright
    or dark [px]. Returns at most `MOST_CANDIDATES`, evenly out of all, none twice.
    """
    found = [(block, first) for block in whole for first in _first_lines(block, places, lines)]
    kept = np.unique(np.linspace(0, len(found) - 1, min(len(found), MOST_CANDIDATES)).round().astype(int))
    chosen = [found[number] for number in kept]
    return [replace(block, lines=range(first, min(first + lines, block.sweep.lines))) for block, first in chosen]


def _first_lines(block: SweepBlock, places: Floats, lines: int) -> list[int]:
    sweep, camera = block.sweep, block.rig.camera
    middles = [0, sweep.lines // 2, sweep.lines - 1] if sweep.lines else []
    centred = np.reshape(places, (-1, 2)) - (np.array(block.shape) - 1) / 2
    along, scan = (centred if sweep.along == "y" else centred[:, ::-1]).T
    line, sample = scene_to_sweep(replace(sweep, binning=1), camera, along, scan).T
    with np.errstate(invalid="ignore"):  # places that no ray reaches
        seen = (line > -1) & (line < sweep.lines) & (sample > -1) & (sample < camera.samples)
    middles += np.rint(line[seen]).astype(int).tolist()
    return sorted({max(0, min(middle - lines // 2, sweep.lines - lines)) for middle in middles})


def worst_blocks(
    candidates: Sequence[SweepBlock], render: Callable[[SweepBlock], Radiance], units: Units
) -> dict[str, SweepBlock]:
    """Return the steepest, brightest, darkest and most oblique of some blocks, where bounds are hardest to keep.

    They are blocks of stored numbers, separate for each binning. ``render`` gives expected electrons (line, sample,
    band), ``units`` one unit of the tolerance at each [e-], from electrons and their binning. Returns them by name; one
    block may have several. Raises ShapeError: there is nothing to choose from.
    """
    best: dict[str, tuple[float, SweepBlock]] = {}
    least = min((block.sweep.binning for block in candidates), default=1)
    for block in candidates:
        binning = block.sweep.binning
        light = stored_mean(render(block), binning)
        if not light.size:
            continue
        relative = light / units(light, binning)
        steps = [np.abs(np.diff(relative, axis=axis)).max(initial=0.0) for axis in (0, 1)]
        scores = {
            "steepest": float(max(steps)),
            "brightest": float(relative.max()),
            "darkest": -float(relative.min()),
            "most oblique": float(block.normals[:, 2].max()),
        }
        for name, score in scores.items():
            full_name = name if binning == least else f"{name} in sums of {binning}"
            if full_name not in best or score > best[full_name][0]:
                best[full_name] = score, block
    if not best:
        raise ShapeError(
            f"no lines to verify effects on: {len(candidates)} candidates hold no sample; give lines of a sweep"
        )
    return {name: block for name, (_, block) in best.items()}


@dataclass(frozen=True)
class _Rendered:
    """A block with everything on as it is stored, and what a unit of the tolerance is at each of its numbers [e-]."""

    name: str
    block: SweepBlock
    light: NDArray[np.floating]
    unit: NDArray[np.floating]


@dataclass(frozen=True)
class _Change:
    """The greatest change on a block in units of the tolerance; the one that arithmetic least explains, and where."""

    greatest: float = 0.0
    change: float = 0.0
    unexplained: float = 0.0  # of the change, by arithmetic; endless where light is no number
    place: str = ""


def verify(
    decision: Decision, render: Render, blocks: Mapping[str, SweepBlock], units: Units, range_e: float
) -> dict[str, float]:
    """Measure on blocks what every effect that is off or cheapened changes, and all together, against everything on.

    Draws are paired: the difference is the effect's alone. Effects of the readout change distributions, not expected
    light, and are not measured. ``render`` gives expected electrons (line, sample, band) of a block with some effects
    on, ``units`` one unit of the tolerance at each [e-]. ``range_e`` is the range of the scene's light: so much of it
    as `KERNELS` says may lie elsewhere. Returns the greatest change of a stored number in units, by name. The names are
    `TOTAL` and each effect that is not exact and bounded by more than `HARDLY`. A request for ``none`` returns that
    alone.

    Raises BoundError: a change exceeds the bound that the decision counted on; names effect, bound, change and place.
    """
    names: dict[tuple[str, range], list[str]] = {}
    for name, block in blocks.items():
        names.setdefault((block.sweep.name, block.lines), []).append(name)
    full = []
    for shared in names.values():
        block = blocks[shared[0]]
        light = stored_mean(render(block, decision.exact), block.sweep.binning)
        unit = np.broadcast_to(units(np.asarray(light, np.float32), block.sweep.binning), light.shape)
        full.append(_Rendered(" and ".join(shared), block, light, unit))
    changed = [
        one
        for one in decision.taken
        if acts_on_light(one.menu.effect) and one.menu.present and one.option is not one.menu.exact
    ]
    each = [one for one in changed if one.option.error > HARDLY] if decision.asked != "none" else []
    measured: dict[str, float] = {}
    for name, inexact in [(one.name, [one]) for one in each] + [(TOTAL, changed)]:
        instead = {one.name: one.option.variant for one in inexact}
        variants = {effect: instead.get(effect.name, variant) for effect, variant in decision.exact.items()}
        chosen = {effect: variant for effect, variant in variants.items() if variant != OFF}
        misplaced_e = range_e * misplaced_fraction(decision.exact, chosen)
        found = [_greatest_change(one, render(one.block, chosen), misplaced_e) for one in full] if inexact else []
        worst = max(found, key=lambda one: one.unexplained, default=_Change())
        bound = math.fsum(one.option.error for one in inexact)
        if not worst.unexplained <= bound:
            raise BoundError(
                f"{name}: leaving it out changes light by {worst.change:.3g} {UNIT_NAMES[decision.unit]} at"
                f" {worst.place}, above its bound of {bound:.3g}; the probe missed how bright or steep the scene is"
                " there: simulate with --tol 0 or --effects all, and please report it with the rig's settings"
            )
        measured[name] = max((one.greatest for one in found), default=0.0)
    return measured


def _greatest_change(one: _Rendered, light: Radiance, misplaced_e: float) -> _Change:
    block, binning = one.block, one.block.sweep.binning
    change = np.abs(stored_mean(light, binning).astype(np.float64) - one.light) / one.unit
    if not change.size:
        return _Change()
    left = change - (misplaced_e + ROUNDING * float(np.abs(one.light).max())) / one.unit
    worst = np.unravel_index(int(np.argmax(left)), left.shape)  # the first NaN, if there is one
    line, number, band = worst
    summed = "" if binning == 1 else f" (of {binning} summed)"
    place = f"sweep {block.sweep.name}, line {block.numbers[line]}, sample {number}{summed}, band {band}"
    unexplained = math.inf if math.isnan(left[worst]) else float(left[worst])
    return _Change(float(change.max()), float(change[worst]), unexplained, f"{place} of the {one.name} lines")


def misplaced_fraction(exact: Mapping[Effect, str], chosen: Mapping[Effect, str]) -> float:
    """Return the fraction of the light's range by which arithmetic may make two ways to render it differ.

    Tables of weights misplace up to `TABULATED` along either axis, in either image. Kernels that stand for those of all
    bands differ, too, where blurs or held positions do.
    """
    return 2 * TABULATED + (0.0 if _folded(exact) == _folded(chosen) else KERNELS)


def _folded(ways: Mapping[Effect, str]) -> dict[str, str]:
    blurs = {one.name: way for one, way in ways.items() if hasattr(one, "moments") or one.name == SMEAR.name}
    return blurs | {one.name: "box" for one in ways if one.name == SLIT.name}
