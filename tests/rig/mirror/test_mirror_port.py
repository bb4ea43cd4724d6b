"""A mirror controller from its settings."""

from __future__ import annotations

from dataclasses import replace

import pytest

from pipeline.errors import RigError
from pipeline.rig.device_errors import DeadlinePassed, DeviceGone
from pipeline.rig.mirror import mirror_controller
from pipeline.rig.mirror.mirror_controller import open_mirror
from pipeline.rig.mirror.mirror_settings import MirrorSettings
from tests.rig.mirror.mirror_bytes import CONNECT, LEAVE
from tests.rig.scripted import ScriptedTransport, scripted


def give(monkeypatch: pytest.MonkeyPatch, transport: ScriptedTransport) -> None:
    """Let the port that the settings name be the transport."""

    def opened(port: str, baud: int, clock: object) -> ScriptedTransport:
        assert (port, baud, clock) == ("/dev/mirror", 256000, transport.clock)
        return transport

    monkeypatch.setattr(mirror_controller, "SerialTransport", opened)


SETTINGS = MirrorSettings(port="/dev/mirror", baud=256000, strict_crc=True)


def test_opening_connects(monkeypatch: pytest.MonkeyPatch):
    """Port and speed are those of the settings, and the controller is greeted."""
    with scripted(CONNECT) as transport:
        give(monkeypatch, transport)
        with open_mirror(SETTINGS, transport.clock) as mirror:
            assert mirror.identity().device == "MR-E-2"
        assert transport.closed


def test_a_port_without_a_controller_is_let_go_of(monkeypatch: pytest.MonkeyPatch):
    """Whoever tries again, or another program, finds the port free."""
    silent = (b"START\r\n", b"")
    with scripted([*[silent] * 3, (LEAVE[0], b""), *[silent] * 3]) as transport:
        give(monkeypatch, transport)
        with pytest.raises(DeadlinePassed):
            open_mirror(SETTINGS, transport.clock)
        assert transport.closed


def test_another_device_is_not_parked(monkeypatch: pytest.MonkeyPatch):
    """Whoever parks at the end parks the mirror that was asked for: another controller is let go of as it was."""
    with scripted(CONNECT) as transport:
        give(monkeypatch, transport)
        with pytest.raises(RigError, match="expected a controller whose id holds 'MR-9'"):
            open_mirror(replace(SETTINGS, expected_id="MR-9", park_at_close=True), transport.clock)
        assert transport.closed


def test_no_port_no_mirror():
    """A port that is not there is said before anything else."""
    with pytest.raises(DeviceGone, match="there is no port /dev/no-such-port"):
        open_mirror(MirrorSettings(port="/dev/no-such-port"))
