"""Lines get the positions that the mirror had, by trigger, log or commands, and what is not known is said."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.errors import RigError, ShapeError
from pipeline.geometry.camera import LineCamera
from pipeline.rig.capture.line_positions import (
    CommandTimes,
    FrameTimes,
    LinePositions,
    MirrorScanPath,
    PlayedPath,
    line_edges,
    lines_by_commands,
    lines_by_log,
    lines_by_trigger,
)

CAMERA = LineCamera(exposure_ms=8.0)
LINES, PERIOD_S, DRIFT = 400, 0.01, 1e-4
START_S = 0.7371  # of the first frame by the mirror's clock
COMMANDS = CommandTimes((10.0, 10.002), (10.736, 10.738))


def sweep(time_s: np.ndarray) -> np.ndarray:
    """Where the mirror is: a curved path that is smooth in time."""
    return np.stack([0.1 * np.sin(time_s / 3), 0.4 * time_s / 6 - 0.2], axis=-1)


def frames(count: int = LINES) -> FrameTimes:
    """Frames by a camera clock that is 100 ppm slow."""
    stamp = 1_700_000_000_000_000 + np.rint(np.arange(count) * PERIOD_S / (1 + DRIFT) * 1e6).astype(np.int64)
    return FrameTimes(np.arange(count), stamp, exposure_ms=8.0, period_ms=10.0)


def edges(count: int = LINES) -> np.ndarray:
    """When exposures began, by the mirror's clock."""
    return START_S + np.arange(count) * PERIOD_S


def scan_path(until_s: float = 6.0, *, from_s: float = 0.0, with_edges: bool = True) -> MirrorScanPath:
    """The 10 kHz log, edges known to a sample."""
    time_s = np.arange(round(from_s * 1e4), round(until_s * 1e4)) / 1e4
    at = edges()[(edges() > time_s[0]) & (edges() < time_s[-1])]
    return MirrorScanPath(time_s, sweep(time_s), np.round(at * 1e4) / 1e4 if with_edges else None)


def check_truth(found: LinePositions, lines: np.ndarray | None = None, atol_s: float = 3e-5) -> None:
    """Valid lines have the positions of their own mid exposures."""
    middle = edges(len(found.valid) if lines is None else lines.max() + 1) + 0.004
    middle = middle if lines is None else middle[lines]
    speed = 0.08
    np.testing.assert_allclose(found.position[found.valid], sweep(middle)[found.valid], atol=atol_s * speed, rtol=0)


def test_by_log() -> None:
    """The fit finds 100 ppm and the offset, far within a sample of the log; residuals are told in us and px."""
    found = lines_by_log(frames(), CAMERA, scan_path())
    check_truth(found)
    assert found.valid.all()
    assert found.method == "log"
    assert found.drift_ppm == pytest.approx(100, abs=3)
    assert found.residual_us is not None
    assert found.residual_us <= 50
    assert found.residual_px == pytest.approx(found.residual_us * 1e-6 * 0.075 / CAMERA.ifov_rad, rel=1)
    assert "400 of 400 frames have an edge in the log" in found.notes


def test_missing_and_repeated_frames() -> None:
    """Frames that were dropped, numbered or not, and one that is there twice, do not move the others."""
    whole = frames()
    lines = np.concatenate([np.arange(50), np.arange(53, 200), [199], np.arange(200, 400)])
    found = lines_by_log(
        replace(whole, number=whole.number[lines], stamp_us=whole.stamp_us[lines]), CAMERA, scan_path()
    )
    check_truth(found, lines)
    assert "3 frames are missing between the lines" in found.notes
    assert "1 frames are there twice or out of order" in found.notes


def test_frames_dropped_without_a_number() -> None:
    """Frames that the camera dropped and did not count are seen by their stamps; a trigger's count sees them too."""
    whole = frames()
    kept = np.concatenate([np.arange(50), np.arange(51, 200), np.arange(203, LINES)])
    dropped = replace(whole, number=np.arange(len(kept)), stamp_us=whole.stamp_us[kept])
    check_truth(lines_by_log(dropped, CAMERA, scan_path()), kept)
    with pytest.raises(RigError, match="counted 400 triggers, the camera's last frame is number 395"):
        lines_by_trigger(dropped, CAMERA, PlayedPath(sweep(np.arange(LINES) / 100), 100.0), index_at_end=LINES - 1)


