"""Requests in both modes as (sent, received) bytes, what is accepted as an answer, and connecting in either mode."""

from __future__ import annotations

import logging
import re
from contextlib import nullcontext

import pytest

from pipeline.errors import RigError
from pipeline.rig.device_settings import Patience
from pipeline.rig.mirror.mirror_requests import ProLink, ask_line, read_done, read_text
from pipeline.rig.mirror.pro_mode import cell_int, get_value
from pipeline.rig.transports import DeadlinePassed, DeviceRefused, StateUnknown, Wire
from tests.pipeline.rig.mirror.mirror_bytes import CONNECT, ENTER, GREET, LEAVE, WELL, WHO, connected, pair, set_value
from tests.pipeline.rig.scripted import Pair, Reply, ScriptedTransport, scripted

OTHER = bytes.fromhex("7E 00 13 0A 00 02 3F 00 00 00 BE 80 00 00 9B D7 7E")
SET, DONE = bytes.fromhex("7E 00 10 06 50 02 3F 00 00 00 1E 88 7E"), bytes.fromhex("7E 00 10 00 0D C0 7E")
ASK = bytes.fromhex("7E 00 11 02 68 0A 0B 3B 7E")


REPLY = bytes.fromhex("7E 00 11 04 00 00 01 2C F2 CC 7E")


WRONG_CRC = bytes.fromhex("7E 00 11 04 00 00 01 2C F2 CD 7E")


HALF, MINUS_QUARTER = bytes.fromhex("3F 00 00 00"), bytes.fromhex("BE 80 00 00")


def wire(transport: ScriptedTransport) -> Wire:
    """A wire that waits a second, asks twice again, and takes 0.1 s for silence."""
    return Wire(transport, transport.clock, Patience(1.0, 2, 0.1))


def pro(transport: ScriptedTransport, **settings: bool) -> ProLink:
    """Pro mode over the transport; CRCs in the script have to fit."""
    return ProLink(wire(transport), **{"with_crc": True, "strict_crc": True, **settings})


def test_every_kind_of_request_in_pro_mode():
    """Each request is these bytes, whether it asks, sets or moves, and each reply means this."""
    with scripted([(ASK, REPLY), (SET, DONE), (SET, DONE)]) as transport:
        link = pro(transport)
        assert link.ask(get_value(0x680A), "it", cell_int) == 300
        link.set(set_value(0x5002, 0.5), "it")
        link.move(set_value(0x5002, 0.5), "it")


@pytest.mark.parametrize(
    ("received", "words"),
    [
        ("7E 00 90 04 00 00 01 03 AD 01 7E", "out of the register's range"),
        ("7E 00 90 04 00 00 01 06 6D 02 7E", "can only be read"),
    ],
)
def test_error_replies_to_motions(received: str, words: str):
    """A motion that the device refused did not happen: nothing freezes."""
    with scripted([(SET, bytes.fromhex(received))]) as transport:
        link = pro(transport)
        with pytest.raises(DeviceRefused, match=words):
            link.move(set_value(0x5002, 0.5), "it")
        assert not link.wire.unknown


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


@pytest.mark.parametrize("received", ["7E 00 91 04 00 00 00 01 2C 81 7E", "7E 00 91 04 00 00 00 04 EC 82 7E"])
def test_what_the_device_got_garbled_is_asked_again(received: str):
    """Where the device saw a wrong frame or CRC, a read is asked again."""
    with scripted([(ASK, bytes.fromhex(received)), (ASK, REPLY)]) as transport:
        assert pro(transport).ask(get_value(0x680A), "it", cell_int) == 300


