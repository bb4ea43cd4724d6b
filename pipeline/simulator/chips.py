"""Chips: a few whole lines each, where what is left out of a simulation can do most harm."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import ShapeError
from pipeline.scan import scene_to_sweep
from pipeline.simulator.block import SweepBlock
from pipeline.simulator.effects.effect import Light
from pipeline.simulator.stored_light import stored_mean

Floats = NDArray[np.float64]
Units = Callable[[Light, int], NDArray[np.floating]]  # of the mean light of so many samples that a number sums

CHIP_LINES = 3  # whole ones, for stray light comes from all of a line
MOST_CANDIDATES = 40


def candidate_chips(whole: Sequence[SweepBlock], places: Floats, *, lines: int = CHIP_LINES) -> list[SweepBlock]:
    """Give chips about places of the scene and about the first, middle and last line of every sweep.

    Parameters
    ----------
    whole
        Every sweep as one block of all its lines.
    places
        (place, 2) rows and columns that are steep, bright or dark. [px]

    Returns
    -------
    At most `MOST_CANDIDATES`, evenly out of all, none twice.
    """
    found = [(block, first) for block in whole for first in _first_lines(block, places, lines)]
    kept = np.unique(np.linspace(0, len(found) - 1, min(len(found), MOST_CANDIDATES)).round().astype(int))
    chosen = [found[number] for number in kept]
    return [replace(block, lines=range(first, min(first + lines, block.sweep.lines))) for block, first in chosen]


def worst_chips(
    candidates: Sequence[SweepBlock], render: Callable[[SweepBlock], Light], units: Units
) -> dict[str, SweepBlock]:
    """Choose where bounds are hardest to keep: the steepest, brightest, darkest and most oblique of some chips.

    Of numbers as they are stored, and of each binning that the sweeps have its own.

    Parameters
    ----------
    render
        Expected electrons (line, sample, band); the footprint alone is enough.
    units
        From expected electrons and their binning to one unit of the tolerance at each. [e-]

    Returns
    -------
    By name; one chip may have several.

    Raises
    ------
    ShapeError : there is nothing to choose from.
    """
    best: dict[str, tuple[float, SweepBlock]] = {}
    least = min((chip.sweep.binning for chip in candidates), default=1)
    for chip in candidates:
        binning = chip.sweep.binning
        light = stored_mean(render(chip), binning)
        if not light.size:
            continue
        for name, score in _scores(chip, light / units(light, binning)).items():
            called = name if binning == least else f"{name} in sums of {binning}"
            if called not in best or score > best[called][0]:
                best[called] = score, chip
    if not best:
        raise ShapeError(
            f"no chip to verify effects on: {len(candidates)} candidates hold no sample; give lines of a sweep"
        )
    return {name: chip for name, (_, chip) in best.items()}


def _first_lines(block: SweepBlock, places: Floats, lines: int) -> list[int]:
    """First lines of the chips of one sweep, ascending."""
    sweep, camera = block.sweep, block.rig.camera
    middles = [0, sweep.lines // 2, sweep.lines - 1] if sweep.lines else []
    centred = np.reshape(places, (-1, 2)) - (np.array(block.shape) - 1) / 2
    along, scan = (centred if sweep.along == "y" else centred[:, ::-1]).T
    line, sample = scene_to_sweep(replace(sweep, binning=1), camera, along, scan).T
    with np.errstate(invalid="ignore"):  # places that no ray reaches
        seen = (line > -1) & (line < sweep.lines) & (sample > -1) & (sample < camera.samples)
    middles += np.rint(line[seen]).astype(int).tolist()
    return sorted({max(0, min(middle - lines // 2, sweep.lines - lines)) for middle in middles})


def _scores(chip: SweepBlock, relative: Floats) -> dict[str, float]:
    """How much a chip is what it may be named for, of light in units."""
    steps = [np.abs(np.diff(relative, axis=axis)).max(initial=0.0) for axis in (0, 1)]
    return {
        "steepest": float(max(steps)),
        "brightest": float(relative.max()),
        "darkest": -float(relative.min()),
        "most oblique": float(chip.normals[:, 2].max()),
    }
