"""Files of the camera over FTP: they arrive byte for byte, transfers resume, and every fault is reported."""

from __future__ import annotations

import socket

import numpy as np
import pytest

from spectralzoom.pipeline.errors import RigError
from spectralzoom.pipeline.rig.camera import camera_files
from spectralzoom.pipeline.rig.camera.camera_files import KeptInMemory, RemoteFile, fetch_files, log_in
from spectralzoom.pipeline.rig.camera.headwall_camera import HeadwallCamera
from spectralzoom.pipeline.rig.device_settings import FileServer
from spectralzoom.pipeline.rig.fakes import FakeClock
from spectralzoom.pipeline.rig.transports import DeviceGone, DeviceRefused, SocketTransport
from tests.pipeline.rig.camera.scripted_files import ScriptedFiles, served
from tests.pipeline.rig.scripted import Pair, ScriptedTransport

RAW = bytes(range(256)) * 20
NAME = "/captured/a/raw_0"
FILE = RemoteFile(NAME, len(RAW))


def said(command: str, response: str) -> Pair:
    """Return a command and its reply as the camera writes it."""
    reply = f'{command}\r\n{{"success": true, "response": {response}, "errorMessage": ""}}\r\nhpi> '
    return f"{command}\r".encode(), reply.encode()


def cube(frames: np.ndarray) -> tuple[bytes, bytes]:
    """Return the data and the header of frames (line, sample, band)."""
    lines, samples, bands = frames.shape
    header = f"ENVI\ninterleave = bil\ndata type = 12\nlines = {lines}\nsamples = {samples}\nbands = {bands}\n"
    return frames.transpose(0, 2, 1).astype("<u2").tobytes(), f"{header}byte order = 0\nheader offset = 0\n".encode()


def test_a_capture_is_fetched_from_control_socket_and_files() -> None:
    """Lines, frame times and means of references are those of the files; small files come first.

    The listing doubles slashes, as a camera does.
    """
    rng = np.random.default_rng(1)
    lines, dark = rng.integers(0, 4096, (5, 6, 4)), rng.integers(60, 70, (20, 6, 4))
    index = "Frame#\tTimestamp\n" + "".join(f"{number}\t{10_000 * number}\n" for number in range(5))
    names = ("raw_0", "raw_0.hdr", "darkReference", "darkReference.hdr", "frameIndex_0.txt")
    contents = dict(zip((f"/c/{name}" for name in names), (*cube(lines), *cube(dark), index.encode()), strict=True))
    entries = [
        f'{{"name": "{name.replace("/c/", "/c//")}", "size": {len(data)}, "isDirectory": false}}'
        for name, data in contents.items()
    ]
    pairs = [said("isCapturing", "false"), said('listFiles("/c")', f"[{', '.join(entries)}]")] * 2
    transport = ScriptedTransport(pairs, FakeClock(), b"hpi> ")
    with served(ScriptedFiles(contents)) as server:
        camera = HeadwallCamera(lambda: transport, server, clock=FakeClock())
        steps: list[tuple[str, int, int]] = []
        found = camera.fetch("/c", KeptInMemory(), lambda *step: steps.append(step))
        references = camera.references("/c", KeptInMemory())
    np.testing.assert_array_equal(found.values, lines)
    assert found.times.stamp_us.tolist() == [0, 10_000, 20_000, 30_000, 40_000]
    assert steps[-1] == ("/c/raw_0", len(contents["/c/raw_0"]), len(contents["/c/raw_0"]))
    np.testing.assert_array_equal(references["dark"].mean, dark.mean(axis=0).astype(np.float32))
    transport.check()


def test_files_of_a_running_capture_are_not_fetched() -> None:
    """The error says that the capture still runs."""
    transport = ScriptedTransport([said("isCapturing", "true")], FakeClock(), b"hpi> ")
    with pytest.raises(RigError, match="a capture still runs"):
        HeadwallCamera(lambda: transport, FileServer(), clock=FakeClock()).fetch("/c", KeptInMemory())


