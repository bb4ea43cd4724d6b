"""A recorded source returns its own sweeps unchanged and planned sweeps by their nearest lines; it reads no others."""

from __future__ import annotations

from dataclasses import asdict, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from spectralzoom.pipeline.capture.recorded import RecordedSweep, nearest_line
from spectralzoom.pipeline.errors import NotRecordedError
from spectralzoom.pipeline.geometry.scan import Sweep, line_positions
from spectralzoom.pipeline.source import References
from tests.pipeline.capture.recordings import CAMERA, FULL, assert_same, record, recording_of, simulated


def assert_same_references(found: References, expected: References) -> None:
    for name, value in asdict(expected).items():
        np.testing.assert_array_equal(getattr(found, name), value)


@pytest.mark.parametrize("sweep", [FULL, Sweep("c", "coarse", "x", 0.0, -39.5, 20, step=4, exposure_ms=25.0)])
def test_a_recorded_sweep_returns_its_lines_unchanged(sweep: Sweep) -> None:
    """Lines and references equal those of the source that was recorded, bit for bit, from any first line."""
    source = simulated()
    recorded = recording_of(source, [record(source, sweep)])
    lines = list(source.lines(sweep))
    assert_same(list(recorded.lines(sweep)), lines)
    assert_same(list(recorded.lines(sweep, 17)), lines[17:])
    assert_same_references(recorded.references(sweep), source.references(sweep))


def test_a_coarse_pass_over_a_full_scan_reads_one_line_in_four() -> None:
    """Each coarse line is the recorded line just before its middle. The other lines are not read."""
    source = simulated()
    counted: list[int] = []
    recorded = recording_of(source, [record(source, FULL, counted)])
    coarse = Sweep("coarse-0", "coarse", "x", 0.0, -39.5, 20, step=4)
    found, full = list(recorded.lines(coarse)), list(source.lines(FULL))
    for number, line in enumerate(found):
        of = full[4 * number + 1]  # the middle, 1.5 px after the first held position, lies between lines 1 and 2
        np.testing.assert_array_equal(line.data, of.data)
        assert (line.number, line.mirror_x, line.mirror_y, line.time_s) == (number, of.mirror_x, of.mirror_y, of.time_s)
    assert counted == list(range(1, 80, 4))
    assert_same_references(recorded.references(coarse), source.references(coarse))


def test_fine_lines_of_a_full_scan_are_found_by_position() -> None:
    """A planned run of lines reads only those lines and returns them as recorded."""
    source = simulated()
    counted: list[int] = []
    recorded = recording_of(source, [record(source, FULL, counted)])
    found = list(recorded.lines(Sweep("fine-0", "fine", "x", 0.0, -9.5, 12)))
    assert_same([replace(line, number=line.number + 30) for line in found], list(source.lines(FULL))[30:42])
    assert counted == list(range(30, 42))
    list(recorded.lines(Sweep("fine-1", "fine", "x", 0.0, -1.5, 8)))
    assert counted[12:] == list(range(38, 46))


def test_a_recorded_coarse_sweep_is_preferred_to_the_full_scan() -> None:
    """If two sweeps can serve a request, the one that has exactly its lines is read."""
    source = simulated()
    coarse = Sweep("recorded coarse", "coarse", "x", 0.0, -39.5, 20, step=4)
    recorded = recording_of(source, [record(source, FULL), record(source, coarse)])
    expected = [replace(line, number=line.number - 2) for line in source.lines(coarse)][2:12]
    assert_same(list(recorded.lines(Sweep("planned", "coarse", "x", 0.0, -31.5, 10, step=4))), expected)


def test_a_backward_recording_returns_lines_in_order_of_time() -> None:
    """The lines of a plan in the opposite direction come in order of time, each at its own position."""
    source = simulated()
    whole = record(source, FULL)
    backward = replace(
        whole, position=whole.position[::-1], read_lines=lambda numbers: whole.read_lines(79 - numbers[::-1])[::-1]
    )
    found = list(recording_of(source, [backward]).lines(Sweep("fine-0", "fine", "x", 0.0, -9.5, 12)))
    times = [line.time_s for line in found]
    assert times == sorted(times)
    planned = line_positions(Sweep("fine-0", "fine", "x", 0.0, -9.5, 12), CAMERA)
    np.testing.assert_allclose([[line.mirror_x, line.mirror_y] for line in found], planned[::-1], atol=1e-12)
    for line, same in zip(found, list(source.lines(FULL))[30:42][::-1], strict=True):
        np.testing.assert_array_equal(line.data, same.data)


def test_two_sweeps_of_one_swath_serve_a_run_across_both() -> None:
    """A run across the end of one recorded sweep takes lines of both, and the times still ascend."""
    source = simulated()
    lower, upper = replace(FULL, lines=40), replace(FULL, name="scan-1", start_px=0.5, lines=40)
    recorded = recording_of(source, [record(source, lower), record(source, upper)])
    found = list(recorded.lines(Sweep("fine-0", "fine", "x", 0.0, -4.5, 10)))
    expected = [*list(source.lines(lower))[35:], *list(source.lines(upper))[:5]]
    for line, same in zip(found, expected, strict=True):
        np.testing.assert_array_equal(line.data, same.data)
        assert (line.mirror_x, line.mirror_y) == (same.mirror_x, same.mirror_y)
    assert np.all(np.diff([line.time_s for line in found]) > 0)


