"""Serial ports, and all errors of missing ports."""

from __future__ import annotations

import os
import socket
import sys
import threading
import tty
from collections.abc import Iterator
from io import FileIO
from unittest.mock import Mock

import pytest
import serial
from serial.rfc2217 import PortManager

from spectralzoom.pipeline.errors import SettingsError
from spectralzoom.pipeline.rig.transports import SYSTEM_CLOCK, DeadlinePassed, DeviceGone, SerialTransport, check_port

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="pseudo terminals are of POSIX systems")


@pytest.fixture
def ends() -> Iterator[tuple[FileIO, str]]:
    """Yield the device's end of a pseudo terminal, and the name of the driver's end."""
    device, driver = os.openpty()
    tty.setraw(driver)
    with FileIO(device, "r+") as end:
        yield end, os.ttyname(driver)
    os.close(driver)


def soon() -> float:
    """Return a deadline that a working line never reaches."""
    return SYSTEM_CLOCK.now() + 5.0


def test_bytes_pass_both_ways(ends: tuple[FileIO, str]):
    """All 256 byte values pass."""
    device, name = ends
    line = SerialTransport(name)
    line.write(bytes(range(256)))
    assert device.read(1000) == bytes(range(256))
    device.write(bytes(range(256)))
    got = b""
    while len(got) < 256:
        got += line.read(100, soon())
    assert got == bytes(range(256))
    line.close()


def test_reading_ends_at_the_deadline(ends: tuple[FileIO, str]):
    """Without data nothing is returned. With a deadline in the past, only data that are there."""
    line = SerialTransport(ends[1])
    assert line.read(10, SYSTEM_CLOCK.now() + 0.03) == b""
    assert line.read(10, SYSTEM_CLOCK.now() - 1) == b""
    ends[0].write(b"stale")
    assert line.read(1, soon()) == b"s"
    assert line.read(100, SYSTEM_CLOCK.now() - 1) == b"tale"
    assert line.read(100, SYSTEM_CLOCK.now() - 1) == b""
    line.close()


def test_a_port_in_use_is_refused(ends: tuple[FileIO, str]):
    """Two programs would mix their motions. After the first one closes the port, the second can open it."""
    first = SerialTransport(ends[1])
    with pytest.raises(DeviceGone, match=r"cannot be opened .*no other program at it"):
        SerialTransport(ends[1])
    first.close()
    SerialTransport(ends[1]).close()


def test_a_disconnected_device_is_reported(ends: tuple[FileIO, str]):
    """After the cable is pulled, reading and writing raise an error with a remedy."""
    line = SerialTransport(ends[1])
    ends[0].close()
    for call in (lambda: line.read(1, soon()), lambda: line.write(b"x")):
        with pytest.raises(DeviceGone, match=r"went away .*cable.*run again"):
            call()
    line.close()


def test_a_blocked_write_ends_at_its_time_limit(ends: tuple[FileIO, str]):
    """A device that takes no bytes costs 0.25 s."""
    line = SerialTransport(ends[1])
    with pytest.raises(DeadlinePassed, match=r"did not take 1000000 bytes within 0.25 s"):
        line.write(bytes(1_000_000))
    line.close()


PORTS = (
    *("/dev/ttyACM0", "/dev/serial/by-path/pci-0000:00:14.0-usb-0:1:1.0-port0", "/dev/cu.usbmodem1", "COM3", "COM104"),
    *("socket://10.0.65.50:4001", "socket://[::1]:1", "rfc2217://ser2net.lan:2217?ign_set_control"),
)
NO_PORTS = (
    *("", "none", "ttyACM0", "mirror/x", "/etc/passwd", "/dev/../etc/passwd", "/dev//x", "/dev/a b", "/dev/spy://x"),
    *("COM3\n", "file:///etc/passwd", "spy:///dev/ttyACM0?file=/tmp/x", "alt://COM3?class=os.system", "loop://"),
    *("hwgrep://usb", "cp2110://0001:004a:00", "socket://evil", "socket://evil:1?logging=debug", "socket://a@evil:1"),
)


@pytest.mark.parametrize("port", PORTS)
def test_devices_and_two_addresses_are_ports(port: str):
    """Names of devices on all systems, and serial ports behind a network."""
    check_port(port)


@pytest.mark.parametrize("port", NO_PORTS)
def test_other_addresses_are_refused_before_they_are_opened(port: str, monkeypatch: pytest.MonkeyPatch):
    """Some addresses of pyserial write files or import classes. One message names the value and what is allowed."""
    opened = Mock()
    monkeypatch.setattr("serial.serial_for_url", opened)
    with pytest.raises(SettingsError, match=r"^rig.port = .* is no port; give a device such as /dev/ttyACM0 or COM3, "):
        SerialTransport(port)
    assert not opened.called


def test_a_missing_port_lists_the_existing_ones(monkeypatch: pytest.MonkeyPatch):
    """The message has the ports of this machine."""

    class Port:
        """An entry of pyserial's list of ports."""

        device = "/dev/ttyUSB3"

    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: [Port()])
    with pytest.raises(DeviceGone, match=r"/dev/no-such-port cannot be opened .* ports of this machine: /dev/ttyUSB3;"):
        SerialTransport("/dev/no-such-port")


def serve_echo(peer: socket.socket, options: bool) -> None:
    """Return what is sent until the peer closes; with ``options`` as a server of RFC 2217, which answers options."""

    class Back:
        """The connection of the options' manager."""

        def write(self, data: bytes) -> None:
            peer.sendall(data)

    with serial.serial_for_url("loop://", timeout=0) as device, peer:
        manager = PortManager(device, Back()) if options else None
        while data := peer.recv(100):
            device.write(data if manager is None else b"".join(manager.filter(data)))
            found = device.read(100)
            if found:
                peer.sendall(found if manager is None else b"".join(manager.escape(found)))


@pytest.mark.filterwarnings("ignore:set(Daemon|Name):DeprecationWarning")  # of pyserial 3.5
@pytest.mark.parametrize("kind", ["socket", "rfc2217"])
def test_a_port_behind_a_network_is_a_port(kind: str):
    """The same driver reaches a device over a server of serial ports."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        thread = threading.Thread(target=lambda: serve_echo(server.accept()[0], kind == "rfc2217"), daemon=True)
        thread.start()
        line = SerialTransport(f"{kind}://127.0.0.1:{server.getsockname()[1]}")
        sent = b"START\r\n\xff\x7e"
        line.write(sent)
        got = b""
        while len(got) < len(sent):
            got += line.read(100, soon())
        assert got == sent
        line.close()
        thread.join(5)
