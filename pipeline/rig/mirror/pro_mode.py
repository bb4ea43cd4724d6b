"""Frames of the mirror controller's pro mode: bytes to frames and back, their payloads, and the registers.

A frame is ``7E | address 00 | command | size | payload | CRC, low byte first | 7E``. Between the boundaries 7D and 7E
are sent as 7D and the byte with bit 5 inverted. The CRC is CRC-16/ARC over address to payload. It fits the one
documented frame (``00 11 04 00 00 00 00 | F2 81``) and is not confirmed on hardware, so a reader only reports whether
it fits.

Numbers in payloads are big-endian. A register's id takes two bytes, its cell four: a float32 or an integer. Several
registers go as their count, all ids, then all cells. A vector's cells are addressed by register, offset in BYTES and
length in bytes. Requests without an argument carry 00 00. Layouts are those of the controller's public software, which
does not document the payload of an acknowledgement; it is assumed to be empty.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum, IntFlag
from functools import cache

from pipeline.errors import ShapeError

BOUNDARY, TURNED = 0x7E, 0x20
MOST_PAYLOAD = 50
_HEAD, _CRC = 3, 2  # bytes: address, command, size; and the check behind the payload
_LONGEST = 2 * (_HEAD + MOST_PAYLOAD + _CRC)  # between boundaries, every byte escaped
ERROR_FLAG = 0x80  # command of a reply that says no


class Command(IntEnum):
    """Commands of frames."""

    STATUS = 0x02
    SET_MODE = 0x06
    GET_VALUE = 0x11
    SET_VALUES = 0x12
    GET_VALUES = 0x13
    SET_VECTOR = 0x14
    GET_VECTOR = 0x15


class ErrorCode(IntEnum):
    """Reasons of the device for refusing a request, with a text for messages."""

    words: str

    FRAME_INVALID = 0x0001, "the frame is not valid"
    COMMAND_UNKNOWN = 0x0002, "the command is unknown"
    LENGTH_MISMATCH = 0x0003, "the length does not fit the command"
    CRC_WRONG = 0x0004, "the CRC is wrong"
    NOT_IMPLEMENTED = 0x0005, "the command is not implemented"
    NO_REGISTER = 0x0101, "there is no such register"
    WRITE_FAILED = 0x0102, "the register could not be written"
    OUT_OF_RANGE = 0x0103, "the value is out of the register's range"
    REGISTER_INVALID = 0x0104, "the register is not valid here"
    READ_FAILED = 0x0105, "the register could not be read"
    READ_ONLY = 0x0106, "the register can only be read"
    VECTOR_INDEX = 0x0107, "the index lies outside the vector"
    VECTOR_ALIGNMENT = 0x0108, "the index does not begin a cell of the vector"
    LOCKED = 0x0109, "the register is locked"
    NOT_READABLE = 0x010A, "the register cannot be read"
    NO_SYSTEM = 0x0201, "there is no such system"
    SYSTEM_NOT_SELECTABLE = 0x0202, "the system cannot be chosen here"
    CHAIN = 0x0203, "the systems do not make a chain from input to output"

    def __new__(cls, code: int, words: str) -> ErrorCode:
        error = int.__new__(cls, code)
        error._value_, error.words = code, words
        return error


def format_error(code: int) -> str:
    """Return the text of an error code, with its number."""
    known = {error.value: error.words for error in ErrorCode}
    return f"{known.get(code, 'unknown error')} (code {code:04X})"


@dataclass(frozen=True)
class Frame:
    """One frame. ``crc_good`` is the finding of a reader; comparisons ignore it."""

    command: int
    payload: bytes = b""
    address: int = 0
    crc_good: bool = field(default=True, compare=False)


@dataclass(frozen=True)
class Damaged:
    """Bytes between two boundaries that form no frame, and the reason."""

    reason: str
    data: bytes


@cache
def _crc_step(value: int) -> int:
    for _ in range(8):
        value = value >> 1 ^ (0xA001 if value & 1 else 0)
    return value


def crc_arc(data: bytes) -> int:
    """Return the CRC-16/ARC of bytes: polynomial 8005 reflected, initial value 0."""
    crc = 0
    for byte in data:
        crc = crc >> 8 ^ _crc_step((crc ^ byte) & 0xFF)
    return crc


def encode(frame: Frame, *, with_crc: bool = True) -> bytes:
    """Return the bytes of a frame with boundaries and escapes; without a CRC its two bytes are 00 00.

    Raises ShapeError: the payload is too long.
    """
    if len(frame.payload) > MOST_PAYLOAD:
        raise ShapeError(f"a frame carries at most {MOST_PAYLOAD} bytes, got {len(frame.payload)}; send several")
    body = bytes((frame.address, frame.command, len(frame.payload))) + frame.payload
    body += (crc_arc(body) if with_crc else 0).to_bytes(_CRC, "little")
    body = body.replace(b"\x7d", b"\x7d\x5d").replace(b"\x7e", b"\x7d\x5e")
    return b"\x7e" + body + b"\x7e"


class FrameReader:
    """Finds frames in a stream that may be cut anywhere.

    Every boundary ends the bytes before it and begins a frame, so a damaged frame never costs the next one.
    """

    def __init__(self) -> None:
        self._held = bytearray()
        self._begun = False  # whether a boundary came before the held bytes

    def feed(self, data: bytes) -> list[Frame | Damaged]:
        """Take bytes; return the frames and the damaged frames that they complete."""
        found: list[Frame | Damaged] = []
        for byte in data:
            if byte == BOUNDARY:
                if self._held:
                    found.append(self._read())
                self._begun = True
            else:
                self._held.append(byte)
                if len(self._held) > _LONGEST:
                    found.append(self._drop(f"more than {_LONGEST} bytes without a boundary"))
        return found

    def _read(self) -> Frame | Damaged:
        if not self._begun:
            return self._drop("bytes that no boundary begins")
        first, *rest = bytes(self._held).split(b"\x7d")
        if any(part[:1] not in (b"\x5d", b"\x5e") for part in rest):
            return self._drop("an escape that escapes nothing")
        plain = first + b"".join(bytes((part[0] ^ TURNED,)) + part[1:] for part in rest)
        if len(plain) < _HEAD + _CRC:
            return self._drop(f"{len(plain)} bytes, where a frame has at least {_HEAD + _CRC}")
        if plain[2] != len(plain) - _HEAD - _CRC:
            return self._drop(f"a size of {plain[2]} over a payload of {len(plain) - _HEAD - _CRC} bytes")
        if plain[2] > MOST_PAYLOAD:
            return self._drop(f"a payload of {plain[2]} bytes, above {MOST_PAYLOAD}")
        self._held.clear()
        body, check = plain[:-_CRC], int.from_bytes(plain[-_CRC:], "little")
        return Frame(body[1], body[_HEAD:], body[0], crc_good=crc_arc(body) == check)

    def _drop(self, reason: str) -> Damaged:
        damaged = Damaged(reason, bytes(self._held))
        self._held.clear()
        self._begun = False
        return damaged


CELL = 4  # bytes
VECTOR_CELLS = 10  # in one frame, as the public software does; 11 would fit
_NO_ARGUMENT = b"\x00\x00"

Value = float | int


def float_cell(value: float) -> bytes:
    """Return the cell of a float32."""
    return struct.pack(">f", value)


def int_cell(value: int) -> bytes:
    """Return the cell of a signed or unsigned integer of 32 bits."""
    return (value & 0xFFFFFFFF).to_bytes(CELL, "big")


def cell_float(cell: bytes) -> float:
    """Read a cell as a float32; ShapeError where it is no cell, here and below."""
    return float(struct.unpack(">f", _checked(cell, CELL))[0])


def cell_int(cell: bytes) -> int:
    """Read a cell as an unsigned integer."""
    return int.from_bytes(_checked(cell, CELL), "big")


def ask_status() -> Frame:
    """Return a request for the status bits; the reply is one cell."""
    return Frame(Command.STATUS, _NO_ARGUMENT)


def go_simple() -> Frame:
    """Return a request for simple mode, which is communication mode 0."""
    return Frame(Command.SET_MODE, _NO_ARGUMENT)


def get_value(register: int) -> Frame:
    """Return a request for a register; the reply is its cell."""
    return Frame(Command.GET_VALUE, count_bytes(register))


def get_values(registers: Sequence[int]) -> Frame:
    """Return a request for 1 to 8 registers; the reply is their count and their cells."""
    return Frame(Command.GET_VALUES, count_bytes(len(registers)) + b"".join(map(count_bytes, registers)))


def set_values(values: Mapping[int, Value]) -> Frame:
    """Return a request that sets 1 to 8 registers at once: integers as such, floats as float32."""
    cells = (int_cell(value) if isinstance(value, int) else float_cell(value) for value in values.values())
    return Frame(Command.SET_VALUES, count_bytes(len(values)) + b"".join([*map(count_bytes, values), *cells]))


def get_vector(register: int, start: int, count: int) -> Frame:
    """Return a request for the cells ``start`` to ``start + count`` of a vector; the reply is the cells."""
    return Frame(Command.GET_VECTOR, struct.pack(">HHB", register, start * CELL, count * CELL))


def set_vector(register: int, start: int, cells: bytes) -> Frame:
    """Return a request that sets the cells of a vector from ``start`` on."""
    return Frame(Command.SET_VECTOR, struct.pack(">HHB", register, start * CELL, len(cells)) + cells)


def refuse(command: int, code: int) -> Frame:
    """Return the device's reply that refuses a command."""
    return Frame(command | ERROR_FLAG, int_cell(code))


