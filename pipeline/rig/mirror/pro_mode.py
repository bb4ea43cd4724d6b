"""Frames of the mirror controller's pro mode: bytes to frames and back. What their payloads mean: `pro_payloads`.

A frame is ``7E | address 00 | command | size | payload | CRC, low byte first | 7E``; 7D and 7E between the boundaries
are sent as 7D and the byte with bit 5 turned. The CRC is CRC-16/ARC over address to payload. It fits the one documented
frame (``00 11 04 00 00 00 00 | F2 81``) and is not confirmed on hardware, so a reader only says whether it fits. That
it begins at 0 leaves open whether the address counts; as the address is 0, either way gives the same CRC.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum

from pipeline.errors import ShapeError

BOUNDARY, TURNED = 0x7E, 0x20
MOST_PAYLOAD = 50
_HEAD, _CRC = 3, 2  # bytes: address, command, size; and the check behind the payload
_LONGEST = 2 * (_HEAD + MOST_PAYLOAD + _CRC)  # between boundaries, every byte escaped
ERROR_FLAG = 0x80  # command of a reply that says no


class Command(IntEnum):
    """What a frame asks for."""

    FIRMWARE_ID = 0x01
    STATUS = 0x02
    SET_MODE = 0x06
    SET_VALUE = 0x10
    GET_VALUE = 0x11
    SET_VALUES = 0x12
    GET_VALUES = 0x13
    SET_VECTOR = 0x14
    GET_VECTOR = 0x15


class ErrorCode(IntEnum):
    """Why the device says no."""

    FRAME_INVALID = 0x0001
    COMMAND_UNKNOWN = 0x0002
    LENGTH_MISMATCH = 0x0003
    CRC_WRONG = 0x0004
    NOT_IMPLEMENTED = 0x0005
    NO_REGISTER = 0x0101
    WRITE_FAILED = 0x0102
    OUT_OF_RANGE = 0x0103
    REGISTER_INVALID = 0x0104
    READ_FAILED = 0x0105
    READ_ONLY = 0x0106
    VECTOR_INDEX = 0x0107
    VECTOR_ALIGNMENT = 0x0108
    LOCKED = 0x0109
    NOT_READABLE = 0x010A
    NO_SYSTEM = 0x0201
    SYSTEM_NOT_SELECTABLE = 0x0202
    CHAIN = 0x0203


_WORDS = {
    ErrorCode.FRAME_INVALID: "the frame is not valid",
    ErrorCode.COMMAND_UNKNOWN: "the command is unknown",
    ErrorCode.LENGTH_MISMATCH: "the length does not fit the command",
    ErrorCode.CRC_WRONG: "the CRC is wrong",
    ErrorCode.NOT_IMPLEMENTED: "the command is not implemented",
    ErrorCode.NO_REGISTER: "there is no such register",
    ErrorCode.WRITE_FAILED: "the register could not be written",
    ErrorCode.OUT_OF_RANGE: "the value is out of the register's range",
    ErrorCode.REGISTER_INVALID: "the register is not valid here",
    ErrorCode.READ_FAILED: "the register could not be read",
    ErrorCode.READ_ONLY: "the register can only be read",
    ErrorCode.VECTOR_INDEX: "the index lies outside the vector",
    ErrorCode.VECTOR_ALIGNMENT: "the index does not begin a cell of the vector",
    ErrorCode.LOCKED: "the register is locked",
    ErrorCode.NOT_READABLE: "the register cannot be read",
    ErrorCode.NO_SYSTEM: "there is no such system",
    ErrorCode.SYSTEM_NOT_SELECTABLE: "the system cannot be chosen here",
    ErrorCode.CHAIN: "the systems do not make a chain from input to output",
}


def error_words(code: int) -> str:
    """Say an error code of the device in words, with its number."""
    known = code in ErrorCode.__members__.values()
    return f"{_WORDS[ErrorCode(code)] if known else 'an error that this driver does not know'} (code {code:04X})"


@dataclass(frozen=True)
class Frame:
    """One frame. ``crc_good`` is what a reader found; it does not count when frames are compared."""

    command: int
    payload: bytes = b""
    address: int = 0
    crc_good: bool = field(default=True, compare=False)


@dataclass(frozen=True)
class Damaged:
    """Bytes between two boundaries that are no frame, as they came, and why."""

    reason: str
    data: bytes


def _table() -> tuple[int, ...]:
    table = []
    for value in range(256):
        for _ in range(8):
            value = value >> 1 ^ (0xA001 if value & 1 else 0)
        table.append(value)
    return tuple(table)


_TABLE = _table()


def crc_arc(data: bytes) -> int:
    """Give the CRC-16/ARC of bytes: polynomial 8005 reflected, beginning at 0."""
    crc = 0
    for byte in data:
        crc = crc >> 8 ^ _TABLE[(crc ^ byte) & 0xFF]
    return crc


def encode(frame: Frame, *, with_crc: bool = True) -> bytes:
    """Give the bytes of a frame, boundaries and escapes included; 00 00 in the CRC's place without one.

    Raises
    ------
    ShapeError : the payload is too long, or the address or the command is no byte.
    """
    if len(frame.payload) > MOST_PAYLOAD:
        raise ShapeError(f"a frame carries at most {MOST_PAYLOAD} bytes, got {len(frame.payload)}; send several")
    if not (0 <= frame.address <= 0xFF and 0 <= frame.command <= 0xFF):
        raise ShapeError(f"expected an address and a command of one byte, got {frame.address} and {frame.command}")
    body = bytes((frame.address, frame.command, len(frame.payload))) + frame.payload
    body += (crc_arc(body) if with_crc else 0).to_bytes(_CRC, "little")
    body = body.replace(b"\x7d", b"\x7d\x5d").replace(b"\x7e", b"\x7d\x5e")
    return b"\x7e" + body + b"\x7e"


class FrameReader:
    """Finds frames in a stream, however it is cut. Every boundary ends what came before it and begins what follows.

    So a damaged frame, or rubbish between frames, never costs the frame behind it.
    """

    def __init__(self) -> None:
        self._held = bytearray()
        self._begun = False  # a boundary came before what is held

    def feed(self, data: bytes) -> list[Frame | Damaged]:
        """Take bytes and give the frames, and the bytes that are none, that they complete."""
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

    @property
    def waiting(self) -> bytes:
        """Bytes that came and are not a frame yet."""
        return bytes(self._held)

    def _read(self) -> Frame | Damaged:
        if not self._begun:
            return self._drop("bytes that no boundary begins")
        plain = _unescape(self._held)
        if plain is None:
            return self._drop("an escape that escapes nothing")
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


def _unescape(data: bytearray) -> bytes | None:
    """Undo the escapes; None where a byte behind an escape is none of the two that need one."""
    first, *rest = bytes(data).split(b"\x7d")
    if any(part[:1] not in (b"\x5d", b"\x5e") for part in rest):
        return None
    return first + b"".join(bytes((part[0] ^ TURNED,)) + part[1:] for part in rest)
