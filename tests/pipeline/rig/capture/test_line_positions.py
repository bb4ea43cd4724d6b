"""Lines get the mirror's positions by trigger, log or commands; unknown positions are reported."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest

from pipeline.errors import RigError
from pipeline.geometry.camera import LineCamera
from pipeline.rig.capture_paths import (
    FrameTimes,
    LinePositions,
    MirrorScanPath,
    lines_by_time,
    lines_by_trigger,
    played_scan_path,
)

CAMERA = LineCamera(exposure_ms=8.0)
LINES = 400
PERIOD_S = 0.01
DRIFT = 1e-5
START_S = 0.7371  # of the first frame on the mirror's clock
BEGAN_S, CAPTURE_S = (10.0, 10.002), (10.736, 10.738)
HELD = np.arange(6000) / 1000  # times at which the positions of a path are held


def sweep(time_s: np.ndarray) -> np.ndarray:
    """Return the mirror's positions on a curved path that is smooth in time."""
    return np.stack([0.1 * np.sin(time_s / 3), 0.4 * time_s / 6 - 0.2], axis=-1)


def frames(count: int = LINES) -> FrameTimes:
    """Return frames of a camera clock that is 10 ppm slow."""
    stamp = 1_700_000_000_000_000 + np.rint(np.arange(count) * PERIOD_S / (1 + DRIFT) * 1e6).astype(np.int64)
    return FrameTimes(np.arange(count), stamp, exposure_ms=8.0, period_ms=10.0)


def scan_path(until_s: float = 6.0, *, from_s: float = 0.0) -> MirrorScanPath:
    """Return the log at 10 kHz."""
    time_s = np.arange(round(from_s * 1e4), round(until_s * 1e4)) / 1e4
    return MirrorScanPath(time_s, sweep(time_s))


def by_log(told: FrameTimes, log: MirrorScanPath, began_s: tuple[float, float] = BEGAN_S) -> LinePositions:
    """Return lines located on a log by the times of the commands."""
    return lines_by_time(told, CAMERA, log, began_s, CAPTURE_S, "log")


def check_truth(found: LinePositions, lines: np.ndarray | None = None, atol_s: float = 2e-3) -> None:
    """Assert that valid lines have the positions of their own mid exposures."""
    kept = np.arange(len(found.valid)) if lines is None else lines
    middle_s = START_S + kept * PERIOD_S + 0.004
    np.testing.assert_allclose(found.position[found.valid], sweep(middle_s)[found.valid], atol=atol_s * 0.08, rtol=0)


@pytest.mark.parametrize("method", ["log", "command"])
def test_positions_by_time_are_right_within_the_stated_error(method: Literal["log", "command"]) -> None:
    """The residual in px is half of the uncertainty of the commands' times."""
    log = scan_path() if method == "log" else played_scan_path(sweep(HELD), 1000.0)
    found = lines_by_time(frames(), CAMERA, log, BEGAN_S, CAPTURE_S, method)
    check_truth(found, atol_s=3e-3)
    assert found.valid.all()
    assert found.method == method
    assert found.residual_px == pytest.approx(0.002 * 0.11 / CAMERA.ifov_rad, rel=0.5)
    assert any("software timing: a constant line offset" in note for note in found.notes)


def test_a_played_position_is_held_for_its_period() -> None:
    """Positions of a played path follow each other without interpolation."""
    held = played_scan_path(np.array([(0.0, 0.0), (0.5, -0.5), (0.1, 0.2)]), 10.0)
    told = FrameTimes(np.arange(6), np.arange(6) * 50_000, exposure_ms=2.0, period_ms=50.0)
    found = lines_by_time(told, CAMERA, held, (0.0, 0.0), (0.0, 0.0), "command")
    assert found.position.tolist() == [[0, 0], [0, 0], [0.5, -0.5], [0.5, -0.5], [0.1, 0.2], [0.1, 0.2]]
    assert found.valid.all()


