"""The emulated camera speaks the documented bytes, and its frames advance with the clock."""

from __future__ import annotations

import pytest

from pipeline.rig.camera.headwall_camera import HeadwallCamera
from pipeline.rig.device_settings import ControlPatience, FileServer
from pipeline.rig.emulator.camera_device import CameraConnection, CameraDevice
from tests.pipeline.rig.camera.camera_line import LinesOf
from tests.pipeline.rig.in_process import InProcessCameraLine, ManualClock

CAPTURE = b'capture({"prefix": "", "maxCubes": 1, "maxFramesPerCube": 5})'
PROMPT = b"\r\nhpi> "
NO = b'{"success": false, "response": null, "errorMessage": "%s"}'
YES = b'{"success": true, "response": %s, "errorMessage": ""}'


@pytest.mark.parametrize(
    ("sent", "end", "reply"),
    [
        (b'configure({"exposure": 4.5, "framePeriod": 5})', b"\r", YES % b'{"exposure": 4.5, "framePeriod": 5.0}'),
        (b'configure({"exposure": 6, "framePeriod": 5})', b"\r", NO % b"exposure longer than frame period"),
        (CAPTURE, b"\r\n", YES % b'{"folder": "/captured/000000"}'),
        (b"isCapturing", b"\r", YES % b"false"),
        (b"stopCapture", b"\r", YES % b"false"),
        (b'listFiles("/")', b"\r", YES % b'[{"name": "/captured", "size": 0, "mtime": 0, "isDirectory": true}]'),
        (b'listFiles("/x")', b"\r", NO % b"no such folder /x"),
        (b"hello", b"\r", NO % b"unknown command hello"),
        (b"configure({]", b"\r", NO % b"argument of configure is not JSON"),
        (b"", b"\r", None),
    ],
)
def test_every_command_gets_its_documented_bytes(sent: bytes, end: bytes, reply: bytes | None) -> None:
    """The reply follows an echo of the command, whether it is sent in one piece or byte by byte."""
    for size in (1, len(sent + end)):
        talk = CameraConnection(CameraDevice(LinesOf(), ManualClock()))
        came = b""
        for at in range(0, len(sent + end), size):
            chunks, goes_on = talk.feed((sent + end)[at : at + size])
            assert goes_on
            came += b"".join(chunk.data for chunk in chunks)
        assert came == (PROMPT if reply is None else sent + b"\r\n" + reply + PROMPT)
        assert talk.feed(b"exit\r") == ([], False)


def test_frames_advance_with_the_clock() -> None:
    """A capture lasts as long as its frames. Frames that are over by then are in the files."""
    clock = ManualClock()
    device = CameraDevice(LinesOf(), clock)
    line = lambda: InProcessCameraLine(device, clock, "emulated:8100")  # noqa: E731
    control = HeadwallCamera(line, FileServer(), clock=clock, patience=ControlPatience(5.0, 2))
    folder = control.capture(60).folder
    clock.sleep(0.3)
    assert control.is_capturing()
    assert len(device.files()[f"{folder}/raw_0"]) == 29 * 48
    clock.sleep(0.4)
    assert not control.is_capturing()
    names = [file.name.rsplit("/", 1)[1] for file in control.list_files(folder)]
    assert names == ["frameIndex_0.txt", "imu_gps.txt", "raw_0", "raw_0.hdr"]