def test_an_interrupted_transfer_resumes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Several interruptions lose no byte and repeat only the overlap."""
    monkeypatch.setattr(camera_files, "OVERLAP", 16)
    files = ScriptedFiles({NAME: RAW}, cuts=[1000, 16, 2000, 500], refusals=2)
    kept = KeptInMemory()
    with served(files) as server:
        fetch_files(server, [FILE], kept)
    assert bytes(kept.files[NAME]) == RAW
    assert [line[5:] for line in files.said if line.startswith("REST")] == ["984", "984", "2968", "3452"]


def test_a_broken_transfer_is_continued_by_a_later_call(monkeypatch: pytest.MonkeyPatch) -> None:
    """The message says how many bytes are kept."""
    monkeypatch.setattr(camera_files, "TRIES", 1)
    kept = KeptInMemory()
    with served(ScriptedFiles({NAME: RAW}, cuts=[3000], refusals=0)) as server:
        with pytest.raises(DeviceGone, match=rf"3000 bytes of {NAME} are kept, and a later fetch continues there"):
            fetch_files(server, [FILE], kept)
        fetch_files(server, [FILE], kept)
    assert bytes(kept.files[NAME]) == RAW


def test_a_different_file_of_the_same_name_is_refused() -> None:
    """Bytes of another file are kept as they are and never mixed with new ones. A file that has grown is refused."""
    with served(ScriptedFiles({NAME: RAW})) as server:
        for held in (b"\xff" * 20, b"x" * 10_000):
            kept = KeptInMemory({NAME: bytearray(held)})
            with pytest.raises(RigError, match="are of another file"):
                fetch_files(server, [FILE], kept)
            assert bytes(kept.files[NAME]) == held
        with pytest.raises(RigError, match=r"481 when it was listed; fetch it when the capture has ended"):
            fetch_files(server, [RemoteFile(NAME, 481)], KeptInMemory())


@pytest.mark.parametrize(
    ("size", "kind", "words"),
    [
        (5000, RigError, r"more than its 5000 bytes; fetch it when the capture has ended"),
        (5300, DeviceGone, r"ended at byte 5120 of 5300; look at the file there"),
    ],
)
def test_transfer_of_other_length(size: int, kind: type[RigError], words: str) -> None:
    """A file that is longer or shorter than the server's size is not accepted as complete."""
    files = ScriptedFiles({NAME: RAW}, stated={NAME: size})
    with served(files) as server, pytest.raises(RigError, match=words) as caught:
        fetch_files(server, [RemoteFile(NAME, None)], KeptInMemory())
    assert type(caught.value) is kind


def test_refused_files_are_reported() -> None:
    """A wrong password, a missing file and an absent server have different messages."""
    with served(ScriptedFiles({NAME: RAW})) as server:
        assert log_in(server) == "scripted camera"
        with pytest.raises(DeviceRefused, match="user and password"):
            log_in(FileServer(server.host, server.port, password="x"))
        with pytest.raises(DeviceRefused, match="whether the file is there"):
            fetch_files(server, [RemoteFile("/captured/none", 3)], KeptInMemory())
    with pytest.raises(DeviceGone, match="is not there, fell silent"):
        fetch_files(FileServer("127.0.0.1", server.port), [FILE], KeptInMemory(), clock=FakeClock())


def test_other_servers_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    """A silent server costs the timeout, a port that speaks no FTP is named as such, and so is a missing one."""
    monkeypatch.setattr(camera_files, "STALL_S", 0.1)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        server = FileServer("127.0.0.1", silent.getsockname()[1])
        with pytest.raises(DeviceGone, match=r"fell silent .*timed out"):
            log_in(server)
    with pytest.raises(DeviceGone, match=r"no connection to 127.0.0.1:1 .*refused.*; is the camera on"):
        SocketTransport("127.0.0.1", 1)
