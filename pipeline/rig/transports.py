"""Connections to devices by serial port or TCP, requests with deadlines over them, clocks, and errors of a rig."""

from __future__ import annotations

import logging
import math
import re
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Literal, Protocol, TypeVar

import serial
from serial.tools import list_ports

from spectralzoom.pipeline.errors import RigError, SettingsError

LOG = logging.getLogger(__name__)
BAUD = 115200  # of the public software; over USB any works
SLICE_S = 0.02  # longest wait of one read of a serial port, by which a deadline may be exceeded
WRITE_S = 0.25  # longest write; a frame takes 10 ms
CONNECT_S = 3.0
DEADLINE_S = 1.0  # longest time of a request with its repetitions
RETRIES = 2  # of a read within it
QUIET_S = 0.1  # silence after which no answer comes
_HOST = r"(\[[0-9a-fA-F:.]+\]|[\w.-]+):\d{1,5}"
_DEVICE = r"/dev/(?!/|\S*(//|\.\.))[!-~]+|COM\d{1,3}"
_PORT = re.compile(rf"{_DEVICE}|socket://{_HOST}|rfc2217://{_HOST}(\?[\w&=.]+)?", re.ASCII)


class DeviceGone(RigError):  # noqa: N818 - the name states the case
    """A device is not there, or went away."""


class DeadlinePassed(RigError):  # noqa: N818 - the name states the case
    """A device did not answer in time, and nothing can have moved."""


class DeviceRefused(RigError):  # noqa: N818 - the name states the case
    """A device refused a request; ``code`` is its error code."""

    def __init__(self, message: str, code: int | None = None) -> None:
        super().__init__(message)
        self.code = code


class StateUnknown(RigError):  # noqa: N818 - the name states the case
    """A device may or may not have moved; a rig gets no further command."""


class NotKept(RigError):  # noqa: N818 - the name states the case
    """The disk cannot store what a device sent. The device still has it."""


class Clock(Protocol):
    """A clock that never goes back. Deadlines are its times."""

    def now(self) -> float:
        """Return the time since any origin. [s]"""

    def sleep(self, seconds: float) -> None:
        """Wait for a time [s]; return at once where it is not above 0."""


class SystemClock:
    """The monotonic clock of the machine."""

    now = staticmethod(time.monotonic)

    def sleep(self, seconds: float) -> None:
        time.sleep(max(seconds, 0.0))


SYSTEM_CLOCK = SystemClock()


class Transport(Protocol):
    """A connection to a device, called ``port`` in messages. Every method may raise DeviceGone."""

    @property
    def port(self) -> str: ...

    def write(self, data: bytes) -> None:
        """Send all bytes; DeadlinePassed where the device does not take them within `WRITE_S`: some may have gone."""

    def read(self, at_most: int, deadline: float) -> bytes:
        """Wait for bytes and return those that are there, ``at_most`` at most; none where the deadline passes first."""

    def close(self) -> None: ...


@contextmanager
def _errors(port: str, sent: int = 0) -> Iterator[None]:
    """Raise the errors of an open connection as DeviceGone, and a blocked write of ``sent`` bytes as DeadlinePassed."""
    try:
        yield
    except (serial.SerialTimeoutException, TimeoutError):
        raise DeadlinePassed(f"{port} did not take {sent} bytes within {WRITE_S:g} s; is the device on?") from None
    except (serial.SerialException, OSError, TypeError) as error:
        raise DeviceGone(f"{port} went away ({error}); look at the cable and the power, then run again") from error


def check_port(port: str) -> None:
    """Raise SettingsError where a text names no port; pyserial knows other addresses, which open files or programs."""
    if not _PORT.fullmatch(port):
        raise SettingsError(
            f"rig.port = {port!r} is no port; give a device such as /dev/ttyACM0 or COM3, socket://HOST:PORT or "
            "rfc2217://HOST:PORT"
        )


class SerialTransport:
    """A :class:`Transport` over a port of pyserial, held exclusively.

    Raises SettingsError: the text names no port. Raises DeviceGone: there is no such port, it is in use, or not
    permitted.
    """

    def __init__(self, port: str, clock: Clock = SYSTEM_CLOCK) -> None:
        check_port(port)
        self.port = port
        self._clock = clock
        write_s = None if port.startswith("rfc2217:") else WRITE_S  # pyserial limits no write by RFC 2217
        try:
            self._serial = serial.serial_for_url(
                port, baudrate=BAUD, timeout=SLICE_S, write_timeout=write_s, exclusive=True
            )
        except (serial.SerialException, ValueError) as error:
            there = ", ".join(sorted(one.device for one in list_ports.comports())) or "none"
            raise DeviceGone(
                f"{port} cannot be opened ({error}), ports of this machine: {there}; is it a serial port, the "
                "controller on, no other program at it, and this user in its group (mostly dialout)?"
            ) from error

    def write(self, data: bytes) -> None:
        with _errors(self.port, len(data)):
            self._serial.write(data)

    def read(self, at_most: int, deadline: float) -> bytes:
        with _errors(self.port):
            while self._serial.in_waiting or self._clock.now() < deadline:
                if first := self._serial.read(1):
                    return bytes(first + self._serial.read(min(at_most - 1, self._serial.in_waiting)))
        return b""

    def close(self) -> None:
        self._serial.close()


