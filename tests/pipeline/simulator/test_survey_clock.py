"""When sweeps start: one after the other, within the seconds that the plan is priced at, and seen by the light."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import CostModel, Sweep
from pipeline.simulator.effects.registry import effects_on
from pipeline.simulator.rig_model import Rig, Sky
from pipeline.simulator.scenes.image_scene import raster_from_values
from pipeline.simulator.simulated import SimulatedSource, sweep_starts

CAMERA = LineCamera()
COST = CostModel()


def sweeps_of(*sizes: int, step: int = 1) -> list[Sweep]:
    """Sweeps of so many lines each."""
    return [Sweep(f"sweep {k}", "fine", "x", 0.0, -10.0, lines, step) for k, lines in enumerate(sizes)]


def test_sweeps_follow_one_another() -> None:
    """Worked by hand: set-ups of .45 s, one load of 1.6 s for 1500 positions, 100 ms a line."""
    assert sweep_starts(sweeps_of(10, 20, 5), CAMERA, COST) == pytest.approx(
        {"sweep 0": 2.05, "sweep 1": 3.5, "sweep 2": 5.95}
    )
    starts = sweep_starts(sweeps_of(1000, 1000, 5), CAMERA, COST)  # the second begins in the first load
    assert starts == pytest.approx({"sweep 0": 2.05, "sweep 1": 102.5, "sweep 2": 204.55})


def test_fine_sweeps_come_after_the_coarse_ones() -> None:
    """What was spent before is added to every start."""
    first, later = (sweep_starts(sweeps_of(10, 20), CAMERA, COST, after_s=seconds) for seconds in (0.0, 60.0))
    assert {name: start + 60 for name, start in first.items()} == later


def test_no_sweeps_have_no_starts() -> None:
    """A plan without sweeps is empty, and one without lines takes a set-up."""
    assert sweep_starts([], CAMERA, COST) == {}
    assert sweep_starts(sweeps_of(0), CAMERA, COST) == pytest.approx({"sweep 0": 0.45})


@given(st.lists(st.integers(0, 2000), max_size=12), st.integers(1, 4))
def test_sweeps_end_before_the_next_and_within_the_price(sizes: list[int], step: int) -> None:
    """No sweep starts before the one before has ended, and the last ends within the plan's seconds."""
    sweeps = sweeps_of(*sizes, step=step)
    starts = [*sweep_starts(sweeps, CAMERA, COST).values(), COST.seconds(sweeps, CAMERA) + 1e-9]
    for sweep, start, following in zip(sweeps, starts, starts[1:], strict=False):
        assert start + CAMERA.scan_seconds(sweep.lines) <= following


def test_light_goes_with_the_clock() -> None:
    """A sweep that starts an hour after sunrise's light is brighter; references are of the survey's start."""
    scene = raster_from_values(np.full((8, 8, 3), 0.1), CAMERA, name="t", wavelength_nm=np.array([500.0, 600.0, 700.0]))
    rig = Rig(CAMERA, sky=Sky(started=datetime(2025, 6, 21, 5, tzinfo=UTC)))
    chosen = effects_on("rotation", "drift")
    sweep = Sweep("a", "fine", "x", 0.0, 0.0, 2)
    now = SimulatedSource(scene, rig, chosen=chosen)
    later = replace(now, clock={"a": 3600.0, "b": 0.0})
    assert (later.started_s(sweep), later.started_s(replace(sweep, name="c")), now.started_s(sweep)) == (3600, 0, 0)
    brighter = later.render(sweep, range(2)).astype(int) - 64
    assert (brighter > 1.1 * (now.render(sweep, range(2)).astype(int) - 64)).all()
    np.testing.assert_array_equal(later.references(sweep).white, now.references(sweep).white)
    assert [line.time_s for line in later.lines(sweep)] == [line.time_s for line in now.lines(sweep)]
