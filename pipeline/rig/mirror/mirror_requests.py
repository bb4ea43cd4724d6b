"""Requests to the mirror controller in either mode: what is sent, what is accepted as the answer, and mode changes.

Lines of simple mode are ASCII, CR LF behind each, at most 64 bytes, in either case. Frames of pro mode: `pro_mode`.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import TypeVar

from pipeline.errors import RigError, ShapeError
from pipeline.rig.mirror.pro_mode import (
    ERROR_FLAG,
    Command,
    Damaged,
    ErrorCode,
    Frame,
    FrameReader,
    ask_status,
    cell_int,
    encode,
    format_error,
    go_simple,
)
from pipeline.rig.transports import DeadlinePassed, DeviceRefused, Kind, Receiver, Wire

LOG = logging.getLogger(__name__)

END = b"\r\n"
MOST_LINE = 64  # bytes, with the end

START = "START"
TEMPERATURE, ID, VERSION, SERIAL = "GETTEMP", "GETID", "GETVERSION", "GETSN"
GO_PRO, GO_PRO_CRC = "GOPRO", "GOPROCRC"

Answer = TypeVar("Answer")


class Reply(StrEnum):
    """Replies to requests that ask for nothing but to be done."""

    OK = "OK"
    NO = "NO"
    BELOW = "OL"
    ABOVE = "OU"
    ERROR = "ERROR"


_WORDS = {
    Reply.NO: "it does not know the request, or not now",
    Reply.BELOW: "a value lies below the range and was set to its end",
    Reply.ABOVE: "a value lies above the range and was set to its end",
    Reply.ERROR: "an error on the device",
}


class LineReader:
    """Finds lines in a stream, however it is cut."""

    def __init__(self) -> None:
        self._held = b""

    def feed(self, data: bytes) -> list[bytes]:
        """Take bytes and give the lines that they complete, without their ends; empty lines are left out."""
        *lines, self._held = (self._held + data).split(b"\n")
        return [line for line in (line.rstrip(b"\r") for line in lines) if line]


def check_done(line: bytes, request: str, port: str) -> None:
    """Accept the reply OK and nothing else: DeviceRefused at any other that the protocol has, RigError at the rest."""
    text = line.decode("ascii", "backslashreplace").strip()
    if text.upper() not in Reply.__members__.values():
        raise RigError(f"expected OK to {request} from {port}, got {text!r}; is this the mirror controller?")
    reply = Reply(text.upper())
    if reply is not Reply.OK:
        raise DeviceRefused(f"the mirror controller on {port} answered {reply} to {request}: {_WORDS[reply]}")


def read_text(line: bytes, request: str, port: str) -> str:
    """Read a reply that is text of the device's own, such as its id.

    It and the reader below raise DeviceRefused where the device said no, and RigError where the reply is none.
    """
    text = line.decode("ascii", "backslashreplace").strip()
    if not re.fullmatch(r"[ -~]+", text) or "\\x" in text:
        raise RigError(f"expected text to {request} from {port}, got {line!r}; is the port's speed right?")
    if text.upper() in (Reply.NO, Reply.ERROR):
        check_done(line, request, port)
    return text


def read_temperature(line: bytes, port: str) -> float:
    """Read a temperature. [deg C]"""
    text = read_text(line, TEMPERATURE, port)
    found = re.fullmatch(r"([-+]?\d+(\.\d*)?)( ?C)?", text)
    if found is None:
        raise RigError(f"expected a temperature to {TEMPERATURE} from {port}, got {text!r}")
    return float(found[1])


@dataclass(frozen=True)
class SimpleLink:
    """Lines of simple mode over a wire.

    Requests raise DeviceRefused, DeadlinePassed or DeviceGone, one that moves the mirror StateUnknown, and RigError
    where the answer is none.
    """

    wire: Wire

    def do(self, request: str, kind: Kind) -> None:
        """Send a request that is answered by OK; going to a range's end is a refusal."""

        def done(line: bytes) -> bool:
            check_done(line, request, self.wire.port)
            return True

        self.ask(request, done, kind)

    def text(self, request: str) -> str:
        """Ask for the controller's id, version or serial number."""
        return self.ask(request, lambda line: read_text(line, request, self.wire.port))

    def temperature(self) -> float:
        """Ask for the temperature. [deg C]"""
        return self.ask(TEMPERATURE, lambda line: read_temperature(line, self.wire.port))

    def ask(self, request: str, parse: Callable[[bytes], Answer], kind: Kind = "read") -> Answer:
        """Send a request and give what ``parse`` makes of the line that answers it."""

        def receiver() -> Receiver[Answer]:
            reader = LineReader()

            def receive(data: bytes) -> Answer | None:
                lines = reader.feed(data)
                return parse(lines[0]) if lines else None

            return receive

        return self.wire.exchange(request.encode("ascii") + END, request, kind, receiver)


