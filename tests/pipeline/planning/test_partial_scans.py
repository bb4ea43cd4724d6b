"""Partial scans: every patch has its lines, and no other run of the same seconds has a higher gain."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from spectralzoom.pipeline.errors import SettingsError
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.pipeline.geometry.scan import Axis, CostModel, exposing, scene_to_sweep
from spectralzoom.pipeline.planning.coverage import (
    full_sweeps,
    lines_showing,
    patches_shown,
    sweeps_over,
    uniform_sweeps,
)
from spectralzoom.pipeline.planning.partial_scans import (
    PartialScan,
    PatchRows,
    RunTimes,
    cheapest_row_seconds,
    choose_runs,
    sweeps_of_runs,
)

GRID = SceneGrid(320, 416, 16)
CAMERA = LineCamera(samples=160)
COST = CostModel()
WIDER = LineCamera(samples=240)
EXPOSURE_MS = 5.0


def rows_of(along: Axis = "x", step: int = 2) -> PatchRows:
    """Return rows of patches in the three sweeps of a uniform scan."""
    return PatchRows.of(uniform_sweeps(GRID, CAMERA, along, step=step, exposure_ms=EXPOSURE_MS), GRID, CAMERA)


ROWS = rows_of()
WHOLE_S = COST.seconds(list(ROWS.sweeps), CAMERA)
worths = st.integers(0, 2**32 - 1).map(lambda seed: _patchy(np.random.default_rng(seed)))


def _patchy(rng: np.random.Generator) -> np.ndarray:
    """Return a gain for each patch, most of it in one block."""
    expected_gain = rng.random(GRID.patch_shape) * 0.1
    top, left = rng.integers(0, GRID.patch_shape[0] - 4), rng.integers(0, GRID.patch_shape[1] - 4)
    expected_gain[top : top + 4, left : left + 4] += 5 * rng.random()
    return np.asarray(expected_gain.ravel())


def partial_scan(expected_gain: np.ndarray, seconds: float) -> PartialScan | None:
    """Return the runs of a partial scan in a number of seconds, at most one for each sweep."""
    return choose_runs(ROWS, expected_gain, RunTimes.of_scan(ROWS.sweeps, CAMERA, COST, EXPOSURE_MS), seconds=seconds)


@pytest.mark.parametrize("along", ["x", "y"])
@pytest.mark.parametrize("step", [1, 2, 4])
def test_the_lines_of_a_row_show_its_patches(along: Axis, step: int) -> None:
    """The rows together contain every patch of the field."""
    rows = rows_of(along, step)
    assert (rows.row[GRID.every_patch()] >= 0).all()
    for number, place in np.argwhere(rows.there)[:: 7 if step > 1 else 3]:
        run = (int(number), int(rows.first[number, place]), int(rows.stop[number, place]))
        shown = patches_shown(sweeps_of_runs(rows.sweeps, [run]), GRID, CAMERA)
        assert shown[rows.row == number * rows.first.shape[1] + place].all()


@given(worths, st.floats(0.02, 1.2))
def test_chosen_runs_have_the_highest_gain_of_their_length(expected_gain: np.ndarray, fraction: float) -> None:
    """No run of the same sweep with at most as many lines has a higher gain."""
    scan_pass = partial_scan(expected_gain, fraction * WHOLE_S)
    sums = ROWS.sums(expected_gain)
    for number, first, stop in () if scan_pass is None else scan_pass.runs:
        firsts, stops, values = ROWS.first[number], ROWS.stop[number], sums[number]
        taken = values[(firsts >= first) & (stops <= stop)].sum()
        for begin, end in combinations(range(len(values) + 1), 2):
            if stops[end - 1] - firsts[begin] <= stop - first:
                assert values[begin:end].sum() <= taken * (1 + 1e-9)


@given(worths, st.floats(0.1, 1.0), st.floats(0.1, 4.0))
def test_no_single_run_in_time_has_a_higher_gain(expected_gain: np.ndarray, fraction: float, power: float) -> None:
    """No run of any swath gains more in the given seconds, also if rows have equal gains per second."""
    seconds = fraction * WHOLE_S
    scan_pass = partial_scan(expected_gain**power, seconds)
    found = 0.0 if scan_pass is None else scan_pass.expected_gain
    for number, values in enumerate(ROWS.sums(expected_gain**power)):
        for begin, end in combinations(range(len(values) + 1), 2):
            run = (number, int(ROWS.first[number, begin]), int(ROWS.stop[number, end - 1]))
            if COST.seconds(sweeps_of_runs(ROWS.sweeps, [run]), CAMERA) <= seconds:
                assert values[begin:end].sum() <= found * (1 + 1e-9)


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("fraction", [0.66, 0.8, 0.95])
def test_runs_of_two_swaths_reach_98_percent_of_the_best_gain(seed: int, fraction: float) -> None:
    """The best pair is found by trying all pairs. Set-ups count, and one load of the mirror's memory has all lines."""
    cost = CostModel(vector_pairs=100_000, capture_start_s=0.3)
    expected_gain = _patchy(np.random.default_rng(seed)) ** 4
    rows = PatchRows.of(uniform_sweeps(GRID, WIDER, "x", step=4, exposure_ms=EXPOSURE_MS), GRID, WIDER)
    assert len(rows.sweeps) == 2
    given_s = fraction * cost.seconds(list(rows.sweeps), WIDER)
    times = RunTimes.of_scan(rows.sweeps, WIDER, cost, EXPOSURE_MS)
    scan_pass = choose_runs(rows, expected_gain, times, seconds=given_s)
    assert scan_pass is not None
    setup_s = cost.setup_seconds(exposing(WIDER, rows.sweeps[0]))
    line_s = exposing(WIDER, rows.sweeps[0]).frame_ms * 1e-3
    options = []
    for values, first, stop in zip(rows.sums(expected_gain), rows.first, rows.stop, strict=True):
        pairs = [(begin, end - 1) for begin, end in combinations(range(len(values) + 1), 2)]
        runs = [(setup_s + line_s * (stop[end] - first[begin]), values[begin : end + 1].sum()) for begin, end in pairs]
        options.append(np.array([(0.0, 0.0), *runs]))
    seconds, values = (np.add.outer(options[0][:, one], options[1][:, one]) for one in (0, 1))
    best = values[seconds + cost.reload_s <= given_s + 1e-9].max()
    assert 0.98 * best <= scan_pass.expected_gain <= best * (1 + 1e-9)


