"""Lines of the mirror controller's simple mode: ASCII, CR LF behind each, at most 64 bytes, in either case."""

from __future__ import annotations

import re
from enum import StrEnum

from pipeline.errors import RigError, ShapeError
from pipeline.rig.device_errors import DeviceRefused
from pipeline.rig.mirror.registers import Status

END = b"\r\n"
MOST_LINE = 64  # bytes, with the end

START, STATUS, ACKNOWLEDGE, RESET = "START", "STATUS", "ACKNOWLEDGE", "RESET"
TEMPERATURE, ID, VERSION, SERIAL = "GETTEMP", "GETID", "GETVERSION", "GETSN"
GO_PRO, GO_PRO_CRC = "GOPRO", "GOPROCRC"


class Answer(StrEnum):
    """Replies to requests that ask for nothing but to be done."""

    OK = "OK"
    NO = "NO"
    BELOW = "OL"
    ABOVE = "OU"
    ERROR = "ERROR"


_WORDS = {
    Answer.NO: "it does not know the request, or not now",
    Answer.BELOW: "a value lies below the range and was set to its end",
    Answer.ABOVE: "a value lies above the range and was set to its end",
    Answer.ERROR: "an error on the device",
}


def to_line(request: str) -> bytes:
    """Give the bytes of a request.

    Raises
    ------
    ShapeError : the request is not ASCII, is empty, has an end of its own, or is too long.
    """
    if not request.isascii() or not request or any(character in request for character in "\r\n"):
        raise ShapeError(f"expected one line of ASCII, got {request!r}")
    line = request.encode("ascii") + END
    if len(line) > MOST_LINE:
        raise ShapeError(f"the controller takes lines of {MOST_LINE} bytes, got {len(line)}: {request!r}")
    return line


def go_x(x: float) -> str:
    """Request for a new X."""
    return f"X={x:.6f}"


def go_y(y: float) -> str:
    """Request for a new Y."""
    return f"Y={y:.6f}"


def go_xy(x: float, y: float) -> str:
    """Request for a new position, to 6 decimals as the protocol has it."""
    return f"XY={x:.6f};{y:.6f}"


class LineReader:
    """Finds lines in a stream, however it is cut."""

    def __init__(self) -> None:
        self._held = b""

    def feed(self, data: bytes) -> list[bytes]:
        """Take bytes and give the lines that they complete, without their ends; empty lines are left out."""
        *lines, self._held = (self._held + data).split(b"\n")
        return [line for line in (line.rstrip(b"\r") for line in lines) if line]

    @property
    def waiting(self) -> bytes:
        """Bytes that came and are not a line yet."""
        return self._held


def check_done(line: bytes, request: str, port: str) -> None:
    """Accept the reply OK and nothing else.

    Raises
    ------
    DeviceRefused : the device said that it did not, or that it did something else.
    RigError : the reply is none of those that the protocol has.
    """
    text = line.decode("ascii", "backslashreplace").strip()
    if text.upper() not in Answer.__members__.values():
        raise RigError(f"expected OK to {request} from {port}, got {text!r}; is this the mirror controller?")
    answer = Answer(text.upper())
    if answer is not Answer.OK:
        raise DeviceRefused(f"the mirror controller on {port} answered {answer} to {request}: {_WORDS[answer]}")


def read_text(line: bytes, request: str, port: str) -> str:
    """Read a reply that is text of the device's own, such as its id.

    Raises
    ------
    DeviceRefused : the device does not know the request.
    RigError : the reply is not text.
    """
    text = line.decode("ascii", "backslashreplace").strip()
    if not re.fullmatch(r"[ -~]+", text) or "\\x" in text:
        raise RigError(f"expected text to {request} from {port}, got {line!r}; is the port's speed right?")
    if text.upper() in (Answer.NO, Answer.ERROR):
        check_done(line, request, port)
    return text


def read_status(line: bytes, port: str) -> Status:
    """Read the 32 status bits, in hexadecimal with or without 0x before them.

    Raises
    ------
    DeviceRefused : the device said that it did not.
    RigError : the reply is not such a number.
    """
    text = read_text(line, STATUS, port)
    if not re.fullmatch(r"(0[xX])?[0-9a-fA-F]{1,8}", text):
        raise RigError(f"expected up to 8 hexadecimal digits to {STATUS} from {port}, got {text!r}")
    return Status(int(text, 16))


def read_temperature(line: bytes, port: str) -> float:
    """Read a temperature. [deg C]

    Raises
    ------
    DeviceRefused : the device said that it did not.
    RigError : the reply is not a number.
    """
    text = read_text(line, TEMPERATURE, port)
    found = re.fullmatch(r"([-+]?\d+(\.\d*)?)( ?C)?", text)
    if found is None:
        raise RigError(f"expected a temperature to {TEMPERATURE} from {port}, got {text!r}")
    return float(found[1])
