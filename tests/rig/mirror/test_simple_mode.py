"""Lines of simple mode: every request and reply as bytes."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.errors import RigError, ShapeError
from pipeline.rig.device_errors import DeviceRefused
from pipeline.rig.mirror.registers import Status
from pipeline.rig.mirror.simple_mode import (
    LineReader,
    check_done,
    go_x,
    go_xy,
    go_y,
    read_status,
    read_temperature,
    read_text,
    to_line,
)


@pytest.mark.parametrize(
    ("request_", "line"),
    [
        ("START", b"START\r\n"),
        (go_x(0.5), b"X=0.500000\r\n"),
        (go_y(-0.25), b"Y=-0.250000\r\n"),
        (go_xy(0.1234567, -1.0), b"XY=0.123457;-1.000000\r\n"),
        ("GETTEMP", b"GETTEMP\r\n"),
    ],
)
def test_requests_are_lines(request_: str, line: bytes):
    """A request ends in CR LF, and positions have 6 decimals."""
    assert to_line(request_) == line


@pytest.mark.parametrize("request_", ["", "X=1\r\nX=2", "X=½", "X" * 63])
def test_no_other_lines_are_sent(request_: str):
    """Empty, double, foreign and long lines are refused; 64 bytes with the end still go."""
    assert len(to_line("X" * 62)) == 64
    with pytest.raises(ShapeError, match=r"one line of ASCII|lines of 64 bytes, got 65"):
        to_line(request_)


@given(st.lists(st.text(st.characters(min_codepoint=33, max_codepoint=126), min_size=1), max_size=6), st.data())
def test_lines_come_whole_however_cut(lines: list[str], data: st.DataObject):
    """Split and merged input give the same lines; empty lines and lone ends do not count."""
    stream = b"\r\n" + b"".join(line.encode() + b"\r\n" for line in lines)
    cut = data.draw(st.integers(0, len(stream)))
    reader = LineReader()
    assert reader.feed(stream[:cut]) + reader.feed(stream[cut:]) == [line.encode() for line in lines]
    assert reader.waiting == b""


@pytest.mark.parametrize("line", [b"OK", b"ok", b" Ok "])
def test_ok_in_any_case_is_done(line: bytes):
    """Replies are not case-sensitive."""
    check_done(line, "START", "p")


@pytest.mark.parametrize(
    ("line", "words"),
    [
        (b"NO", "NO to X=2: it does not know"),
        (b"OL", "below the range"),
        (b"OU", "above the range"),
        (b"error", "ERROR"),
    ],
)
def test_refusals_are_said_in_words(line: bytes, words: str):
    """NO, OL, OU and ERROR are the device's refusals, with the request and the port."""
    with pytest.raises(DeviceRefused, match=words) as caught:
        check_done(line, "X=2", "/dev/m")
    assert "/dev/m" in str(caught.value)


@pytest.mark.parametrize("line", [b"", b"OKOK", b"$GPGGA,1", b"\xff\xfe"])
def test_other_replies_are_another_device(line: bytes):
    """What the protocol does not have is not taken for an answer."""
    with pytest.raises(RigError, match="is this the mirror controller"):
        check_done(line, "START", "p")


@pytest.mark.parametrize(
    ("line", "bits"), [(b"0x00000011", 0x11), (b"00000011", 0x11), (b"FFFFFFFF", 2**32 - 1), (b"0", 0)]
)
def test_status_is_hexadecimal(line: bytes, bits: int):
    """32 bits in hexadecimal, with 0x or without."""
    assert read_status(line, "p") == Status(bits)


@pytest.mark.parametrize("line", [b"123456789", b"OK", b"xyz", b""])
def test_a_status_is_nothing_else(line: bytes):
    """Nine digits and words are no status."""
    with pytest.raises(RigError, match=r"hexadecimal digits|expected text"):
        read_status(line, "p")


@pytest.mark.parametrize(("line", "degrees"), [(b"31.5", 31.5), (b"-4", -4.0), (b"+31.25 C", 31.25)])
def test_temperatures_are_numbers(line: bytes, degrees: float):
    """A temperature with or without decimals and unit."""
    assert read_temperature(line, "p") == degrees


def test_texts_are_text():
    """An id is printable; NO and ERROR are refusals of it."""
    assert read_text(b"MR-E-2 ", "GETID", "p") == "MR-E-2"
    with pytest.raises(DeviceRefused, match="NO to GETID"):
        read_text(b"NO", "GETID", "p")
    with pytest.raises(RigError, match="port's speed"):
        read_text(b"\x00\x81", "GETID", "p")
    with pytest.raises(RigError, match="a temperature to GETTEMP from p, got 'warm'"):
        read_temperature(b"warm", "p")
