"""The emulated mirror controller, byte for byte; the bytes were worked out by hand and by a CRC of their own."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.rig.emulator.mirror_device import MirrorDevice, Mode
from pipeline.rig.emulator.mirror_state import MirrorUnit
from pipeline.rig.mirror.mirror_controller import hold_values
from pipeline.rig.mirror.pro_mode import Status, encode, set_values
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
    "temperature": (b"GETTEMP\r\n", b"25.00\r\n"),
    "unknown": (b"HELLO\r\n", b"NO\r\n"),
    "too long": (b"X=0." + b"0" * 60 + b"\r\n", b"ERROR\r\n"),
    "pro": (b"GOPRO\r\n", b"OK\r\n"),
    "pro with CRC": (GO_PRO_CRC, b"OK\r\n"),
}

PRO = {
    "firmware id": ("7e 00 01 02 00 00 a0 3c 7e", "7e 00 01 04 00 01 00 00 a1 d1 7e"),
    "status": ("7e 00 02 02 00 00 a0 78 7e", "7e 00 02 04 00 00 00 00 f0 22 7e"),
    "simple mode": ("7e 00 06 02 00 00 a1 48 7e", "7e 00 06 00 03 a0 7e"),
    "get value": ("7e 00 11 02 50 01 59 3c 7e", "7e 00 11 04 00 00 00 00 f2 81 7e"),  # the documented pair
    "get feedback": ("7e 00 11 02 23 02 3c 0d 7e", "7e 00 11 04 00 00 00 00 f2 81 7e"),
    "get cycles": ("7e 00 11 02 68 07 ca fe 7e", "7e 00 11 04 ff ff ff ff f3 15 7e"),
    "get index": ("7e 00 11 02 68 0a 0b 3b 7e", "7e 00 11 04 00 00 00 00 f2 81 7e"),
    "set value": ("7e 00 10 06 50 02 3f 00 00 00 1e 88 7e", "7e 00 10 00 0d c0 7e"),
    "escapes": ("7e 00 10 06 50 02 3e 7d 5e 7d 5d 00 5e 3c 7e", "7e 00 10 00 0d c0 7e"),
    "set cycles": ("7e 00 10 06 68 07 ff ff ff ff db b0 7e", "7e 00 10 00 0d c0 7e"),
    "set two": ("7e 00 12 0e 00 02 50 02 51 02 3e 80 00 00 bf 00 00 00 a3 f3 7e", "7e 00 12 00 0c a0 7e"),
    "set eight": (
        "7e 00 12 32 00 08 68 00 68 02 68 03 68 04 68 07 68 08 40 00 40 02 00 00 00 02 00 00 00 00 00 00 00 03 42 c8 "
        "00 00 00 00 00 01 00 00 00 00 00 00 00 68 00 00 00 c0 07 06 7e",
        "7e 00 12 00 0c a0 7e",
    ),
    "get eight": (
        "7e 00 13 12 00 08 68 00 68 01 68 02 68 03 68 04 68 05 68 06 68 08 50 5c 7e",
        "7e 00 13 22 00 08 00 00 00 01 00 00 00 00 00 00 00 00 00 00 00 00 46 1c 40 00 00 00 00 00 46 1c 40 00 00 00 "
        "00 00 a1 7d 5d 7e",
    ),
    "set vector": ("7e 00 14 0d 26 00 00 0c 08 3f 00 00 00 bf 80 00 00 ae f3 7e", "7e 00 14 00 0f 00 7e"),
    "cells that are cut": ("7e 00 15 05 26 00 00 02 04 4d f0 7e", "7e 00 95 04 00 00 01 08 ec 93 7e"),
    "choose a logged register": ("7e 00 10 06 24 00 00 00 23 02 f9 19 7e", "7e 00 10 00 0d c0 7e"),
    "log rate": ("7e 00 10 06 24 11 44 7a 00 00 a8 c2 7e", "7e 00 10 00 0d c0 7e"),
    "run the log": ("7e 00 10 06 24 10 00 00 00 01 61 eb 7e", "7e 00 10 00 0d c0 7e"),
    "log not run": ("7e 00 15 05 24 00 00 00 08 35 55 7e", "7e 00 95 04 00 00 01 07 ac 97 7e"),
    "other mode": ("7e 00 06 02 00 01 60 88 7e", "7e 00 86 04 00 00 01 03 af f7 7e"),
    "no register": ("7e 00 11 02 99 99 0e c6 7e", "7e 00 91 04 00 00 01 01 2d 11 7e"),
    "out of range": ("7e 00 10 06 50 02 40 00 00 00 07 5c 7e", "7e 00 90 04 00 00 01 03 ad 01 7e"),
    "read only": ("7e 00 10 06 23 02 00 00 00 00 19 9f 7e", "7e 00 90 04 00 00 01 06 6d 02 7e"),
    "read beyond the vector": ("7e 00 15 05 26 00 2e e0 04 65 59 7e", "7e 00 95 04 00 00 01 07 ac 97 7e"),
    "write beyond the vector": (
        "7e 00 14 0d 26 00 2e dc 08 00 00 00 00 00 00 00 00 52 1a 7e",
        "7e 00 94 04 00 00 01 07 ad 46 7e",
    ),
    "a run of nothing": ("7e 00 10 06 68 01 00 00 00 01 93 e4 7e", "7e 00 90 04 00 00 01 07 ac c2 7e"),
    "length": ("7e 00 11 01 50 51 a9 7e", "7e 00 91 04 00 00 00 03 ad 40 7e"),
    "length of a vector": ("7e 00 14 09 26 00 00 00 08 00 00 00 00 c2 7f 7e", "7e 00 94 04 00 00 00 03 ad 15 7e"),
    "unknown command": ("7e 00 33 00 14 f0 7e", "7e 00 b3 04 00 00 00 02 6a 02 7e"),
    "CRC": ("7e 00 02 02 00 00 00 00 7e", "7e 00 82 04 00 00 00 04 ee 21 7e"),
    "no frame": ("7e 00 11 05 50 7e", "7e 00 91 04 00 00 00 01 2c 81 7e"),
    "a system that is no input": ("7e 00 10 06 40 00 00 00 00 99 a9 a6 7e", "7e 00 90 04 00 00 02 02 6c 31 7e"),
}
STORY = "set vector", "get value", "set two", "get eight", "no frame", "escapes", "unknown command", "simple mode"


def answer(device: MirrorDevice, data: bytes) -> bytes:
    """All that comes back to some bytes."""
    return b"".join(chunk for _, chunk in device.receive(data))


def pro_device(line: bytes = GO_PRO_CRC) -> MirrorDevice:
    """A controller in pro mode."""
    device = MirrorDevice(ManualClock())
    assert answer(device, line) == b"OK\r\n"
    return device


@pytest.mark.parametrize("name", SIMPLE)
def test_every_line_of_simple_mode_has_its_answer(name: str) -> None:
    """Each request of simple mode is answered by exactly these bytes."""
    sent, expected = SIMPLE[name]
    assert answer(MirrorDevice(ManualClock()), sent) == expected


@pytest.mark.parametrize("name", PRO)
def test_every_frame_of_pro_mode_has_its_answer(name: str) -> None:
    """Each request of pro mode is answered by exactly these bytes."""
    sent, expected = map(bytes.fromhex, PRO[name])
    assert answer(pro_device(), sent).hex(" ") == expected.hex(" ")


def test_what_is_set_can_be_read() -> None:
    """Cells that a frame sets come back in those that read them, from registers and from the vector memory."""
    device = pro_device()
    pairs = (
        ("7e 00 12 0e 00 02 50 02 51 02 3e 80 00 00 bf 00 00 00 a3 f3 7e", "7e 00 12 00 0c a0 7e"),
        ("7e 00 13 06 00 02 50 02 51 02 52 48 7e", "7e 00 13 0a 00 02 3e 80 00 00 bf 00 00 00 db c7 7e"),
        ("7e 00 10 06 50 02 3e 7d 5e 7d 5d 00 5e 3c 7e", "7e 00 10 00 0d c0 7e"),
        ("7e 00 11 02 50 02 19 3d 7e", "7e 00 11 04 3e 7d 5e 7d 5d 00 be 21 7e"),
        ("7e 00 14 0d 26 00 00 0c 08 3f 00 00 00 bf 80 00 00 ae f3 7e", "7e 00 14 00 0f 00 7e"),
        ("7e 00 15 05 26 00 00 0c 08 49 95 7e", "7e 00 15 08 3f 00 00 00 bf 80 00 00 11 2d 7e"),
        ("7e 00 10 06 24 10 00 00 00 01 61 eb 7e", "7e 00 10 00 0d c0 7e"),
    )
    for sent, expected in pairs:
        assert answer(device, bytes.fromhex(sent)).hex(" ") == expected


def test_each_mode_knows_its_own_requests_alone() -> None:
    """A line has no answer in pro mode, but is answered again after mode 0, in the same write; CRCs pass by mode."""
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


def test_a_reset_forgets_everything() -> None:
    """After a reset the controller is deaf for a while, then in simple mode, at rest in the middle, memory empty."""
    clock = ManualClock()
    device = MirrorDevice(clock)
    answer(device, GO_PRO_CRC + bytes.fromhex(PRO["set two"][0] + PRO["set vector"][0]))
    clock.advance(1.0)
    assert np.any(device.state.memory)
    assert np.any(device.positions(clock.now()))
    device.restart(boot_s=1.0)
    clock.advance(0.99)
    assert answer(device, b"START\r\n") == b""
    clock.advance(0.02)
    assert answer(device, b"START\r\n") == b"OK\r\n"
    assert not np.any(device.state.memory)
    np.testing.assert_array_equal(device.positions(clock.now()), (0, 0))


def test_a_target_beyond_the_rim_goes_to_the_rim_and_is_told() -> None:
    """The mirror goes to the nearest point of the rim, and the bit stands as long as the target does."""
    clock = ManualClock()
    device = MirrorDevice(clock)
    answer(device, GO_PRO_CRC)
    for target, place, bits in (((1.0, 1.0), (np.sqrt(0.5), np.sqrt(0.5)), Status.TRIMMED), ((0, 0), (0, 0), 0)):
        answer(device, encode(set_values(hold_values(*target))))
        clock.advance(1.0)
        np.testing.assert_allclose(device.positions(clock.now()), place, atol=1e-7)
        assert device.state.status() == Status(bits)


@given(cuts=st.lists(st.integers(0, 400), max_size=40))
@settings(deadline=None, max_examples=60)
def test_any_cutting_of_the_bytes_gives_the_same_answers(cuts: list[int]) -> None:
    """However a stream of lines and frames is cut, the bytes that come back are the same."""
    frames = b"".join(bytes.fromhex(PRO[name][0]) for name in STORY)
    stream = b"start\r\nGETID\r\n" + GO_PRO_CRC + frames + b"START\r\nNONSENSE\r\n"
    whole = answer(MirrorDevice(ManualClock()), stream)
    device = MirrorDevice(ManualClock())
    edges = sorted({0, len(stream), *(cut for cut in cuts if cut < len(stream))})
    assert b"".join(answer(device, stream[a:b]) for a, b in pairwise(edges)) == whole


@given(junk=st.binary(max_size=200))
@settings(deadline=None, max_examples=100)
def test_no_bytes_confuse_the_controller_for_long(junk: bytes) -> None:
    """After any bytes that change no mode, in either mode, it answers the next request rightly."""
    device = MirrorDevice(ManualClock())
    answer(device, junk.upper().replace(b"GOPRO", b"") + b"\r\n")
    if device.mode is Mode.SIMPLE:
        device.clock.sleep(2.0)
        assert answer(device, b"\r\nGETID\r\n").endswith(b"MR-E-2\r\n")
    device = pro_device()
    answer(device, junk + b"\x7e")
    request, reply = map(bytes.fromhex, PRO["firmware id"])
    if device.mode is not Mode.SIMPLE:
        assert answer(device, request).endswith(reply)


def test_the_acts_tell_what_was_done_by_which_unit() -> None:
    """What was carried out is kept with its time; texts and the size of the memory are settings."""
    device = MirrorDevice(ManualClock(5.0), unit=MirrorUnit(model="MR-E-3", vector_pairs=2))
    assert answer(device, b"GETID\r\nSTART\r\n") == b"MR-E-3\r\nOK\r\n"
    assert [(act.time_s, act.request.line) for act in device.acts] == [(5.0, "GETID"), (5.0, "START")]
    assert device.state.memory.size == 4
