"""Uniform scans: what they cost, what a record expects of them, and the choice within limits."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.errors import BudgetError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import CostModel
from pipeline.planning.coverage import full_sweeps, on_scene, uniform_sweeps
from pipeline.planning.uniform_scans import (
    LOSS,
    MIOU,
    REFERENCE_LOSS,
    ScanPerformance,
    choose_scan,
    longest_exposure,
    priced_scan,
    reference_scan,
    uniform_scans,
)

CAMERA, COST, GRID = LineCamera(), CostModel(), SceneGrid(256, 320, 16)
SWEEPS = {step: uniform_sweeps(GRID, CAMERA, "x", step=step) for step in (1, 2, 4)}
CONTENT = {
    "scenes": 3,
    "steps": [1, 2, 4],
    "exposures_ms": [100.0, 25.0, 6.25],
    "miou": [[0.94, 0.93, 0.89], [0.92, 0.91, 0.85], [0.83, 0.81, 0.74]],
    "per_class_iou": {"weed": [[0.8, 0.7, 0.6], [0.7, 0.65, 0.5], [0.5, 0.4, 0.3]]},
}
RECORD = ScanPerformance.read(CONTENT)
SCANS = uniform_scans(RECORD, SWEEPS, CAMERA, COST, 270)
CHEAPEST = min(scan.seconds for scan in SCANS)


def test_lines_of_a_scan_are_not_binned_and_cover_the_field() -> None:
    """Every pixel across is seen by half or a quarter of the lines; with step 1 they are those of the full scan."""
    full = full_sweeps(GRID, CAMERA, "x")
    assert [replace(one, name="", kind="fine") for one in SWEEPS[1]] == [replace(one, name="") for one in full]
    for step, sweeps in SWEEPS.items():
        assert {(one.binning, one.step, one.kind) for one in sweeps} == {(1, step, "coarse")}
        seen = sum(int(on_scene((256, 320), CAMERA, one).sum()) for one in sweeps)
        assert seen == 256 * 320 / step


def test_a_record_is_read_between_its_exposures_by_their_logarithm() -> None:
    """At an exposure of the table its own figure, half-way by the logarithm the mean, for maps and classes alike."""
    assert RECORD.expected(2, 25.0) == pytest.approx({MIOU: 0.91, "weed": 0.65})
    assert RECORD.expected(1, 12.5) == pytest.approx({MIOU: 0.91, "weed": 0.65})
    assert RECORD.expected(1, 400.0) == RECORD.expected(1, 100.0)


@pytest.mark.parametrize("light", [0.125, 0.2, 0.7])
def test_in_less_light_longer_exposures_score_the_same(light: float) -> None:
    """An exposure counts by its light; those offered range up to the camera's own light, and each is known."""
    dim = ScanPerformance.read(CONTENT, light)
    assert dim.expected(2, 25.0 / light) == pytest.approx(RECORD.expected(2, 25.0))
    assert dim.offered_ms(CAMERA) == pytest.approx((6.25 / light, 100 / light))
    assert dim.offered_ms(replace(CAMERA, exposure_ms=50.0))[1] == pytest.approx(50 / light)
    scans = uniform_scans(dim, SWEEPS, CAMERA, COST, 270)
    assert max(scan.exposure_ms for scan in scans) == pytest.approx(100 / light, abs=0.1)
    assert all(dim.knows(scan.exposure_ms) for scan in scans)
    for seconds in (10.0, 20.0):
        clear, dim_scan = (choose_scan(some, seconds) for some in (SCANS, scans))
        assert dim_scan.expected[MIOU] <= clear.expected[MIOU]
        assert (dim_scan.step, dim_scan.exposure_ms) > (clear.step, clear.exposure_ms)


@given(seconds=st.floats(0.1, 60.0))
def test_a_scan_ends_in_time_and_no_longer_exposure_would(seconds: float) -> None:
    """The longest exposure that ends in time is offered, to a tenth of a millisecond; more seconds never give less."""
    offered = uniform_scans(RECORD, SWEEPS, CAMERA, COST, 270, seconds=seconds)
    assert all(6.2 <= scan.exposure_ms <= 100 for scan in offered)
    for step in (1, 2, 4):
        within = [scan.exposure_ms for scan in offered if scan.step == step and scan.seconds <= seconds]
        if within and max(within) < 100:
            longer = priced_scan(RECORD, SWEEPS[step], CAMERA, COST, 270, max(within) + 0.1)
            assert longer.seconds > seconds
    if seconds < CHEAPEST:
        with pytest.raises(BudgetError, match=r"--seconds .*the least is \S+ s") as refused:
            choose_scan(offered, seconds)
        named = float(re.findall(r"the least is (\S+) s", str(refused.value))[0])
        assert choose_scan(offered, named).seconds <= named  # the time that the message names suffices
        return
    chosen = choose_scan(offered, seconds)
    assert chosen.seconds <= seconds
    more = uniform_scans(RECORD, SWEEPS, CAMERA, COST, 270, seconds=2 * seconds)
    assert choose_scan(more, 2 * seconds).expected[MIOU] >= chosen.expected[MIOU] - LOSS


