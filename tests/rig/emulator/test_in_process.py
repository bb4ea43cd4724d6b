"""The line straight to an emulated controller: order, pace, deadlines and ends."""

from __future__ import annotations

import pytest

from pipeline.rig.device_settings import MirrorSettings
from pipeline.rig.devices import DeadlinePassed, DeviceGone, ManualClock
from pipeline.rig.emulator.fault_names import make_fault
from pipeline.rig.emulator.mirror_device import MirrorDevice
from pipeline.rig.emulator.mirror_ports import InProcessTransport
from pipeline.rig.mirror.mirror_controller import MirrorController
from pipeline.rig.mirror.pro_mode import Frame, encode
from pipeline.rig.mirror.transactions import BITS_PER_BYTE


def line(*faults: str, baud: int = 0) -> InProcessTransport:
    """A line to a controller with faults that strike at once."""
    clock = ManualClock()
    return InProcessTransport(MirrorDevice(clock, [make_fault(name, at=0) for name in faults]), clock, baud=baud)


def test_bytes_come_in_order_and_no_more_than_asked_for() -> None:
    """Reads give what is there, in parts if fewer are asked for."""
    transport = line()
    transport.write(b"START\r\nGETID\r\n", 1.0)
    assert transport.drain() == b""
    assert [transport.read(5, 1.0), transport.read(3, 1.0), transport.read(99, 1.0)] == [b"OK\r\nM", b"R-E", b"-2\r\n"]
    assert transport.clock.now() < 0.01
    assert transport.sent == [b"START\r\nGETID\r\n"]


def test_a_read_waits_until_its_deadline_and_no_longer() -> None:
    """Where nothing comes, the clock stands at the deadline."""
    transport = line()
    assert transport.read(10, 2.5) == b""
    assert transport.clock.now() == 2.5


def test_bytes_take_their_time_on_the_line() -> None:
    """At 9600 baud 7 bytes there and 4 back take 11 times 10 bits, besides the controller's own time."""
    transport = line(baud=9600)
    transport.write(b"START\r\n", 1.0)
    assert transport.read(10, 1.0) == b"OK\r\n"
    assert transport.clock.now() == pytest.approx(110 / 9600 + 2e-4)


@pytest.mark.parametrize("name", ["gone-before", "gone-within"])
def test_a_device_that_goes_is_gone(name: str) -> None:
    """Whether it is gone at once or when it is read from, and for good."""
    transport = line(name)

    def ask() -> None:
        transport.write(b"START\r\n", 1.0)
        transport.read(10, 1.0)

    for _ in range(2):
        with pytest.raises(DeviceGone, match="went away; look at the cable"):
            ask()
    assert not transport.device.acts


def test_a_device_that_went_after_a_request_has_done_it() -> None:
    """The request is carried out, and its reply never comes."""
    transport = line("gone-after")
    transport.write(b"X=0.5\r\n", 1.0)
    assert len(transport.device.acts) == 1
    with pytest.raises(DeviceGone):
        transport.read(10, 1.0)


def test_a_port_that_hangs_takes_nothing_until_the_deadline() -> None:
    """The first bytes go nowhere, then writing blocks until its deadline."""
    transport = line("hangs")
    transport.write(b"START\r\n", 1.0)
    assert transport.read(10, 1.0) == b""
    with pytest.raises(DeadlinePassed, match="did not take 7 bytes"):
        transport.write(b"START\r\n", 3.0)
    assert transport.clock.now() == 3.0


def test_what_was_left_in_the_port_is_there_when_it_is_opened() -> None:
    """Stale bytes can be drained before anything was sent."""
    transport = line("stale-bytes")
    transport.clock.sleep(0.1)
    assert transport.drain()


def test_a_closed_line_is_closed() -> None:
    """Nothing can be sent or read any more."""
    transport = line()
    transport.close()
    with pytest.raises(DeviceGone, match="is closed"):
        transport.write(b"START\r\n", 1.0)
    with pytest.raises(DeviceGone, match="is closed"):
        transport.read(1, 1.0)


@pytest.mark.parametrize("baud", [115200, 256000])
def test_an_upload_takes_little_more_than_the_line_needs(baud: int) -> None:
    """1500 positions go up in at most 1.2 times the time of their bytes, progress told from first to last."""
    transport = line(baud=baud)
    driver = MirrorController(transport, MirrorSettings(baud=baud), transport.clock)
    driver.connect()
    began, told, before = transport.clock.now(), [], len(transport.sent)
    driver.load_path([(0.1, 0.2)] * 1500, "none", lambda done, total: told.append((done, total)))
    wire_s = (sum(map(len, transport.sent[before:])) + 300 * len(encode(Frame(0x14)))) * BITS_PER_BYTE / baud
    assert transport.clock.now() - began <= 1.2 * wire_s
    assert told[-1] == (3000, 3000)
    assert len(told) == 300
