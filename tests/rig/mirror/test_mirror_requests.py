"""Requests in both modes as (sent, received) bytes, and what is accepted as an answer."""

from __future__ import annotations

import logging

import pytest

from pipeline.errors import RigError
from pipeline.rig.device_errors import DeadlinePassed, DeviceRefused, StateUnknown
from pipeline.rig.mirror.mirror_requests import ProLink, SimpleLink
from pipeline.rig.mirror.mirror_settings import Patience
from pipeline.rig.mirror.pro_payloads import (
    ask_firmware,
    ask_status,
    cell_float,
    cell_int,
    get_value,
    get_values,
    get_vector,
    go_simple,
    read_values,
    set_value,
    set_values,
    set_vector,
)
from pipeline.rig.mirror.registers import Status
from pipeline.rig.mirror.simple_mode import go_x, go_xy, go_y
from pipeline.rig.mirror.transactions import Wire
from tests.rig.scripted import Pair, ScriptedTransport, scripted

ASK = bytes.fromhex("7E 00 11 02 68 0A 0B 3B 7E")
REPLY = bytes.fromhex("7E 00 11 04 00 00 01 2C F2 CC 7E")
WRONG_CRC = bytes.fromhex("7E 00 11 04 00 00 01 2C F2 CD 7E")
OTHER = bytes.fromhex("7E 00 13 0A 00 02 3F 00 00 00 BE 80 00 00 9B D7 7E")
HALF, MINUS_QUARTER = bytes.fromhex("3F 00 00 00"), bytes.fromhex("BE 80 00 00")


def wire(transport: ScriptedTransport) -> Wire:
    """A wire that waits a second, asks twice again, and takes 0.1 s for silence."""
    return Wire(transport, transport.clock, Patience(1.0, 2, 0.1))


def pro(transport: ScriptedTransport, **settings: bool) -> ProLink:
    """Pro mode over the transport; CRCs in the script have to fit."""
    return ProLink(wire(transport), **{"strict_crc": True, **settings})


PRO_READS = [
    (ask_firmware(), bytes, "7E 00 01 02 00 00 A0 3C 7E", "7E 00 01 04 4D 52 45 32 F5 E9 7E", b"MRE2"),
    (ask_status(), cell_int, "7E 00 02 02 00 00 A0 78 7E", "7E 00 02 04 00 00 00 11 30 2E 7E", 0x11),
    (get_value(0x680A), cell_int, "7E 00 11 02 68 0A 0B 3B 7E", "7E 00 11 04 00 00 01 2C F2 CC 7E", 300),
    (get_value(0x2302), cell_float, "7E 00 11 02 23 02 3C 0D 7E", "7E 00 11 04 00 00 00 00 F2 81 7E", 0.0),
    (
        get_values([0x2302, 0x2303]),
        read_values,
        "7E 00 13 06 00 02 23 02 23 03 AD AC 7E",
        "7E 00 13 0A 00 02 3F 00 00 00 BE 80 00 00 9B D7 7E",
        [HALF, MINUS_QUARTER],
    ),
    (
        get_vector(0x2600, 10, 2),
        bytes,
        "7E 00 15 05 26 00 00 28 08 52 95 7E",
        "7E 00 15 08 3F 00 00 00 BE 80 00 00 10 D1 7E",
        HALF + MINUS_QUARTER,
    ),
]
PRO_WRITES = [
    (go_simple(), "7E 00 06 02 00 00 A1 48 7E", "7E 00 06 00 03 A0 7E"),
    (set_value(0x5002, 0.5), "7E 00 10 06 50 02 3F 00 00 00 1E 88 7E", "7E 00 10 00 0D C0 7E"),
    (
        set_values({0x6801: 1, 0x6901: 1}),
        "7E 00 12 0E 00 02 68 01 69 01 00 00 00 01 00 00 00 01 42 49 7E",
        "7E 00 12 00 0C A0 7E",
    ),
    (
        set_vector(0x2600, 10, HALF + MINUS_QUARTER),
        "7E 00 14 0D 26 00 00 28 08 3F 00 00 00 BE 80 00 00 EF B0 7E",
        "7E 00 14 00 0F 00 7E",
    ),
]


@pytest.mark.parametrize(("frame", "parse", "sent", "received", "answer"), PRO_READS)
def test_reads_in_pro_mode(frame, parse, sent, received, answer):
    """Each request is these bytes, and each reply means this."""
    with scripted([(bytes.fromhex(sent), bytes.fromhex(received))]) as transport:
        assert pro(transport).ask(frame, "it", parse) == answer


