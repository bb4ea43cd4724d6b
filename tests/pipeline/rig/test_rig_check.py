"""The check of a rig before a survey: its rows have results and remedies, and nothing moves unless requested."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from pipeline.errors import RigError
from pipeline.rig.camera.camera_files import log_in
from pipeline.rig.camera.headwall_camera import HeadwallCamera
from pipeline.rig.capture_paths import capture_prefix
from pipeline.rig.device_settings import FileServer, SurveyRig
from pipeline.rig.mirror_controller import MirrorController, MotionLog
from pipeline.rig.rig_check import SQUARE, CheckRow, check_camera, check_mirror, failed, works
from pipeline.rig.transports import Clock, DeviceGone, DeviceRefused
from tests.pipeline.rig.camera_faults import CameraFault, CameraFaults, FaultyRig
from tests.pipeline.rig.in_process import InProcessRig, ManualClock
from tests.pipeline.rig.mirror_faults import make_fault
from tests.pipeline.rig.small_rig import FINE, set_anything, small_source


@contextmanager
def rig(*faults: str, camera: CameraFaults | None = None) -> Iterator[InProcessRig]:
    """Yield an emulated rig whose mirror's faults strike at the first opportunity."""
    struck = [make_fault(name, at=0) for name in faults]
    whole = FaultyRig(small_source(), ManualClock(), mirror_faults=struck, camera_faults=camera)
    with InProcessRig(whole) as line:
        yield line


def mirror_rows(line: InProcessRig, *, move: bool = False, **settings: Any) -> list[CheckRow]:
    """Check the mirror of a rig."""

    return check_mirror(lambda: line.mirror(SurveyRig(**settings)), line.clock, move=move)


def told(rows: list[CheckRow], verdict: str) -> list[str]:
    """Return the names of the checks with this verdict."""
    return [row.asked for row in rows if row.verdict == verdict]


def test_a_working_mirror_passes_the_check() -> None:
    """The rows are in order, nothing was set, and the port is closed."""
    with rig() as line:
        rows = mirror_rows(line)
        assert [row.asked for row in rows] == ["connect", "status"]
        assert {row.verdict for row in rows} == {"ok"}
        assert rows[0].came == "MR-E-2, version EMULATOR 1.0, serial EMUL0001"
        assert works(rows, "mirror")
        assert not works(rows, "camera")
        assert not set_anything(line.rig.mirror)
        with pytest.raises(DeviceGone, match="closed"):
            line.transport.drain()


def test_the_mirror_moves_in_a_square_and_is_read_back() -> None:
    """Four corners within 0.05 of the centre, and the centre, are each reached."""
    assert np.hypot(*np.transpose(SQUARE)).max() < 0.05
    with rig() as line:
        rows = mirror_rows(line, move=True)
        moves = [row for row in rows if row.asked.startswith("go to")]
        assert [row.asked for row in moves][-1] == "go to 0; 0"
        assert len(moves) == 5
        assert {row.verdict for row in rows} == {"ok"}
        assert "read back 0.0300; -0.0300" in moves[1].came
        assert np.abs(line.rig.mirror.positions(line.clock.now())).max() < 1e-4


@pytest.mark.parametrize(
    ("fault", "asked", "mend"),
    [
        ("wrong-firmware", "connect", "rig.expected_id"),
        ("mirror-warm", "status", "motions are refused"),
        ("disconnected", "status", "motions are refused"),
        ("never-stable", "status", "not stable"),  # a survey would wait
        ("trimmed", "status", "trimmed"),
        ("echo", "connect", ""),
        ("mute", "connect", "is the controller on"),
        ("gone-before", "connect", "cable"),
    ],
)
def test_mirror_faults_fail_the_check_and_nothing_moves(fault: str, asked: str, mend: str) -> None:
    """One row fails and names a remedy, and a requested square is not begun."""
    with rig(fault) as line:
        rows = mirror_rows(line, move=True)
        assert told(rows, "fail") == [asked]
        assert mend in next(row.mend for row in rows if row.verdict == "fail")
        assert not works(rows, "mirror")
        assert not set_anything(line.rig.mirror)
        if asked != "connect":
            assert "move" in told(rows, "warn")


def test_another_device_id_passes_if_it_is_configured() -> None:
    """The configured id may be undocumented. An error without a remedy gives a row without one."""
    with rig("wrong-firmware") as line:
        assert works(mirror_rows(line, expected_id="LENS"), "mirror")
    assert failed("mirror", "connect", RigError("no")) == CheckRow("mirror", "connect", "no", "fail", "")


def test_a_position_that_is_not_finite_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    """A mirror whose log has only NaN has not reached its target."""
    log = MotionLog(np.full((8, 2), np.nan, np.float32), 1000.0, 0.0, 0.0)
    monkeypatch.setattr(MirrorController, "read_log", lambda *_: log)
    with rig() as line:
        assert "go to 0.03; 0.03" in told(mirror_rows(line, move=True), "fail")


def test_a_working_camera_passes_the_check() -> None:
    """Rows report its state, its files and their server. A running capture is a warning and is left alone."""
    with rig() as line:
        rows = check_camera(line.camera)
        asked = [row.asked.partition(",")[0] for row in rows]
        assert asked == ["whether it captures", "list its files", "log in to its files"]
        assert {row.verdict for row in rows} == {"ok"}
        line.camera().capture(5, prefix=capture_prefix(FINE))
        assert told(check_camera(line.camera), "warn") == ["whether it captures"]
        assert line.rig.camera.is_capturing()


def test_camera_faults_fail_the_check() -> None:
    """A missing control port or file server fails its row. A wrong password is refused."""
    with rig(camera=CameraFaults({CameraFault.HANGS_UP: 9})) as line:
        assert told(check_camera(line.camera), "fail") == ["connect"]
    with rig() as line:
        gone = HeadwallCamera(line.camera_line, FileServer("127.0.0.1", 1), clock=line.clock)
        assert told(check_camera(lambda: gone), "fail") == ["log in to its files, port 1"]
        with pytest.raises(DeviceRefused, match="password"):
            log_in(replace(line.files, password="other"))
        assert log_in(line.files) == "emulated camera"


@dataclass
class Mock:
    """A mirror of another manufacturer, which reaches its targets at once."""

    clock: Clock
    place: tuple[float, float] = (0.0, 0.0)
    closed: bool = False

    def goto(self, x: float, y: float) -> None:
        self.place = (x, y)

    def start_log(self, rate_hz: float) -> None: ...

    def settle(self, within_s: float) -> None: ...

    def read_log(self) -> MotionLog:
        return MotionLog(np.full((8, 2), self.place, np.float32), 1000.0, 0.0, 0.0)

    def close(self) -> None:
        self.closed = True


def test_a_mirror_of_another_make_passes_the_square() -> None:
    """The check uses only what every mirror driver has, and closes the driver."""
    mirror: Any = Mock(ManualClock())
    rows = check_mirror(lambda: mirror, mirror.clock, move=True)
    assert rows[0].came == "Mock is there"
    assert rows[1].came.startswith("read back 0.0300; 0.0300")
    assert ([row.verdict for row in rows], mirror.closed) == (["ok"] * 6, True)
