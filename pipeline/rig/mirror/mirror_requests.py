"""Requests to the mirror controller in either mode: bytes sent, answers accepted, and mode changes.

Lines of simple mode are ASCII with CR LF, at most 64 bytes, in either case. Frames of pro mode: `pro_mode`.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable
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
ID, VERSION, SERIAL = "GETID", "GETVERSION", "GETSN"
GO_PRO, GO_PRO_CRC = "GOPRO", "GOPROCRC"

Answer = TypeVar("Answer")


class Reply(StrEnum):
    """Replies to requests that return no value."""

    OK = "OK"
    NO = "NO"
    BELOW = "OL"
    ABOVE = "OU"
    ERROR = "ERROR"


_REASONS = {
    Reply.NO: "it does not know the request, or does not take it now",
    Reply.BELOW: "a value lies below the range and was set to its end",
    Reply.ABOVE: "a value lies above the range and was set to its end",
    Reply.ERROR: "an error on the device",
}


def read_done(line: bytes, request: str, port: str) -> bool:
    """Accept the reply OK; DeviceRefused at another reply of the protocol, RigError at anything else."""
    text = line.decode("ascii", "backslashreplace").strip()
    if text.upper() not in Reply.__members__.values():
        raise RigError(f"expected OK to {request} from {port}, got {text!r}; is this the mirror controller?")
    reply = Reply(text.upper())
    if reply is not Reply.OK:
        raise DeviceRefused(f"the mirror controller on {port} answered {reply} to {request}: {_REASONS[reply]}")
    return True


def read_text(line: bytes, request: str, port: str) -> str:
    """Read a reply that is a text of the device, such as its id; DeviceRefused or RigError where it is none."""
    text = line.decode("ascii", "backslashreplace").strip()
    if not re.fullmatch(r"[ -~]+", text) or "\\x" in text:
        raise RigError(f"expected text to {request} from {port}, got {line!r}; is the port's speed right?")
    if text.upper() in (Reply.NO, Reply.ERROR):
        read_done(line, request, port)
    return text


def ask_line(wire: Wire, request: str, parse: Callable[[bytes, str, str], Answer], kind: Kind) -> Answer:
    """Send a line of simple mode and return the parsed line that answers it; raises as `Wire.exchange`."""

    def receiver() -> Receiver[Answer]:
        """Return a receiver that collects a line."""
        held = b""

        def receive(data: bytes) -> Answer | None:
            nonlocal held
            *lines, held = (held + data).split(b"\n")
            line = next((line for line in (line.rstrip(b"\r") for line in lines) if line), None)
            return None if line is None else parse(line, request, wire.port)

        return receive

    return wire.exchange(request.encode("ascii") + END, request, kind, receiver)


@dataclass(frozen=True)
class ProLink:
    """Frames of pro mode over a wire. ``with_crc`` sends and checks CRCs; ``strict_crc`` refuses those that differ.

    Requests raise DeviceRefused, DeadlinePassed or DeviceGone, and one that moves the mirror StateUnknown.
    """

    wire: Wire
    with_crc: bool = False
    strict_crc: bool = False

    def ask(self, frame: Frame, name: str, parse: Callable[[bytes], Answer], kind: Kind = "read") -> Answer:
        """Send a request that only reads and return the parsed payload; it is sent again where no answer comes."""

        def receiver() -> Receiver[Answer]:
            reader = FrameReader()

            def receive(data: bytes) -> Answer | None:
                answers = (self._answer(found, frame, name, parse) for found in reader.feed(data))
                return next((answer for answer in answers if answer is not None), None)

            return receive

        return self.wire.exchange(encode(frame, with_crc=self.with_crc), name, kind, receiver)

    def set(self, frame: Frame, name: str) -> None:
        """Send a request once that writes and moves nothing."""
        self.ask(frame, name, bytes, "write")

    def move(self, frame: Frame, name: str) -> None:
        """Send a request once that moves the mirror."""
        self.ask(frame, name, bytes, "motion")

    def _answer(
        self, found: Frame | Damaged, sent: Frame, name: str, parse: Callable[[bytes], Answer]
    ) -> Answer | None:
        """Return the answer in a frame; None, and a line in the log, where it does not answer the request."""
        port = self.wire.port
        if isinstance(found, Damaged):
            LOG.warning("%s, while waiting for %s: %s: %s", port, name, found.reason, found.data.hex(" "))
            return None
        if self.with_crc and not found.crc_good:
            action = "refused" if self.strict_crc else "accepted (set strict_crc to refuse it)"
            LOG.warning("%s: the CRC of an answer to %s does not fit; %s", port, name, action)
            if self.strict_crc:
                return None
        if found.command == sent.command | ERROR_FLAG:
            if len(found.payload) != 4:
                raise RigError(f"{name}: {port} answered with an error of {len(found.payload)} bytes, expected 4")
            code = cell_int(found.payload)
            garbled = code in (ErrorCode.FRAME_INVALID, ErrorCode.CRC_WRONG)
            message = f"the mirror controller on {port} refused {name}: {format_error(code)}"
            raise DeviceRefused(message, code, garbled=garbled)
        if found.command != sent.command:
            # a controller in pro mode complains of lines when the next frame follows
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
    """Identity of a controller; a field is empty where it does not know the request."""

    device: str
    version: str
    serial: str

    @property
    def summary(self) -> str:
        """All fields in one line."""
        return f"{self.device or 'no id'}, version {self.version or 'unknown'}, serial {self.serial or 'unknown'}"


class Modes:
    """Changes between the modes of a controller. Between calls it is in pro mode."""

    def __init__(self, pro: ProLink) -> None:
        self.pro = pro
        self.found_in_pro = False  # at the last connect

    def connect(self) -> Identity:
        """Find the controller in either mode, read its identity, and leave it in pro mode. Nothing moves.

        Raises DeadlinePassed where nothing answers in either mode, RigError where something else answers, or
        DeviceGone. If only frames with the other setting of ``with_crc`` are answered, the error says so.
        """
        with self.pro.wire.lock:
            self.found_in_pro = False
            self.found_in_pro = self._find()
            identity = Identity(*map(self._text, (ID, VERSION, SERIAL)))
            try:
                self._enter_pro()
            except (DeadlinePassed, DeviceRefused) as error:
                raise self._with_advice(error) from error
            return identity

    def try_frames(self, *, with_crc: bool) -> str:
        """Try frames with a CRC, or without, and return to those of the settings; return why none is answered, or "".

        Nothing moves. Raises DeadlinePassed, DeviceRefused or DeviceGone where a mode is not reached again.
        """
        with self.pro.wire.lock:
            self._leave_pro()
            try:
                return self._why_unanswered(with_crc=with_crc)
            finally:
                self._enter_pro()

    def _why_unanswered(self, *, with_crc: bool) -> str:
        """Try frames from simple mode and return to it; return why none is answered, or ""."""
        tried = Modes(replace(self.pro, with_crc=with_crc))
        try:
            tried._enter_pro()
        except (DeadlinePassed, DeviceRefused) as error:
            tried._find()
            return str(error)
        tried._leave_pro()
        return ""

    def _text(self, request: str) -> str:
        try:
            return ask_line(self.pro.wire, request, read_text, "read")
        except DeviceRefused as error:  # other firmware may not know it
            LOG.warning("%s", error)
            return ""

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
        except DeviceRefused as error:  # an earlier session may have used the other kind of frames
            LOG.info("%s; asking with the other kind of frames", error)
            self._ask_for_simple(replace(self.pro, with_crc=not self.pro.with_crc))
        self._greet()

    def _ask_for_simple(self, link: ProLink) -> None:
        try:
            link.set(go_simple(), "changing to simple mode")
        except DeadlinePassed as error:  # it may have changed; the greeting shows
            LOG.info("%s; greeting it in any case", error)

    def _greet(self) -> None:
        try:
            ask_line(self.pro.wire, START, read_done, "greeting")
        except DeviceRefused as error:  # the greeting ended a line that was begun before
            LOG.info("%s; greeting it once more", error)
            ask_line(self.pro.wire, START, read_done, "greeting")

    def _enter_pro(self) -> None:
        request = GO_PRO_CRC if self.pro.with_crc else GO_PRO
        try:
            ask_line(self.pro.wire, request, read_done, "write")
        except DeadlinePassed as error:  # it may have changed; the status shows
            LOG.info("%s; asking for the status in any case", error)
        self.pro.ask(ask_status(), "the status", cell_int)

    def _with_advice(self, error: DeadlinePassed | DeviceRefused) -> RigError:
        """Return the error of a pro mode that was not reached, with the setting that reaches it where there is one."""
        other = not self.pro.with_crc
        try:
            self._find()
            if self._why_unanswered(with_crc=other):
                return error
        except RigError:
            return error
        own, others = ("frames without a CRC", "frames with a CRC")[:: 1 if other else -1]
        return DeviceRefused(f"{own}: {error}. It answers {others}; set with_crc = {str(other).lower()} in [rig]")
