"""The emulated camera speaks the documented bytes, and its faults meet a client that says what happened."""

from __future__ import annotations

import pytest

from pipeline.rig.emulator.camera_device import CameraConnection
from tests.pipeline.rig.camera.camera_line import LinesOf, control_of
from tests.pipeline.rig.camera_faults import CameraFault, CameraFaults, FaultyCamera
from tests.pipeline.rig.in_process import ManualClock

CAPTURE = b'capture({"prefix": "", "maxCubes": 1, "maxFramesPerCube": 5})'
PROMPT = b"\r\nhpi> "


def device_with(fault: CameraFault | None = None, times: int = 1, seed: int = 0) -> FaultyCamera:
    """A camera with one fault."""
    faults = CameraFaults({} if fault is None else {fault: times}, seed)
    return FaultyCamera(LinesOf(), ManualClock(), faults=faults)


@pytest.mark.parametrize(
    ("sent", "received"),
    [
        (
            b'configure({"exposure": 4.5, "framePeriod": 5})\r',
            b'configure({"exposure": 4.5, "framePeriod": 5})\r\n{"success": true, '
            b'"response": {"exposure": 4.5, "framePeriod": 5.0}, "errorMessage": ""}' + PROMPT,
        ),
        (
            b'configure({"exposure": 6, "framePeriod": 5})\r',
            b'configure({"exposure": 6, "framePeriod": 5})\r\n{"success": false, "response": null, '
            b'"errorMessage": "exposure longer than frame period"}' + PROMPT,
        ),
        (
            CAPTURE + b"\r\n",
            CAPTURE + b'\r\n{"success": true, "response": {"folder": "/captured/000000"}, "errorMessage": ""}' + PROMPT,
        ),
        (b"isCapturing\r", b'isCapturing\r\n{"success": true, "response": false, "errorMessage": ""}' + PROMPT),
        (b"stopCapture\r", b'stopCapture\r\n{"success": true, "response": false, "errorMessage": ""}' + PROMPT),
        (
            b'listFiles("/")\r',
            b'listFiles("/")\r\n{"success": true, "response": [{"name": "/captured", "size": 0, "mtime": 0, '
            b'"isDirectory": true}], "errorMessage": ""}' + PROMPT,
        ),
        (
            b'listFiles("/x")\r',
            b'listFiles("/x")\r\n{"success": false, "response": null, "errorMessage": "no such folder /x"}' + PROMPT,
        ),
        (
            b"hello\r",
            b'hello\r\n{"success": false, "response": null, "errorMessage": "unknown command hello"}' + PROMPT,
        ),
        (
            b"configure({]\r",
            b'configure({]\r\n{"success": false, "response": null, "errorMessage": '
            b'"argument of configure is not JSON"}' + PROMPT,
        ),
        (b"\r", PROMPT),
    ],
)
def test_bytes_of_every_command(sent: bytes, received: bytes) -> None:
    """Each command gives its bytes, in one piece or byte by byte."""
    for size in (1, len(sent)):
        talk = CameraConnection(device_with())
        came = b""
        for at in range(0, len(sent), size):
            chunks, goes_on = talk.feed(sent[at : at + size])
            assert goes_on
            came += b"".join(chunk.data for chunk in chunks)
        assert came == received
        assert talk.feed(b"exit\r") == ([], False)


def test_frames_pass_with_time() -> None:
    """A capture runs for its frames' time; what is over by then is in the files."""
    device = device_with()
    control = control_of(device, device.clock)  # type: ignore[arg-type]
    folder = control.capture(60).folder
    device.clock.sleep(0.3)
    assert control.is_capturing()
    assert len(device.files()[f"{folder}/raw_0"]) == 29 * 48
    device.clock.sleep(0.4)
    assert not control.is_capturing()
    names = [file.name.rsplit("/", 1)[1] for file in control.list_files(folder)]
    assert names == ["frameIndex_0.txt", "imu_gps.txt", "raw_0", "raw_0.hdr"]