def test_a_swath_whose_gain_does_not_justify_its_set_up_is_left_out() -> None:
    """With time for two rows of two swaths, exactly these rows are captured."""
    expected_gain = np.full(int(np.prod(GRID.patch_shape)), 1e-6)
    for number in (0, 2):
        expected_gain[ROWS.row == number * ROWS.first.shape[1] + 5] = 1.0
    wanted = tuple((number, int(ROWS.first[number, 5]), int(ROWS.stop[number, 5])) for number in (0, 2))
    seconds = COST.seconds(sweeps_of_runs(ROWS.sweeps, wanted), CAMERA) + 0.01
    assert partial_scan(expected_gain, seconds).runs == wanted


def test_lines_shared_by_two_rows_are_paid_once() -> None:
    """Neighbours of two chosen rows cost fewer lines than a distant row of higher gain."""
    expected_gain = np.zeros(int(np.prod(GRID.patch_shape)))
    for place, gain in ((2, 1.0), (3, 0.5), (9, 0.6), (15, 1.0), (16, 0.5)):
        expected_gain[np.flatnonzero(place == ROWS.row)[0]] = gain
    assert ROWS.first.shape[1] > 16
    wanted = tuple((0, int(ROWS.first[0, one]), int(ROWS.stop[0, one + 1])) for one in (2, 15))
    times = RunTimes(1.0, 0.0, lambda runs: float(sum(stop - first for _, first, stop in runs)))
    assert choose_runs(ROWS, expected_gain, times, seconds=times.seconds(wanted), several=True).runs == wanted


def test_rows_of_equal_gain_are_captured_until_time_ends() -> None:
    """Part of a block that exceeds the time is captured, with no lines next to the block."""
    expected_gain = np.zeros(GRID.patch_shape)
    expected_gain[4:16, 3:6] = 1.0
    scan_pass = partial_scan(expected_gain.ravel(), 2.2)
    shown = patches_shown(sweeps_of_runs(ROWS.sweeps, scan_pass.runs), GRID, CAMERA).reshape(GRID.patch_shape)
    assert np.count_nonzero(shown[4:16, 3:6].all(axis=1)) >= 4
    assert not shown[:3].any()
    assert not shown[17:].any()