def count_bytes(number: int) -> bytes:
    """Return the two bytes of a count or of a register's id."""
    return number.to_bytes(2, "big")


def read_registers(payload: bytes, *, with_cells: bool) -> dict[int, bytes]:
    """Read the registers of a request, each with its cell, or with no bytes where only ids came."""
    count = int.from_bytes(payload[:2], "big")
    _checked(payload, 2 + count * (2 + CELL * with_cells))
    if not count:
        raise ShapeError("expected one register or more, got none")
    ids = [int.from_bytes(payload[at : at + 2], "big") for at in range(2, 2 + 2 * count, 2)]
    cells = split_cells(payload[2 + 2 * count :]) if with_cells else [b""] * count
    return dict(zip(ids, cells, strict=True))


def read_values(payload: bytes) -> list[bytes]:
    """Read the cells of a reply with several registers."""
    return split_cells(_checked(payload, 2 + CELL * int.from_bytes(payload[:2], "big"))[2:])


def read_vector(payload: bytes) -> tuple[int, int, int, bytes]:
    """Read a request for cells of a vector: register, offset and length in bytes, and the cells, if any."""
    if len(payload) < 5:
        raise ShapeError(f"expected a register, an offset and a length, 5 bytes or more, got {len(payload)}")
    register, offset, length = struct.unpack(">HHB", payload[:5])
    return register, offset, length, payload[5:]