@dataclass(frozen=True)
class ProLink:
    """Frames of pro mode over a wire. ``with_crc`` sends and checks CRCs; ``strict_crc`` refuses those that differ.

    Requests raise DeviceRefused, DeadlinePassed or DeviceGone, and one that moves the mirror StateUnknown.
    """

    wire: Wire
    with_crc: bool = False
    strict_crc: bool = False

    def ask(self, frame: Frame, name: str, parse: Callable[[bytes], Answer]) -> Answer:
        """Send a request that only reads, again where no answer comes, and give what ``parse`` makes of the payload."""
        return self._exchange(frame, name, "read", parse)

    def tell(self, frame: Frame, name: str) -> None:
        """Send a request that sets something and moves nothing, once."""
        self._exchange(frame, name, "write", bytes)

    def move(self, frame: Frame, name: str) -> None:
        """Send a request that moves the mirror, once."""
        self._exchange(frame, name, "motion", bytes)

    def _exchange(self, frame: Frame, name: str, kind: Kind, parse: Callable[[bytes], Answer]) -> Answer:
        def receiver() -> Receiver[Answer]:
            reader = FrameReader()

            def receive(data: bytes) -> Answer | None:
                answers = (self._answer(found, frame, name, parse) for found in reader.feed(data))
                return next((answer for answer in answers if answer is not None), None)

            return receive

        return self.wire.exchange(encode(frame, with_crc=self.with_crc), name, kind, receiver)

    def _answer(
        self, found: Frame | Damaged, sent: Frame, name: str, parse: Callable[[bytes], Answer]
    ) -> Answer | None:
        """Return what a frame says to the request; None, and a line in the log, where it is no answer to it."""
        port = self.wire.port
        if isinstance(found, Damaged):
            LOG.warning("%s, while waiting for %s: %s: %s", port, name, found.reason, found.data.hex(" "))
            return None
        if self.with_crc and not found.crc_good:
            what = "refused" if self.strict_crc else "taken all the same (set strict_crc to refuse it)"
            LOG.warning("%s: the CRC of an answer to %s does not fit; %s", port, name, what)
            if self.strict_crc:
                return None
        if found.command == sent.command | ERROR_FLAG:
            try:
                code = cell_int(found.payload)
            except ShapeError:
                size = len(found.payload)
                raise RigError(f"{name}: {port} answered with an error of {size} bytes, expected 4") from None
            words = f"the mirror controller on {port} refused {name}: {format_error(code)}"
            garbled = code in (ErrorCode.FRAME_INVALID, ErrorCode.CRC_WRONG)
            raise DeviceRefused(words, code, garbled=garbled)
        if found.command != sent.command:
            # lines that were said to a controller in pro mode are complained about when a frame follows
            usual = sent.command == Command.SET_MODE and found.command & ERROR_FLAG
            level = logging.INFO if usual else logging.WARNING
            LOG.log(level, "%s, while waiting for %s: an answer to command %02X", port, name, found.command)
            return None
        try:
            return parse(found.payload)
        except ShapeError as error:
            LOG.warning("%s, while waiting for %s: an answer that does not fit: %s", port, name, error)
            return None


@dataclass(frozen=True)
class Identity:
    """Identity of a controller, as it states it; a field is empty where it does not know the request."""

    device: str
    version: str
    serial: str

    @property
    def words(self) -> str:
        """All of it, for people."""
        return f"{self.device or 'no id'}, version {self.version or 'unknown'}, serial {self.serial or 'unknown'}"