@pytest.mark.parametrize(("frame", "sent", "received"), PRO_WRITES)
def test_writes_in_pro_mode(frame, sent, received):
    """Each request is these bytes, whether it moves or not, and is acknowledged by these."""
    pair = (bytes.fromhex(sent), bytes.fromhex(received))
    with scripted([pair, pair]) as transport:
        link = pro(transport)
        link.tell(frame, "it")
        link.move(frame, "it")


@pytest.mark.parametrize(
    ("received", "words", "code"),
    [
        ("7E 00 91 04 00 00 00 03 AD 40 7E", "length does not fit", 0x0003),
        ("7E 00 91 04 00 00 01 01 2D 11 7E", "no such register", 0x0101),
    ],
)
def test_error_replies_to_reads(received: str, words: str, code: int):
    """The device's error code is said in words, with port and request, and is not asked again."""
    with scripted([(ASK, bytes.fromhex(received))]) as transport:
        with pytest.raises(DeviceRefused, match=f"on scripted refused the place: .*{words}.*{code:04X}") as caught:
            pro(transport).ask(get_value(0x680A), "the place", cell_int)
        assert caught.value.code == code


@pytest.mark.parametrize(
    ("frame", "sent", "received", "words"),
    [
        (set_value(0x5002, 0.5), PRO_WRITES[1][1], "7E 00 90 04 00 00 01 03 AD 01 7E", "out of the register's range"),
        (set_value(0x5002, 0.5), PRO_WRITES[1][1], "7E 00 90 04 00 00 01 06 6D 02 7E", "can only be read"),
        (set_values({0x6801: 1, 0x6901: 1}), PRO_WRITES[2][1], "7E 00 92 04 00 00 02 03 AC 13 7E", "make a chain"),
        (set_vector(0x2600, 10, HALF + MINUS_QUARTER), PRO_WRITES[3][1], "7E 00 94 04 00 00 01 07 AD 46 7E", "outside"),
    ],
)
def test_error_replies_to_motions(frame, sent, received, words):
    """A motion that the device refused did not happen: nothing freezes."""
    with scripted([(bytes.fromhex(sent), bytes.fromhex(received))]) as transport:
        link = pro(transport)
        with pytest.raises(DeviceRefused, match=words):
            link.move(frame, "it")
        assert not link.wire.unknown


@pytest.mark.parametrize("received", ["7E 00 91 04 00 00 00 01 2C 81 7E", "7E 00 91 04 00 00 00 04 EC 82 7E"])
def test_what_the_device_got_garbled_is_asked_again(received: str):
    """Where the device saw a wrong frame or CRC, a read is asked again."""
    with scripted([(ASK, bytes.fromhex(received)), (ASK, REPLY)]) as transport:
        assert pro(transport).ask(get_value(0x680A), "it", cell_int) == 300


def test_a_wrong_crc_is_taken_with_a_warning(caplog: pytest.LogCaptureFixture):
    """Until a capture on hardware confirms the CRC, one that does not fit is logged and the answer taken."""
    with scripted([(ASK, WRONG_CRC)]) as transport, caplog.at_level(logging.WARNING):
        assert pro(transport, strict_crc=False).ask(get_value(0x680A), "the place", cell_int) == 300
    assert "CRC of an answer to the place does not fit; taken" in caplog.text


def test_strict_crc_refuses_a_wrong_one(caplog: pytest.LogCaptureFixture):
    """With the setting, the answer is thrown away and asked for again."""
    with scripted([(ASK, WRONG_CRC), (ASK, REPLY)]) as transport:
        assert pro(transport, strict_crc=True).ask(get_value(0x680A), "it", cell_int) == 300
    assert "does not fit; refused" in caplog.text


def test_without_crc_none_is_sent_or_checked(caplog: pytest.LogCaptureFixture):
    """In pro mode without CRC the place holds zeros on both sides."""
    pair = (bytes.fromhex("7E 00 11 02 68 0A 00 00 7E"), bytes.fromhex("7E 00 11 04 00 00 01 2C 00 00 7E"))
    with scripted([pair]) as transport:
        assert pro(transport, with_crc=False).ask(get_value(0x680A), "it", cell_int) == 300
    assert caplog.text == ""