def test_a_wrong_crc_is_what_the_settings_say(caplog: pytest.LogCaptureFixture):
    """Until hardware confirms the CRC, one that does not fit is logged and taken; strictly refused; or none is sent."""
    with scripted([(ASK, WRONG_CRC)]) as transport:
        assert pro(transport, strict_crc=False).ask(get_value(0x680A), "the place", cell_int) == 300
    assert "CRC of an answer to the place does not fit; accepted" in caplog.text
    with scripted([(ASK, WRONG_CRC), (ASK, REPLY)]) as transport:
        assert pro(transport, strict_crc=True).ask(get_value(0x680A), "it", cell_int) == 300
    assert "does not fit; refused" in caplog.text
    caplog.clear()
    pair = (bytes.fromhex("7E 00 11 02 68 0A 00 00 7E"), bytes.fromhex("7E 00 11 04 00 00 01 2C 00 00 7E"))
    with scripted([pair]) as transport:
        assert pro(transport, with_crc=False).ask(get_value(0x680A), "it", cell_int) == 300
    assert caplog.text == ""


@pytest.mark.parametrize("noise", [b"junk\x7e", b"\x7e\x00\x11\x7e", OTHER, bytes.fromhex("7E 00 11 00 0C 50 7E")])
def test_what_is_no_answer_is_passed_over(noise: bytes, caplog: pytest.LogCaptureFixture):
    """Rubbish, halves of frames, answers to other commands, of another size are logged, not taken; in pieces too."""
    pieces: list[Reply] = [bytes((byte,)) for byte in noise + REPLY]
    with scripted([(ASK, [noise + REPLY]), (ASK, pieces)]) as transport:
        for _ in range(2):
            assert pro(transport).ask(get_value(0x680A), "the place", cell_int) == 300
    assert "while waiting for the place" in caplog.text


def test_every_kind_of_request_in_simple_mode():
    """Greeting and text with their replies, in pieces too, and each refusal of a motion, which freezes nothing."""
    refused = (b"NO", b"OL", b"OU", b"ERROR")
    pairs: list[Pair] = [
        (b"START\r\n", b"\r\nOK\r\n"),
        (b"GETID\r\n", [b"MR-", b"E-2\r", b"\nX"]),
        *((b"X=0.500000\r\n", reply + b"\r\n") for reply in refused),
    ]
    with scripted(pairs) as transport:
        line = wire(transport)
        assert ask_line(line, "START", read_done, "greeting")
        assert ask_line(line, "GETID", read_text, "read") == "MR-E-2"
        transport.read(1, transport.clock.now())
        for reply in refused:
            with pytest.raises(DeviceRefused, match=reply.decode()):
                ask_line(line, "X=0.500000", read_done, "motion")
        assert not line.unknown


def test_a_motion_answered_by_nonsense_freezes():
    """A reply that the protocol does not have says nothing about where the mirror is."""
    pair = (b"XY=0.500000;0.000000\r\n", b"O\xcb\r\n")
    with scripted([pair]) as transport, pytest.raises(StateUnknown, match="may have happened or not: expected OK"):
        ask_line(wire(transport), "XY=0.500000;0.000000", read_done, "motion")


@pytest.mark.parametrize(
    ("line", "error", "words"),
    [
        (b"OK", None, ""),
        (b" ok ", None, ""),
        (b"NO", DeviceRefused, "on /dev/m answered NO to X=2: it does not know"),
        (b"OL", DeviceRefused, "below the range"),
        (b"OU", DeviceRefused, "above the range"),
        (b"error", DeviceRefused, "ERROR"),
        *((line, RigError, "is this the mirror controller") for line in (b"", b"OKOK", b"$GPGGA,1", b"\xff\xfe")),
    ],
)
def test_replies_that_say_whether_it_was_done(line: bytes, error: type[RigError] | None, words: str):
    """OK in any case is done; refusals are said in words, and what the protocol does not have is another device."""
    with nullcontext() if error is None else pytest.raises(error, match=words):
        read_done(line, "X=2", "/dev/m")


def test_texts_are_text():
    """An id is printable; NO and ERROR are refusals of it."""
    assert read_text(b"MR-E-2 ", "GETID", "p") == "MR-E-2"
    with pytest.raises(DeviceRefused, match="NO to GETID"):
        read_text(b"NO", "GETID", "p")
    with pytest.raises(RigError, match="port's speed"):
        read_text(b"\x00\x81", "GETID", "p")