def test_an_invalid_line_is_used_only_without_a_valid_neighbour() -> None:
    """In a coarse pass a valid neighbour replaces an invalid line. In a fine pass the line stays invalid."""
    source = simulated()
    lost = replace(record(source, FULL), valid_line=np.arange(80) != 5)
    recorded = recording_of(source, [lost])
    assert recorded.pick(Sweep("coarse-0", "coarse", "x", 0.0, -39.5, 20, step=4)).line[:3].tolist() == [1, 6, 9]
    fine = list(recorded.lines(Sweep("fine-0", "fine", "x", 0.0, -35.5, 3)))
    assert [line.valid for line in fine] == [True, False, True]


def test_a_recorded_line_that_serves_two_planned_lines_is_valid_once() -> None:
    """Recorded lines 1.25 px apart serve a plan of 1 px. If two planned lines share one, only one of them is valid."""
    scan = 1.25 * (np.arange(40) - 19.5)
    position = np.concatenate([line_positions(Sweep("one", "fine", "x", 0.0, at, 1), CAMERA) for at in scan.tolist()])
    frame = np.zeros((64, 3), np.float32)
    wide = RecordedSweep(
        Sweep("wide", "fine", "x", 0.0, -19.5, 40),
        References(frame, frame + 1, np.ones(3, np.float32)),
        position,
        np.arange(40.0),
        np.full(40, 100.0),
        np.ones(40, bool),
        lambda numbers: np.zeros((len(numbers), 64, 3), np.uint16),
    )
    found = list(recording_of(simulated(), [wide]).lines(Sweep("fine-0", "fine", "x", 0.0, -10.0, 10)))
    assert len({line.mirror_x for line in found}) == sum(line.valid for line in found) < 10


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        (
            Sweep("fine-0", "fine", "x", 0.0, 35.5, 8),
            r"line 5 of sweep fine-0 was never captured: it lies at 40.5 px of the scan on the swath at 0 px "
            r"\(binning 1, step 1\), and sweep scan-0 from -39.5 to 39.5 px on 0 px",
        ),
        (Sweep("fine-0", "fine", "x", 20.0, -9.5, 4), r"line 0 of sweep fine-0 was never captured: .* swath at 20 px"),
        (Sweep("fine", "fine", "y", 0.0, -9.5, 4), "lie along y, those of the recording along x; plan sweeps along x"),
    ],
)
def test_a_missing_line_is_named_before_any_line_is_read(asked: Sweep, message: str) -> None:
    """Lines beyond the end of the recording, on another swath or along the other axis are refused."""
    source = simulated()
    counted: list[int] = []
    recorded = recording_of(source, [record(source, FULL, counted)])
    with pytest.raises(NotRecordedError, match=message):
        next(recorded.lines(asked))
    assert counted == []


def test_a_plan_is_cut_to_the_recorded_lines() -> None:
    """Lines beyond either end are removed and lines in a gap stay. A plan on another swath becomes None."""
    source = simulated()
    lower, upper = replace(FULL, lines=30), replace(FULL, name="scan-1", start_px=10.5, lines=30)
    recorded = recording_of(source, [record(source, lower), record(source, upper)])
    beyond = Sweep("coarse-0", "coarse", "x", 0.0, -49.5, 30, step=4)
    assert recorded.cut_to_recorded(beyond) == replace(beyond, start_px=-41.5, lines=21)
    inside = replace(lower, name="fine", lines=10)
    assert recorded.cut_to_recorded(inside) == inside
    assert recorded.cut_to_recorded(replace(inside, swath_px=64.0)) is None
    with pytest.raises(NotRecordedError, match="line 9 of sweep coarse-0 was never captured: it lies at -4 px"):
        next(recorded.lines(replace(beyond, start_px=-41.5, lines=21)))


def test_a_coarse_line_next_to_a_gap_uses_one_of_its_own_four_lines() -> None:
    """With lines 1 to 3 lost, line 0 serves the first coarse line, because it is one of that line's four."""
    source = simulated()
    lost = replace(record(source, FULL), valid_line=~np.isin(np.arange(80), [1, 2, 3]))
    picked = recording_of(source, [lost]).pick(Sweep("c", "coarse", "x", 0.0, -39.5, 20, step=4))
    assert picked.line[:2].tolist() == [0, 5]


def test_a_plan_equal_up_to_rounding_is_the_recorded_sweep() -> None:
    """Such a plan gets the recorded lines in order, although the measured positions have noise."""
    source = simulated()
    whole = record(source, FULL)
    strayed = replace(whole, position=whole.position + np.random.default_rng(0).normal(0, 3e-4, (80, 2)))
    recorded = recording_of(source, [strayed])
    picked = recorded.pick(replace(FULL, name="planned", swath_px=3e-7, start_px=FULL.start_px - 2e-7))
    assert picked.line.tolist() == list(range(80))


def test_lines_finer_than_recorded_are_refused() -> None:
    """A coarse recording serves no fine request."""
    source = simulated()
    recorded = recording_of(source, [record(source, Sweep("stepped", "coarse", "x", 0.0, -39.5, 20, step=4))])
    with pytest.raises(NotRecordedError, match="no finer than recorded"):
        recorded.pick(Sweep("fine-0", "fine", "x", 0.0, -9.5, 4))


@given(st.lists(st.integers(-300, 300), min_size=1, unique=True), st.floats(-40, 40))
def test_nearest_line_has_the_smallest_distance(tenths: list[int], wanted: float) -> None:
    """The lines may have any order; the returned distance is that of the returned line."""
    scan = np.array(tenths) / 10
    near, distance = nearest_line(scan, np.array([wanted]))
    assert distance[0] == abs(scan[near[0]] - wanted)
    assert distance[0] <= np.abs(scan - wanted).min() + 1e-6
