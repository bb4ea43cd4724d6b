"""The decision checked afterwards: the worst blocks of lines rendered with and without what was left out."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy
from numpy.typing import NDArray

from pipeline.errors import BoundError, PoseError, ShapeError
from pipeline.geometry.scan import Sweep, line_positions, scene_to_sweep
from pipeline.simulator.effects.blurs import DIFFRACTION
from pipeline.simulator.effects.effect import OFF, Effect, Radiance, SweepBlock
from pipeline.simulator.effects.line import ROTATION, SLIT, SMEAR, folded_positions
from pipeline.simulator.effects.probe import stored_mean
from pipeline.simulator.optics.kernel_fit import NEGLIGIBLE
from pipeline.simulator.optics.tap_sums import TABULATED
from pipeline.simulator.render import kernel_error, tails_apart
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.selection.choice import TOTAL, UNIT_NAMES, Decision
from pipeline.simulator.selection.options import acts_on_light

Floats = NDArray[np.float64]
Units = Callable[[Radiance, int], NDArray[np.floating]]  # of the mean light of so many samples that a number sums
HARDLY = 1e-3  # units: an effect that changes less is measured together with the others alone
VERIFIED_LINES = 3  # whole ones, for stray light comes from all of a line
MOST_CANDIDATES = 40
Render = Callable[[SweepBlock, Mapping[Effect, str]], Radiance]
ROUNDING = 4e-6  # of the brightest light of some lines: float32 sums
REACH_PX = 8  # of a footprint's weights, along the line and the scan, but for the tails of diffraction
TAILS_PX = 128  # of these: beyond, less is put elsewhere than by tables, in bands from 400 to 1000 nm
_HALVES = ((0.0, 0.0), (0.5, 0.0), (0.0, 0.5), (0.5, 0.5))  # px along and scan
MIDDLE_RAYS: Mapping[Effect, str] = {ROTATION: ROTATION.variants[0]}  # the scene itself, where lines really lie


def candidate_blocks(whole: Sequence[SweepBlock], places: Floats, *, lines: int = VERIFIED_LINES) -> list[SweepBlock]:
    """Return blocks of few lines about places of the scene and about the first, middle and last line of every sweep.

    ``whole``: every sweep as one block of all its lines; ``places``: (place, 2) rows and columns that are steep, bright
    or dark [px]. Returns at most `MOST_CANDIDATES`, evenly out of all, none twice.
    """
    found = [(block, first) for block in whole for first in _first_lines(block, places, lines)]
    kept = np.unique(np.linspace(0, len(found) - 1, min(len(found), MOST_CANDIDATES)).round().astype(int))
    chosen = [found[number] for number in kept]
    return [replace(block, lines=range(first, min(first + lines, block.sweep.lines))) for block, first in chosen]


def worst_blocks(
    candidates: Sequence[SweepBlock], render: Callable[[SweepBlock], Radiance], units: Units
) -> dict[str, SweepBlock]:
    """Choose where bounds are hardest to keep: the steepest, brightest, darkest and most oblique of some blocks.

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
        for name, score in _scores(block, light / units(light, binning)).items():
            called = name if binning == least else f"{name} in sums of {binning}"
            if called not in best or score > best[called][0]:
                best[called] = score, block
    if not best:
        raise ShapeError(
            f"no lines to verify effects on: {len(candidates)} candidates hold no sample; give lines of a sweep"
        )
    return {name: block for name, (_, block) in best.items()}


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


def _scores(block: SweepBlock, relative: Floats) -> dict[str, float]:
    steps = [np.abs(np.diff(relative, axis=axis)).max(initial=0.0) for axis in (0, 1)]
    return {
        "steepest": float(max(steps)),
        "brightest": float(relative.max()),
        "darkest": -float(relative.min()),
        "most oblique": float(block.normals[:, 2].max()),
    }


@dataclass(frozen=True)
class _Rendered:
    """A block with everything on as it is stored, and what a unit of the tolerance is at each of its numbers [e-]."""

    name: str
    block: SweepBlock
    light: NDArray[np.floating]
    unit: NDArray[np.floating]
    render: Render

    @cached_property
    def contrast(self) -> NDArray[np.floating]:
        """Range of the scene's light about each number, (1, number, band) [e-]; only asked for where it matters."""
        return stored_mean(contrast_about(self.block, self.render), self.block.sweep.binning)


