"""A scan beside the same scan with everything on and exact: what both cost, and how far their light is apart.

Both have the same random streams. All lines are compared where that takes about a minute, else blocks spread evenly
over the scan; what is looked at closely is where the two differ most.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flows.tasks.run import CaptureRun
from flows.tasks.stages.effects import chosen_effects, load_manifest, source_with
from pipeline.errors import BoundError
from pipeline.geometry.camera import bin_samples
from pipeline.geometry.scan import Sweep
from pipeline.simulator.effects.effect import Effect, SweepBlock
from pipeline.simulator.effects.probe import Unit, stored_mean, unit_at
from pipeline.simulator.effects.registry import BY_NAME
from pipeline.simulator.readout import dark_frame, read_out
from pipeline.simulator.render import expected_light
from pipeline.simulator.selection.choice import UNIT_NAMES
from pipeline.simulator.selection.verification import (
    contrast_about,
    misplaced_electrons,
    misplaced_fraction,
    misplaced_in_tails,
)
from pipeline.simulator.simulated import BLOCK_LINES, SimulatedSource, sweep_starts
from storage.archive.keys import StageRef
from storage.arrays.quicklooks import choose_bands

MOST_S = 60.0  # of processor time for both ways together; beyond, not all lines are compared
VIEW_PX = 160  # of the camera, along the line and along the scan

Radiance = NDArray[np.float32]
Raw = NDArray[np.uint16]


@dataclass(frozen=True)
class ViewPlace:
    """A stored number: a band of a sample, or of some that are summed."""

    sweep: str
    line: int
    sample: int  # of the camera: the first of those that are summed
    band: int


@dataclass(frozen=True)
class View:
    """Some lines and samples as both ways show them, about the place where they differ most."""

    exact: Radiance  # (line, binned sample, 3) over the white reference
    chosen: Radiance  # the same
    change: NDArray[np.float64]  # (line, binned sample), the band that differs most, in the unit of the tolerance
    bands: str  # which three, in words
    lines: range
    samples: range  # of the camera
    sweep: Sweep


@dataclass(frozen=True)
class Comparison:
    """What everything on and the effects chosen cost, and how far apart they are, over all lines compared."""

    lines: int
    of_lines: int
    exact_cpu_s: float
    cpu_s: float
    effects_exact: int  # how many the rig has
    effects_on: int
    unit: Unit
    tolerance: float | None  # None: any
    bound: float | None  # None: there is none
    measured: float  # greatest change of expected light
    rms: float
    place: ViewPlace  # of the greatest
    raw_unequal: float  # fraction of raw numbers that differ where light alone does: noise and digits as chosen
    raw_most_dn: int
    left_out: tuple[str, ...]  # of what the rig has
    cheaper: tuple[str, ...]  # name and variant
    view: View = field(repr=False)

    @property
    def ratio(self) -> float:
        return self.exact_cpu_s / self.cpu_s if self.cpu_s else float("nan")

    def record(self) -> dict[str, Any]:
        figures = {name: getattr(self, name) for name in self.__dataclass_fields__ if name not in ("view", "place")}
        return {**figures, "ratio": self.ratio, "place": asdict(self.place)}


@dataclass
class _ChangeSums:
    exact_cpu_s: float = 0.0
    cpu_s: float = 0.0
    greatest: float = -1.0
    unexplained: float = -1.0  # of the greatest change, what arithmetic can not have made
    place: ViewPlace | None = None
    squares: float = 0.0
    numbers: int = 0
    unequal: int = 0
    raw_numbers: int = 0
    most_dn: int = 0


@dataclass(frozen=True)
class _Both:
    """A block both ways: expected electrons with those of the dark, as means over the samples summed; raw numbers."""

    exact: NDArray[np.floating]
    chosen: NDArray[np.floating]
    exact_raw: Raw
    chosen_raw: Raw
    alike_raw: Raw  # of exact light with the noise and the digits of the effects chosen
    exact_cpu_s: float
    cpu_s: float


def everything(effects: StageRef) -> dict[Effect, str]:
    """Give all effects that the rig has, exact, in the order of the chain, out of a stored decision."""
    rows = [row for row in load_manifest(effects)["effects"] if row["reason"] != "absent"]
    return {BY_NAME[row["name"]]: BY_NAME[row["name"]].variants[0] for row in rows}


def compare_with_everything(
    run: CaptureRun, sweeps: Sequence[Sweep], effects: StageRef, say: Callable[[str], None]
) -> Comparison:
    """Take lines both ways; ``say`` is told how many. BoundError, with the place: light differs beyond the bound."""
    clock = sweep_starts(sweeps, run.camera, run.settings.cost)
    chosen = source_with(run.simulated, effects, clock)
    total = load_manifest(effects)["total"]
    bound = math.inf if total["bound"] is None else total["bound"]
    ways = _Ways(replace(chosen, chosen=everything(effects)), chosen, total["unit"], bound)
    blocks = [  # all lines, as they are rendered at a time
        (sweep, range(first, min(first + BLOCK_LINES, sweep.lines)))
        for sweep in sweeps
        for first in range(0, sweep.lines, BLOCK_LINES)
    ]
    taken = _affordable(ways, blocks, say)
    sums = _ChangeSums()
    for number, (sweep, lines) in enumerate(taken):
        ways.add(sweep, lines, sums)
        run.report((number + 1) / (len(taken) + 1))
    found = _compared(run, ways, sums, taken, blocks, effects)
    if found.bound is not None and sums.unexplained > found.bound:
        place = found.place
        raise BoundError(
            f"against everything on, light differs by {found.measured:.3g} {UNIT_NAMES[found.unit]} at sweep "
            f"{place.sweep}, line {place.line}, sample {place.sample}, band {place.band}, above the bound of "
            f"{found.bound:.3g}; simulate with --tol 0 or --effects all, and please report it with the rig's settings"
        )
    run.report(1.0)
    return found


def _affordable(
    ways: _Ways, blocks: list[tuple[Sweep, range]], say: Callable[[str], None]
) -> list[tuple[Sweep, range]]:
    """Blocks of which both ways take about `MOST_S` seconds, evenly out of all; ``say`` how many."""
    middle = blocks[len(blocks) // 2]
    for sweep in {sweep.name: sweep for sweep, _ in blocks}.values():
        ways.take(sweep, range(1))  # tables of a sweep are made once
    trial = ways.take(*middle)
    block_s = max(trial.exact_cpu_s + trial.cpu_s, 1e-6)
    count = max(1, min(len(blocks), int(MOST_S / block_s)))
    kept = np.unique(np.linspace(0, len(blocks) - 1, count).round().astype(int))
    taken = [blocks[number] for number in kept] if count < len(blocks) else blocks
    lines, of_lines = _count(taken), _count(blocks)
    which = "all" if lines == of_lines else f"{lines} of"
    seconds = block_s * len(taken)
    all_s = "" if lines == of_lines else f" (all would take about {block_s * len(blocks):.0f} s)"
    say(f"{which} {of_lines} lines are taken both ways: about {seconds:.0f} s of CPU{all_s}")
    return taken


def _count(blocks: Sequence[tuple[Sweep, range]]) -> int:
    return sum(len(lines) for _, lines in blocks)


def _taken(source: SimulatedSource, block: SweepBlock) -> tuple[Radiance, Radiance, Raw, float]:
    """A block one way: expected electrons without and with those of the dark, raw numbers, seconds of the processor."""
    began = time.process_time()
    light = expected_light(source.scene, block, source.choice)
    raw = read_out(light, block, source.choice)
    spent = time.process_time() - began
    return light, light + dark_frame(block, source.choice) * np.float32(block.rig.camera.electrons_per_dn), raw, spent


@dataclass(frozen=True)
class _Ways:
    """One scan with everything on, exact, and with the effects chosen; their seed and clock are the same."""

    exact: SimulatedSource
    chosen: SimulatedSource
    unit: Unit
    bound: float

    def take(self, sweep: Sweep, lines: range) -> _Both:
        light, shown, raw, exact_s = _taken(self.exact, self.exact.block(sweep, lines))
        block = self.chosen.block(sweep, lines)
        _, other, other_raw, chosen_s = _taken(self.chosen, block)
        alike = read_out(light, block, self.chosen.choice)
        exact_mean, chosen_mean = (stored_mean(one, sweep.binning) for one in (shown, other))
        exact_raw, chosen_raw, alike_raw = (bin_samples(one, sweep.binning) for one in (raw, other_raw, alike))
        return _Both(exact_mean, chosen_mean, exact_raw, chosen_raw, alike_raw, exact_s, chosen_s)

    def change(self, both: _Both, sweep: Sweep) -> NDArray[np.float64]:
        """By how much the stored light differs, in the unit of the tolerance, (line, binned sample, band)."""
        difference: NDArray[np.float64] = (both.chosen.astype(np.float64) - both.exact) / self._unit(both, sweep)
        return difference

    def _unit(self, both: _Both, sweep: Sweep) -> NDArray[np.floating]:
        return unit_at(both.exact, self.exact.rig, self.unit, sweep.binning)

    def add(self, sweep: Sweep, lines: range, sums: _ChangeSums) -> None:
        """Simulate some lines both ways, and add to the sums by how much they differ."""
        both = self.take(sweep, lines)
        change = self.change(both, sweep)
        sums.exact_cpu_s += both.exact_cpu_s
        sums.cpu_s += both.cpu_s
        sums.squares += float(np.square(change).sum())
        sums.numbers += change.size
        np.abs(change, out=change)
        line, sample, band = (int(one) for one in np.unravel_index(int(np.argmax(change)), change.shape))
        if change[line, sample, band] > sums.greatest:
            sums.greatest = float(change[line, sample, band])
            sums.place = ViewPlace(sweep.name, lines[line], sample * sweep.binning, band)
        if change.max() > self.bound:  # what of it arithmetic may have made
            block = self.exact.block(sweep, lines)
            ways = dict(self.exact.choice.effects), dict(self.chosen.choice.effects)
            fraction, render = misplaced_fraction(block, *ways), partial(expected_light, self.exact.scene)
            contrast = contrast_about(block, render)
            misplaced = misplaced_electrons(both.exact, stored_mean(contrast, sweep.binning), fraction)
            change -= misplaced / self._unit(both, sweep)
            if change.max() > self.bound:
                change -= stored_mean(misplaced_in_tails(block, *ways, render), sweep.binning) / self._unit(both, sweep)
        sums.unexplained = max(sums.unexplained, float(change.max()))
        apart = np.abs(both.chosen_raw.astype(np.int32) - both.alike_raw)
        sums.unequal += int(np.count_nonzero(apart))
        sums.raw_numbers += apart.size
        sums.most_dn = max(sums.most_dn, int(apart.max()))


def _compared(
    run: CaptureRun,
    ways: _Ways,
    sums: _ChangeSums,
    taken: list[tuple[Sweep, range]],
    blocks: list[tuple[Sweep, range]],
    effects: StageRef,
) -> Comparison:
    if sums.place is None:
        raise BoundError("there is no line to compare; give a scene that the rig sees")
    total, place = load_manifest(effects)["total"], sums.place
    sweep = next(sweep for sweep, _ in blocks if sweep.name == place.sweep)
    exact, chosen = everything(effects), chosen_effects(effects)
    return Comparison(
        lines=_count(taken),
        of_lines=_count(blocks),
        exact_cpu_s=sums.exact_cpu_s,
        cpu_s=sums.cpu_s,
        effects_exact=len(exact),
        effects_on=len(chosen),
        unit=total["unit"],
        tolerance=total["tolerance"],
        bound=total["bound"],
        measured=sums.greatest,
        rms=float(np.sqrt(sums.squares / sums.numbers)),
        place=place,
        raw_unequal=sums.unequal / sums.raw_numbers,
        raw_most_dn=sums.most_dn,
        left_out=tuple(one.name for one in exact if one not in chosen),
        cheaper=tuple(f"{one.name} as {variant}" for one, variant in chosen.items() if variant != one.variants[0]),
        view=_view(run, ways, sweep, place),
    )


def _view(run: CaptureRun, ways: _Ways, sweep: Sweep, place: ViewPlace) -> View:
    binning, camera = sweep.binning, run.camera
    lines = _about(place.line, VIEW_PX // sweep.step, sweep.lines)
    samples = _about(place.sample // binning, VIEW_PX // binning, camera.samples // binning)
    of_camera = range(samples.start * binning, samples.stop * binning)
    bands, words = choose_bands(run.scene.wavelength_nm)
    exact: list[Raw] = []
    chosen: list[Raw] = []
    changes = []
    for first in range(lines.start, lines.stop, BLOCK_LINES):
        both = ways.take(sweep, range(first, min(first + BLOCK_LINES, lines.stop)))
        for kept, raw in ((exact, both.exact_raw), (chosen, both.chosen_raw)):
            kept.append(raw[:, samples.start : samples.stop, list(bands)])
        change = ways.change(both, sweep)[:, samples.start : samples.stop]
        strongest = np.abs(change).argmax(axis=2)[..., None]
        changes.append(np.take_along_axis(change, strongest, axis=2)[..., 0])
    white = np.maximum(run.scene.white_reference_electrons[list(bands)] / camera.electrons_per_dn, np.float32(1e-6))
    dark = np.float32(binning * camera.dark_dn)
    shown = [(np.concatenate(kept).astype(np.float32) - dark) / (binning * white) for kept in (exact, chosen)]
    return View(shown[0], shown[1], np.concatenate(changes), words, lines, of_camera, sweep)


def _about(middle: int, count: int, most: int) -> range:
    """So many numbers in a row below ``most`` about a middle; all where there are fewer."""
    count = min(count, most)
    first = max(0, min(middle - count // 2, most - count))
    return range(first, first + count)
