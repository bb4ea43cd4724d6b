"""Uniform scans: their costs, the scores that a record expects, and the choice within limits."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from spectralzoom.pipeline.errors import BudgetError
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.pipeline.geometry.scan import CostModel
from spectralzoom.pipeline.planning.coverage import full_sweeps, on_scene, uniform_sweeps
from spectralzoom.pipeline.planning.uniform_scans import (
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

CAMERA = LineCamera()
COST = CostModel()
GRID = SceneGrid(256, 320, 16)
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


def test_lines_of_a_uniform_scan_are_unbinned_and_cover_the_field() -> None:
    """Steps 2 and 4 see a half and a quarter of the samples; step 1 has the lines of the full scan."""
    full = full_sweeps(GRID, CAMERA, "x")
    assert [replace(one, name="", kind="fine") for one in SWEEPS[1]] == [replace(one, name="") for one in full]
    for step, sweeps in SWEEPS.items():
        assert {(one.binning, one.step, one.kind) for one in sweeps} == {(1, step, "coarse")}
        assert sum(int(on_scene((256, 320), CAMERA, one).sum()) for one in sweeps) == 256 * 320 / step


def test_a_record_interpolates_scores_by_the_logarithm_of_exposure() -> None:
    """Exposures of the table have their own scores, the logarithmic middle has the mean, for mIoU and classes alike."""
    assert RECORD.expected(2, 25.0) == pytest.approx({MIOU: 0.91, "weed": 0.65})
    assert RECORD.expected(1, 12.5) == pytest.approx({MIOU: 0.91, "weed": 0.65})
    assert RECORD.expected(1, 400.0) == RECORD.expected(1, 100.0)


@pytest.mark.parametrize("light", [0.125, 0.2, 0.7])
def test_longer_exposures_in_less_light_score_the_same(light: float) -> None:
    """An exposure counts by its light. The longest offered one is the camera's own divided by the light fraction."""
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
def test_a_scan_has_the_longest_exposure_that_ends_in_time(seconds: float) -> None:
    """The exposure is the longest to 0.1 ms, and more seconds never choose a worse scan."""
    offered = uniform_scans(RECORD, SWEEPS, CAMERA, COST, 270, seconds=seconds)
    assert all(6.2 <= scan.exposure_ms <= 100 for scan in offered)
    for step in (1, 2, 4):
        within = [scan.exposure_ms for scan in offered if scan.step == step and scan.seconds <= seconds]
        if within and max(within) < 100:
            assert priced_scan(RECORD, SWEEPS[step], CAMERA, COST, 270, max(within) + 0.1).seconds > seconds
    if seconds < CHEAPEST:
        with pytest.raises(BudgetError, match=r"--seconds .*the least is \S+ s") as refused:
            choose_scan(offered, seconds)
        named = float(re.findall(r"the least is (\S+) s", str(refused.value))[0])
        assert choose_scan(offered, named).seconds <= named  # the duration in the message suffices
        return
    chosen = choose_scan(offered, seconds)
    assert chosen.seconds <= seconds
    more = uniform_scans(RECORD, SWEEPS, CAMERA, COST, 270, seconds=2 * seconds)
    assert choose_scan(more, 2 * seconds).expected[MIOU] >= chosen.expected[MIOU] - LOSS


def test_the_longest_exposure_in_time_may_be_the_shortest_allowed() -> None:
    """Rounding it up to the next tenth of a millisecond would end too late."""
    seconds = priced_scan(RECORD, SWEEPS[1], CAMERA, COST, 270, 16.23).seconds
    assert longest_exposure(seconds, SWEEPS[1], CAMERA, COST, 16.23, 100.0) == 16.23


def test_the_shortest_of_equally_good_exposures_is_chosen() -> None:
    """Beyond 25 ms the recorded score grows by 0.05 points only, so the scan uses 25 ms."""
    flat = replace(RECORD, scores={MIOU: np.array([[0.9, 0.94, 0.9405], [0.8, 0.8, 0.8], [0.7, 0.7, 0.7]])})
    chosen = choose_scan(uniform_scans(flat, SWEEPS, CAMERA, COST, 270), 1e3)
    assert (chosen.step, chosen.exposure_ms) == (1, 25.0)


def test_camera_limits_exposures_and_frame_rate() -> None:
    """No exposure exceeds the camera's own. One below the shortest frame saves no time and is not chosen."""
    short = replace(CAMERA, exposure_ms=50.0)
    assert max(scan.exposure_ms for scan in uniform_scans(RECORD, SWEEPS, short, COST, 270)) == 50.0
    assert uniform_scans(RECORD, SWEEPS, replace(CAMERA, exposure_ms=5.0), COST, 270) == []
    slow = replace(CAMERA, max_rate_hz=20.0)  # frames of 50 ms at least
    scans = uniform_scans(RECORD, SWEEPS, slow, COST, 270)
    assert choose_scan(scans, min(scan.seconds for scan in scans if scan.step == 1)).exposure_ms > 45


def test_reference_is_the_cheapest_scan_near_the_best() -> None:
    """The reference is at most half a point of mIoU below the best scan; every cheaper scan is further below."""
    reference = reference_scan(SCANS)
    assert reference.expected[MIOU] >= 0.94 - REFERENCE_LOSS
    assert all(one.expected[MIOU] < 0.94 - REFERENCE_LOSS for one in SCANS if one.seconds < reference.seconds)
    assert reference.seconds < priced_scan(RECORD, SWEEPS[1], CAMERA, COST, 270, 100.0).seconds
