"""Requests in both modes as (sent, received) bytes, the accepted replies, and connecting in either mode."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from functools import partial
from typing import Any

import pytest

from spectralzoom.pipeline.errors import RigError, SettingsError
from spectralzoom.pipeline.rig.mirror_controller import ask_frame, ask_line, read_done, read_text
from spectralzoom.pipeline.rig.pro_mode import cell_int
from spectralzoom.pipeline.rig.transports import DeadlinePassed, DeviceRefused, Wire
from tests.pipeline.rig.mirror.mirror_bytes import (
    CONNECT,
    ENTER,
    GREET,
    HALT,
    LEAVE,
    LOAD,
    PATH,
    WELL,
    WHO,
    connected,
    get_value,
    pair,
    set_value,
)
from tests.pipeline.rig.scripted import Pair, Reply, ScriptedTransport, scripted

OTHER = bytes.fromhex("7E 00 13 0A 00 02 3F 00 00 00 BE 80 00 00 9B D7 7E")
SET, DONE = bytes.fromhex("7E 00 10 06 50 02 3F 00 00 00 1E 88 7E"), bytes.fromhex("7E 00 10 00 0D C0 7E")
ASK, REPLY = bytes.fromhex("7E 00 11 02 68 0A 0B 3B 7E"), bytes.fromhex("7E 00 11 04 00 00 01 2C F2 CC 7E")
WRONG_CRC = bytes.fromhex("7E 00 11 04 00 00 01 2C F2 CD 7E")


def wire(transport: ScriptedTransport) -> Wire:
    """Return a wire."""
    return Wire(transport, transport.clock)


Ask = Callable[..., Any]


def pro(transport: ScriptedTransport, *, with_crc: bool = True) -> Ask:
    """Return requests in frames over the transport; CRCs in the script have to fit."""
    return partial(ask_frame, wire(transport), with_crc=with_crc)


def test_pro_mode_sends_every_kind_of_request():
    """A read, a write and a motion have these bytes, and the reply gives this value."""
    with scripted([(ASK, REPLY), (SET, DONE), (SET, DONE)]) as transport:
        ask = pro(transport)
        assert ask(get_value(0x680A), "it", cell_int) == 300
        ask(set_value(0x5002, 0.5), "it", bytes, "write")
        ask(set_value(0x5002, 0.5), "it", bytes, "motion")


@pytest.mark.parametrize(
    ("received", "words"),
    [
        ("7E 00 91 04 00 00 00 03 AD 40 7E", r"length mismatch \(code 0003"),
        ("7E 00 91 04 00 00 01 01 2D 11 7E", r"no register \(code 0101"),
    ],
)
def test_error_replies_are_reported_in_words(received: str, words: str):
    """The message has the error code in words, the port and the request. The request is not retried."""
    refused = pytest.raises(DeviceRefused, match=f"on scripted refused the place: {words}")
    with scripted([(ASK, bytes.fromhex(received))]) as transport, refused:
        pro(transport)(get_value(0x680A), "the place", cell_int)


def test_a_refused_motion_blocks_nothing():
    """A motion that the device refused did not happen."""
    with scripted([(SET, bytes.fromhex("7E 00 90 04 00 00 01 03 AD 01 7E"))]) as transport:
        ask = pro(transport)
        with pytest.raises(DeviceRefused, match="out of range"):
            ask(set_value(0x5002, 0.5), "it", bytes, "motion")


def test_a_wrong_crc_is_refused(caplog: pytest.LogCaptureFixture):
    """The request is sent again. Without CRC none is sent, and those of replies are not looked at."""
    with scripted([(ASK, WRONG_CRC), (ASK, REPLY)]) as transport:
        assert pro(transport)(get_value(0x680A), "the place", cell_int) == 300
    assert "CRC of an answer to the place does not fit; it is refused" in caplog.text
    caplog.clear()
    with scripted([pair("7E 00 11 02 68 0A 00 00 7E", "7E 00 11 04 00 00 01 2C 00 00 7E")]) as transport:
        assert pro(transport, with_crc=False)(get_value(0x680A), "it", cell_int) == 300
    assert caplog.text == ""


@pytest.mark.parametrize("noise", [b"junk\x7e", b"\x7e\x00\x11\x7e", OTHER, bytes.fromhex("7E 00 11 00 0C 50 7E")])
def test_data_other_than_the_reply_are_skipped(noise: bytes):
    """Noise, partial frames, and replies to other commands or of another size are skipped, also in pieces."""
    pieces: list[Reply] = [bytes((byte,)) for byte in noise + REPLY]
    with scripted([(ASK, [noise + REPLY]), (ASK, pieces)]) as transport:
        for _ in range(2):
            assert pro(transport)(get_value(0x680A), "the place", cell_int) == 300


def test_simple_mode_reads_replies_to_lines():
    """A greeting and a text have their replies, also in pieces."""
    pairs: list[Pair] = [(b"START\r\n", b"\r\nOK\r\n"), (b"GETID\r\n", [b"MR-", b"E-2\r", b"\n"])]
    with scripted(pairs) as transport:
        line = wire(transport)
        assert ask_line(line, "START", read_done)
        assert ask_line(line, "GETID", read_text) == "MR-E-2"


@pytest.mark.parametrize(
    ("line", "error", "words"),
    [
        (b"OK", None, ""),
        (b" ok ", None, ""),
        *((line, DeviceRefused, f"on /dev/m answered {line.decode().upper()} to X=2") for line in (b"NO", b"error")),
        *((line, RigError, "is this the mirror controller") for line in (b"", b"OKOK", b"$GPGGA,1", b"\xff\xfe")),
    ],
)
def test_replies_of_simple_mode_mean_done_or_refused(line: bytes, error: type[RigError] | None, words: str):
    """OK in any case is done, NO and ERROR are refusals. Other text comes from another device."""
    with nullcontext() if error is None else pytest.raises(error, match=words):
        read_done(line, "X=2", "/dev/m")


def test_text_replies_are_printable():
    """A reply of NO gives an empty text, and unprintable bytes are refused."""
    assert read_text(b"MR-E-2 ", "GETID", "p") == "MR-E-2"
    assert read_text(b"NO", "GETID", "p") == ""
    with pytest.raises(RigError, match="is this the mirror controller"):
        read_text(b"\x00\x81", "GETID", "p")


SILENT = (b"START\r\n", b"")
DAMAGED = bytes.fromhex("7E 00 D4 04 00 00 00 01 22 14 7E")  # reply to the greeting in pro mode
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
def test_a_controller_is_found_in_any_mode(name: str):
    """An earlier session may have left it in either mode. The greeting moves nothing, so it is repeated."""
    with scripted(FOUND[name]) as transport:
        assert connected(transport).identity.startswith("MR-E-2,")


def test_stale_bytes_are_dropped_at_connect():
    """A version or serial number that the controller does not give is empty."""
    stale = b"NO\r\n" + bytes.fromhex("7E 00 11 04 00 00")
    who = [WHO[0], (b"GETVERSION\r\n", b"NO\r\n"), (b"GETSN\r\n", b"NO\r\n")]
    with scripted([GREET, *who, ENTER, WELL], stale=stale, drained=stale) as transport:
        identity = connected(transport).identity
    assert identity == "MR-E-2, version unknown, serial unknown"


def test_a_silent_port_is_reported_within_the_deadlines():
    """Without a reply in either mode the error comes within three transactions and names a remedy."""
    with scripted([*[SILENT] * 3, (LEAVE[0], b""), *[SILENT] * 3]) as transport:
        with pytest.raises(DeadlinePassed, match=r"no answer to START from scripted .*is the controller on"):
            connected(transport)
        assert transport.clock.now() < 4


PLAIN: Pair = (b"GOPRO\r\n", b"OK\r\n")
PLAIN_WELL = pair("7E 00 02 02 00 00 00 00 7E", "7E 00 02 04 00 00 00 00 00 00 7E")
FIRMWARES: dict[str, tuple[bool, list[Pair]]] = {
    "no GOPROCRC": (True, [(ENTER[0], b"NO\r\n")]),
    "no GOPRO": (False, [(PLAIN[0], b"NO\r\n")]),
    "GOPRO that checks": (False, [PLAIN, (PLAIN_WELL[0], bytes.fromhex("7E 00 82 04 00 00 00 04 00 00 7E"))]),
}


@pytest.mark.parametrize("name", FIRMWARES)
def test_unsuitable_firmware_names_the_crc_setting(name: str):
    """The message names the setting with which this firmware may reply."""
    with_crc, script = FIRMWARES[name]
    words = rf"wants them with(out)? one, set with_crc = {str(not with_crc).lower()} in \[rig\]"
    with scripted([GREET, *WHO, *script]) as transport, pytest.raises(RigError, match=words):
        connected(transport, with_crc=with_crc)


def test_frames_without_a_crc_have_zeros():
    """00 00 replaces the CRC. A controller left in pro mode gets a frame with a CRC to leave it."""
    with scripted([*[SILENT] * 3, LEAVE, GREET, *WHO, PLAIN, PLAIN_WELL]) as transport:
        connected(transport, with_crc=False)


def test_another_device_is_refused():
    """Its text does not fit the greeting, or its id is another than expected."""
    with scripted([(b"START\r\n", b"login: \r\n")] * 3) as transport, pytest.raises(RigError, match="got 'login:'"):
        connected(transport)
    who = [(b"GETID\r\n", b"LENS-4\r\n"), *WHO[1:]]
    with scripted([GREET, *who]) as transport, pytest.raises(RigError, match=r"id begins with MR on .*got LENS-4"):
        connected(transport)


BOOT = b"\x00\xffMR-E-2 boot 1.2\r\nready\r\n"


def test_boot_text_is_not_taken_for_a_reply():
    """Text that is on the line is dropped. Text that comes while the greeting waits costs one repetition of it."""
    with scripted(CONNECT, stale=BOOT, drained=BOOT) as transport:
        assert connected(transport).identity.startswith("MR-E-2,")
    with scripted([(b"START\r\n", [b"ready\r\n"]), *CONNECT]) as transport:
        assert connected(transport).identity.startswith("MR-E-2,")


def test_an_echo_is_no_controller():
    """A port that returns what is sent is reported, and nothing moves."""
    echo = (b"START\r\n", b"START\r\n")
    with scripted([echo] * 3) as transport, pytest.raises(RigError, match=r"got 'START'; is this the mirror"):
        connected(transport)


def test_a_second_reader_of_the_port_costs_repetitions():
    """Bytes that another program takes are missing: a read is sent again, a motion leaves the state unknown."""
    torn = bytes(WELL[1])[:4]
    with scripted([*CONNECT, (WELL[0], [torn]), WELL]) as transport:
        assert connected(transport).status() == 0


def test_a_restarted_controller_loses_its_path():
    """It speaks in lines again, so that frames have no answer. The next connection finds it, without a path."""
    restarted = (LOAD[0], [BOOT])
    lost = pytest.raises(DeadlinePassed, match=r"no answer to writing cells 0 to 6 .*other bytes came")
    with scripted([*CONNECT, HALT, restarted]) as transport, lost:
        connected(transport).load_path(PATH)
    with scripted(CONNECT) as transport:
        mirror = connected(transport)
        with pytest.raises(SettingsError, match="no path is loaded"):
            mirror.run(10.0)