SILENT = (b"START\r\n", b"")


DAMAGED = bytes.fromhex("7E 00 D4 04 00 00 00 01 22 14 7E")  # what the greeting gets in pro mode


REST: list[Pair] = [*WHO, ENTER, WELL]
FOUND: dict[str, list[Pair]] = {
    "in pro mode": [SILENT, SILENT, SILENT, LEAVE, GREET, *REST],
    "in pro mode, complaining of the greeting": [*[SILENT] * 3, (LEAVE[0], [DAMAGED, LEAVE[1]]), GREET, *REST],
    "in a line that somebody began": [(b"START\r\n", b"NO\r\n"), *CONNECT],
    "in a line that somebody began, and that is known": [(b"START\r\n", b"ERROR\r\n"), *CONNECT],
    "after a greeting that was lost": [SILENT, *CONNECT],
    "though the change's answer was lost": [GREET, *WHO, (ENTER[0], b""), WELL],
}


@pytest.mark.parametrize("name", FOUND)
def test_a_controller_is_found(name: str):
    """In whichever mode an earlier session left it; a greeting moves nothing and is repeated."""
    with scripted(FOUND[name]) as transport:
        assert connected(transport).identity().device == "MR-E-2"


def test_a_usual_reconnect_warns_of_nothing(caplog: pytest.LogCaptureFixture):
    """In pro mode as drivers leave it, with bytes of another program before: noted, no cause to look."""
    leave = (LEAVE[0], [DAMAGED, LEAVE[1]])
    with (
        caplog.at_level(logging.INFO),
        scripted([SILENT, SILENT, SILENT, leave, GREET, *WHO, ENTER, WELL]) as transport,
    ):
        assert connected(transport).found_in_pro
    with caplog.at_level(logging.INFO), scripted(CONNECT, stale=b"NO", drained=b"NO") as transport:
        assert not connected(transport).found_in_pro
    assert "it may be in pro mode" in caplog.text
    assert "dropped 2 stale bytes" in caplog.text
    assert {record.levelno for record in caplog.records} == {logging.INFO}


def test_damage_at_a_reconnect_is_warned_of(caplog: pytest.LogCaptureFixture):
    """Half of an answer to the greeting is nothing that another mode explains."""
    with caplog.at_level(logging.INFO), scripted([(b"START\r\n", b"O"), *CONNECT]) as transport:
        connected(transport)
    assert [record.levelname for record in caplog.records] == ["WARNING"]


def test_stale_bytes_and_unknown_questions_at_connect():
    """Whatever lies on the line from before is dropped; a version that is not told stays empty."""
    stale = b"NO\r\n" + bytes.fromhex("7E 00 11 04 00 00")
    who = [WHO[0], (b"GETVERSION\r\n", b"NO\r\n"), (b"GETSN\r\n", b"NO\r\n")]
    with scripted([GREET, *who, ENTER, WELL], stale=stale, drained=stale) as transport:
        identity = connected(transport).identity()
    assert (identity.device, identity.version, identity.serial) == ("MR-E-2", "", "")


def test_nobody_there_is_said_within_the_deadlines():
    """No answer in either mode: three transactions' time, and what to look at."""
    with scripted([*[SILENT] * 3, (LEAVE[0], b""), *[SILENT] * 3]) as transport:
        with pytest.raises(DeadlinePassed, match=r"no answer to START from scripted .*is the controller on"):
            connected(transport)
        assert transport.clock.now() < 4