@pytest.mark.parametrize("along", ["x", "y"])
def test_a_patch_in_two_swaths_belongs_to_the_nearer_one(along: Axis) -> None:
    """The distance is that from the patch's centre to the middle of the lines."""
    rows = rows_of(along)
    patch_index = GRID.every_patch()
    middle = GRID.patch_origin(patch_index) + GRID.patch / 2 - np.array([GRID.height, GRID.width]) / 2
    across = middle[:, "yx".index(along)]
    off = np.abs(across[:, None] - np.array([sweep.swath_px for sweep in rows.sweeps]))
    own = off[np.arange(len(patch_index)), rows.row[patch_index] // rows.first.shape[1]]
    assert (own <= off.min(axis=1) + 1).all()  # rotation moves lines by a pixel at most


def test_least_seconds_are_those_of_the_cheapest_row_with_gain() -> None:
    """A shorter row without gain does not count, because a scan of its seconds would be refused again."""
    gain = np.zeros(len(ROWS.row))
    assert cheapest_row_seconds(ROWS, gain, CAMERA, COST, EXPOSURE_MS) == np.inf
    for patch in (0, len(gain) // 2, len(gain) - 1):
        gain[:] = np.arange(len(gain)) == patch
        least = cheapest_row_seconds(ROWS, gain, CAMERA, COST, EXPOSURE_MS)
        assert partial_scan(gain, least) is not None
        assert partial_scan(gain, 0.999 * least) is None


@given(worths, st.floats(0.02, 1.2))
def test_partial_scans_end_in_time_and_gain_only_shown_patches(expected_gain: np.ndarray, fraction: float) -> None:
    """Seconds are those of the cost model, at most the given ones. The gain is at most that of the shown patches."""
    scan_pass = partial_scan(expected_gain, fraction * WHOLE_S)
    if scan_pass is None:
        assert cheapest_row_seconds(ROWS, expected_gain, CAMERA, COST, EXPOSURE_MS) > fraction * WHOLE_S
        return
    sweeps = sweeps_of_runs(ROWS.sweeps, scan_pass.runs)
    assert scan_pass.seconds == COST.seconds(sweeps, CAMERA) <= fraction * WHOLE_S
    assert scan_pass.expected_gain <= expected_gain[patches_shown(sweeps, GRID, CAMERA)].sum() * (1 + 1e-9)


@given(worths)
def test_more_seconds_never_reduce_the_gain(expected_gain: np.ndarray) -> None:
    """The seconds of the whole scan reach the whole gain."""
    scan_passes = [partial_scan(expected_gain, one * WHOLE_S) for one in (0.3, 0.5, 0.7, 0.9, 1.0)]
    found = [0.0 if scan_pass is None else scan_pass.expected_gain for scan_pass in scan_passes]
    assert found == sorted(found)
    assert found[-1] == pytest.approx(ROWS.sums(expected_gain).sum())


@pytest.mark.parametrize(
    ("runs", "told"),
    [
        ([(3, 0, 5)], "extent names sweep 3, the scan has sweeps 0 to 2"),
        ([(0, 0, 100_000)], "lines 0 to 100000 of sweep 0, which has lines 0 to"),
        ([(1, 0, 5), (1, 9, 12)], "names sweep 1 twice"),
    ],
)
def test_lines_outside_of_a_scan_are_refused(runs: list[tuple[int, int, int]], told: str) -> None:
    """The message names the sweeps and lines that the scan has."""
    with pytest.raises(SettingsError, match=told):
        sweeps_of_runs(ROWS.sweeps, runs)


def shown_of(top: int, left: int, rows: int, columns: int) -> np.ndarray:
    """Return a mask of a block of patches, (patch,)."""
    shown = np.zeros(GRID.patch_shape, bool)
    shown[top : top + rows, left : left + columns] = True
    return shown.ravel()


blocks = st.builds(shown_of, st.integers(0, 19), st.integers(0, 25), st.integers(1, 8), st.integers(1, 8))


@given(blocks, st.sampled_from(["x", "y"]))
def test_cutting_a_full_scan_keeps_the_requested_patches(shown: np.ndarray, along: Axis) -> None:
    """Each swath of a full scan keeps the lines that show part of them, and others are removed."""
    sweeps = full_sweeps(GRID, CAMERA, along)
    cut = sweeps_over(sweeps, GRID, CAMERA, shown)
    before, after = (patches_shown(one, GRID, CAMERA) for one in (sweeps, cut))
    assert after[before & shown].all()
    assert sum(one.lines for one in cut) < sum(one.lines for one in sweeps)


@given(blocks)
def test_cutting_a_coarse_sweep_keeps_its_positions(shown: np.ndarray) -> None:
    """A coarse sweep that is cut has only positions of the whole one."""
    whole = {sweep.name: sweep for sweep in uniform_sweeps(GRID, CAMERA, "x", step=4)}
    for sweep in sweeps_over(list(whole.values()), GRID, CAMERA, shown):
        assert np.isin(sweep.held_px(), whole[sweep.name].held_px()).all()


def test_swaths_outside_of_the_area_are_left_out() -> None:
    """A corner of the field needs one of three swaths, no patch needs none."""
    sweeps = full_sweeps(GRID, CAMERA, "x")
    assert len(sweeps) == 3
    assert [one.name for one in sweeps_over(sweeps, GRID, CAMERA, shown_of(0, 0, 3, 3))] == ["full-0"]
    assert sweeps_over(sweeps, GRID, CAMERA, np.zeros_like(shown_of(0, 0, 1, 1))) == []


def test_a_patch_has_all_lines_that_resampling_reads() -> None:
    """Its lines reach from the one before its first pixel to two after its last, within the sweep."""
    for sweep in full_sweeps(GRID, CAMERA, "x"):
        for patch in GRID.every_patch()[::5]:
            down, across = GRID.patch_origin(np.array([patch]))[0]
            y, x = (place + np.arange(16) - (size - 1) / 2 for place, size in ((down, 320), (across, 416)))
            at = scene_to_sweep(sweep, CAMERA, x[None, :], y[:, None])
            line = np.floor(at[np.abs(at[..., 1] - 79.5) <= 80][:, 0])
            first, stop = lines_showing(sweep, GRID, CAMERA, np.array([patch])) or (sweep.lines, 0)
            assert first <= max(line.min(initial=np.inf) - 1, 0)
            assert stop > min(line.max(initial=-np.inf) + 2, sweep.lines - 1)
