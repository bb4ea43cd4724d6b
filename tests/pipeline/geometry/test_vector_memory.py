"""Vector memory: loads of whole lines, half-open ranges, and prices that agree."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.errors import SettingsError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import CostModel, Sweep, count_loads, device_range, memory_loads

CAMERA, COST = LineCamera(), CostModel()


def sweep(lines: int, step: int = 1, name: str = "a") -> Sweep:
    """A sweep of some lines."""
    return Sweep(name, "fine" if step == 1 else "coarse", "x", 0.0, 0.0, lines, step)


sweeps = st.lists(st.builds(sweep, st.integers(0, 40), st.integers(1, 9)), max_size=6)


@pytest.mark.parametrize(("lines", "step", "loads"), [(1500, 1, 1), (1501, 1, 2), (375, 4, 1), (376, 4, 2), (0, 1, 0)])
def test_fifteen_hundred_pairs_fit_one_load(lines: int, step: int, loads: int):
    """1500 positions are one load, 1501 two, held one or four to a line."""
    assert len(memory_loads([sweep(lines, step)], 1500)) == loads
    price = COST.seconds([sweep(lines, step)], CAMERA)
    assert price == pytest.approx(lines * 0.1 + COST.setup_seconds(CAMERA) + loads * COST.reload_s)


@given(sweeps, st.integers(9, 60))
def test_loads_hold_every_line_once_in_order(given_sweeps: list[Sweep], capacity: int):
    """Parts take the lines of all sweeps one after the other, lie end to end, and no load is too large."""
    loads = memory_loads(given_sweeps, capacity)
    parts = [part for load in loads for part in load.parts]
    held = [(part.sweep, line) for part in parts for line in range(*part.lines)]
    assert held == [(number, line) for number, each in enumerate(given_sweeps) for line in range(each.lines)]
    for load in loads:
        assert load.parts[0].pairs[0] == 0
        assert all(one.pairs[1] == other.pairs[0] for one, other in pairwise(load.parts))
        assert load.pairs <= capacity
    for part in parts:
        pairs, lines = part.pairs[1] - part.pairs[0], part.lines[1] - part.lines[0]
        assert pairs == lines * given_sweeps[part.sweep].step


@given(sweeps, st.integers(9, 60))
def test_the_count_is_that_of_the_layout(given_sweeps: list[Sweep], capacity: int):
    """Loads counted in closed form are those laid out, and every one but the last is as full as lines allow."""
    loads = memory_loads(given_sweeps, capacity)
    assert count_loads(given_sweeps, capacity) == len(loads)
    for load, after in pairwise(loads):
        assert load.pairs + given_sweeps[after.parts[0].sweep].step > capacity


def test_a_line_is_never_parted():
    """Of lines that hold 7 positions 214 fit 1500 pairs; the two cells left stay empty."""
    first, second = memory_loads([sweep(215, 7)], 1500)
    assert first.parts[0].lines == (0, 214)
    assert first.pairs == 1498
    assert second.parts[0].lines == (214, 215)


def test_channels_lie_one_behind_the_other():
    """X and Y of a part have as many cells, Y behind all X of the load."""
    (load,) = memory_loads([sweep(10), sweep(5)], 1500)
    assert load.channels(load.parts[0]) == ((0, 10), (15, 25))
    assert load.channels(load.parts[1]) == ((10, 15), (25, 30))


@pytest.mark.parametrize(("ends", "expected"), [("exclusive", (0, 1450)), ("inclusive", (0, 1449))])
def test_ends_are_converted_in_one_place(ends: str, expected: tuple[int, int]):
    """Erratum E14: 1450 cells end at 1450 or at 1449, whichever the device means."""
    assert device_range((0, 1450), ends) == expected


@pytest.mark.parametrize("cells", [(3, 3), (5, 2), (-1, 4)])
def test_empty_ranges_are_refused(cells: tuple[int, int]):
    """With inclusive ends an empty range has no form at all."""
    with pytest.raises(SettingsError, match="half-open range"):
        device_range(cells, "inclusive")


def test_a_line_that_no_load_holds_is_refused():
    """More positions in a line than the memory has."""
    for layout in (memory_loads, count_loads):
        with pytest.raises(SettingsError, match=r"sweep wide holds 1501 positions in each line.* 1500 pairs"):
            layout([sweep(1, 1501, "wide")], 1500)