@dataclass(frozen=True)
class _Change:
    """The greatest change on a block in units of the tolerance; the one that arithmetic least explains, and where."""

    greatest: float
    change: float = 0.0
    rounding: float = 0.0  # what of it arithmetic may have made
    place: str = ""

    @property
    def unexplained(self) -> float:
        """Return what arithmetic can not have made; endless where light is no number."""
        return math.inf if math.isnan(self.change) else self.change - self.rounding


def verify(decision: Decision, render: Render, blocks: Mapping[str, SweepBlock], units: Units) -> dict[str, float]:
    """Measure on blocks what every effect that is off or cheapened changes, and all together, against everything on.

    Draws are paired: the difference is the effect's alone. Effects of the readout change distributions, not expected
    light, and are not measured. ``render`` gives expected electrons (line, sample, band) of a block with some effects
    on, ``units`` one unit of the tolerance at each [e-]. Returns the greatest change of a stored number in units, by
    name. The names are `TOTAL` and each effect that is not exact and bounded by more than `HARDLY`. A request for
    ``none`` returns that alone.

    Raises BoundError: a change exceeds the bound that the decision counted on; names effect, bound, change and place.
    """
    names: dict[tuple[str, range], list[str]] = {}
    for name, block in blocks.items():
        names.setdefault((block.sweep.name, block.lines), []).append(name)
    full = []
    for block, said in ((blocks[said[0]], said) for said in names.values()):
        light = stored_mean(render(block, decision.exact), block.sweep.binning)
        unit = np.broadcast_to(units(np.asarray(light, np.float32), block.sweep.binning), light.shape)
        full.append(_Rendered(" and ".join(said), block, light, unit, render))
    changed = [
        one
        for one in decision.taken
        if acts_on_light(one.menu.effect) and one.menu.present and one.option is not one.menu.exact
    ]
    each = [one for one in changed if one.option.error > HARDLY] if decision.asked != "none" else []
    trials = [(one.name, [one]) for one in each] + [(TOTAL, changed)]
    measured: dict[str, float] = {}
    for name, inexact in trials:
        instead = {one.name: one.option.variant for one in inexact}
        variants = {effect: instead.get(effect.name, variant) for effect, variant in decision.exact.items()}
        bound = math.fsum(one.option.error for one in inexact)
        chosen = {effect: variant for effect, variant in variants.items() if variant != OFF}
        found = [_greatest_change(one, decision.exact, chosen, bound) for one in full] if inexact else []
        worst = max(found, key=lambda one: one.unexplained, default=_Change(0.0))
        if not worst.unexplained <= bound:
            raise BoundError(
                f"{name}: what was left out changes light by {worst.change:.3g} {UNIT_NAMES[decision.unit]} at"
                f" {worst.place}, above its bound of {bound:.3g}; the probe missed how bright or steep the scene is"
                " there: simulate with --tol 0 or --effects all, and please report it with the rig's settings"
            )
        measured[name] = max((one.greatest for one in found), default=0.0)
    return measured


def _greatest_change(
    one: _Rendered, exact: Mapping[Effect, str], chosen: Mapping[Effect, str], bound: float
) -> _Change:
    binning = one.block.sweep.binning
    change = np.abs(stored_mean(one.render(one.block, chosen), binning).astype(np.float64) - one.light) / one.unit
    if not change.size:
        return _Change(0.0)
    rounding = np.zeros(change.shape)
    if not change.max() <= bound:
        rounding = misplaced_electrons(one.light, one.contrast, misplaced_fraction(one.block, exact, chosen)) / one.unit
        if not (change - rounding).max() <= bound:
            afar = misplaced_in_tails(one.block, exact, chosen, one.render)
            rounding = rounding + stored_mean(afar, binning) / one.unit
    worst = np.unravel_index(int(np.argmax(change - rounding)), change.shape)  # the first NaN, if there is one
    line, number, band = worst
    block, summed = one.block, "" if binning == 1 else f" (of {binning} summed)"
    place = f"sweep {block.sweep.name}, line {block.numbers[line]}, sample {number}{summed}, band {band}"
    return _Change(
        float(change.max()), float(change[worst]), float(rounding[worst]), f"{place} of the {one.name} lines"
    )


def misplaced_electrons(light: NDArray[np.floating], contrast: NDArray[np.floating], fraction: float) -> Floats:
    """Bound by how much two ways may differ at each number of some lines (line, number, band). [e-]

    ``contrast`` is that of `contrast_about`, stored as the light is, ``fraction`` that of `misplaced_fraction`.
    """
    return fraction * contrast.astype(np.float64) + ROUNDING * float(np.abs(light).max(initial=0.0))


