"""Requests to the mirror controller in either mode: what is sent, what is accepted as the answer, and its kind."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from pipeline.errors import RigError, ShapeError
from pipeline.rig.device_errors import DeviceRefused
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
from pipeline.rig.mirror.pro_payloads import cell_int
from pipeline.rig.mirror.registers import Status
from pipeline.rig.mirror.transactions import Kind, Receiver, Wire

LOG = logging.getLogger(__name__)

Answer = TypeVar("Answer")
_GARBLED = (ErrorCode.FRAME_INVALID, ErrorCode.CRC_WRONG)


@dataclass(frozen=True)
class ProLink:
    """Frames of pro mode over a wire. ``with_crc`` sends and checks CRCs; ``strict_crc`` refuses those that differ."""

    wire: Wire
    with_crc: bool = True
    strict_crc: bool = False

    def ask(self, frame: Frame, name: str, parse: Callable[[bytes], Answer]) -> Answer:
        """Send a request that only reads, again where no answer comes, and give what ``parse`` makes of the payload.

        Raises
        ------
        DeviceRefused, DeadlinePassed, DeviceGone
        """
        return self._exchange(frame, name, "read", parse)

    def tell(self, frame: Frame, name: str) -> None:
        """Send a request that sets something and moves nothing, once.

        Raises
        ------
        DeviceRefused, DeadlinePassed, DeviceGone
        """
        self._exchange(frame, name, "write", bytes)

    def move(self, frame: Frame, name: str) -> None:
        """Send a request that moves the mirror, once.

        Raises
        ------
        StateUnknown : it was not acknowledged, or motions are frozen.
        DeviceRefused : the device said no.
        """
        self._exchange(frame, name, "motion", bytes)

    def _exchange(self, frame: Frame, name: str, kind: Kind, parse: Callable[[bytes], Answer]) -> Answer:
        data = encode(frame, with_crc=self.with_crc)
        return self.wire.exchange(data, name, kind, lambda: self._receiver(frame, name, parse))

    def _receiver(self, sent: Frame, name: str, parse: Callable[[bytes], Answer]) -> Receiver[Answer]:
        reader = FrameReader()

        def receive(data: bytes) -> Answer | None:
            for found in reader.feed(data):
                answer = self._answer(found, sent, name, parse)
                if answer is not None:
                    return answer
            return None

        return receive

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
    """Lines of simple mode over a wire."""

    wire: Wire

    def start(self) -> None:
        """Greet the controller, which answers in simple mode alone.

        Raises
        ------
        DeadlinePassed : nothing answered. RigError, DeviceRefused : something else did.
        """
        self._do(simple_mode.START, "greeting")

    def text(self, request: str) -> str:
        """Ask for the controller's id, version or serial number.

        Raises
        ------
        DeviceRefused, DeadlinePassed, DeviceGone, RigError
        """
        return self._line(request, "read", lambda line: simple_mode.read_text(line, request, self.wire.port))

    def status(self) -> Status:
        """Ask for the status bits.

        Raises
        ------
        DeviceRefused, DeadlinePassed, DeviceGone, RigError
        """
        return self._line(simple_mode.STATUS, "read", lambda line: simple_mode.read_status(line, self.wire.port))

    def temperature(self) -> float:
        """Ask for the temperature. [deg C]

        Raises
        ------
        DeviceRefused, DeadlinePassed, DeviceGone, RigError
        """
        return self._line(
            simple_mode.TEMPERATURE, "read", lambda line: simple_mode.read_temperature(line, self.wire.port)
        )

    def tell(self, request: str) -> None:
        """Send a request that moves nothing and is answered by OK, once.

        Raises
        ------
        DeviceRefused, DeadlinePassed, DeviceGone, RigError
        """
        self._do(request, "write")

    def move(self, request: str) -> None:
        """Send a request that moves the mirror (a position, a reset), once.

        Raises
        ------
        StateUnknown : it was not acknowledged, or motions are frozen.
        DeviceRefused : the device said no, or went to the end of its range instead.
        """
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