def test_the_longest_exposure_in_time_may_be_the_shortest_there_is() -> None:
    """Rounded to the next tenth of a millisecond it would end too late."""
    seconds = priced_scan(RECORD, SWEEPS[1], CAMERA, COST, 270, 16.23).seconds
    assert longest_exposure(seconds, SWEEPS[1], CAMERA, COST, 16.23, 100.0) == 16.23


def test_nothing_is_spent_that_does_not_pay() -> None:
    """Where a record no longer grows with the exposure, the shortest of those as good is taken."""
    flat = replace(RECORD, scores={MIOU: np.array([[0.9, 0.94, 0.9405], [0.8, 0.8, 0.8], [0.7, 0.7, 0.7]])})
    chosen = choose_scan(uniform_scans(flat, SWEEPS, CAMERA, COST, 270))
    assert (chosen.step, chosen.exposure_ms) == (1, 25.0)


def test_the_camera_bounds_exposures_and_its_rate_the_seconds() -> None:
    """No exposure beyond the camera's own; below its shortest frame less light saves no time, and is not taken."""
    short = replace(CAMERA, exposure_ms=50.0)
    assert max(scan.exposure_ms for scan in uniform_scans(RECORD, SWEEPS, short, COST, 270)) == 50.0
    assert uniform_scans(RECORD, SWEEPS, replace(CAMERA, exposure_ms=5.0), COST, 270) == []
    slow = replace(CAMERA, max_rate_hz=20.0)  # frames of 50 ms at least
    scans = uniform_scans(RECORD, SWEEPS, slow, COST, 270)
    fastest = min(scan.seconds for scan in scans if scan.step == 1)
    assert choose_scan(scans, fastest).exposure_ms > 45


@pytest.mark.parametrize("goals", [{MIOU: 0.85}, {"weed": 0.55}, {MIOU: 0.9, "weed": 0.7}])
def test_a_goal_is_reached_as_cheaply_as_it_can_be(goals: dict[str, float]) -> None:
    """The choice reaches it, and no cheaper scan does."""
    chosen = choose_scan(SCANS, goals=goals)
    assert all(chosen.expected[name] >= least for name, least in goals.items())
    cheaper = [scan for scan in SCANS if scan.seconds < chosen.seconds]
    assert all(any(scan.expected[name] < least for name, least in goals.items()) for scan in cheaper)


def test_goals_out_of_reach_name_the_best_there_is() -> None:
    """Beyond the record, or of two goals that no one scan has: the best; beyond the time: what it takes."""
    with pytest.raises(BudgetError, match=r"reaches --goal 95, where the best scan has 94\.0; ask for less"):
        choose_scan(SCANS, goals={MIOU: 0.95})
    with pytest.raises(BudgetError, match=r"--goal takes \d+\.\d+ s .*, --seconds is") as refused:
        choose_scan(SCANS, CHEAPEST, {MIOU: 0.93})
    named = float(re.findall(r"takes (\S+) s", str(refused.value))[0])
    assert choose_scan(SCANS, named, {MIOU: 0.93}).seconds <= named
    scores = {MIOU: RECORD.scores[MIOU], "weed": RECORD.scores[MIOU][::-1]}
    torn = uniform_scans(replace(RECORD, scores=scores), SWEEPS, CAMERA, COST, 270)
    with pytest.raises(BudgetError, match=r"no scan of these weights reaches --goal 93, .* and weed=93, where"):
        choose_scan(torn, goals={MIOU: 0.93, "weed": 0.93})


def test_the_reference_is_the_cheapest_scan_that_is_nearly_as_good_as_any() -> None:
    """Half a point of mIoU below the best at most, and dearer than no other such scan."""
    reference = reference_scan(SCANS)
    assert reference.expected[MIOU] >= 0.94 - REFERENCE_LOSS
    assert all(one.expected[MIOU] < 0.94 - REFERENCE_LOSS for one in SCANS if one.seconds < reference.seconds)
    assert reference.seconds < priced_scan(RECORD, SWEEPS[1], CAMERA, COST, 270, 100.0).seconds
