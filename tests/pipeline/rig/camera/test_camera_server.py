"""The emulated camera on the network and its driver: lines arrive bit for bit, and faults are reported."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from pipeline.errors import RigError
from pipeline.rig.camera import camera_files
from pipeline.rig.camera.camera_files import KeptInMemory, RemoteFile, fetch_files, log_in
from pipeline.rig.camera.headwall_camera import HeadwallCamera
from pipeline.rig.device_settings import CameraAddress, FileServer
from pipeline.rig.emulator.camera_device import MOST_LINE, CameraConnection, CameraDevice, CameraServer
from pipeline.rig.transports import DeviceGone, DeviceRefused, SocketTransport
from tests.pipeline.rig.camera.camera_line import LinesOf, wait_for
from tests.pipeline.rig.camera_faults import CameraFault, CameraFaults, FaultyCamera, FaultyServer
from tests.pipeline.rig.in_process import ManualClock


def remote_files(device: CameraDevice, folder: str) -> list[RemoteFile]:
    """Return a device's files in a folder, as a listing has them."""
    files = sorted(device.files().items())
    return [RemoteFile(name, len(data), False) for name, data in files if name.startswith(folder + "/")]


@contextmanager
def camera(
    faults: dict[CameraFault, int] | None = None, **server: object
) -> Iterator[tuple[HeadwallCamera, CameraDevice, LinesOf]]:
    """Yield the driver of a served camera, the camera with the same clock, and the lines that it sees."""
    clock = ManualClock(100.0)
    lines = LinesOf()
    device = FaultyCamera(lines, clock, faults=CameraFaults(dict(faults or {})))
    with FaultyServer(device) as served:
        files = FileServer(served.host, served.file_port, stall_s=2.0, pause_s=0.01, **server)  # type: ignore[arg-type]
        driver = HeadwallCamera.at(CameraAddress(served.host, served.port), files, clock=clock)
        yield driver, device, lines
        driver.close()


def test_an_endless_command_closes_the_connection() -> None:
    """The camera keeps at most the bytes of the longest command and closes the connection at the next byte."""
    talk = CameraConnection(CameraDevice(LinesOf(), ManualClock()))
    assert talk.feed(b"x" * MOST_LINE) == ([], True)
    assert talk.feed(b"x") == ([], False)


def test_capture_and_fetch_return_the_cameras_lines() -> None:
    """Configure, capture, poll and fetch give the camera's lines, its frame times and the mean of its references."""
    dark = np.random.default_rng(1).integers(60, 70, (20, 6, 4)).astype(np.uint16)
    with camera() as (driver, device, lines):
        driver.configure(8.0, 10.0)
        folder = driver.capture(180, prefix="field").folder
        device.captures[0].references["darkReference"] = dark
        wait_for(driver, 5.0)
        seen: list[tuple[str, int, int]] = []
        found = driver.fetch(folder, KeptInMemory(), lambda *step: seen.append(step))
        np.testing.assert_array_equal(found.values, np.concatenate(lines.given))
        assert found.values.shape == (180, 6, 4)
        assert (found.lost, found.notes) == (0, ())
        assert np.diff(found.times.stamp_us).tolist() == [10000] * 179
        assert seen[-1] == ("/captured/field_000000/raw_0", 180 * 48, 180 * 48)
        assert device.commands.count("isCapturing") > 2
        (kind,) = (means := driver.references(folder, KeptInMemory()))
        assert kind == "dark"
        np.testing.assert_array_equal(means["dark"].mean, dark.mean(axis=0).astype(np.float32))