def misplaced_fraction(block: SweepBlock, exact: Mapping[Effect, str], chosen: Mapping[Effect, str]) -> float:
    """Return the fraction of the contrast about a sample by which two ways to compute its light may differ at most.

    Tables of weights misplace up to `TABULATED` of the light along either axis, in either image. Kernels that stand for
    those of all bands differ, too, where blurs or held positions do. Each is right to `NEGLIGIBLE` unless its footprint
    says otherwise. Half counts.
    """
    if _folded(exact) == _folded(chosen):
        return 2 * TABULATED
    return 2 * TABULATED + sum(max(kernel_error(block, one), NEGLIGIBLE) for one in (exact, chosen)) / 2


def misplaced_in_tails(
    block: SweepBlock, exact: Mapping[Effect, str], chosen: Mapping[Effect, str], render: Render
) -> Floats:
    """Bound by how much the tails of kernels make two ways differ at each sample, (1, sample, band). [e-]

    They do where blurs or held positions are folded otherwise and both ways have the pattern of the pupil. Light that
    is spread `REACH_PX` and more counts by the range of the scene within `TAILS_PX`.
    """
    fraction = tails_fraction(block, exact, chosen)
    if not fraction.any():
        return np.zeros((1, block.rig.camera.samples, len(block.wavelength_nm)))
    return fraction * contrast_about(block, render, TAILS_PX)


def tails_fraction(block: SweepBlock, exact: Mapping[Effect, str], chosen: Mapping[Effect, str]) -> Floats:
    """Return the fraction of light that two renderings place differently beyond `REACH_PX`, by kernels, (band,)."""
    positions = (folded_positions(block.sweep, _way(ways, SMEAR)) for ways in (exact, chosen))
    same = len(set(positions)) == 1 and _folded(exact) == _folded(chosen)
    if same or _way(exact, DIFFRACTION) != _way(chosen, DIFFRACTION):
        return np.zeros(len(block.wavelength_nm))
    return tails_apart(block, exact, chosen, REACH_PX)


def _way(ways: Mapping[Effect, str], effect: Effect) -> str:
    return next((way for one, way in ways.items() if one.name == effect.name), OFF)


def _folded(ways: Mapping[Effect, str]) -> dict[str, str]:
    blurs = {one.name: way for one, way in ways.items() if hasattr(one, "moments") or one.name == SMEAR.name}
    return blurs | {one.name: "box" for one in ways if one.name == SLIT.name}


def contrast_about(block: SweepBlock, render: Render, reach_px: int = REACH_PX) -> Floats:
    """Return the range of the scene's light within a reach of each sample, (1, sample, band). [e-]

    The scene is looked at by middle rays, a px and half a px apart: pixels may lie between those of one look.
    """
    held = _beyond(block.sweep, block.rig, reach_px)
    first = round(block.sweep.start_px - held.start_px) + block.lines.start * block.sweep.step
    ends = first - reach_px, first + len(block.lines) * block.sweep.step + reach_px
    wide = replace(block, sweep=held, lines=range(max(ends[0], 0), min(ends[1], held.lines)))
    if not wide.lines:
        return np.zeros((1, block.rig.camera.samples, len(block.wavelength_nm)))
    moved = (replace(held, swath_px=held.swath_px + along, start_px=held.start_px + scan) for along, scan in _HALVES)
    probes = (render(replace(wide, sweep=one), MIDDLE_RAYS) for one in moved)
    ends_e = np.max([(seen.max(axis=0), -seen.min(axis=0)) for seen in probes], axis=0)
    most, least = (scipy.ndimage.maximum_filter1d(one, 2 * reach_px + 1, axis=0, mode="nearest") for one in ends_e)
    return np.asarray((most + least).astype(np.float64)[None])


def _beyond(sweep: Sweep, rig: Rig, reach_px: int) -> Sweep:
    """Return a sweep of every held position, extended beyond its ends where the mirror reaches that far."""
    held = replace(sweep, step=1, lines=sweep.lines * sweep.step)
    wide = replace(held, start_px=held.start_px - reach_px - 1, lines=held.lines + 2 * (reach_px + 1))
    try:
        line_positions(wide, rig.camera)
    except PoseError:
        return held
    return wide
