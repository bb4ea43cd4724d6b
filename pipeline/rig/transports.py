"""Lines to a device by serial port or TCP, transactions with deadlines over them, clocks, and errors of a rig."""

from __future__ import annotations

import logging
import math
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Literal, Protocol, TypeVar

import serial
from serial.tools import list_ports

from spectralzoom.pipeline.errors import RigError, SettingsError


class Clock(Protocol):
    """A clock that never goes back. Deadlines are its times."""

    def now(self) -> float:
        """Return the time since any origin. [s]"""

    def sleep(self, seconds: float) -> None:
        """Wait for a time [s]; return at once where it is not above 0."""


@dataclass(frozen=True)
class SystemClock:
    """The monotonic clock of the machine."""

    def now(self) -> float:
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        if seconds > 0:
            time.sleep(seconds)


SYSTEM_CLOCK = SystemClock()


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


_SLICE_S = 0.02  # reads wait in slices, so a deadline may be exceeded by one
_WRITE_S = 0.25  # a frame takes 10 ms at 115200
_CONNECT_S = 3.0
_MOST_DRAINED = 1 << 20  # bytes
DEADLINE_S = 1.0  # longest time of a transaction
RETRIES = 2  # of a read within it
QUIET_S = 0.1  # silence after which no answer comes
LOG = logging.getLogger(__name__)

Kind = Literal["read", "write", "motion"]
Answer = TypeVar("Answer")
# takes bytes as they come and returns the answer once it is complete
Receiver = Callable[[bytes], Answer | None]


class Transport(Protocol):
    """A line to a device. Deadlines are times of the clock that both ends of a call share.

    Every method may raise DeviceGone: the device is not there any more.
    """

    @property
    def port(self) -> str:
        """Its name in messages."""

    def write(self, data: bytes, deadline: float) -> None:
        """Send all bytes; DeadlinePassed where the device did not take them in time, and some may have gone."""

    def read(self, at_most: int, deadline: float) -> bytes:
        """Wait for bytes and return those that are there, ``at_most`` at most; none where the deadline passes first."""

    def drain(self) -> bytes:
        """Return the bytes that are there already, without waiting."""

    def close(self) -> None:
        """Close the port."""


def _check_time(left_s: float, data: bytes, port: str) -> None:
    if left_s <= 0:
        raise DeadlinePassed(f"no time was left to send {len(data)} bytes to {port}; give a longer deadline")


@contextmanager
def _errors(port: str) -> Iterator[None]:
    """Raise the errors of an open port as DeviceGone."""
    try:
        yield
    except RigError:
        raise
    except (serial.SerialException, OSError, TypeError) as error:
        raise DeviceGone(f"{port} went away ({error}); look at the cable and the power, then run again") from error


class SerialTransport:
    """A :class:`Transport` over a serial port, held exclusively, or an address of pyserial (``socket://host:port``).

    Raises DeviceGone: there is no such port, it is in use, or not permitted. Raises SettingsError: the kind of address
    or the speed does not exist.
    """

    def __init__(self, port: str, baud: int, clock: Clock = SYSTEM_CLOCK) -> None:
        self.port = port
        self._clock = clock
        try:
            self._serial = serial.serial_for_url(
                port, baudrate=baud, timeout=_SLICE_S, write_timeout=_WRITE_S, exclusive=True
            )
        except serial.SerialException as error:
            there = ", ".join(sorted(one.device for one in list_ports.comports())) or "none"
            raise DeviceGone(
                f"{port} cannot be opened ({error}), ports of this machine: {there}; is it a serial port, the "
                "controller on, no other program at it, and this user in its group (mostly dialout)?"
            ) from error
        except (ValueError, OverflowError) as error:
            raise SettingsError(
                f"expected a port's name or an address that pyserial knows, and a speed, got {port!r} at {baud!r}: "
                f"{error}"
            ) from error

    def write(self, data: bytes, deadline: float) -> None:
        """Send all bytes, in the longest time that a port takes; DeadlinePassed where it takes longer."""
        _check_time(deadline - self._clock.now(), data, self.port)
        with _errors(self.port):
            try:
                self._serial.write(data)
            except serial.SerialTimeoutException:
                raise DeadlinePassed(
                    f"{self.port} did not take {len(data)} bytes within {_WRITE_S:g} s; is the device on?"
                ) from None

    def read(self, at_most: int, deadline: float) -> bytes:
        """Wait for a first byte until the deadline, and return what is there, ``at_most`` at most."""
        with _errors(self.port):
            while self._clock.now() < deadline:
                first: bytes = self._serial.read(1)
                if first:
                    rest: bytes = self._serial.read(min(at_most - 1, self._serial.in_waiting))
                    return first + rest
        return b""

    def drain(self) -> bytes:
        """Return what is there already, at most `_MOST_DRAINED` bytes: a port may never fall silent."""
        drained = b""
        with _errors(self.port):
            while len(drained) < _MOST_DRAINED and (there := self._serial.in_waiting):
                drained += self._serial.read(there)
        return drained

    def close(self) -> None:
        self._serial.close()


