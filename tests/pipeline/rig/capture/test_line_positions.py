"""Lines lie where the mirror's path was at the camera's frame times; unknown positions are reported."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from spectralzoom.pipeline.errors import RigError
from spectralzoom.pipeline.frame_indices import LineTimes
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.scan import Sweep
from spectralzoom.pipeline.rig.capture_paths import (
    CaptureRecord,
    LinePositions,
    UnusableCaptureError,
    positions_by_time,
)

LINES = 400
PERIOD_MS = 10.0
DRIFT = 1e-5
SWEEP = Sweep("fine-1", "fine", "x", 0.0, 0.0, LINES, step=2)
MIDDLE = np.stack([0.1 * np.sin(np.arange(LINES) / 300), 0.4 * np.arange(LINES) / LINES - 0.2], axis=-1)
AT_ONCE = (10.0, 10.0)


def frames(count: int = LINES, drift: float = 0.0) -> LineTimes:
    """Return frames, stamped by a camera clock that is slow by ``drift``."""
    stamp = 1_700_000_000_000_000 + np.rint(np.arange(count) * PERIOD_MS / (1 + drift) * 1e3).astype(np.int64)
    return LineTimes(np.arange(count), stamp)


def located(
    told: LineTimes,
    run_s: tuple[float, float] = AT_ONCE,
    capture_s: tuple[float, float] = AT_ONCE,
    *,
    exposure_ms: float = PERIOD_MS,
    period_ms: float = PERIOD_MS,
    step: int = 2,
) -> LinePositions:
    """Return the positions of frames on the path."""
    exposed = LineCamera(exposure_ms=exposure_ms, readout_ms=period_ms - exposure_ms)
    sweep = replace(SWEEP, step=step)
    return positions_by_time(told, MIDDLE, CaptureRecord(sweep, 0, LINES, "/c", run_s, capture_s), exposed)


def at(place: np.ndarray) -> np.ndarray:
    """Return the path's positions at places in lines."""
    return np.stack([np.interp(place, np.arange(LINES), MIDDLE[:, axis]) for axis in (0, 1)], axis=-1)


def test_lines_of_a_path_in_step_have_its_positions():
    """Stamps in whole microseconds change no bit, as the frames follow their period."""
    for period_ms in (10.0, 9.8765):
        told = LineTimes(np.arange(LINES), np.rint(np.arange(LINES) * period_ms * 1e3).astype(np.int64))
        found = located(told, exposure_ms=period_ms, period_ms=period_ms)
        np.testing.assert_array_equal(found.position, MIDDLE)
        assert (found.residual_px, found.valid.all()) == (0.0, True)


@given(st.floats(-0.02, 0.02), st.floats(0, 0.004), st.floats(0, 0.004))
def test_positions_are_right_within_the_stated_error(delay_s: float, run_s: float, capture_s: float):
    """The true start of path and capture lies anywhere in the spans of their commands."""
    found = located(frames(), (10.0, 10.0 + run_s), (10.0 + delay_s, 10.0 + delay_s + capture_s))
    for true_s in (delay_s - run_s, delay_s + capture_s):
        place = np.arange(LINES) + true_s / (PERIOD_MS * 1e-3)
        off_px = np.abs(found.position[:, 1] - at(place)[:, 1])[5:-5] / (0.4 / LINES) * SWEEP.step
        assert off_px.max() <= found.residual_px + 1e-9
    assert any("software timing: a constant line offset" in note for note in found.notes)


def test_a_slow_clock_of_the_camera_is_followed():
    """Stamps count, where they differ from the frame's period by more than their rounding."""
    found = located(frames(drift=1e-3))
    np.testing.assert_allclose(found.position, at(np.arange(LINES) / (1 + 1e-3)), atol=1e-6)


def test_stamps_that_contradict_the_frame_period_are_refused():
    """Stamps of a computer, which gets two frames at a time, are none."""
    whole = frames()
    with pytest.raises(RigError, match="are 5 ms apart, the camera was set to a frame period of 10 ms"):
        located(replace(whole, stamp_us=whole.stamp_us // 2))
    assert located(replace(whole, stamp_us=whole.stamp_us[np.arange(LINES) // 2 * 2])).valid.all()


def test_dropped_frames_do_not_move_other_lines():
    """Other lines keep their positions, whether frame numbers show the gap or only time stamps do."""
    whole = frames(drift=DRIFT)
    kept = np.concatenate([np.arange(50), np.arange(53, LINES)])
    numbered = replace(whole, frame=whole.frame[kept], stamp_us=whole.stamp_us[kept])
    found = located(numbered)
    np.testing.assert_allclose(found.position, MIDDLE[kept], atol=1e-4)
    assert "3 frames are missing between the lines" in found.notes
    found = located(replace(numbered, frame=np.arange(len(kept))))
    np.testing.assert_allclose(found.position, MIDDLE[kept], atol=1e-4)


def test_lines_beyond_the_path_are_invalid():
    """The mirror holds its first and its last position for up to one line; lines beyond have no position."""
    early, late = located(frames(), (10.025, 10.025)), located(frames(), AT_ONCE, (10.025, 10.025))
    assert np.flatnonzero(~early.valid).tolist() == [0, 1]
    assert early.position[2].tolist() == MIDDLE[0].tolist()
    assert np.flatnonzero(~late.valid).tolist() == [398, 399]
    assert late.position[397].tolist() == MIDDLE[-1].tolist()
    assert "without a time, or outside of the path's: 2 of 400 lines" in late.notes
    assert np.isnan(late.position[~late.valid]).all()


def test_frames_without_time_stamps_follow_their_period():
    """A note says that no line has a time stamp."""
    found = located(LineTimes(np.arange(LINES), np.full(LINES, -1)))
    np.testing.assert_array_equal(found.position, MIDDLE)
    assert "no line has a time stamp: frames are taken to follow their period" in found.notes


def test_missing_time_stamps_make_lines_invalid():
    """Lines without a stamp or number are invalid, the others stay right. Stamps that go back are refused."""
    whole = frames()
    stamp, number = whole.stamp_us.copy(), whole.frame.copy()
    stamp[200:210], number[:5] = -1, -1
    found = located(replace(whole, stamp_us=stamp, frame=number))
    np.testing.assert_array_equal(found.position[found.valid], MIDDLE[found.valid])
    assert np.flatnonzero(~found.valid).tolist() == [*range(5), *range(200, 210)]
    stamp[300:] -= 1_000_000
    with pytest.raises(UnusableCaptureError, match="the time stamps of its frames go back"):
        located(replace(whole, stamp_us=stamp))


def test_dropped_first_frames_do_not_move_the_lines():
    """Lines that begin with frame 50 lie half a second after the capture's start."""
    whole = frames()
    found = located(replace(whole, frame=whole.frame[50:], stamp_us=whole.stamp_us[50:]))
    np.testing.assert_array_equal(found.position, MIDDLE[50:])


def test_a_short_exposure_sees_the_first_held_positions():
    """Held positions fill the frame period; the stated error has what an exposure of half of it misses."""
    found = located(frames(), exposure_ms=PERIOD_MS / 2, step=4)
    assert found.residual_px == 0.75
