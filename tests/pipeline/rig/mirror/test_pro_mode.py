"""Pro mode: the documented bytes of frames and payloads, any stream of bytes, and the published registers."""

from __future__ import annotations

import logging
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from spectralzoom.pipeline.errors import ShapeError
from spectralzoom.pipeline.rig import pro_mode as pro
from tests.pipeline.rig.mirror.mirror_bytes import ASK_FIRMWARE, set_value

nasty = st.binary(max_size=50) | st.lists(st.sampled_from([0x7D, 0x7E, 0x5D, 0x5E, 0]), max_size=50).map(bytes)
frames = st.builds(pro.Frame, st.integers(0, 255), nasty, st.integers(0, 255))


def test_the_documented_frame_is_written_and_read():
    """The only reply with a documented CRC is 00 11 04 00 00 00 00. Frames without a CRC have zeros."""
    data = bytes.fromhex("7E 00 11 04 00 00 00 00 F2 81 7E")
    assert pro.encode(pro.Frame(0x11, bytes(4))) == data
    assert pro.encode(pro.Frame(0x11, bytes(4)), with_crc=False) == data[:-3] + b"\x00\x00\x7e"
    (found,) = pro.FrameReader().feed(data)
    assert found == pro.Frame(0x11, bytes(4))
    assert found.crc_good


def test_both_marks_are_escaped():
    """7D and 7E in a payload are sent as 7D 5D and 7D 5E."""
    data = bytes.fromhex("7E 00 11 04 7D 5D 7D 5E 7D 5D 7D 5E 2B 85 7E")
    frame = pro.Frame(0x11, b"\x7d\x7e\x7d\x7e")
    assert pro.encode(frame) == data
    assert pro.FrameReader().feed(data) == [frame]


@given(frames)
def test_reading_inverts_writing(frame: pro.Frame):
    """Any frame is read back with a good CRC, and boundary bytes occur only at its ends."""
    data = pro.encode(frame)
    assert 0x7E not in data[1:-1]
    found = pro.FrameReader().feed(data)
    assert found == [frame]
    assert found[0].crc_good


@given(st.binary(max_size=400), st.lists(st.integers(0, 1000), max_size=20))
def test_a_reader_survives_any_stream(stream: bytes, cuts: list[int]):
    """Any bytes, cut anywhere, give the same results, and the reader finds the next frame after a boundary."""
    places = sorted({0, len(stream), *(place % (len(stream) + 1) for place in cuts)})
    whole, cut = pro.FrameReader(), pro.FrameReader()
    found = whole.feed(stream)
    assert [item for start, stop in pairwise(places) for item in cut.feed(stream[start:stop])] == found
    assert whole._held == cut._held
    assert len(whole._held) <= 111
    frame = pro.Frame(0x15, b"abcd")
    assert whole.feed(b"\x7e" + pro.encode(frame))[-1] == frame


@given(frames, st.integers(0, 2000))
def test_a_flipped_bit_breaks_the_crc(frame: pro.Frame, place: int):
    """One wrong bit inside of a frame leaves no frame with a good CRC, unless it becomes a boundary byte."""
    data = bytearray(pro.encode(frame))
    at, bit = 1 + place // 8 % (len(data) - 2), place % 8
    data[at] ^= 1 << bit
    if 0x7E not in data[1:-1]:
        found = pro.FrameReader().feed(bytes(data))
        assert not any(item.crc_good for item in found)


@pytest.mark.parametrize(
    "data",
    [
        "41 42 7E",
        "7E 00 11 00 00 7E",
        "7E 00 11 05 00 00 00 00 F2 81 7E",
        "7E 00 11 7D 41 00 00 7E",
        "7E 00 11 00 00 7D 7E",
        "7E 00 11 33" + " 00" * 53 + " 7E",
        "7E" + " 00" * 111 + " 7E",
    ],
)
def test_damaged_frames_are_dropped_and_logged(data: str, caplog: pytest.LogCaptureFixture):
    """Damaged frames are too short or too long, contradict their size, or have an invalid escape."""
    with caplog.at_level(logging.INFO):
        assert pro.FrameReader().feed(bytes.fromhex(data)) == []
    assert f"no frame: {bytes.fromhex(data).strip(b'~').hex(' ')}" in caplog.text


def test_error_codes_have_words():
    """Known codes have a name and a number, others a number only."""
    assert pro.format_error(0x0103) == "out of range (code 0103)"
    assert pro.format_error(0x0203) == "chain (code 0203)"
    assert pro.format_error(0x7777) == "unknown error (code 7777)"


def test_a_wrong_crc_is_reported_with_its_frame():
    """The reader returns the frame and marks its CRC as wrong; the driver decides whether to accept it."""
    (found,) = pro.FrameReader().feed(bytes.fromhex("7E 00 11 04 00 00 00 00 F2 82 7E"))
    assert not found.crc_good


def cell(value: int) -> bytes:
    """Return the cell of an integer."""
    return value.to_bytes(4, "big")


