"""The staircase of the path: the jitter of geometry's table, and positions that change within an exposure."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.geometry.scan import Sweep
from pipeline.simulator.effects.effect import SweepBlock
from pipeline.simulator.effects.mirror_path import STAIRCASE, beside_plan
from pipeline.simulator.effects.probe import Probe
from pipeline.simulator.rig_model import MirrorMotion, Rig
from tests.pipeline.geometry.test_second_order import staircase_jitter

SWEEP = Sweep("strip", "fine", "x", 0.0, -20.0, 41)


def rig(positions: float) -> Rig:
    """A rig with so many positions per px."""
    return Rig(mirror=replace(MirrorMotion(), positions_per_line=positions))


def block(positions: float, sweep: Sweep = SWEEP, lines: range = range(41)) -> SweepBlock:
    """Some lines of a sweep."""
    return SweepBlock(rig(positions), sweep, lines, np.array([500.0]), (64, 64))


def probe(slope: float, curvature: float, span: float = 1e9, sweep: Sweep = SWEEP) -> Probe:
    """A scene of one band, known by its slope and curvature along the scan."""
    one, none = np.ones(1), np.zeros(1)
    both = np.stack([none, one])
    return Probe(
        "sigma",
        (sweep,),
        500 * one,
        None,
        one,
        one,
        span * one,
        slope * both,
        curvature * both,
        none,
        none,
        1e4,
        0.0,
        1.0,
        sweep.lines,
        60.0,
    )


@pytest.mark.parametrize(("samples", "lines", "px"), [(1450, 640, 0.011), (1500, 600, 0.020), (1500, 1000, 0.056)])
def test_line_centres_shake_as_in_the_table(samples: int, lines: int, px: float):
    """Line centres jitter by .011, .020 and .056 px rms, as the whole-number reckoning has it."""
    centre = beside_plan(samples / lines, 1, np.arange(lines)).mean(axis=1)
    assert np.std(centre) == pytest.approx(px, abs=5e-4)
    assert np.std(centre) == pytest.approx(staircase_jitter(samples, lines), rel=1e-6)


@settings(max_examples=60, deadline=None)
@given(st.floats(0.05, 40.0), st.integers(1, 5), st.integers(1, 4))
def test_parts_are_means_of_the_held_positions(positions: float, step: int, parts: int):
    """Each part has the mean of what the mirror holds in it, taken here at many moments."""
    found = beside_plan(positions, step, np.arange(7), parts)
    moment = (np.arange(4000) + 0.5) / 4000
    for line in (0, 6):
        time = line * step + (np.arange(step * parts)[:, None] + moment) / parts
        held = np.floor(positions * time) / positions + 0.5 / positions - 0.5
        planned = line * step + np.arange(step * parts) // parts
        np.testing.assert_allclose(found[line], held.mean(axis=1) - planned, atol=1e-3 / positions + 3e-4)


@pytest.mark.parametrize("positions", [1.0, 2.0, 5.0])
def test_whole_numbers_do_not_shake_lines(positions: float):
    """A whole number of positions per line leaves every line where it is planned."""
    shift = STAIRCASE.aim(block(positions), "exact")
    assert shift.shape == (41, int(positions), 2)
    np.testing.assert_allclose(shift.mean(axis=1), 0, atol=1e-12)
    np.testing.assert_allclose(shift[:, :, 1], np.tile((np.arange(positions) + 0.5) / positions - 0.5, (41, 1)))


@pytest.mark.parametrize("sweep", [SWEEP, replace(SWEEP, step=4)])
@pytest.mark.parametrize("size", [1, 7, 41])
def test_blocks_do_not_change_lines(sweep: Sweep, size: int):
    """Lines are bit for bit the same in blocks of any size."""
    whole = STAIRCASE.aim(block(2.265625, sweep), "exact")
    parts = [STAIRCASE.aim(block(2.265625, sweep, range(a, min(a + size, 41))), "exact") for a in range(0, 41, size)]
    np.testing.assert_array_equal(np.concatenate(parts), whole)


@pytest.mark.parametrize("image", ["waves", "step", "point"])
@pytest.mark.parametrize("positions", [0.5, 0.9, 1.5, 2.5, 7.3])
def test_bound_holds_and_is_tight(positions: float, image: str):
    """The change of analytic images stays below the bound, which is at most six times as much."""
    width = 1.2
    look, slope, curvature = {
        "waves": (lambda s: np.sin(s) + np.cos(2.3 * s), 3.3, 1 + 2.3**2),
        "step": (lambda s: np.tanh(s / width), 1 / width, 0.77 / width**2),
        "point": (lambda s: np.exp(-(s**2) / 2), 0.607, 1.0),
    }[image]
    shift = STAIRCASE.aim(block(positions), "exact")[:, :, 1]
    worst = {"off": 0.0, "centres": 0.0}
    for place in np.linspace(-3, 3, 61):
        exact = look(place + shift).mean(axis=1)
        worst["off"] = max(worst["off"], np.abs(exact - look(place)).max())
        worst["centres"] = max(worst["centres"], np.abs(exact - look(place + shift.mean(axis=1))).max())
    for variant, measured in worst.items():
        bound = STAIRCASE.bound(probe(slope, curvature), rig(positions), variant).value
        assert measured <= bound * (1 + 1e-9)
        assert bound <= max(6 * measured, 1e-12)


def test_default_rig_and_flat_scene_need_no_staircase():
    """One position per px, no slope or no sweep: nothing to compute."""
    assert STAIRCASE.bound(probe(5.0, 5.0), rig(1.0)).value == 0
    assert STAIRCASE.bound(probe(0.0, 0.0), rig(2.5)).value == 0
    assert STAIRCASE.bound(replace(probe(5.0, 5.0), sweeps=()), rig(2.5)).value == 0
    assert STAIRCASE.bound(probe(5.0, 5.0), rig(2.5), "exact").value == 0