def test_log_shorter_than_the_capture() -> None:
    """Lines beyond the log have no position and are not valid; the others are as good as ever."""
    found = lines_by_log(frames(), CAMERA, scan_path(3.0))
    check_truth(found)
    assert np.count_nonzero(~found.valid) == np.count_nonzero(edges() + 0.004 > 2.9999)
    assert np.isnan(found.position[~found.valid]).all()
    assert any("lie outside of the log and are not valid" in note for note in found.notes)
    late = lines_by_log(frames(), CAMERA, scan_path(6.0, from_s=2.0))
    check_truth(late)
    assert not late.valid[:100].any()
    with pytest.raises(RigError, match="start the log before the capture"):
        lines_by_log(frames(), CAMERA, scan_path(3.0, from_s=2.0))
    check_truth(lines_by_log(frames(), CAMERA, replace(scan_path(3.0, from_s=0.0)), commands=COMMANDS))


def test_jitter_and_no_stamps() -> None:
    """Edges that jitter by 0.3 ms average out, and the residual says so; without an index they follow their period."""
    rng = np.random.default_rng(4)
    whole = scan_path()
    jittered = replace(whole, edge_s=np.sort(edges() + rng.normal(0, 3e-4, LINES)))
    found = lines_by_log(frames(), CAMERA, jittered)
    check_truth(found, atol_s=1.5e-4)
    assert found.residual_us == pytest.approx(300, rel=0.15)
    found = lines_by_log(FrameTimes(np.full(LINES, -1), np.full(LINES, -1), 8.0, 10.0), CAMERA, whole)
    check_truth(found, atol_s=1e-4)
    assert "no line has a time stamp: frames are taken to follow their period" in found.notes


def test_stamps_that_go_back() -> None:
    """Stamps that jump back, and ones that are missing, follow their neighbours; edges say what moment they are of."""
    whole = frames()
    stamp = whole.stamp_us.copy()
    stamp[100] -= 5_000_000
    stamp[200:210] = -1
    stamp[300] += 9_000_000_000
    for stamp_at in ("start", "middle", "end"):
        found = lines_by_log(replace(whole, stamp_us=stamp, stamp_at=stamp_at), CAMERA, scan_path())
        check_truth(found)
        assert found.valid.all()
        assert "12 time stamps are missing or stray, and follow their neighbours" in found.notes


@pytest.mark.parametrize("line", [1, 200, 300, 399])
def test_clock_that_is_set_back(line: int) -> None:
    """A camera clock set back by a second somewhere: that is taken off and said."""
    whole = frames()
    stamp = whole.stamp_us - np.where(np.arange(LINES) >= line, 1_000_000, 0)
    found = lines_by_log(replace(whole, stamp_us=stamp), CAMERA, scan_path())
    check_truth(found)
    assert found.valid.all()
    assert any("the camera's clock was set back 1 times" in note or "stray" in note for note in found.notes)


def test_one_frame() -> None:
    """One frame has its own edge, and no drift."""
    one = replace(scan_path(), edge_s=edges(1))
    found = lines_by_log(frames(1), CAMERA, one)
    check_truth(found)
    assert found.drift_ppm == 0
    assert "a drift cannot be told from 1 frame" in found.notes
    assert lines_by_trigger(frames(1), CAMERA, PlayedPath(sweep(edges(1)), 100.0)).valid.all()
    assert lines_by_commands(frames(1), CAMERA, PlayedPath(sweep(edges(200)), 100.0), COMMANDS).valid.all()


def test_log_without_edges() -> None:
    """By the commands' times alone the offset is as uncertain as they are, and that is said; without them none."""
    found = lines_by_log(frames(), CAMERA, scan_path(with_edges=False), commands=COMMANDS)
    check_truth(found, atol_s=2e-3)
    assert found.residual_us == pytest.approx(2000)
    assert any("a constant line offset of about" in note for note in found.notes)
    with pytest.raises(RigError, match="no edges and there are no command times"):
        lines_by_log(frames(), CAMERA, scan_path(with_edges=False))
    with pytest.raises(ShapeError, match="expected logged times"):
        lines_by_log(frames(), CAMERA, replace(scan_path(), time_s=np.arange(3.0)))


def test_moments_of_stamps_count_without_edges() -> None:
    """A stamp of the start lies half an exposure before the middle, one of the end as much behind it."""
    log, path = scan_path(with_edges=False), PlayedPath(sweep(np.arange(6000) / 1000), 1000.0)
    for stamp_at, late_s in (("start", 0.004), ("middle", 0.0), ("end", -0.004)):
        told = replace(frames(), stamp_at=stamp_at)
        by_log = lines_by_log(told, CAMERA, log, commands=COMMANDS)
        assert by_log.time_s[0] == pytest.approx(0.736 + late_s, abs=1e-9)
        np.testing.assert_allclose(by_log.position[0], sweep(by_log.time_s[:1])[0], atol=1e-6)
        by_commands = lines_by_commands(told, CAMERA, path, COMMANDS)
        assert by_commands.time_s[0] == pytest.approx(late_s, abs=1e-9)
        np.testing.assert_allclose(by_commands.position[0], sweep(np.array([0.7365 + late_s]))[0], atol=1e-4)


