"""Payloads of the pro mode: what requests and replies carry, built and read for driver and emulator alike.

All numbers are big-endian. A register's id takes two bytes, its cell four: a float32, or an integer. Several registers
go as their count, all ids, then all cells. A vector's cells are addressed by register, offset in BYTES and length in
bytes. Requests without an argument carry 00 00. Layouts are those of the controller's public software; what an
acknowledgement carries is not documented there, it is taken to be nothing.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence

from pipeline.errors import ShapeError
from pipeline.rig.mirror.pro_mode import ERROR_FLAG, Command, Frame

CELL = 4  # bytes
MOST_REGISTERS = 8  # in one frame: 2 + 8 * (2 + 4) bytes are 50
VECTOR_CELLS = 10  # in one frame, as the public software does; 11 would fit
_NO_ARGUMENT = b"\x00\x00"

Value = float | int


def float_cell(value: float) -> bytes:
    """Give the cell of a float32; ShapeError where the value does not fit."""
    try:
        return struct.pack(">f", value)
    except OverflowError:
        raise ShapeError(f"expected a number that fits a float32, got {value}") from None


def int_cell(value: int) -> bytes:
    """Give the cell of an integer of 32 bits, with or without a sign; ShapeError where the value does not fit."""
    if not -(2**31) <= value < 2**32:
        raise ShapeError(f"expected an integer of 32 bits, got {value}")
    return (value & 0xFFFFFFFF).to_bytes(CELL, "big")


def to_cell(value: Value) -> bytes:
    """Give the cell of a float or of an integer, by its type."""
    return int_cell(value) if isinstance(value, int) else float_cell(value)


def cell_float(cell: bytes) -> float:
    """Read a cell as a float32."""
    return float(struct.unpack(">f", _checked(cell, CELL, "a cell"))[0])


def cell_int(cell: bytes) -> int:
    """Read a cell as an integer without a sign."""
    return int.from_bytes(_checked(cell, CELL, "a cell"), "big")


def ask_firmware() -> Frame:
    """Ask for the id of the firmware."""
    return Frame(Command.FIRMWARE_ID, _NO_ARGUMENT)


def ask_status() -> Frame:
    """Ask for the status bits; the reply is one cell."""
    return Frame(Command.STATUS, _NO_ARGUMENT)


def go_simple() -> Frame:
    """Ask for simple mode, which is communication mode 0."""
    return Frame(Command.SET_MODE, _NO_ARGUMENT)


def get_value(register: int) -> Frame:
    """Ask for a register; the reply is its cell."""
    return Frame(Command.GET_VALUE, _id(register))


def set_value(register: int, value: Value) -> Frame:
    """Set a register."""
    return Frame(Command.SET_VALUE, _id(register) + to_cell(value))


def get_values(registers: Sequence[int]) -> Frame:
    """Ask for 1 to 8 registers (else ShapeError); the reply is their count and their cells."""
    return Frame(Command.GET_VALUES, _count(len(registers)) + b"".join(map(_id, registers)))


def set_values(values: Mapping[int, Value]) -> Frame:
    """Set 1 to 8 registers (else ShapeError) at once, in the order given."""
    ids, cells = b"".join(map(_id, values)), b"".join(map(to_cell, values.values()))
    return Frame(Command.SET_VALUES, _count(len(values)) + ids + cells)


def get_vector(register: int, start: int, count: int) -> Frame:
    """Ask for the cells ``start`` to ``start + count`` of a vector; the reply is the cells."""
    return Frame(Command.GET_VECTOR, _span(register, start, count))


def set_vector(register: int, start: int, cells: bytes) -> Frame:
    """Set the cells of a vector from ``start`` on."""
    return Frame(Command.SET_VECTOR, _span(register, start, len(cells) // CELL) + cells)


def acknowledge(command: int) -> Frame:
    """Build the device's reply that it did something."""
    return Frame(command)


def refuse(command: int, code: int) -> Frame:
    """Build the device's reply that it did not."""
    return Frame(command | ERROR_FLAG, int_cell(code))


def values_reply(cells: Sequence[bytes]) -> Frame:
    """Build the device's reply with several registers' cells."""
    return Frame(Command.GET_VALUES, _count(len(cells)) + b"".join(cells))


def read_register(payload: bytes) -> tuple[int, bytes]:
    """Read the register that a request names, and what follows it: nothing, or its cell.

    Raises
    ------
    ShapeError : the payload has neither length. All readers here raise it where a length does not fit.
    """
    if len(payload) not in (2, 2 + CELL):
        raise ShapeError(f"expected a register's id and at most its cell, 2 or 6 bytes, got {len(payload)}")
    return int.from_bytes(payload[:2], "big"), payload[2:]


def read_registers(payload: bytes, *, with_cells: bool) -> list[tuple[int, bytes]]:
    """Read the registers that a request names, each with its cell, or with nothing where only ids came."""
    count = int.from_bytes(payload[:2], "big")
    _checked(payload, 2 + count * (2 + CELL * with_cells), f"{count} registers")
    ids = [int.from_bytes(payload[at : at + 2], "big") for at in range(2, 2 + 2 * count, 2)]
    cells = split_cells(payload[2 + 2 * count :]) if with_cells else [b""] * count
    return list(zip(ids, cells, strict=True))


def read_values(payload: bytes) -> list[bytes]:
    """Read the cells of a reply with several registers."""
    count = int.from_bytes(payload[:2], "big")
    return split_cells(_checked(payload, 2 + CELL * count, f"{count} values")[2:])


def read_vector(payload: bytes) -> tuple[int, int, int, bytes]:
    """Read a request for cells of a vector: register, offset and length in bytes, and the cells, if they came."""
    if len(payload) < 5:
        raise ShapeError(f"expected a register, an offset and a length, 5 bytes or more, got {len(payload)}")
    register, offset, length = struct.unpack(">HHB", payload[:5])
    return register, offset, length, payload[5:]


def split_cells(data: bytes) -> list[bytes]:
    """Cut bytes into cells."""
    if len(data) % CELL:
        raise ShapeError(f"expected whole cells of {CELL} bytes, got {len(data)} bytes")
    return [data[at : at + CELL] for at in range(0, len(data), CELL)]


def _id(register: int) -> bytes:
    return register.to_bytes(2, "big")


def _count(registers: int) -> bytes:
    if not 1 <= registers <= MOST_REGISTERS:
        raise ShapeError(f"a frame takes 1 to {MOST_REGISTERS} registers, got {registers}; send several frames")
    return registers.to_bytes(2, "big")


def _span(register: int, start: int, count: int) -> bytes:
    if start < 0 or count < 1 or (start + count) * CELL > 0xFFFF:
        raise ShapeError(f"expected cells of a vector from 0 on, at least one, got {count} from {start}")
    return struct.pack(">HHB", register, start * CELL, count * CELL)


def _checked(data: bytes, size: int, what: str) -> bytes:
    if len(data) != size:
        raise ShapeError(f"expected {size} bytes for {what}, got {len(data)}")
    return data
