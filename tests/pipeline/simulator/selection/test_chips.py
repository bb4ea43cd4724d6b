"""Chips to verify on: about the worst places, within the sweep, few."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.errors import ShapeError
from pipeline.geometry.scan import Sweep, sweep_to_scene
from pipeline.simulator.effects.effect import Light, SweepBlock
from pipeline.simulator.selection.verification import MOST_CANDIDATES, candidate_blocks, worst_blocks
from tests.pipeline.simulator.made_up_effects import RIG

FAR = Sweep("far", "fine", "y", -400.0, -900.0, 50)
WHOLE = SweepBlock(RIG, FAR, range(50), np.array([500.0]), (1000, 2000))


def ones(light: Light, binning: int) -> Light:
    """Electrons are the unit."""
    return np.ones_like(light)


def test_worst_chips_are_about_the_worst_places():
    """A bright spot, a dark one, an edge, and the line that meets the mirror most obliquely, each its own chip."""

    def light(chip: SweepBlock) -> Light:
        seen = np.full((50, 640, 1), 50.0, np.float32)
        seen[10, 100], seen[45, 630], seen[20, 200:400] = 60.0, 41.0, 58.0
        seen[20, 300:] = 43.0
        return seen[chip.lines.start : chip.lines.stop]

    chips = [replace(WHOLE, lines=range(first, first + 5)) for first in range(0, 50, 5)]
    found = worst_blocks(chips, light, ones)
    assert {name: chip.lines.start for name, chip in found.items() if name != "most oblique"} == {
        "steepest": 20,
        "brightest": 10,
        "darkest": 45,
    }
    assert found["most oblique"].normals[:, 2].max() == WHOLE.normals[:, 2].max()


def test_each_binning_has_worst_chips_of_its_own():
    """Sums by sums: what is brightest as a sample need not be so in a sum of 4."""

    def light(chip: SweepBlock) -> Light:
        seen = np.full((50, 640, 1), 50.0, np.float32)
        seen[10, 100], seen[30, 100:108] = 60.0, 58.0
        return seen[chip.lines.start : chip.lines.stop]

    coarse = replace(WHOLE, sweep=replace(FAR, binning=4))
    chips = [replace(whole, lines=range(at, at + 5)) for whole in (WHOLE, coarse) for at in range(0, 50, 5)]
    found = worst_blocks(chips, light, ones)
    assert found["brightest"].lines.start == 10
    assert found["brightest in sums of 4"].lines.start == 30
    assert found["brightest in sums of 4"].sweep.binning == 4


def test_candidates_are_about_places_that_the_sweep_sees():
    """And about its ends and middle; places beside it or out of the mirror's reach add none."""
    along, scan = sweep_to_scene(FAR, RIG.camera)
    here = np.array([along[30, 12], scan[30, 12]]) + (np.array(WHOLE.shape) - 1) / 2
    places = np.array([here, here + np.array([0, 300]), [0, 1e6]])
    assert [chip.lines for chip in candidate_blocks([WHOLE], places)] == [
        range(3),
        range(24, 27),
        range(29, 32),
        range(47, 50),
    ]


def test_candidates_stay_few_and_within_short_sweeps():
    """Of many sweeps evenly; a sweep of one line has one chip, of none none."""
    sweeps = [Sweep(f"s{number}", "fine", "x", 0.0, 0.0, number % 2 + 1) for number in range(99)]
    chips = candidate_blocks([replace(WHOLE, sweep=sweep) for sweep in sweeps], np.zeros((0, 2)))
    assert len(chips) == MOST_CANDIDATES
    assert all(chip.lines == range(chip.sweep.lines) for chip in chips)
    assert candidate_blocks([replace(WHOLE, sweep=replace(FAR, lines=0))], np.zeros((1, 2))) == []


def test_nothing_to_choose_from_is_refused():
    """Rather than verified on nothing."""
    with pytest.raises(ShapeError, match="no lines to verify effects on: 0 candidates hold no sample"):
        worst_blocks([], lambda chip: np.zeros((0, 640, 1), np.float32), ones)
