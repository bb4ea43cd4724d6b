"""Requests to the mirror controller in either mode: what is sent, what is accepted as the answer, and mode changes."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeVar

from pipeline.errors import RigError, ShapeError
from pipeline.rig.device_errors import DeadlinePassed, DeviceRefused
from pipeline.rig.mirror import simple_mode
from pipeline.rig.mirror.pro_mode import (
    ERROR_FLAG,
    Command,
    Damaged,
    ErrorCode,
    Frame,
    FrameReader,
    encode,
    error_words,
)
from pipeline.rig.mirror.pro_payloads import ask_status, cell_int, go_simple
from pipeline.rig.mirror.registers import Status
from pipeline.rig.mirror.steering import Identity
from pipeline.rig.mirror.transactions import Kind, Receiver, Wire

LOG = logging.getLogger(__name__)

Answer = TypeVar("Answer")
_GARBLED = (ErrorCode.FRAME_INVALID, ErrorCode.CRC_WRONG)


@dataclass(frozen=True)
class ProLink:
    """Frames of pro mode over a wire. ``with_crc`` sends and checks CRCs; ``strict_crc`` refuses those that differ.

    Requests raise DeviceRefused, DeadlinePassed or DeviceGone, and one that moves the mirror StateUnknown.
    """

    wire: Wire
    with_crc: bool = True
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
        """What a frame says to the request; None, and a line in the log, where it is no answer to it."""
        port = self.wire.port
        if isinstance(found, Damaged):
            LOG.warning("%s, while waiting for %s: %s: %s", port, name, found.reason, found.data.hex(" "))
            return None
        if not self._crc_passes(found, name):
            return None
        if found.command == sent.command | ERROR_FLAG:
            raise self._refusal(found, name)
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

    def _crc_passes(self, found: Frame, name: str) -> bool:
        if found.crc_good or not self.with_crc:
            return True
        what = "refused" if self.strict_crc else "taken all the same (set strict_crc to refuse it)"
        LOG.warning("%s: the CRC of an answer to %s does not fit; %s", self.wire.port, name, what)
        return not self.strict_crc

    def _refusal(self, found: Frame, name: str) -> RigError:
        port = self.wire.port
        try:
            code = cell_int(found.payload)
        except ShapeError:
            return RigError(f"{name}: {port} answered with an error of {len(found.payload)} bytes, expected 4")
        return DeviceRefused(
            f"the mirror controller on {port} refused {name}: {error_words(code)}", code, garbled=code in _GARBLED
        )


@dataclass(frozen=True)
class SimpleLink:
    """Lines of simple mode over a wire.

    Requests raise DeviceRefused, DeadlinePassed or DeviceGone, one that moves the mirror StateUnknown, and RigError
    where the answer is none.
    """

    wire: Wire

    def start(self) -> None:
        """Greet the controller, which answers in simple mode alone."""
        self._do(simple_mode.START, "greeting")

    def text(self, request: str) -> str:
        """Ask for the controller's id, version or serial number."""
        return self._line(request, "read", lambda line: simple_mode.read_text(line, request, self.wire.port))

    def status(self) -> Status:
        """Ask for the status bits."""
        return self._line(simple_mode.STATUS, "read", lambda line: simple_mode.read_status(line, self.wire.port))

    def temperature(self) -> float:
        """Ask for the temperature. [deg C]"""
        return self._line(
            simple_mode.TEMPERATURE, "read", lambda line: simple_mode.read_temperature(line, self.wire.port)
        )

    def tell(self, request: str) -> None:
        """Send a request that moves nothing and is answered by OK, once."""
        self._do(request, "write")

    def move(self, request: str) -> None:
        """Send a request that moves the mirror (a position, a reset), once; going to a range's end is a refusal."""
        self._do(request, "motion")

    def _do(self, request: str, kind: Kind) -> None:
        def done(line: bytes) -> bool:
            simple_mode.check_done(line, request, self.wire.port)
            return True

        self._line(request, kind, done)

    def _line(self, request: str, kind: Kind, parse: Callable[[bytes], Answer]) -> Answer:
        def receiver() -> Receiver[Answer]:
            reader = simple_mode.LineReader()

            def receive(data: bytes) -> Answer | None:
                lines = reader.feed(data)
                return parse(lines[0]) if lines else None

            return receive

        return self.wire.exchange(simple_mode.to_line(request), request, kind, receiver)


class Modes:
    """A controller whose mode is known. Between calls it is in pro mode."""

    def __init__(self, pro: ProLink) -> None:
        self.pro = pro
        self.found_in_pro = False  # at the last connect, where an earlier session had left it
        self._lines = SimpleLink(pro.wire)

    def connect(self) -> Identity:
        """Find the controller in either mode, ask what it is, and leave it in pro mode. Nothing moves.

        Raises
        ------
        DeadlinePassed : nothing answers in either mode.
        RigError : something else answers.
        DeviceGone : the port went away.
        """
        with self.pro.wire.lock:
            self.found_in_pro = False
            try:
                self._greet()
            except DeadlinePassed:
                LOG.info("%s does not answer in simple mode; it may be in pro mode", self.pro.wire.port)
                self._leave_pro()
                self.found_in_pro = True
            words = (simple_mode.ID, simple_mode.VERSION, simple_mode.SERIAL)
            device, version, serial = (self._text(word) for word in words)
            self._enter_pro()
            return Identity(device, version, serial)

    @contextmanager
    def simple(self) -> Iterator[SimpleLink]:
        """Simple mode for as long as the block lasts.

        Raises
        ------
        DeadlinePassed, DeviceRefused, DeviceGone : a mode was not reached; connect again.
        """
        with self.pro.wire.lock:
            self._leave_pro()
            try:
                yield self._lines
            finally:
                self._enter_pro()

    def _leave_pro(self) -> None:
        try:
            self.pro.tell(go_simple(), "changing to simple mode")
        except DeadlinePassed as error:  # it may have changed all the same; the greeting tells
            LOG.info("%s; greeting it all the same", error)
        self._greet()

    def _greet(self) -> None:
        try:
            self._lines.start()
        except DeviceRefused as error:  # the greeting ended a line that somebody had begun
            LOG.info("%s; greeting it once more", error)
            self._lines.start()

    def _enter_pro(self) -> None:
        words = simple_mode.GO_PRO_CRC if self.pro.with_crc else simple_mode.GO_PRO
        try:
            self._lines.tell(words)
        except DeadlinePassed as error:  # it may have changed all the same; the status tells
            LOG.info("%s; asking for the status all the same", error)
        except DeviceRefused as error:
            raise DeviceRefused(f"{error}. Firmware without {words}? Turn mirror.with_crc over") from error
        self.pro.ask(ask_status(), "the status", cell_int)

    def _text(self, request: str) -> str:
        """The answer to a request that other firmware may not know."""
        try:
            return self._lines.text(request)
        except DeviceRefused as error:
            LOG.warning("%s", error)
            return ""
