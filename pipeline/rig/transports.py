"""Bytes to and from a device, with deadlines of a clock: over a serial port, or what else pyserial knows, or TCP."""

from __future__ import annotations

import errno
import socket
from typing import Protocol

import serial
from serial import SerialException, SerialTimeoutException
from serial.tools import list_ports

from pipeline.errors import SettingsError
from pipeline.rig.devices import SYSTEM_CLOCK, Clock, DeadlinePassed, DeviceGone

USB_ID = (0x0483, 0xA31E)  # vendor and product of the mirror controller
_SLICE_S = 0.02  # reads wait in slices: by so much a deadline may be overrun
_WRITE_S = 0.25  # a frame takes 10 ms at 115200
_MOST_DRAINED = 1 << 16  # bytes of a port that never ends; over TCP 16 times as many


class Transport(Protocol):
    """A line to a device. Deadlines are moments of the clock that both ends of a call share.

    Whatever speaks over it raises DeviceGone where the device is not there any more.
    """

    @property
    def port(self) -> str:
        """Its name in messages."""

    def write(self, data: bytes, deadline: float) -> None:
        """Send all bytes; DeadlinePassed where they were not taken in time, and then some may have gone."""

    def read(self, at_most: int, deadline: float) -> bytes:
        """Wait for bytes and give those that are there; none where the deadline passes first."""

    def drain(self) -> bytes:
        """Give what is there already, without waiting."""

    def close(self) -> None:
        """Let go of the port."""


class SerialTransport:
    """A :class:`Transport` over a serial port, held exclusively, or an address that pyserial knows (``socket://host:port``).

    DeviceGone where there is no such port, it is in use, or not permitted; SettingsError for a kind of address, or a
    speed, that there is not.
    """

    def __init__(self, port: str, baud: int, clock: Clock = SYSTEM_CLOCK) -> None:
        self.port = port
        self._clock = clock
        try:
            self._serial = serial.serial_for_url(
                port, baudrate=baud, timeout=_SLICE_S, write_timeout=_WRITE_S, exclusive=True
            )
        except SerialException as error:
            raise DeviceGone(_why_not(port, error)) from error
        except (ValueError, OverflowError) as error:
            raise SettingsError(
                f"expected a port's name or an address that pyserial knows, and a speed, got {port!r} at {baud!r}: "
                f"{error}"
            ) from error

    def write(self, data: bytes, deadline: float) -> None:
        if self._clock.now() >= deadline:
            raise DeadlinePassed(f"no time was left to send {len(data)} bytes to {self.port}; give a longer deadline")
        try:
            self._serial.write(data)
        except SerialTimeoutException:
            raise DeadlinePassed(
                f"{self.port} did not take {len(data)} bytes within {_WRITE_S:g} s; is the device on?"
            ) from None
        except (SerialException, OSError, TypeError) as error:
            raise self._gone(error) from error

    def read(self, at_most: int, deadline: float) -> bytes:
        try:
            while self._clock.now() < deadline:
                first: bytes = self._serial.read(1)
                if first:
                    rest: bytes = self._serial.read(min(at_most - 1, self._serial.in_waiting))
                    return first + rest
            return b""
        except (SerialException, OSError, TypeError) as error:
            raise self._gone(error) from error

    def drain(self) -> bytes:
        drained = b""
        try:
            while len(drained) < _MOST_DRAINED and (there := self._serial.in_waiting):
                drained += self._serial.read(there)
        except (SerialException, OSError, TypeError) as error:
            raise self._gone(error) from error
        return drained

    def close(self) -> None:
        self._serial.close()

    def _gone(self, error: Exception) -> DeviceGone:
        return DeviceGone(f"{self.port} went away ({error}); look at the cable and the power, then connect again")


def _why_not(port: str, error: OSError) -> str:
    if error.errno in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
        return f"there is no port {port}; {_ports_here()}"
    if error.errno in (errno.EBUSY, errno.EAGAIN, errno.EWOULDBLOCK):
        return f"{port} is in use by another program; close that, since two would mix their motions"
    if error.errno in (errno.EACCES, errno.EPERM):
        return f"no permission for {port}; add this user to the port's group (mostly dialout), then log in again"
    return f"{port} cannot be opened: {error}; is it a serial port, and the device on?"


def _ports_here() -> str:
    """Say which ports there are, and which of them is a mirror controller."""
    ports = list(list_ports.comports())
    mirrors = [port.device for port in ports if (port.vid, port.pid) == USB_ID]
    if mirrors:
        return f"a mirror controller is at {', '.join(mirrors)}: set the port to that"
    if not ports:
        return "this machine has no serial port: is the controller on, and its cable in?"
    return f"there are {', '.join(sorted(port.device for port in ports))}; is the controller on?"


class SocketTransport:
    """A :class:`Transport` to ``host:port``; SettingsError where that cannot be, DeviceGone where nobody is there."""

    def __init__(self, host: str, port: int, clock: Clock = SYSTEM_CLOCK, *, connect_s: float = 3.0) -> None:
        if not host or not 0 < port < 65536:
            raise SettingsError(f"expected a host and a port from 1 to 65535, got {host!r} and {port!r}; correct them")
        self.port = f"{host}:{port}"
        self._clock = clock
        try:
            self._socket = socket.create_connection((host, port), timeout=connect_s)
        except (OSError, UnicodeError) as error:
            timed_out = isinstance(error, TimeoutError)
            reason = str(getattr(error, "strerror", None) or error).lower()
            why = f"nothing answered within {connect_s:g} s" if timed_out else reason
            raise DeviceGone(
                f"no connection to {self.port}: {why}; is the camera on, its network cable in, and this machine's "
                "address in its network?"
            ) from error
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def write(self, data: bytes, deadline: float) -> None:
        left = deadline - self._clock.now()
        if left <= 0:
            raise DeadlinePassed(f"no time was left to send {len(data)} bytes to {self.port}; give a longer deadline")
        try:
            self._socket.settimeout(left)
            self._socket.sendall(data)
        except TimeoutError:
            raise DeadlinePassed(f"{self.port} did not take {len(data)} bytes within {left:g} s; is it hung?") from None
        except OSError as error:
            raise self._gone(str(error)) from error

    def read(self, at_most: int, deadline: float) -> bytes:
        left = deadline - self._clock.now()
        if left <= 0:
            return b""
        try:
            self._socket.settimeout(max(left, 1e-3))
            data = self._socket.recv(at_most)
        except TimeoutError:
            self._clock.sleep(deadline - self._clock.now())  # a clock turned by hand has not moved meanwhile
            return b""
        except OSError as error:
            raise self._gone(str(error)) from error
        if not data:
            raise self._gone("closed by the other end")
        return data

    def drain(self) -> bytes:
        drained = b""
        self._socket.setblocking(False)
        try:
            while len(drained) < 16 * _MOST_DRAINED:
                data = self._socket.recv(65536)
                if not data:
                    raise self._gone("closed by the other end")
                drained += data
        except (BlockingIOError, InterruptedError):
            pass
        except DeviceGone:
            raise
        except OSError as error:
            raise self._gone(str(error)) from error
        return drained

    def close(self) -> None:
        self._socket.close()

    def _gone(self, why: str) -> DeviceGone:
        return DeviceGone(f"the connection to {self.port} was lost ({why}); look at the cable and the power")