def test_first_frames_that_were_dropped_without_edges() -> None:
    """Lines that begin with frame 50 lie half a second behind the capture's start, by the log and by commands."""
    whole = frames()
    late = replace(whole, number=whole.number[50:], stamp_us=whole.stamp_us[50:])
    lines = np.arange(50, LINES)
    check_truth(lines_by_log(late, CAMERA, scan_path(with_edges=False), commands=COMMANDS), lines, atol_s=2e-3)
    path = PlayedPath(sweep(np.arange(6000) / 1000), 1000.0)
    check_truth(lines_by_commands(late, CAMERA, path, COMMANDS), lines, atol_s=3e-3)


def test_commands_count_from_the_logs_own_start() -> None:
    """A log begins with its first sample, at 0 or not: without edges, and where edges do not tell the frame."""
    late = replace(COMMANDS, run_s=(10.3, 10.302))
    check_truth(lines_by_log(frames(), CAMERA, scan_path(from_s=0.3, with_edges=False), commands=late), atol_s=2e-3)
    amid = replace(COMMANDS, run_s=(10.9, 10.902))
    found = lines_by_log(frames(), CAMERA, scan_path(3.0, from_s=0.9), commands=amid)
    check_truth(found)
    assert np.count_nonzero(found.valid) > 200


def test_by_trigger() -> None:
    """One vector index a frame: numbers count, missing ones too, and the mirror's count must agree."""
    path = PlayedPath(sweep(np.arange(LINES) / 100), 100.0)
    whole = frames()
    kept = np.concatenate([np.arange(10), np.arange(12, LINES)])
    told = replace(whole, number=whole.number[kept], stamp_us=whole.stamp_us[kept])
    found = lines_by_trigger(told, CAMERA, path, index_at_end=LINES - 1)
    np.testing.assert_array_equal(found.position, path.position[kept])
    assert (found.method, found.residual_us, found.residual_px) == ("trigger", 0.0, 0.0)
    assert "2 frames are missing between the lines" in found.notes
    with pytest.raises(RigError, match=r"counted 399 triggers, the camera's last frame is number 399"):
        lines_by_trigger(told, CAMERA, path, index_at_end=LINES - 2)
    unchecked = lines_by_trigger(told, CAMERA, path)
    assert unchecked.residual_us is None
    assert "positions are those sent, not measured; triggers were not counted" in unchecked.notes


def test_by_trigger_without_numbers() -> None:
    """Gaps that the lines around them explain are filled; others, and lines beyond the path, are not valid."""
    number = np.array([0, 1, -1, 3, -1, 6, 99])
    found = lines_by_trigger(replace(frames(7), number=number), CAMERA, PlayedPath(sweep(np.arange(8) / 10), 10.0))
    assert found.valid.tolist() == [True, True, True, True, False, True, False]
    assert "1 lines are beyond the 8 positions of the path" in found.notes
    with pytest.raises(RigError, match="no line has a frame number"):
        lines_by_trigger(replace(frames(3), number=np.full(3, -1)), CAMERA, PlayedPath(sweep(np.arange(8) / 10), 10.0))


def test_by_commands() -> None:
    """Held positions by the commands' times; half of what is not known is told, in px too, and that an offset stays."""
    path = PlayedPath(sweep(np.arange(6000) / 1000), 1000.0)
    found = lines_by_commands(frames(), CAMERA, path, COMMANDS)
    check_truth(found, atol_s=3e-3)
    assert found.method == "command"
    assert found.residual_us == pytest.approx(2000)
    assert found.residual_px == pytest.approx(0.002 * 0.11 / CAMERA.ifov_rad, rel=0.5)
    assert any("software timing: a constant line offset" in note for note in found.notes)
    short = lines_by_commands(frames(), CAMERA, replace(path, position=path.position[:2000]), COMMANDS)
    assert 0 < np.count_nonzero(short.valid) < LINES


def test_line_edges() -> None:
    """An edge is half a sample before its cell was seen, or a later one where two came between samples."""
    index = np.array([0, 0, 1, 2, 4, 5, 5])
    assert line_edges(index, np.arange(7.0), 1, 1).tolist() == [1.5, 2.5, 3.5, 3.5, 4.5]
    assert line_edges(index, np.arange(7.0), 1, 2).tolist() == [1.5, 3.5, 4.5]
    assert line_edges(np.zeros(3, np.int64), np.arange(3.0), 1, 2).tolist() == []