def split_cells(data: bytes) -> list[bytes]:
    """Cut bytes into cells."""
    return [_checked(data[at : at + CELL], CELL) for at in range(0, len(data), CELL)]


def _checked(data: bytes, size: int) -> bytes:
    if len(data) != size:
        raise ShapeError(f"expected {size} bytes, got {len(data)}")
    return data


FEEDBACK_X, FEEDBACK_Y = 0x2302, 0x2303
LOG_SLOTS = 6
LOG_RUN, LOG_RATE = 0x2410, 0x2411
VECTOR_MEMORY = 0x2600  # one vector, shared by the channels


class Unit(IntEnum):
    """Units of an input's numbers."""

    CURRENT = 0
    FEEDBACK = 1
    XY = 2


class Trigger(IntEnum):
    """Edges at the trigger input that step through the vector memory (1, both edges, is not used)."""

    OFF = 0
    RISING_EDGE = 2


class Status(IntFlag):
    """Status bits with their texts. The ``WAS`` bits stay on until they are acknowledged."""

    text: str

    DISCONNECTED = 1 << 0, "the mirror head is not connected"
    ELECTRONICS_WARM = 1 << 1, "the mirror head's electronics are too warm"
    MIRROR_WARM = 1 << 2, "the mirror is too warm"
    EEPROM_INVALID = 1 << 3, "the mirror's own calibration cannot be read"
    NOT_STABLE = 1 << 4, "the mirror is not at rest"
    OUTPUT_LIMIT = 1 << 5, "the drive is at its limit"
    AVERAGE_LIMIT = 1 << 6, "the drive's average is at its limit"
    TRIMMED = 1 << 7, "a target was beyond the rim, and was trimmed to it"
    WAS_DISCONNECTED = 1 << 8, "the mirror head was not connected (since the last acknowledgement)"
    WAS_ELECTRONICS_WARM = 1 << 9, "the mirror head's electronics were too warm (since the last acknowledgement)"
    WAS_MIRROR_WARM = 1 << 10, "the mirror was too warm (since the last acknowledgement)"
    WAS_OUTPUT_LIMIT = 1 << 11, "the drive was at its limit (since the last acknowledgement)"
    WAS_AVERAGE_LIMIT = 1 << 12, "the drive's average was at its limit (since the last acknowledgement)"
    WAS_TRIMMED = 1 << 13, "a target was trimmed to the rim (since the last acknowledgement)"

    def __new__(cls, bit: int, text: str = "") -> Status:
        status = int.__new__(cls, bit)
        status._value_, status.text = bit, text
        return status

    @property
    def sentence(self) -> str:
        """The bits and their texts, for messages; unknown bits by their number."""
        texts = [bit.text for bit in Status if bit in self]
        rest = int(self) & ~sum(Status)
        texts += [f"unknown bit {place}" for place in range(32) if rest >> place & 1]
        return f"status {int(self):08X}: {'; '.join(texts) or 'no error'}"

    @property
    def stops_motion(self) -> bool:
        """Return whether a bit is on with which the mirror does not go where it is sent."""
        return bool(self & _STOPS)


