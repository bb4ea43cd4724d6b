"""Connections to the emulated controller: a line in this process, and a pty that acts as a real port."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import Mock

import pytest
import serial

from pipeline.errors import RigError
from pipeline.rig.device_settings import SurveyRig
from pipeline.rig.emulator.emulated_rig import EmulatedPort
from pipeline.rig.emulator.mirror_device import MirrorDevice
from pipeline.rig.mirror_controller import open_mirror
from pipeline.rig.transports import SYSTEM_CLOCK, DeviceGone
from tests.pipeline.rig.mirror_faults import FaultyMirror, make_fault

ASKED = bytes.fromhex("7e 00 11 02 68 0a 0b 3b 7e")
REPLIED = bytes.fromhex("7e 00 11 04 00 00 00 00 f2 81 7e")


@contextmanager
def opened(*faults: str, baud: int = 0) -> Iterator[tuple[EmulatedPort, serial.Serial]]:
    """Yield an emulated port with faults that strike at once, and a client of it."""
    device = FaultyMirror(SYSTEM_CLOCK, [make_fault(name, at=0) for name in faults])
    with (
        EmulatedPort(device, baud=baud) as port,
        serial.Serial(port.path, 115200, timeout=2.0, write_timeout=0.5, exclusive=True) as user,
    ):
        yield port, user


def descriptors() -> int:
    """Return the number of open files of this process."""
    return len(list(Path("/proc/self/fd").iterdir()))


def test_both_modes_work_through_the_pty() -> None:
    """The pty changes no byte, neither line ends nor 03 or 1A."""
    with opened() as (_, user):
        user.write(b"START\r\n")
        assert user.read_until(b"\n") == b"OK\r\n"
        user.write(b"GOPROCRC\r\n" + ASKED)
        assert user.read(4 + len(REPLIED)) == b"OK\r\n" + REPLIED
        user.write(bytes.fromhex("7e 00 03 1a 11 13 0a 0d 7e") + ASKED)
        assert user.read_until(REPLIED).endswith(REPLIED)


def test_a_closed_port_leaves_no_threads_or_files() -> None:
    """After closing, even twice, the numbers of threads and open files are the initial ones."""
    before = (threading.active_count(), descriptors())
    for _ in range(3):
        port = EmulatedPort(MirrorDevice(SYSTEM_CLOCK))
        port.close()
        port.close()
    assert (threading.active_count(), descriptors()) == before


def test_bytes_take_the_time_of_the_baud_rate() -> None:
    """At 2400 baud 7 bytes sent and 4 received take at least 11 times 10 bits."""
    with opened(baud=2400) as (_, user):
        began = SYSTEM_CLOCK.now()
        user.write(b"START\r\n")
        assert user.read_until(b"\n") == b"OK\r\n"
        assert SYSTEM_CLOCK.now() - began >= 110 / 2400


def test_the_driver_works_through_a_pty() -> None:
    """The driver connects, moves, loads and disconnects. A device that disappears is reported as such."""
    device = MirrorDevice(SYSTEM_CLOCK)
    with EmulatedPort(device) as port, open_mirror(SurveyRig(port=port.path)) as mirror:
        assert mirror.identity.device == "MR-E-2"
        mirror.goto(0.1, -0.2)
        mirror.settle(2.0)
        assert device.positions(SYSTEM_CLOCK.now()) == pytest.approx((0.1, -0.2), abs=1e-3)
        mirror.load_path([(0.0, 0.0), (0.1, 0.1)])
    device = FaultyMirror(SYSTEM_CLOCK, [make_fault("gone-before", at=5)])
    with EmulatedPort(device) as port, pytest.raises(DeviceGone, match=f"{port.path} went away"):
        open_mirror(SurveyRig(port=port.path)).goto(0.0, 0.0)


def test_a_missing_pty_has_a_clear_message(monkeypatch: pytest.MonkeyPatch) -> None:
    """The message quotes the error of a system without free ptys."""
    monkeypatch.setattr(os, "openpty", Mock(side_effect=OSError("out of pty devices")))
    with pytest.raises(RigError, match="no pty for the emulated port: out of pty devices"):
        EmulatedPort(MirrorDevice(SYSTEM_CLOCK))