_FRAMES = {False: "frames without a CRC", True: "frames with a CRC"}


class Modes:
    """A controller whose mode is known. Between calls it is in pro mode."""

    def __init__(self, pro: ProLink) -> None:
        self.pro = pro
        self.found_in_pro = False  # at the last connect, where an earlier session had left it
        self._lines = SimpleLink(pro.wire)

    def connect(self) -> Identity:
        """Find the controller in either mode, ask what it is, and leave it in pro mode. Nothing moves.

        Raises DeadlinePassed where nothing answers in either mode, RigError where something else does, or DeviceGone.
        If frames are not answered in the form of the settings, the error says whether they are in the other form.
        """
        with self.pro.wire.lock:
            self.found_in_pro = False
            self.found_in_pro = self._find()
            said = []
            for request in (ID, VERSION, SERIAL):
                try:
                    said.append(self._lines.text(request))
                except DeviceRefused as error:  # other firmware may not know it
                    LOG.warning("%s", error)
                    said.append("")
            try:
                self._enter_pro()
            except (DeadlinePassed, DeviceRefused) as error:
                raise self._with_advice(error) from error
            return Identity(*said)

    def why_unanswered(self, *, with_crc: bool) -> str:
        """Try frames with a CRC, or without, from simple mode and back to it: return why none is answered, else "".

        Nothing moves. Raises DeadlinePassed, DeviceRefused or DeviceGone where simple mode is not reached again.
        """
        tried = Modes(replace(self.pro, with_crc=with_crc))
        try:
            tried._enter_pro()
        except (DeadlinePassed, DeviceRefused) as error:
            tried._find()
            return str(error)
        tried._leave_pro()
        return ""

    @contextmanager
    def simple(self) -> Iterator[SimpleLink]:
        """Keep simple mode while the block runs; connect again where a mode is not reached.

        Raises DeadlinePassed, DeviceRefused or DeviceGone.
        """
        with self.pro.wire.lock:
            self._leave_pro()
            try:
                yield self._lines
            finally:
                self._enter_pro()

    def _find(self) -> bool:
        """Reach simple mode from either mode, and return whether it was pro mode."""
        try:
            self._greet()
        except DeadlinePassed:
            LOG.info("%s does not answer in simple mode; it may be in pro mode", self.pro.wire.port)
            self._leave_pro()
            return True
        return False

    def _leave_pro(self) -> None:
        try:
            self._ask_for_simple(self.pro)
        except DeviceRefused as error:  # an earlier session may have sent frames the other way
            LOG.info("%s; asking the other way", error)
            self._ask_for_simple(replace(self.pro, with_crc=not self.pro.with_crc))
        self._greet()

    def _ask_for_simple(self, link: ProLink) -> None:
        try:
            link.tell(go_simple(), "changing to simple mode")
        except DeadlinePassed as error:  # it may have changed all the same; the greeting tells
            LOG.info("%s; greeting it all the same", error)

    def _greet(self) -> None:
        try:
            self._lines.do(START, "greeting")
        except DeviceRefused as error:  # the greeting ended a line that was begun before
            LOG.info("%s; greeting it once more", error)
            self._lines.do(START, "greeting")

    def _enter_pro(self) -> None:
        words = GO_PRO_CRC if self.pro.with_crc else GO_PRO
        try:
            self._lines.do(words, "write")
        except DeadlinePassed as error:  # it may have changed all the same; the status tells
            LOG.info("%s; asking for the status all the same", error)
        self.pro.ask(ask_status(), "the status", cell_int)

    def _with_advice(self, error: DeadlinePassed | DeviceRefused) -> RigError:
        """Return the error of a pro mode that was not reached, with the setting that reaches it where there is one."""
        own, other = self.pro.with_crc, not self.pro.with_crc
        try:
            self._find()
            if self.why_unanswered(with_crc=other):
                return error
        except RigError:
            return error
        setting = f"with_crc = {str(other).lower()}"
        return DeviceRefused(f"{_FRAMES[own]}: {error}. It answers {_FRAMES[other]}; set {setting} in [rig]")