class SocketTransport:
    """A :class:`Transport` to ``host:port``; DeviceGone where no device answers."""

    def __init__(self, host: str, port: int, clock: Clock = SYSTEM_CLOCK) -> None:
        self.port = f"{host}:{port}"
        self._clock = clock
        try:
            self._socket = socket.create_connection((host, port), timeout=_CONNECT_S)
        except (OSError, UnicodeError) as error:
            raise DeviceGone(
                f"no connection to {self.port} within {_CONNECT_S:g} s ({error}); is the camera on, its network cable "
                "in, and this machine's address in its network?"
            ) from error
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def write(self, data: bytes, deadline: float) -> None:
        """Send all bytes before the deadline; DeadlinePassed where the other end did not take them."""
        left_s = deadline - self._clock.now()
        _check_time(left_s, data, self.port)
        with _errors(self.port):
            self._socket.settimeout(left_s)
            try:
                self._socket.sendall(data)
            except TimeoutError:
                raise DeadlinePassed(
                    f"{self.port} did not take {len(data)} bytes within {left_s:g} s; does it hang?"
                ) from None

    def read(self, at_most: int, deadline: float) -> bytes:
        """Wait for bytes until the deadline, and return what is there, ``at_most`` at most."""
        left_s = deadline - self._clock.now()
        if left_s <= 0:
            return b""
        with _errors(self.port):
            self._socket.settimeout(max(left_s, 1e-3))
            try:
                return self._received(at_most)
            except TimeoutError:
                self._clock.sleep(deadline - self._clock.now())  # a manual clock has not moved meanwhile
        return b""

    def drain(self) -> bytes:
        """Return what is there already, a limited number of bytes: a sender may never fall silent."""
        drained = b""
        self._socket.setblocking(False)
        with _errors(self.port), suppress(BlockingIOError):
            while len(drained) < _MOST_DRAINED:
                drained += self._received(65536)
        return drained

    def close(self) -> None:
        self._socket.close()

    def _received(self, at_most: int) -> bytes:
        data = self._socket.recv(at_most)
        if not data:
            raise OSError("closed by the other end")
        return data


class Wire:
    """One device behind a transport. Each transaction begins with an empty line.

    A read is sent again within its deadline. A write or a motion never is.
    """

    def __init__(self, transport: Transport, clock: Clock) -> None:
        self.transport = transport
        self.clock = clock
        self._unanswered = 0  # requests whose answer may still come

    @property
    def port(self) -> str:
        """Name of the port."""
        return self.transport.port

    def exchange(self, data: bytes, name: str, kind: Kind, receiver: Callable[[], Receiver[Answer]]) -> Answer:
        """Send a request, called ``name`` in messages, and return its answer.

        ``receiver`` makes a receiver, one for each time that the request is sent. Raises StateUnknown: a motion was not
        acknowledged. Raises DeadlinePassed: a read or a write was not answered in time. Raises
        DeviceRefused or DeviceGone.
        """
        self._empty_line(f"before {name}")
        deadline = self.clock.now() + DEADLINE_S
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
                        "Look at the mirror, then run again, which connects anew"
                    ) from error
                left -= 1
                if left == 0 or isinstance(error, DeviceGone):
                    raise
                LOG.info("%s; asking again", error)
                self._empty_line("before asking again", deadline)
                if self.clock.now() >= deadline:
                    raise

    def _once(self, data: bytes, name: str, receiver: Receiver[Answer], silence_s: float, deadline: float) -> Answer:
        """Send once, and wait until the device has been silent for ``silence_s``, at most to the deadline."""
        began = self.clock.now()
        self._unanswered += 1
        self.transport.write(data, deadline)
        came = b""
        until = min(began + silence_s, deadline)
        while self.clock.now() < until:
            part = self.transport.read(4096, until)
            until = min(self.clock.now() + silence_s, deadline) if part else until
            came += part
            try:
                answer = receiver(part) if part else None
            except DeviceRefused:  # this is an answer; after other errors one may still come
                self._unanswered -= 1
                raise
            if answer is not None:
                self._unanswered -= 1
                return answer
        found = f"{len(came)} other bytes came: {came[:32].hex(' ')}" if came else "nothing came"
        raise DeadlinePassed(
            f"no answer to {name} from {self.port} within {self.clock.now() - began:.3g} s ({found}); is the "
            f"controller on, its cable in, and the port's speed right?"
        )

    def _empty_line(self, when: str, latest: float = math.inf) -> None:
        """Drop what is on the line. If an answer may still come, wait for silence: it would pass for the next one."""
        stale = self.transport.drain()
        now = self.clock.now()
        latest = min(latest, now + 5 * QUIET_S)  # some devices never stop
        until = min(now + QUIET_S, latest)
        while self._unanswered and (part := self.transport.read(4096, until)):
            stale += part
            until = min(self.clock.now() + QUIET_S, latest)
        self._unanswered = 0
        if stale:
            LOG.info("%s: dropped %d stale bytes %s: %s", self.port, len(stale), when, stale[:64].hex(" "))
