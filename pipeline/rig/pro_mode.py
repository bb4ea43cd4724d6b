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

import logging
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntFlag
from functools import cache

from spectralzoom.pipeline.errors import ShapeError

LOG = logging.getLogger(__name__)
TURNED = 0x20  # the bit that an escape inverts
MOST_PAYLOAD = 50
_HEAD, _CRC = 3, 2  # bytes: address, command, size; and the check behind the payload
_TOO_LONG = 2 * (_HEAD + MOST_PAYLOAD + _CRC) + 1  # bytes between boundaries: a frame has fewer, every byte escaped
ERROR_FLAG = 0x80  # command of a reply that says no


STATUS, SET_MODE, SET_VALUES, SET_VECTOR, GET_VECTOR = 0x02, 0x06, 0x12, 0x14, 0x15  # commands of frames
_REASONS = {  # of a refusal, by the code of the first in a row
    0x0001: ("frame invalid", "command unknown", "length mismatch", "CRC wrong", "not implemented"),
    0x0101: (
        *("no register", "write failed", "out of range", "register invalid", "read failed", "read only"),
        *("vector index", "vector alignment", "locked", "not readable"),
    ),
    0x0201: ("no system", "system not selectable", "chain"),
}


def format_error(code: int) -> str:
    """Return the reason of a refusal by its code, with the code."""
    reasons = {first + number: one for first, row in _REASONS.items() for number, one in enumerate(row)}
    return f"{reasons.get(code, 'unknown error')} (code {code:04X})"


@dataclass(frozen=True)
class Frame:
    """One frame. ``crc_good`` is the finding of a reader; comparisons ignore it."""

    command: int
    payload: bytes = b""
    address: int = 0
    crc_good: bool = field(default=True, compare=False)


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
        self._held = b""  # behind the last boundary

    def feed(self, data: bytes) -> list[Frame]:
        """Take bytes; return the frames that they complete. A line in the log names bytes that form none."""
        *ended, held = (self._held + data).split(b"\x7e")
        self._held = held[:_TOO_LONG]
        found = (_read_frame(part[:_TOO_LONG]) for part in ended if part)
        return [frame for frame in found if frame is not None]


def _read_frame(data: bytes) -> Frame | None:
    """Read the bytes between two boundaries; None where they form no frame."""
    first, *rest = data.split(b"\x7d")
    plain = first + b"".join(bytes((part[0] ^ TURNED,)) + part[1:] for part in rest if part)
    size = len(plain) - _HEAD - _CRC
    escaped = all(part[:1] in (b"\x5d", b"\x5e") for part in rest)
    if not escaped or not 0 <= size <= MOST_PAYLOAD or plain[2] != size:
        LOG.info("bytes that form no frame: %s", data.hex(" "))
        return None
    body, check = plain[:-_CRC], int.from_bytes(plain[-_CRC:], "little")
    return Frame(body[1], body[_HEAD:], body[0], crc_good=crc_arc(body) == check)


CELL = 4  # bytes
VECTOR_CELLS = 10  # in one frame, as the public software does; 11 would fit
ASK_STATUS = Frame(STATUS, b"\x00\x00")  # without an argument; the reply is one cell
GO_SIMPLE = Frame(SET_MODE, b"\x00\x00")  # simple mode is communication mode 0

Value = float | int


def cell_int(cell: bytes) -> int:
    """Read a cell as an unsigned integer; ShapeError where it is no cell."""
    return int.from_bytes(checked(cell, CELL), "big")


def set_values(values: Mapping[int, Value]) -> Frame:
    """Return a request that sets 1 to 8 registers at once: integers as such, floats as float32."""
    cells = (struct.pack(">I" if isinstance(value, int) else ">f", value) for value in values.values())
    return Frame(SET_VALUES, struct.pack(f">{1 + len(values)}H", len(values), *values) + b"".join(cells))


def get_vector(register: int, start: int, count: int) -> Frame:
    """Return a request for the cells ``start`` to ``start + count`` of a vector; the reply is the cells."""
    return Frame(GET_VECTOR, struct.pack(">HHB", register, start * CELL, count * CELL))


def set_vector(register: int, start: int, cells: bytes) -> Frame:
    """Return a request that sets the cells of a vector from ``start`` on."""
    return Frame(SET_VECTOR, struct.pack(">HHB", register, start * CELL, len(cells)) + cells)


def checked(data: bytes, size: int) -> bytes:
    """Return bytes of that size; ShapeError where they have another."""
    if len(data) != size:
        raise ShapeError(f"expected {size} bytes, got {len(data)}")
    return data


VECTOR_MEMORY = 0x2600  # one vector, shared by the channels
TRIGGER_OFF = 0  # of the trigger input: the path runs by the device's own clock
UNIT_XY = 2  # of an input's numbers: positions on the disk


class Status(IntFlag):
    """Status bits. The ``WAS`` bits stay on until they are acknowledged."""

    DISCONNECTED = 1 << 0  # the mirror head
    ELECTRONICS_WARM = 1 << 1  # of the mirror head
    MIRROR_WARM = 1 << 2
    EEPROM_INVALID = 1 << 3  # the mirror's own calibration
    NOT_STABLE = 1 << 4  # not at rest
    OUTPUT_LIMIT = 1 << 5  # of the drive
    AVERAGE_LIMIT = 1 << 6
    TRIMMED = 1 << 7  # a target was beyond the rim
    WAS_DISCONNECTED = 1 << 8
    WAS_ELECTRONICS_WARM = 1 << 9
    WAS_MIRROR_WARM = 1 << 10
    WAS_OUTPUT_LIMIT = 1 << 11
    WAS_AVERAGE_LIMIT = 1 << 12
    WAS_TRIMMED = 1 << 13

    @property
    def sentence(self) -> str:
        """The number and the names of the known bits, for messages."""
        names = ", ".join(str(bit.name).lower().replace("_", " ") for bit in Status if bit in self)
        return f"status {int(self):08X}: {names or 'no known bit'}"

    @property
    def stops_motion(self) -> bool:
        """Return whether a bit is on with which the mirror does not go where it is sent."""
        return bool(self & _STOPS)


_STOPS = Status.DISCONNECTED | Status.ELECTRONICS_WARM | Status.MIRROR_WARM | Status.EEPROM_INVALID


class ChannelRegisters:
    """Registers of one channel, and the values that make it follow an input, controlled by position."""

    def __init__(self, channel: int) -> None:
        held, vector = 0x50 + channel, 0x68 + channel  # systems: a held position, and the player of the vector memory
        control = {0x4002 + 5 * channel: 0xC0 + channel}
        self.hold: dict[int, Value] = {**control, 0x4000 + 5 * channel: held}
        self.play: dict[int, Value] = {**control, 0x4000 + 5 * channel: vector}
        self.static_xy = held << 8 | UNIT_XY  # held position, float
        self.unit, self.run, self.start, self.end, self.frequency = (vector << 8 | number for number in range(5))
        self.cycles, self.trigger = vector << 8 | 7, vector << 8 | 8


X, Y = ChannelRegisters(0), ChannelRegisters(1)
