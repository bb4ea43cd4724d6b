"""The emulated mirror controller, byte for byte. The bytes were worked out by hand, with an independent CRC."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.rig.emulator.mirror_device import MirrorDevice, Mode
from tests.pipeline.rig.in_process import ManualClock

GO_PRO_CRC = b"GOPROCRC\r\n"

SIMPLE = {
    "start": (b"START\r\n", b"OK\r\n"),
    "in any case": (b"start\r\n", b"OK\r\n"),
    "without CR": (b"START\n", b"OK\r\n"),
    "empty": (b"\r\n\r\n", b""),
    "id": (b"GETID\r\n", b"MR-E-2\r\n"),
    "version": (b"GETVERSION\r\n", b"EMULATOR 1.0\r\n"),
    "serial": (b"GETSN\r\n", b"EMUL0001\r\n"),
    "unknown": (b"HELLO\r\n", b"NO\r\n"),
    "too long": (b"X=0." + b"0" * 60 + b"\r\n", b"ERROR\r\n"),
    "pro": (b"GOPRO\r\n", b"OK\r\n"),
    "pro with CRC": (GO_PRO_CRC, b"OK\r\n"),
}

PRO = {
    "status": ("7e 00 02 02 00 00 a0 78 7e", "7e 00 02 04 00 00 00 00 f0 22 7e"),
    "simple mode": ("7e 00 06 02 00 00 a1 48 7e", "7e 00 06 00 03 a0 7e"),
    "get index": ("7e 00 11 02 68 0a 0b 3b 7e", "7e 00 11 04 00 00 00 00 f2 81 7e"),  # the documented reply
    "set two": ("7e 00 12 0e 00 02 50 02 51 02 3e 80 00 00 bf 00 00 00 a3 f3 7e", "7e 00 12 00 0c a0 7e"),
    "escapes": ("7e 00 12 08 00 01 50 02 3e 7d 5d 7d 5e 00 1e 9f 7e", "7e 00 12 00 0c a0 7e"),
    "set vector": ("7e 00 14 0d 26 00 00 0c 08 3f 00 00 00 bf 80 00 00 ae f3 7e", "7e 00 14 00 0f 00 7e"),
    "log not run": ("7e 00 15 05 24 00 00 00 08 35 55 7e", "7e 00 95 04 00 00 01 07 ac 97 7e"),
    "other mode": ("7e 00 06 02 00 01 60 88 7e", "7e 00 86 04 00 00 01 03 af f7 7e"),
    "no register": ("7e 00 11 02 99 99 0e c6 7e", "7e 00 91 04 00 00 01 01 2d 11 7e"),
    "read beyond": ("7e 00 15 05 26 00 2e e0 04 65 59 7e", "7e 00 95 04 00 00 01 07 ac 97 7e"),
    "write beyond": ("7e 00 14 0d 26 00 2e dc 08 00 00 00 00 00 00 00 00 52 1a 7e", "7e 00 94 04 00 00 01 07 ad 46 7e"),
    "out of range": ("7e 00 12 08 00 01 50 02 40 00 00 00 b7 0f 7e", "7e 00 92 04 00 00 01 03 ac e3 7e"),
    "a run of nothing": ("7e 00 12 08 00 01 68 01 00 00 00 01 23 b7 7e", "7e 00 92 04 00 00 01 07 ad 20 7e"),
    "a system that is no input": ("7e 00 12 08 00 01 40 00 00 00 00 99 19 f5 7e", "7e 00 92 04 00 00 02 02 6d d3 7e"),
    "length of a vector": ("7e 00 14 09 26 00 00 00 08 00 00 00 00 c2 7f 7e", "7e 00 94 04 00 00 00 03 ad 15 7e"),
    "unknown command": ("7e 00 33 00 14 f0 7e", "7e 00 b3 04 00 00 00 02 6a 02 7e"),
    "CRC": ("7e 00 02 02 00 00 00 00 7e", "7e 00 82 04 00 00 00 04 ee 21 7e"),
    "no frame": ("7e 00 11 05 50 7e", "7e 00 91 04 00 00 00 01 2c 81 7e"),
}


def answer(device: MirrorDevice, data: bytes) -> bytes:
    """Return all bytes that answer some bytes."""
    return b"".join(chunk for _, chunk in device.receive(data))


def pro_device(line: bytes = GO_PRO_CRC) -> MirrorDevice:
    """Return a controller in pro mode."""
    device = MirrorDevice(ManualClock())
    assert answer(device, line) == b"OK\r\n"
    return device


@pytest.mark.parametrize("name", SIMPLE)
def test_every_line_of_simple_mode_has_its_reply(name: str) -> None:
    """The reply to each request of simple mode has exactly these bytes."""
    sent, expected = SIMPLE[name]
    assert answer(MirrorDevice(ManualClock()), sent) == expected


@pytest.mark.parametrize("name", PRO)
def test_every_frame_of_pro_mode_has_its_reply(name: str) -> None:
    """The reply to each request of pro mode has exactly these bytes."""
    sent, expected = map(bytes.fromhex, PRO[name])
    assert answer(pro_device(), sent).hex(" ") == expected.hex(" ")


def test_cells_that_are_set_can_be_read() -> None:
    """Frames read the cells that other frames set, in registers and in the vector memory."""
    device = pro_device()
    pairs = (
        ("7e 00 12 0e 00 02 50 02 51 02 3e 80 00 00 bf 00 00 00 a3 f3 7e", "7e 00 12 00 0c a0 7e"),
        ("7e 00 11 02 50 02 19 3d 7e", "7e 00 11 04 3e 80 00 00 fe 81 7e"),
        ("7e 00 14 0d 26 00 00 0c 08 3f 00 00 00 bf 80 00 00 ae f3 7e", "7e 00 14 00 0f 00 7e"),
        ("7e 00 15 05 26 00 00 0c 08 49 95 7e", "7e 00 15 08 3f 00 00 00 bf 80 00 00 11 2d 7e"),
    )
    for sent, expected in pairs:
        assert answer(device, bytes.fromhex(sent)).hex(" ") == expected


def test_each_mode_answers_only_its_own_requests() -> None:
    """Pro mode answers no line, but simple mode does after a change in the same write. CRCs depend on the mode."""
    device = pro_device()
    assert answer(device, b"START\r\n") == b""
    request, reply = map(bytes.fromhex, PRO["status"])
    assert answer(device, request).endswith(reply)
    back, done = map(bytes.fromhex, PRO["simple mode"])
    assert answer(device, back + b"START\r\n") == done + b"OK\r\n"
    assert device.mode is Mode.SIMPLE
    without = bytes.fromhex("7e 00 02 02 00 00 00 00 7e")
    assert answer(pro_device(b"GOPRO\r\n"), without) == reply
    assert answer(pro_device(), without) == bytes.fromhex("7e 00 82 04 00 00 00 04 ee 21 7e")


def test_a_reset_clears_everything() -> None:
    """After a reset the controller is in simple mode, at rest in the centre, with an empty memory."""
    device = pro_device()
    answer(device, bytes.fromhex(PRO["set two"][0] + PRO["set vector"][0]))
    assert np.any(device.state.memory)
    assert np.any(device.positions(device.clock.now()))
    device.restart()
    assert answer(device, b"START\r\n") == b"OK\r\n"
    assert not np.any(device.state.memory)
    np.testing.assert_array_equal(device.positions(device.clock.now()), (0, 0))