@pytest.mark.parametrize("noise", [b"junk\x7e", b"\x7e\x00\x11\x7e", OTHER, bytes.fromhex("7E 00 11 00 0C 50 7E")])
def test_what_is_no_answer_is_passed_over(noise: bytes, caplog: pytest.LogCaptureFixture):
    """Rubbish, halves of frames, answers to other commands, and answers of another size are logged, not taken."""
    with scripted([(ASK, [noise + REPLY])]) as transport:
        assert pro(transport).ask(get_value(0x680A), "the place", cell_int) == 300
    assert "while waiting for the place" in caplog.text


def test_answers_may_come_byte_by_byte():
    """How an answer is split does not matter."""
    with scripted([(ASK, [bytes((byte,)) for byte in REPLY])]) as transport:
        assert pro(transport).ask(get_value(0x680A), "it", cell_int) == 300


SIMPLE_TEXTS = [
    ("GETID", b"GETID\r\n", b"MR-E-2\r\n", "MR-E-2"),
    ("GETVERSION", b"GETVERSION\r\n", b"1.2.3\r\n", "1.2.3"),
    ("GETSN", b"GETSN\r\n", b"ABCD0123\r\n", "ABCD0123"),
]
SIMPLE_MOTIONS = [
    (go_x(0.5), b"X=0.500000\r\n"),
    (go_y(-0.25), b"Y=-0.250000\r\n"),
    (go_xy(0.5, -0.25), b"XY=0.500000;-0.250000\r\n"),
    ("RESET", b"RESET\r\n"),
]


def test_greeting_status_and_temperature_in_simple_mode():
    """START, STATUS and GETTEMP with their replies."""
    pairs: list[Pair] = [(b"START\r\n", b"OK\r\n"), (b"STATUS\r\n", b"00000110\r\n"), (b"GETTEMP\r\n", b"31.5\r\n")]
    with scripted(pairs) as transport:
        link = SimpleLink(wire(transport))
        link.start()
        assert link.status() == Status.NOT_STABLE | Status.WAS_DISCONNECTED
        assert link.temperature() == 31.5


@pytest.mark.parametrize(("request_", "sent", "received", "answer"), SIMPLE_TEXTS)
def test_texts_in_simple_mode(request_: str, sent: bytes, received: bytes, answer: str):
    """GETID, GETVERSION and GETSN with their replies."""
    with scripted([(sent, received)]) as transport:
        assert SimpleLink(wire(transport)).text(request_) == answer


@pytest.mark.parametrize("request_", ["GOPRO", "GOPROCRC", "ACKNOWLEDGE"])
def test_writes_in_simple_mode(request_: str):
    """Requests that move nothing are answered by OK."""
    with scripted([(request_.encode() + b"\r\n", b"OK\r\n")]) as transport:
        SimpleLink(wire(transport)).tell(request_)


@pytest.mark.parametrize(("request_", "sent"), SIMPLE_MOTIONS)
@pytest.mark.parametrize("received", [b"OK\r\n", b"NO\r\n", b"OL\r\n", b"OU\r\n", b"ERROR\r\n"])
def test_motions_in_simple_mode(request_: str, sent: bytes, received: bytes):
    """Positions and resets with every reply: OK is done, the others are refusals, and none of them freezes."""
    with scripted([(sent, received)]) as transport:
        link = SimpleLink(wire(transport))
        if received == b"OK\r\n":
            link.move(request_)
        else:
            with pytest.raises(DeviceRefused, match=received.decode().strip()):
                link.move(request_)
        assert not link.wire.unknown


def test_a_motion_answered_by_nonsense_freezes():
    """A reply that the protocol does not have says nothing about where the mirror is."""
    pair = (b"XY=0.500000;0.000000\r\n", b"O\xcb\r\n")
    with scripted([pair]) as transport, pytest.raises(StateUnknown, match="may have happened or not: expected OK"):
        SimpleLink(wire(transport)).move(go_xy(0.5, 0))


def test_another_device_is_named_by_what_it_says():
    """A position receiver on the port is not the mirror."""
    with (
        scripted([(b"START\r\n", b"$GPGGA,1\r\n")] * 3) as transport,
        pytest.raises(RigError, match=r"got '\$GPGGA,1'"),
    ):
        SimpleLink(wire(transport)).start()


def test_no_answer_says_what_to_look_at():
    """Nothing came: the request, the port, the time, and what to do."""
    with scripted([(ASK, b"")] * 3) as transport:
        with pytest.raises(DeadlinePassed, match=r"no answer to the place from scripted .*nothing came.*cable"):
            pro(transport).ask(get_value(0x680A), "the place", cell_int)
        assert transport.clock.now() == pytest.approx(1.0)