_STOPS = Status.DISCONNECTED | Status.ELECTRONICS_WARM | Status.MIRROR_WARM | Status.EEPROM_INVALID


class VectorRegister(IntEnum):
    """Registers of the vector unit."""

    UNIT = 0x0
    RUN = 0x1
    START = 0x2
    END = 0x3
    FREQUENCY = 0x4  # cells per second, float
    CYCLES = 0x7  # -1 is without end
    TRIGGER = 0x8
    INDEX = 0xA  # read only


class ChannelRegisters:
    """Registers of one channel: the inputs it can follow, and which of them it follows."""

    def __init__(self, channel: int) -> None:
        self.static_system = 0x50 + channel  # of held positions
        self.vector_system = 0x68 + channel  # plays the vector memory
        self.xy_system = 0xC0 + channel  # controls position
        self.static_xy = self.static_system << 8 | Unit.XY  # held position, float
        self.input = 0x4000 + 5 * channel  # which system the channel follows
        self.control = 0x4002 + 5 * channel  # which system controls the channel

    def vector(self, register: VectorRegister) -> int:
        """Return the id of a register of the vector unit."""
        return self.vector_system << 8 | register

    def followed(self, system: int) -> dict[int, Value]:
        """Return the values that make the channel follow an input, controlled by position."""
        return {self.control: self.xy_system, self.input: system}


X, Y = ChannelRegisters(0), ChannelRegisters(1)


def log_slot(slot: int) -> int:
    """Return the id of the register that assigns a slot of the logger; the recorded vector has the same id."""
    return 0x2400 | slot