PLAIN: Pair = (b"GOPRO\r\n", b"OK\r\n")
PLAIN_WELL = pair("7E 00 02 02 00 00 00 00 7E", "7E 00 02 04 00 00 00 00 00 00 7E")
PLAIN_LEAVE = pair("7E 00 06 02 00 00 00 00 7E", "7E 00 06 00 00 00 7E")
CRC_WRONG = bytes.fromhex("7E 00 82 04 00 00 00 04 00 00 7E")
KNOWN_CRC = [ENTER, WELL, LEAVE]
UNCHECKED: list[Pair] = [(PLAIN_WELL[0], CRC_WRONG)] * 3  # a read is asked again twice
STUCK = [SILENT] * 3
NO_ENTER, NO_PLAIN = (ENTER[0], b"NO\r\n"), (PLAIN[0], b"NO\r\n")
CHECKED_LEAVE = (PLAIN_LEAVE[0], bytes.fromhex("7E 00 86 04 00 00 00 04 00 00 7E"))
FIRMWARES: dict[str, tuple[bool, list[Pair], str]] = {
    "no GOPROCRC": (True, [NO_ENTER, GREET, PLAIN, PLAIN_WELL, PLAIN_LEAVE, GREET], "with_crc = false"),
    "no GOPRO": (False, [NO_PLAIN, GREET, *KNOWN_CRC, GREET], "with_crc = true"),
    "GOPRO that checks": (
        False,
        [PLAIN, *UNCHECKED, *STUCK, CHECKED_LEAVE, LEAVE, GREET, *KNOWN_CRC, GREET],
        "with_crc = true",
    ),
}


@pytest.mark.parametrize("name", FIRMWARES)
def test_a_firmware_that_wants_frames_the_other_way_says_which_setting(name: str):
    """The other way is tried and left again before the message names its setting; it moves nothing."""
    with_crc, script, setting = FIRMWARES[name]
    with (
        scripted([GREET, *WHO, *script]) as transport,
        pytest.raises(DeviceRefused, match=rf"It answers frames .*; set {setting} in \[rig\]"),
    ):
        connected(transport, with_crc=with_crc, strict_crc=False)


def test_a_firmware_that_answers_frames_neither_way_says_what_it_said():
    """Nothing is advised where nothing would help."""
    script = [GREET, *WHO, NO_PLAIN, GREET, NO_ENTER, GREET]
    with scripted(script) as transport, pytest.raises(DeviceRefused, match=r"NO to GOPRO: it does not know.*now$"):
        connected(transport, with_crc=False)


def test_frames_without_a_crc_connect_by_these_bytes():
    """00 00 stands in the CRC's place, in requests and replies."""
    with scripted([GREET, *WHO, PLAIN, PLAIN_WELL]) as transport:
        connected(transport, with_crc=False)


def test_a_controller_left_with_requests_checked_is_left_by_a_checked_request():
    """An earlier session sent CRCs and this one does not: the change of mode is asked for again with one."""
    script = [*STUCK, CHECKED_LEAVE, LEAVE, GREET, *WHO, PLAIN, PLAIN_WELL]
    with scripted(script) as transport:
        assert connected(transport, with_crc=False).found_in_pro


IDLE_PLAIN = pair("7E 00 13 06 00 02 68 01 69 01 00 00 7E", "7E 00 13 0A 00 02 00 00 00 00 00 00 00 00 00 00 7E")
BOTH: dict[str, tuple[list[Pair], str]] = {"both": (KNOWN_CRC, "^$"), "none with a CRC": ([NO_ENTER], "NO to GOPROCRC")}


@pytest.mark.parametrize("name", BOTH)
def test_the_other_way_is_tried_and_given_up_again(name: str):
    """Simple mode, the other way and back, byte by byte; the session goes on as its settings say."""
    other, words = BOTH[name]
    script = [GREET, *WHO, PLAIN, PLAIN_WELL, IDLE_PLAIN, PLAIN_LEAVE, GREET, *other, GREET, PLAIN, PLAIN_WELL]
    with scripted(script) as transport:
        assert re.search(words, connected(transport, with_crc=False).why_unanswered(with_crc=True))


def test_another_device_is_refused():
    """What talks without being asked, or answers otherwise, is not the mirror."""
    with scripted([(b"START\r\n", b"login: \r\n")] * 3) as transport, pytest.raises(RigError, match="got 'login:'"):
        connected(transport)
