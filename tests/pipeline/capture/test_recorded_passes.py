"""Passes over a recording keep plans that its lines serve and move other plans to the recorded swaths."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from spectralzoom.pipeline.capture.recorded import Recording
from spectralzoom.pipeline.capture.recorded_passes import (
    lines_served,
    recorded_fine_ms,
    recorded_fine_pass,
    recorded_first_pass,
    recorded_full_scan,
    sweeps_as_taken,
)
from spectralzoom.pipeline.errors import NotRecordedError, SceneError
from spectralzoom.pipeline.geometry.scan import Sweep
from tests.pipeline.capture.recordings import CAMERA, FULL, record, recording_of, simulated

COARSE = Sweep("coarse-0", "coarse", "x", 0.0, -45.5, 23, step=4)
ASIDE = replace(FULL, name="mine", swath_px=7.0)


def recorded(*sweeps: Sweep) -> Recording:
    """Return a recording of these sweeps of a small simulated field."""
    source = simulated()
    return recording_of(source, [record(source, sweep) for sweep in sweeps])


def test_a_planned_pass_is_cut_at_the_ends_of_the_recording() -> None:
    """A coarse pass from -44 to 44 px keeps the lines within 2 px of those recorded from -39.5 to 39.5 px."""
    (found,) = recorded_first_pass(recorded(FULL), [COARSE])
    assert (found.swath_px, found.step, found.binning) == (0.0, 4, 1)
    assert found.line_px()[0] == pytest.approx(-40)
    assert found.line_px()[-1] == pytest.approx(40)
    assert recorded(FULL).serves(found)


def test_a_recorded_line_serves_the_end_of_a_plan_once() -> None:
    """A plan shifted by half a pixel has one line more than the recording and loses it. A single line stays."""
    recording = recorded(FULL)
    beside = replace(FULL, start_px=-40.0, lines=81)
    (found,) = recorded_full_scan(recording, [beside])
    assert (found.lines, found.start_px) == (80, -39.0)
    assert recorded_first_pass(recording, [beside]) == [found]
    assert lines_served(recording, [found]) == 80
    (one,) = recorded_fine_pass(recording, [replace(FULL, name="fine", start_px=-39.75, lines=1)])
    assert one.lines == 1


def test_a_plan_without_recorded_lines_moves_to_the_recorded_swath() -> None:
    """The plan's kind, line spacing and binning stay; the last recorded line serves its last one."""
    recording = recorded(ASIDE)
    assert recording.cut_to_recorded(COARSE) is None
    (found,) = recorded_first_pass(recording, [COARSE])
    assert (found.name, found.swath_px, found.step, found.binning) == ("coarse-0", 7.0, 4, 1)
    assert found.line_px() == pytest.approx(-39.5 + 4 * np.arange(21), abs=1e-5)
    assert recorded_full_scan(recording, [FULL]) == [ASIDE]
    blank = replace(record(simulated(), replace(ASIDE, name="blank", swath_px=30.0)), valid_line=np.zeros(80, bool))
    source = recording_of(simulated(), [*recording.sweeps, blank])
    assert recorded_first_pass(source, [COARSE]) == [found]  # no line of the other swath is valid


def test_recorded_lines_that_serve_several_sweeps_count_once() -> None:
    """A coarse pass and two fine ones share recorded lines: 80 lines altogether."""
    recording = recorded(FULL)
    (coarse,) = recorded_first_pass(recording, [COARSE])
    assert lines_served(recording, [coarse]) == coarse.lines
    assert lines_served(recording, [coarse, FULL, replace(FULL, name="again")]) == 80


def test_a_missing_line_is_named() -> None:
    """Lines finer than the recorded ones and lines in a gap are refused with their number."""
    with pytest.raises(NotRecordedError, match=r"line \d+ of sweep scan-0 was never captured.*no finer than recorded"):
        recorded_first_pass(recorded(Sweep("scan-0", "coarse", "x", 0.0, -39.5, 20, step=4)), [FULL])
    gap = replace(FULL, lines=20), replace(FULL, name="rest", start_px=10.5, lines=30)
    with pytest.raises(NotRecordedError, match=r"line \d+ of sweep fine was never captured"):
        recorded_fine_pass(recorded(*gap), [replace(FULL, name="fine", start_px=-25.5, lines=50)])


def test_a_recording_of_two_kinds_of_lines_is_no_uniform_scan() -> None:
    """A coarse and a fine pass are refused as a uniform scan. A full scan is then planned over the fine lines."""
    recording = recorded(replace(COARSE, start_px=-39.5, lines=20), replace(FULL, name="fine-0", lines=30))
    with pytest.raises(SceneError, match=r"lines of 2 kinds .*give the --budget of a zoomed survey"):
        sweeps_as_taken(recording)
    assert recorded_full_scan(recording, [replace(FULL, name="full-0")]) == [replace(FULL, name="full-0")]


def test_a_planned_pass_takes_the_recorded_exposure() -> None:
    """It replaces that of the plan, the camera's stays unchanged. A second pass takes that of close lines, if any."""
    (found,) = recorded_first_pass(recorded(replace(FULL, exposure_ms=20.0)), [replace(COARSE, exposure_ms=50.0)])
    assert found.exposure_ms == 20.0
    assert CAMERA.exposure_ms == 100.0
    first = replace(COARSE, exposure_ms=200.0)
    assert recorded_fine_ms(recorded(first, replace(FULL, exposure_ms=20.0))) == 20.0
    assert recorded_fine_ms(recorded(first)) is None
