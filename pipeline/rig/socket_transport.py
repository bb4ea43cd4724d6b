"""Bytes to and from a device over TCP, with deadlines of an injected clock."""

from __future__ import annotations

import socket

from pipeline.errors import SettingsError
from pipeline.rig.clock import SYSTEM_CLOCK, Clock
from pipeline.rig.device_errors import DeadlinePassed, DeviceGone

_LEAST_WAIT_S = 0.001
_MOST_DRAINED = 1 << 20


class SocketTransport:
    """A connection to ``host:port``.

    Raises
    ------
    SettingsError : the host or the port cannot be one.
    DeviceGone : nobody answers there; the message says what to do.
    """

    def __init__(self, host: str, port: int, clock: Clock = SYSTEM_CLOCK, *, connect_s: float = 3.0) -> None:
        if not host or not 0 < port < 65536:
            raise SettingsError(f"expected a host and a port from 1 to 65535, got {host!r} and {port!r}; correct them")
        self.port = f"{host}:{port}"
        self._clock = clock
        try:
            self._socket = socket.create_connection((host, port), timeout=connect_s)
        except (OSError, UnicodeError) as error:
            raise DeviceGone(
                f"no connection to {self.port}: {_why_not(error, connect_s)}; is the camera on, its network cable in, "
                "and this machine's address in its network?"
            ) from error
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def write(self, data: bytes, deadline: float) -> None:
        """Send all bytes.

        Raises
        ------
        DeadlinePassed : they were not taken in time; some may have gone.
        DeviceGone : the connection was lost.
        """
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
        """Wait for bytes and give those that are there; none where the deadline passes first.

        Raises
        ------
        DeviceGone : the connection was lost, or closed by the other end.
        """
        left = deadline - self._clock.now()
        if left <= 0:
            return b""
        try:
            self._socket.settimeout(max(left, _LEAST_WAIT_S))
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
        """Give what is there already, without waiting.

        Raises
        ------
        DeviceGone : the connection was lost, or closed by the other end.
        """
        drained = b""
        self._socket.setblocking(False)
        try:
            while len(drained) < _MOST_DRAINED:
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
        """Hang up."""
        self._socket.close()

    def _gone(self, why: str) -> DeviceGone:
        return DeviceGone(f"the connection to {self.port} was lost ({why}); look at the cable and the power")


def _why_not(error: OSError | UnicodeError, connect_s: float) -> str:
    if isinstance(error, TimeoutError):
        return f"nothing answered within {connect_s:g} s"
    return str(getattr(error, "strerror", None) or error).lower()
