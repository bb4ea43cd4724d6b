"""Frames of pro mode: the documented bytes, and laws over any payload and any stream."""

from __future__ import annotations

import re
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.errors import ShapeError
from pipeline.rig.mirror.pro_mode import Command, Damaged, ErrorCode, Frame, FrameReader, crc_arc, encode, error_words

nasty = st.one_of(
    st.binary(max_size=50), st.lists(st.sampled_from([0x7D, 0x7E, 0x5D, 0x5E, 0]), max_size=50).map(bytes)
)
frames = st.builds(Frame, st.integers(0, 255), nasty, st.integers(0, 255))
rubbish = st.binary(max_size=30).map(lambda data: data.replace(b"\x7e", b"?"))


def parts(stream: bytes, cuts: list[int]) -> list[bytes]:
    """Cut a stream at places taken modulo its length."""
    places = sorted({0, len(stream), *(cut % (len(stream) + 1) for cut in cuts)})
    return [stream[start:stop] for start, stop in pairwise(places)]


def test_the_documented_frame():
    """The one reply whose CRC is documented, 00 11 04 00 00 00 00 with F2 81, is written and read so."""
    data = bytes.fromhex("7E 00 11 04 00 00 00 00 F2 81 7E")
    assert encode(Frame(Command.GET_VALUE, bytes(4))) == data
    (found,) = FrameReader().feed(data)
    assert found == Frame(0x11, bytes(4))
    assert found.crc_good


def test_both_marks_are_escaped():
    """7D and 7E in a payload are sent as 7D 5D and 7D 5E."""
    data = bytes.fromhex("7E 00 11 04 7D 5D 7D 5E 7D 5D 7D 5E 2B 85 7E")
    frame = Frame(0x11, b"\x7d\x7e\x7d\x7e")
    assert encode(frame) == data
    assert FrameReader().feed(data) == [frame]


def test_without_a_crc_zeros_are_sent():
    """The CRC's place is never left out."""
    assert encode(Frame(0x11, b"\x68\x0a"), with_crc=False) == bytes.fromhex("7E 00 11 02 68 0A 00 00 7E")


@given(st.binary(max_size=60))
def test_an_address_of_zero_does_not_change_the_crc(data: bytes):
    """Whether the CRC covers the address, which is not documented, does not matter at address 0."""
    assert crc_arc(b"\x00" + data) == crc_arc(data)


@given(frames)
def test_reading_undoes_writing(frame: Frame):
    """Any frame comes back, with a CRC that fits, and boundaries stand nowhere but at its ends."""
    data = encode(frame)
    assert 0x7E not in data[1:-1]
    found = FrameReader().feed(data)
    assert found == [frame]
    assert found[0].crc_good


@given(st.lists(frames, max_size=5), st.lists(st.integers(0, 1000), max_size=20))
def test_how_a_stream_is_cut_changes_nothing(sent: list[Frame], cuts: list[int]):
    """Split and merged input give the same frames."""
    stream = b"".join(map(encode, sent))
    reader = FrameReader()
    assert [found for part in parts(stream, cuts) for found in reader.feed(part)] == sent
    assert reader.waiting == b""


@given(st.lists(st.tuples(rubbish, frames), max_size=5), rubbish)
def test_rubbish_between_frames_costs_no_frame(sent: list[tuple[bytes, Frame]], tail: bytes):
    """Every frame is found in order, and all bytes of the rubbish are given back or are frames by chance."""
    stream = b"".join(noise + encode(frame) for noise, frame in sent) + tail
    found = FrameReader().feed(stream)
    frames_found = iter([item for item in found if isinstance(item, Frame)])
    assert all(any(frame == item for item in frames_found) for _, frame in sent)
    dropped = b"".join(item.data for item in found if isinstance(item, Damaged))
    assert len(dropped) <= sum(len(noise) for noise, _ in sent) + len(tail)


@given(st.binary(max_size=400), st.lists(st.integers(0, 1000), max_size=20))
def test_no_stream_stops_a_reader(stream: bytes, cuts: list[int]):
    """Any bytes, however cut, give the same findings, and the next frame is found after a boundary."""
    whole, cut = FrameReader(), FrameReader()
    found = whole.feed(stream)
    assert [item for part in parts(stream, cuts) for item in cut.feed(part)] == found
    assert whole.waiting == cut.waiting
    assert len(whole.waiting) <= 110
    frame = Frame(0x15, b"abcd")
    assert whole.feed(b"\x7e" + encode(frame))[-1] == frame


@given(frames, st.integers(0, 2000))
def test_a_flipped_bit_is_never_a_good_frame(frame: Frame, place: int):
    """One wrong bit inside a frame leaves no frame whose CRC fits, but for one cut in two by a false boundary."""
    data = bytearray(encode(frame))
    at, bit = 1 + place // 8 % (len(data) - 2), place % 8
    data[at] ^= 1 << bit
    if 0x7E not in data[1:-1]:
        found = FrameReader().feed(bytes(data))
        assert not any(isinstance(item, Frame) and item.crc_good for item in found)


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        ("41 42 7E", "no boundary begins"),
        ("7E 00 11 00 7E", "4 bytes, where a frame has at least 5|3 bytes, where a frame has at least 5"),
        ("7E 00 11 05 00 00 00 00 F2 81 7E", "a size of 5 over a payload of 4"),
        ("7E 00 11 7D 41 00 00 7E", "escapes nothing"),
        ("7E 00 11 00 00 7D 7E", "escapes nothing"),
        ("7E 00 11 33" + " 00" * 53 + " 7E", "51 bytes, above 50"),
        ("7E" + " 00" * 111, "more than 110 bytes"),
    ],
)
def test_damage_is_said(data: str, reason: str):
    """What is no frame is given back with the reason."""
    (found,) = FrameReader().feed(bytes.fromhex(data))
    assert isinstance(found, Damaged)
    assert re.search(reason, found.reason)
    assert found.data == bytes.fromhex(data).strip(b"\x7e")


def test_a_wrong_crc_is_a_frame_all_the_same():
    """A reader says that the CRC does not fit; what to make of it is the driver's."""
    (found,) = FrameReader().feed(bytes.fromhex("7E 00 11 04 00 00 00 00 F2 82 7E"))
    assert isinstance(found, Frame)
    assert not found.crc_good


@pytest.mark.parametrize(("frame", "match"), [(Frame(1, bytes(51)), "at most 50 bytes, got 51"), (Frame(256), "256")])
def test_what_does_not_fit_is_refused(frame: Frame, match: str):
    """Too long a payload and too large a command are refused."""
    with pytest.raises(ShapeError, match=match):
        encode(frame)


@pytest.mark.parametrize("code", list(ErrorCode))
def test_error_codes_have_words(code: ErrorCode):
    """Every known code is said in words and by number; others by number."""
    assert f"(code {code:04X})" in error_words(code)
    assert "does not know" not in error_words(code)
    assert "does not know (code 7777)" in error_words(0x7777)