def test_an_interrupted_transfer_resumes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Several interruptions lose no byte and repeat none."""
    monkeypatch.setattr(camera_files, "OVERLAP", 16)
    with camera({CameraFault.BREAKS_OFF: 4, CameraFault.REFUSES_FILES: 2}, tries=3) as (driver, device, lines):
        folder = driver.capture(100).folder
        wait_for(driver, 5.0)
        kept = KeptInMemory()
        np.testing.assert_array_equal(driver.fetch(folder, kept).values, np.concatenate(lines.given))
        assert kept.files == {file.name: device.files()[file.name] for file in remote_files(device, folder)}
        assert not any(device.faults.left.values())


def test_a_different_file_of_the_same_name_is_refused() -> None:
    """Bytes of another file are kept as they are and never mixed with new ones. A file that has grown is refused."""
    with camera() as (driver, device, _):
        driver.capture(10)
        wait_for(driver, 5.0)
        (raw,) = [file for file in remote_files(device, "/captured/000000") if file.name.endswith("raw_0")]
        for held, words in ((b"\xff" * 20, "are of another file"), (b"x" * 10_000, "are of another file")):
            kept = KeptInMemory({raw.name: bytearray(held)})
            with pytest.raises(RigError, match=words):
                fetch_files(driver.server, [raw], kept)
            assert bytes(kept.files[raw.name]) == held
        with pytest.raises(RigError, match=r"481 when it was listed; fetch it when the capture has ended"):
            fetch_files(driver.server, [RemoteFile(raw.name, 481, False)], KeptInMemory())


@pytest.mark.parametrize(
    ("more", "kind", "words"),
    [
        (-100, RigError, r"more than its 380 bytes; fetch it when the capture has ended"),
        (100, DeviceGone, r"ended at byte 480 of 580; look at the file there"),
    ],
)
def test_transfer_of_other_length(more: int, kind: type[RigError], words: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file that is longer or shorter than the server's size is not accepted as complete."""
    with camera(tries=2) as (driver, device, _):
        driver.capture(10)
        wait_for(driver, 5.0)
        name = "/captured/000000/raw_0"
        whole = device.files()[name]
        monkeypatch.setattr("pipeline.rig.emulator.camera_device._FilesInMemory.getsize", lambda *_: len(whole) + more)
        with pytest.raises(RigError, match=words) as caught:
            fetch_files(driver.server, [RemoteFile(name, None, False)], KeptInMemory())
        assert type(caught.value) is kind


def test_a_silent_server_is_reported() -> None:
    """A silent server costs the timeout. A port that speaks no FTP is named as such."""
    with socket.create_server(("127.0.0.1", 0)) as silent:
        server = FileServer("127.0.0.1", silent.getsockname()[1], stall_s=0.1, tries=1)
        with pytest.raises(DeviceGone, match=r"fell silent .*timed out"):
            log_in(server)
    with CameraServer(CameraDevice(LinesOf(), ManualClock())) as served:
        server = FileServer(served.host, served.port, stall_s=2.0)
        with pytest.raises(DeviceGone, match=r"is no FTP server .*Hyperspec"):
            log_in(server)


def test_refused_files_are_reported() -> None:
    """A wrong password, a missing file and an absent server have different messages."""
    with camera() as (driver, device, _):
        driver.capture(2)
        wait_for(driver, 5.0)
        (index,) = [file for file in remote_files(device, "/captured/000000") if "frameIndex" in file.name]
        wrong = FileServer(driver.server.host, driver.server.port, password="x")
        with pytest.raises(DeviceRefused, match="user and password"):
            fetch_files(wrong, [index], KeptInMemory())
        with pytest.raises(DeviceRefused, match="whether the file is there"):
            fetch_files(driver.server, [RemoteFile("/captured/none", 3, False)], KeptInMemory())
        port = driver.server.port
    with pytest.raises(DeviceGone, match="is not there, fell silent"):
        fetch_files(FileServer("127.0.0.1", port, tries=2, pause_s=0.0), [index], KeptInMemory())


def test_files_of_a_running_capture_are_not_fetched() -> None:
    """The error says that the capture still runs. An address without a camera is reported on connecting."""
    with camera() as (driver, _, _):
        folder = driver.capture(1000).folder
        with pytest.raises(RigError, match="a capture still runs"):
            driver.fetch(folder, KeptInMemory())
        driver.stop()
        assert not driver.is_capturing()
    with pytest.raises(DeviceGone, match=r"no connection to 127.0.0.1:1 .*refused.*; is the camera on"):
        SocketTransport("127.0.0.1", 1)


def test_camera_server_closes_its_threads() -> None:
    """The number of threads is the same after the server's end, even with a client that connected."""
    before = threading.active_count()
    with CameraServer(CameraDevice(LinesOf(), ManualClock())) as served:
        line = SocketTransport(served.host, served.port)
    line.close()
    assert threading.active_count() == before
