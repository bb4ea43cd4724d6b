"""Payloads of pro mode: every form as bytes written by hand, both ways."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.errors import ShapeError
from pipeline.rig.mirror.pro_mode import ErrorCode, Frame, FrameReader, encode
from pipeline.rig.mirror.pro_payloads import (
    acknowledge,
    ask_firmware,
    ask_status,
    cell_float,
    cell_int,
    float_cell,
    get_value,
    get_values,
    get_vector,
    go_simple,
    int_cell,
    read_register,
    read_registers,
    read_values,
    read_vector,
    refuse,
    set_value,
    set_values,
    set_vector,
    split_cells,
    to_cell,
    values_reply,
)

HALF, MINUS_QUARTER = b"\x3f\x00\x00\x00", b"\xbe\x80\x00\x00"

REQUESTS = [
    (ask_firmware(), "7E 00 01 02 00 00 A0 3C 7E"),
    (ask_status(), "7E 00 02 02 00 00 A0 78 7E"),
    (go_simple(), "7E 00 06 02 00 00 A1 48 7E"),
    (set_value(0x5002, 0.5), "7E 00 10 06 50 02 3F 00 00 00 1E 88 7E"),
    (get_value(0x680A), "7E 00 11 02 68 0A 0B 3B 7E"),
    (set_values({0x6801: 1, 0x6901: 1}), "7E 00 12 0E 00 02 68 01 69 01 00 00 00 01 00 00 00 01 42 49 7E"),
    (get_values([0x2302, 0x2303]), "7E 00 13 06 00 02 23 02 23 03 AD AC 7E"),
    (set_vector(0x2600, 10, HALF + MINUS_QUARTER), "7E 00 14 0D 26 00 00 28 08 3F 00 00 00 BE 80 00 00 EF B0 7E"),
    (get_vector(0x2600, 10, 2), "7E 00 15 05 26 00 00 28 08 52 95 7E"),
]
REPLIES = [
    (Frame(0x01, b"MRE2"), "7E 00 01 04 4D 52 45 32 F5 E9 7E"),
    (Frame(0x02, int_cell(0x11)), "7E 00 02 04 00 00 00 11 30 2E 7E"),
    (acknowledge(0x06), "7E 00 06 00 03 A0 7E"),
    (acknowledge(0x10), "7E 00 10 00 0D C0 7E"),
    (Frame(0x11, int_cell(300)), "7E 00 11 04 00 00 01 2C F2 CC 7E"),
    (acknowledge(0x12), "7E 00 12 00 0C A0 7E"),
    (values_reply([HALF, MINUS_QUARTER]), "7E 00 13 0A 00 02 3F 00 00 00 BE 80 00 00 9B D7 7E"),
    (acknowledge(0x14), "7E 00 14 00 0F 00 7E"),
    (Frame(0x15, HALF + MINUS_QUARTER), "7E 00 15 08 3F 00 00 00 BE 80 00 00 10 D1 7E"),
    (refuse(0x11, ErrorCode.FRAME_INVALID), "7E 00 91 04 00 00 00 01 2C 81 7E"),
    (refuse(0x11, ErrorCode.LENGTH_MISMATCH), "7E 00 91 04 00 00 00 03 AD 40 7E"),
    (refuse(0x11, ErrorCode.CRC_WRONG), "7E 00 91 04 00 00 00 04 EC 82 7E"),
    (refuse(0x11, ErrorCode.NO_REGISTER), "7E 00 91 04 00 00 01 01 2D 11 7E"),
    (refuse(0x10, ErrorCode.OUT_OF_RANGE), "7E 00 90 04 00 00 01 03 AD 01 7E"),
    (refuse(0x10, ErrorCode.READ_ONLY), "7E 00 90 04 00 00 01 06 6D 02 7E"),
    (refuse(0x14, ErrorCode.VECTOR_INDEX), "7E 00 94 04 00 00 01 07 AD 46 7E"),
    (refuse(0x12, ErrorCode.CHAIN), "7E 00 92 04 00 00 02 03 AC 13 7E"),
]
cells = st.binary(min_size=4, max_size=4)


@pytest.mark.parametrize(("frame", "data"), [*REQUESTS, *REPLIES])
def test_forms_are_these_bytes(frame: Frame, data: str):
    """Every request and reply is these bytes, and these bytes are it."""
    assert encode(frame) == bytes.fromhex(data)
    assert FrameReader().feed(bytes.fromhex(data)) == [frame]


@given(
    st.dictionaries(
        st.integers(0, 0xFFFF), st.one_of(st.floats(width=32), st.integers(0, 2**32 - 1)), min_size=1, max_size=8
    )
)
def test_registers_come_back(values: dict[int, float | int]):
    """What is set in several registers is what the device reads, in order."""
    found = read_registers(set_values(values).payload, with_cells=True)
    assert found == [(register, to_cell(value)) for register, value in values.items()]
    assert read_registers(get_values(list(values)).payload, with_cells=False) == [(one, b"") for one in values]
    assert read_values(values_reply([cell for _, cell in found]).payload) == [cell for _, cell in found]


@given(st.integers(0, 16000), st.lists(cells, min_size=1, max_size=10))
def test_vectors_come_back(start: int, held: list[bytes]):
    """Cells of a vector are addressed in bytes, and come back."""
    data = b"".join(held)
    assert read_vector(set_vector(0x2600, start, data).payload) == (0x2600, 4 * start, 4 * len(held), data)
    assert read_vector(get_vector(0x2600, start, len(held)).payload) == (0x2600, 4 * start, 4 * len(held), b"")
    assert split_cells(data) == held


@given(st.floats(width=32, allow_nan=False), st.integers(-(2**31), 2**32 - 1))
def test_cells_come_back(number: float, whole: int):
    """A float32 and an integer of 32 bits pass through a cell."""
    assert cell_float(float_cell(number)) == number
    assert cell_int(int_cell(whole)) == whole % 2**32


def test_one_register_comes_back():
    """A request for one register holds its id, and its cell where it is set."""
    assert read_register(get_value(0x680A).payload) == (0x680A, b"")
    assert read_register(set_value(0x5002, 0.5).payload) == (0x5002, HALF)


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: float_cell(1e39), "fits a float32, got 1e"),
        (lambda: int_cell(2**32), "32 bits, got 4294967296"),
        (lambda: get_values([]), "1 to 8 registers, got 0"),
        (lambda: get_values(list(range(9))), "1 to 8 registers, got 9; send several"),
        (lambda: get_vector(0x2600, -1, 2), "got 2 from -1"),
        (lambda: get_vector(0x2600, 16383, 2), "got 2 from 16383"),
        (lambda: read_register(b"\x00"), "2 or 6 bytes, got 1"),
        (lambda: read_registers(b"\x00\x02\x11", with_cells=False), "expected 6 bytes for 2 registers, got 3"),
        (lambda: read_values(b"\x00\x02\x11"), "expected 10 bytes for 2 values, got 3"),
        (lambda: read_vector(b"\x26"), "5 bytes or more, got 1"),
        (lambda: split_cells(b"12345"), "whole cells of 4 bytes, got 5"),
        (lambda: cell_int(b"123"), "expected 4 bytes for a cell, got 3"),
    ],
)
def test_what_does_not_fit_is_refused(make, match):
    """Numbers and lengths that no payload has are refused, with what was expected."""
    with pytest.raises(ShapeError, match=match):
        make()