class SocketTransport:
    """A :class:`Transport` to ``host:port``; DeviceGone where no device answers.

    A socket of pyserial drops what has arrived when it opens, and with it the greeting of a camera.
    """

    def __init__(self, host: str, port: int, clock: Clock = SYSTEM_CLOCK) -> None:
        self.port = f"{host}:{port}"
        self._clock = clock
        try:
            self._socket = socket.create_connection((host, port), timeout=CONNECT_S)
        except (OSError, UnicodeError) as error:
            raise DeviceGone(
                f"no connection to {self.port} within {CONNECT_S:g} s ({error}); is the camera on, its network cable "
                "in, and this machine's address in its network?"
            ) from error

    def write(self, data: bytes) -> None:
        with _errors(self.port, len(data)):
            self._socket.settimeout(WRITE_S)
            self._socket.sendall(data)

    def read(self, at_most: int, deadline: float) -> bytes:
        self._socket.settimeout(max(deadline - self._clock.now(), 0.0))
        with _errors(self.port):
            try:
                data = self._socket.recv(at_most)
            except (TimeoutError, BlockingIOError):
                return b""
            if not data:
                raise OSError("closed by the other end")
        return data

    def close(self) -> None:
        self._socket.close()


Kind = Literal["read", "write", "motion"]
Answer = TypeVar("Answer")
# takes bytes as they come and returns the answer once it is complete
Receiver = Callable[[bytes], Answer | None]


class Wire:
    """Requests to one device, each of which begins with an empty line.

    A read is sent again within its deadline. A write or a motion never is. ``advice`` ends the message of a request
    that is not answered.
    """

    def __init__(
        self,
        transport: Transport,
        clock: Clock,
        *,
        deadline_s: float = DEADLINE_S,
        advice: str = "is the controller on, its cable in, and this its port?",
    ) -> None:
        self.transport = transport
        self.clock = clock
        self.deadline_s = deadline_s
        self._advice = advice
        self._unanswered = 0  # requests whose answer may still come

    @property
    def port(self) -> str:
        """Name of the port."""
        return self.transport.port

    def exchange(self, data: bytes, name: str, kind: Kind, receiver: Callable[[], Receiver[Answer]]) -> Answer:
        """Send a request, called ``name`` in messages, and return its answer.

        ``receiver`` makes a receiver, one for each time that the request is sent. Raises StateUnknown: a motion was not
        acknowledged. Raises DeadlinePassed: a read or a write was not answered in time. Raises DeviceRefused or
        DeviceGone.
        """
        self.empty_line(f"before {name}")
        deadline = self.clock.now() + self.deadline_s
        left = 1 + (RETRIES if kind == "read" else 0)
        while True:
            silence_s = (deadline - self.clock.now()) / left
            try:
                return self._once(data, name, receiver(), silence_s, deadline)
            except DeviceRefused:
                raise
            except RigError as error:
                if kind == "motion":
                    raise StateUnknown(
                        f"{name} was sent to {self.port} and may have happened or not: {error}. It is not sent again. "
                        "Look at the device, stop what runs there, then run again, which connects anew"
                    ) from error
                left -= 1
                if left == 0 or isinstance(error, DeviceGone):
                    raise
                LOG.info("%s; asking again", error)
                self.empty_line("before asking again", deadline)
                if self.clock.now() >= deadline:
                    raise

    def wait_for(self, name: str, receiver: Receiver[Answer]) -> Answer:
        """Return what a device sends unasked, such as a greeting; raises as `exchange`."""
        return self._once(b"", name, receiver, self.deadline_s, self.clock.now() + self.deadline_s)

    def _once(self, data: bytes, name: str, receiver: Receiver[Answer], silence_s: float, deadline: float) -> Answer:
        """Send once, and wait until the device has been silent for ``silence_s``, at most to the deadline."""
        began = self.clock.now()
        if data:
            self._unanswered += 1
            self.transport.write(data)
        came = b""
        until = min(began + silence_s, deadline)
        while self.clock.now() < until:
            part = self.transport.read(1 << 16, until)
            if not part:
                continue
            until = min(self.clock.now() + silence_s, deadline)
            came += part
            try:
                answer = receiver(part)
            except DeviceRefused:  # this is an answer; after other errors one may still come
                self._unanswered -= 1
                raise
            if answer is not None:
                self._unanswered -= bool(data)
                return answer
        found = f"{len(came)} other bytes came: {came[:64]!r}" if came else "nothing came"
        raise DeadlinePassed(
            f"no answer to {name} from {self.port} within {self.clock.now() - began:.3g} s ({found}); {self._advice}"
        )

    def empty_line(self, when: str, latest: float = math.inf) -> None:
        """Drop what is on the line. If an answer may still come, wait for silence: it would pass for the next one."""
        quiet_s = QUIET_S if self._unanswered else 0.0
        latest = min(latest, self.clock.now() + 5 * QUIET_S)  # some devices never stop
        stale = b""
        while (now := self.clock.now()) < latest and (part := self.transport.read(4096, min(now + quiet_s, latest))):
            stale += part
        self._unanswered = 0
        if stale:
            LOG.info("%s: dropped %d stale bytes %s: %r", self.port, len(stale), when, stale[:64])
