"""Which cell the emulated vector unit plays at which time."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.geometry.scan import Ends
from pipeline.rig.emulator.mirror_motion import MOST_STEPS, VectorPlayer
from pipeline.rig.mirror.registers import Trigger


def player(**settings: object) -> VectorPlayer:
    """A unit that plays cells 4 to 7 at 100 Hz."""
    return VectorPlayer(**{"start": 4, "end": 7, "frequency_hz": 100.0, "cycles": 2, **settings})  # type: ignore[arg-type]


@pytest.mark.parametrize(("ends", "cells"), [("exclusive", [4, 5, 6]), ("inclusive", [4, 5, 6, 7])])
def test_cells_are_played_in_turn_as_often_as_asked(ends: Ends, cells: list[int]) -> None:
    """Both readings of a range's end; each cell is held for a period, the last one too, and the run is over."""
    unit = player(ends=ends)
    unit.run(10.0)
    steps = list(unit.due(10.0 + 0.01 * (2 * len(cells)) - 0.001))
    assert [cell for _, cell in steps] == 2 * cells
    np.testing.assert_allclose([time_s for time_s, _ in steps], 10 + 0.01 * np.arange(2 * len(cells)))
    assert unit.running
    assert not list(unit.due(10.0 + 0.01 * (2 * len(cells)) + 0.001))
    assert not unit.running
    assert unit.index == cells[-1]


def test_it_does_not_matter_how_often_it_is_asked() -> None:
    """Steps asked for at many moments are those asked for at once."""
    often, once = player(cycles=-1), player(cycles=-1)
    often.run(0.0)
    once.run(0.0)
    steps = [step for now in np.linspace(0, 1, 337) for step in often.due(float(now))]
    assert steps == list(once.due(1.0))


@pytest.mark.parametrize(
    ("kind", "cells"), [(Trigger.RISING_EDGE, [4, 5, 6, 4]), (Trigger.BOTH_EDGES, [4, 5, 6, 4, 5, 6])]
)
def test_edges_take_one_cell_each(kind: Trigger, cells: list[int]) -> None:
    """The run command takes the first cell, then each rising edge, or each edge, the next one; the rate is nothing."""
    unit = player(external=kind)
    unit.run(0.0)
    rises = np.array([0.5, 0.6, 0.7])
    unit.trigger(rises, rises + 0.01)
    assert [cell for _, cell in unit.due(0.55)] == cells[: 2 if kind is Trigger.RISING_EDGE else 3]
    assert [cell for _, cell in unit.due(2.0)][-1] == cells[-1]
    assert unit.index == cells[-1]


def test_edges_before_a_run_are_lost() -> None:
    """A unit that does not run takes no edges."""
    unit = player(external=Trigger.RISING_EDGE)
    unit.trigger(np.array([0.1]), np.array([0.2]))
    unit.run(1.0)
    assert [cell for _, cell in unit.due(2.0)] == [4]


def test_a_long_silence_costs_no_more_than_its_end() -> None:
    """Of an hour without a question only the last steps are played, and the cell is the right one."""
    unit = player(cycles=-1, frequency_hz=10_000.0)
    unit.run(0.0)
    steps = list(unit.due(3600.0))
    assert len(steps) <= MOST_STEPS + 1
    assert unit.index == 4 + 36_000_000 % 3


def test_past_cells_can_be_asked_for() -> None:
    """The cell at any past time is the one of the last step before it."""
    unit = player(cycles=1)
    assert unit.indices(np.array([0.0])).tolist() == [4]
    unit.run(0.0)
    list(unit.due(1.0))
    assert unit.indices(np.array([-1.0, 0.0, 0.0099, 0.0101, 5.0])).tolist() == [4, 4, 4, 5, 6]