def refusal(command: int, code: int) -> pro.Frame:
    """Return the device's reply that refuses a command."""
    return pro.Frame(command | pro.ERROR_FLAG, cell(code))


HALF, MINUS_QUARTER = b"\x3f\x00\x00\x00", b"\xbe\x80\x00\x00"
REQUESTS = [
    (ASK_FIRMWARE, "7E 00 01 02 00 00 A0 3C 7E"),
    (pro.ASK_STATUS, "7E 00 02 02 00 00 A0 78 7E"),
    (pro.GO_SIMPLE, "7E 00 06 02 00 00 A1 48 7E"),
    (set_value(0x5002, 0.5), "7E 00 10 06 50 02 3F 00 00 00 1E 88 7E"),
    (pro.set_values({0x6801: 1, 0x6901: 1}), "7E 00 12 0E 00 02 68 01 69 01 00 00 00 01 00 00 00 01 42 49 7E"),
    (pro.set_vector(0x2600, 10, HALF + MINUS_QUARTER), "7E 00 14 0D 26 00 00 28 08 3F 00 00 00 BE 80 00 00 EF B0 7E"),
    (pro.get_vector(0x2600, 10, 2), "7E 00 15 05 26 00 00 28 08 52 95 7E"),
]
REPLIES = [
    (pro.Frame(0x01, b"MRE2"), "7E 00 01 04 4D 52 45 32 F5 E9 7E"),
    (pro.Frame(0x02, cell(0x11)), "7E 00 02 04 00 00 00 11 30 2E 7E"),
    (pro.Frame(0x06), "7E 00 06 00 03 A0 7E"),
    (pro.Frame(0x10), "7E 00 10 00 0D C0 7E"),
    (pro.Frame(0x11, cell(300)), "7E 00 11 04 00 00 01 2C F2 CC 7E"),
    (pro.Frame(0x12), "7E 00 12 00 0C A0 7E"),
    (pro.Frame(0x14), "7E 00 14 00 0F 00 7E"),
    (pro.Frame(0x15, HALF + MINUS_QUARTER), "7E 00 15 08 3F 00 00 00 BE 80 00 00 10 D1 7E"),
    (refusal(0x11, 0x0001), "7E 00 91 04 00 00 00 01 2C 81 7E"),
    (refusal(0x11, 0x0003), "7E 00 91 04 00 00 00 03 AD 40 7E"),
    (refusal(0x11, 0x0004), "7E 00 91 04 00 00 00 04 EC 82 7E"),
    (refusal(0x11, 0x0101), "7E 00 91 04 00 00 01 01 2D 11 7E"),
    (refusal(0x10, 0x0103), "7E 00 90 04 00 00 01 03 AD 01 7E"),
    (refusal(0x10, 0x0106), "7E 00 90 04 00 00 01 06 6D 02 7E"),
    (refusal(0x14, 0x0107), "7E 00 94 04 00 00 01 07 AD 46 7E"),
    (refusal(0x12, 0x0203), "7E 00 92 04 00 00 02 03 AC 13 7E"),
]


@pytest.mark.parametrize(("frame", "data"), [*REQUESTS, *REPLIES])
def test_requests_and_replies_have_these_bytes(frame: pro.Frame, data: str):
    """Every request and reply is encoded to these bytes and decoded from them."""
    assert pro.encode(frame) == bytes.fromhex(data)
    assert pro.FrameReader().feed(bytes.fromhex(data)) == [frame]


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: pro.encode(pro.Frame(1, bytes(51))), "at most 50 bytes, got 51"),
        (lambda: pro.cell_int(b"123"), "expected 4 bytes, got 3"),
    ],
)
def test_payloads_of_a_wrong_size_are_refused(make, match):
    """The message has the expected and the given size."""
    with pytest.raises(ShapeError, match=match):
        make()


def test_registers_have_the_published_ids():
    """An id is the system times 256 plus the number."""
    assert (pro.X.static_xy, pro.Y.static_xy) == (0x5002, 0x5102)
    assert (pro.X.unit, pro.X.run, pro.X.start, pro.X.end, pro.X.frequency) == tuple(range(0x6800, 0x6805))
    assert (pro.X.cycles, pro.Y.trigger) == (0x6807, 0x6908)
    assert pro.X.hold == {0x4000: 0x50, 0x4002: 0xC0}
    assert pro.Y.play == {0x4005: 0x69, 0x4007: 0xC1}
    assert pro.VECTOR_MEMORY == 0x2600


def test_status_bits_have_words():
    """Known bits have names, others appear in the number. Only bits 0 to 3 forbid motion."""
    assert pro.Status(0).sentence == "status 00000000: no known bit"
    assert pro.Status(0x80000090).sentence == "status 80000090: not stable, trimmed"
    assert [bit for bit in range(32) if pro.Status(1 << bit).stops_motion] == [0, 1, 2, 3]