def test_dropped_frames_do_not_move_other_lines() -> None:
    """Other lines keep their positions, whether frame numbers show the gap or only time stamps do."""
    whole = frames()
    kept = np.concatenate([np.arange(50), np.arange(53, LINES)])
    numbered = replace(whole, number=whole.number[kept], stamp_us=whole.stamp_us[kept])
    found = by_log(numbered, scan_path())
    check_truth(found, kept)
    assert "3 frames are missing between the lines" in found.notes
    check_truth(by_log(replace(numbered, number=np.arange(len(kept))), scan_path()), kept)


def test_lines_outside_of_the_log_are_invalid() -> None:
    """Lines before or after the log, or the path, have no position. The others keep theirs."""
    found = by_log(frames(), scan_path(3.0))
    check_truth(found)
    assert np.count_nonzero(found.valid) == pytest.approx(226, abs=1)
    assert np.isnan(found.position[~found.valid]).all()
    assert any("or outside of the log's: " in note for note in found.notes)
    short = lines_by_time(frames(), CAMERA, played_scan_path(sweep(HELD[:2000]), 1000.0), BEGAN_S, CAPTURE_S, "command")
    assert 0 < np.count_nonzero(short.valid) < LINES


def test_frames_without_time_stamps_follow_their_period() -> None:
    """A note says that no line has a time stamp."""
    found = by_log(FrameTimes(np.arange(LINES), np.full(LINES, -1), 8.0, 10.0), scan_path())
    check_truth(found)
    assert "no line has a time stamp: frames are taken to follow their period" in found.notes


def test_missing_time_stamps_make_lines_invalid() -> None:
    """Lines without a stamp or number are invalid, the others stay right. Stamps that go back are refused."""
    whole = frames()
    stamp, number = whole.stamp_us.copy(), whole.number.copy()
    stamp[200:210], number[:5] = -1, -1
    found = by_log(replace(whole, stamp_us=stamp, number=number), scan_path())
    check_truth(found)
    assert np.flatnonzero(~found.valid).tolist() == [*range(5), *range(200, 210)]
    stamp[300:] -= 1_000_000
    with pytest.raises(RigError, match="the time stamps of its frames go back"):
        by_log(replace(whole, stamp_us=stamp), scan_path())


def test_dropped_first_frames_do_not_move_the_lines() -> None:
    """Lines that begin with frame 50 lie half a second after the capture's start, by log and by commands."""
    whole = frames()
    lines = np.arange(50, LINES)
    late = replace(whole, number=whole.number[50:], stamp_us=whole.stamp_us[50:])
    check_truth(by_log(late, scan_path()), lines)
    played = lines_by_time(late, CAMERA, played_scan_path(sweep(HELD), 1000.0), BEGAN_S, CAPTURE_S, "command")
    check_truth(played, lines, atol_s=3e-3)


def test_command_times_count_from_the_start_of_the_log() -> None:
    """The log's first sample may have any time, and a single line suffices."""
    check_truth(by_log(frames(), scan_path(from_s=0.3), began_s=(10.3, 10.302)))
    assert by_log(frames(1), scan_path()).valid.all()


def test_positions_by_trigger_follow_the_frame_numbers() -> None:
    """Each frame number has one position. Frames without a number or beyond the path are invalid."""
    path = sweep(np.arange(8) / 10)
    told = replace(frames(6), number=np.array([0, 1, -1, 3, 6, 99]))
    found = lines_by_trigger(told, path, counted=True)
    np.testing.assert_array_equal(found.position[found.valid], path[[0, 1, 3, 6]])
    assert found.valid.tolist() == [True, True, False, True, True, False]
    assert (found.method, found.residual_px) == ("trigger", 0.0)
    unchecked = lines_by_trigger(told, path, counted=False)
    assert unchecked.residual_px is None
    assert "positions are those sent, not measured; triggers were not counted" in unchecked.notes
