"""The check of a rig before a survey: its rows have results and remedies, and nothing moves unless requested."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest

from spectralzoom.flows.cli.rig_commands import SQUARE, CheckRow, check_camera, check_mirror, failed, works
from spectralzoom.pipeline.errors import RigError
from spectralzoom.pipeline.rig.camera.headwall_camera import HeadwallCamera
from spectralzoom.pipeline.rig.device_settings import FileServer
from spectralzoom.pipeline.rig.fakes import FakeCamera, FakeClock, FakeMirror
from spectralzoom.pipeline.rig.transports import DeviceGone
from tests.pipeline.rig.camera.scripted_files import ScriptedFiles, served
from tests.pipeline.rig.mirror import mirror_bytes as w
from tests.pipeline.rig.scripted import Pair, ScriptedTransport, scripted


def mirror_rows(script: Sequence[Pair], *, move: bool = False) -> list[CheckRow]:
    """Check a mirror that follows a script, with every byte of it."""
    with scripted(script) as transport:
        rows = check_mirror(lambda: w.connected(transport), move=move)
        assert transport.closed == (rows[0].verdict == "ok")
    return rows


def told(rows: list[CheckRow], verdict: str) -> list[str]:
    """Return the names of the checks with this verdict."""
    return [row.asked for row in rows if row.verdict == verdict]


def test_a_working_mirror_passes_the_check() -> None:
    """The rows are in order, no byte moves it, and the port is closed."""
    rows = mirror_rows([*w.CONNECT, w.WELL, w.WELL])
    assert [row.asked for row in rows] == ["connect", "status"]
    assert {row.verdict for row in rows} == {"ok"}
    assert rows[0].came == "MR-E-2, version 1.2.4065, serial ABCD0123"
    assert works(rows, "mirror")
    assert not works(rows, "camera")


def test_the_mirror_moves_in_a_square() -> None:
    """Four corners within 0.05 of the centre, and the centre, are each reached; any driver does."""
    assert np.hypot(*np.transpose(SQUARE)).max() < 0.05
    mirror = FakeMirror(FakeClock())
    rows = check_mirror(lambda: mirror, move=True)
    assert [row.asked for row in rows] == ["connect", *(f"go to {x:g}; {y:g}" for x, y in SQUARE), "go to 0; 0"]
    assert {row.verdict for row in rows} == {"ok"}
    assert rows[0].came == "FakeMirror is there"
    assert mirror.position == (0.0, 0.0)


MUTE: list[Pair] = [(b"START\r\n", b"")] * 3


@pytest.mark.parametrize(
    ("script", "asked", "mend"),
    [
        ([w.GREET, (b"GETID\r\n", b"LENS-4\r\n"), *w.WHO[1:]], "connect", "is another device at this port"),
        ([*w.CONNECT, w.WARM, w.WARM], "status", "motions are refused"),
        ([*w.CONNECT, w.TRIMMED], "status", "trimmed"),
        ([(b"START\r\n", b"START\r\n")] * 3, "connect", "is this the mirror"),
        (
            [*[(b"START\r\n", b"")] * 3, (w.LEAVE[0], b""), *[(b"START\r\n", b"")] * 3],
            "connect",
            "is the controller on",
        ),
        ([(b"START\r\n", [DeviceGone("p went away; look at the cable")])], "connect", "cable"),
    ],
    ids=["another device", "warm", "trimmed", "echo", "mute", "gone"],
)
def test_mirror_faults_fail_the_check_and_nothing_moves(script: list[Pair], asked: str, mend: str) -> None:
    """One row fails and names a remedy, and a requested square is not begun."""
    rows = mirror_rows(script, move=True)
    assert told(rows, "fail") == [asked]
    failure = next(row for row in rows if row.verdict == "fail")
    assert mend in f"{failure.came}; {failure.mend}"
    assert not works(rows, "mirror")
    if asked != "connect":
        assert "move" in told(rows, "warn")


def test_the_square_ends_at_the_first_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """A corner that is not reached is the last row. An error without a remedy gives a row without one."""
    monkeypatch.setattr(FakeMirror, "settle", Mock(side_effect=RigError("it is not at rest after 2 s; mend that")))
    rows = check_mirror(lambda: FakeMirror(FakeClock()), move=True)
    assert told(rows, "fail") == ["go to 0.03; 0.03"]
    assert len(rows) == 2
    assert failed("mirror", "connect", RigError("no")) == CheckRow("mirror", "connect", "no", "fail", "")


def camera_of(script: Sequence[Pair], server: FileServer) -> Callable[[], HeadwallCamera]:
    """Return a function that connects to a camera that follows a script."""
    clock = FakeClock()
    return lambda: HeadwallCamera(lambda: ScriptedTransport(script, clock, b"hpi> "), server, clock=clock)


def said(command: bytes, response: bytes) -> Pair:
    return command, command + b'\n{"success": true, "response": ' + response + b', "errorMessage": ""}\r\nhpi> '


IDLE, EXIT = said(b"isCapturing\r", b"false"), (b"exit\r", b"")


def test_a_working_camera_passes_the_check() -> None:
    """Rows report its state and its file server. A running capture is a warning and is left alone."""
    with served(ScriptedFiles({})) as server:
        rows = check_camera(camera_of([IDLE, EXIT], server))
        assert [row.asked.partition(",")[0] for row in rows] == [*("whether it captures", "log in to its files")]
        assert {row.verdict for row in rows} == {"ok"}
        rows = check_camera(camera_of([said(b"isCapturing\r", b"true"), EXIT], server))
        assert told(rows, "warn") == ["whether it captures"]
        rows = check_camera(camera_of([IDLE, EXIT], replace(server, password="x")))
        assert told(rows, "fail") == [f"log in to its files, port {server.port}"]
    assert [row.came for row in check_camera(lambda: FakeCamera(FakeClock()))] == ["no capture runs"]


def test_a_camera_that_is_not_there_fails_the_check() -> None:
    """Neither its control port nor its files answer."""
    gone = Mock(side_effect=DeviceGone("no connection to it; is the camera on?"))
    camera = HeadwallCamera(gone, FileServer("127.0.0.1", 1), clock=FakeClock())
    rows = check_camera(lambda: camera)
    assert told(rows, "fail") == ["connect", "log in to its files, port 1"]
    assert rows[0].mend == "is the camera on?"
