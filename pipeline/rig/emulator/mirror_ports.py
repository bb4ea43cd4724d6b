"""Ports that an emulated controller hangs on: a line in this process, or a pty that is opened as a real port is."""

from __future__ import annotations

import heapq
import logging
import os
import select
import threading
import tty
from dataclasses import dataclass, field
from itertools import count

from pipeline.errors import RigError
from pipeline.rig.devices import Clock, Closing, DeadlinePassed, DeviceGone
from pipeline.rig.emulator import Chunk
from pipeline.rig.emulator.mirror_device import MirrorDevice, VanishedError
from pipeline.rig.transports import BITS_PER_BYTE

LOG = logging.getLogger(__name__)
_AT_ONCE = 4096  # bytes
_RETRY_S = 0.005  # of a user who does not read


@dataclass
class InProcessTransport:
    """A :class:`~pipeline.rig.transports.Transport` to ``device``; both share the clock.

    ``sent`` are the writes, for whoever checks what was sent. ``baud`` paces both directions; 0 does not.
    """

    device: MirrorDevice
    clock: Clock
    baud: int = 0
    port: str = "emulator"
    sent: list[bytes] = field(default_factory=list)
    _due: list[tuple[float, int, bytes]] = field(default_factory=list, init=False)
    _order: count[int] = field(default_factory=count, init=False)
    _free_s: float = field(default=0.0, init=False)  # when the line from the device is free again
    _closed: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        self._schedule(self.device.opened())

    def write(self, data: bytes, deadline: float) -> None:
        """Hand the bytes to the device at once."""
        self._check_open()
        self.sent.append(data)
        if self.device.hung:
            self.clock.sleep(deadline - self.clock.now())
            raise DeadlinePassed(f"{self.port} did not take {len(data)} bytes in time; is the device on?")
        self.clock.sleep(self._seconds(len(data)))
        try:
            self._schedule(self.device.receive(data))
        except VanishedError as error:
            raise self._gone() from error

    def read(self, at_most: int, deadline: float) -> bytes:
        """Give what the device has answered by then."""
        self._check_open()
        if not self._due and self.device.gone:
            raise self._gone()
        until = min(self._due[0][0], deadline) if self._due else deadline
        self.clock.sleep(until - self.clock.now())
        data = self.drain()
        if len(data) > at_most:
            heapq.heappush(self._due, (self.clock.now(), -next(self._order), data[at_most:]))
        return data[:at_most]

    def drain(self) -> bytes:
        self._check_open()
        data = b""
        while self._due and self._due[0][0] <= self.clock.now():
            data += heapq.heappop(self._due)[2]
        return data

    def close(self) -> None:
        self._closed = True
        self._due.clear()

    def _schedule(self, chunks: list[Chunk]) -> None:
        now = self.clock.now()
        for delay_s, data in chunks:
            self._free_s = max(now + delay_s, self._free_s if self.baud else 0.0) + self._seconds(len(data))
            heapq.heappush(self._due, (self._free_s, next(self._order), data))

    def _seconds(self, size: int) -> float:
        return size * BITS_PER_BYTE / self.baud if self.baud else 0.0

    def _check_open(self) -> None:
        if self._closed:
            raise DeviceGone(f"{self.port} is closed; open it again")

    def _gone(self) -> DeviceGone:
        return DeviceGone(f"{self.port} went away; look at the cable and the power, then connect again")


class EmulatedPort(Closing):
    """A pty and the thread that serves it, from :meth:`open` to :meth:`close`; use it as a context.

    The device's clock paces the bytes, too. ``baud`` is the speed in both directions; 0 lets bytes through as they
    come: USB ports do that whatever their speed says.
    """

    def __init__(self, device: MirrorDevice, *, baud: int = 0) -> None:
        self.device, self.baud = device, baud
        self.path = ""
        self._master = self._slave = self._wake = -1
        self._thread: threading.Thread | None = None

    def __enter__(self) -> EmulatedPort:
        self.open()
        return self

    def open(self) -> str:
        """Make the pty, serve it, and give the name that users open; RigError where this system has no ptys."""
        if self._thread is not None:
            raise RigError(f"the emulated port {self.path} is open; close it first")
        try:
            self._master, self._slave = os.openpty()
            tty.setraw(self._slave)  # else line discipline would echo, and turn CR into LF
        except OSError as error:
            raise RigError(f"no pty for the emulated port: {error}; ptys are there on Linux and macOS") from error
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self._slave)
        read_end, self._wake = os.pipe()
        self._thread = threading.Thread(target=self._serve, args=(read_end,), name="emulated mirror port", daemon=True)
        self._thread.start()
        return self.path

    def close(self) -> None:
        """End the thread and let go of the pty; users of the port see the device go. Nothing where it is closed."""
        if self._thread is None:
            return
        os.close(self._wake)
        self._thread.join()
        self._thread = None

    def _serve(self, read_end: int) -> None:
        try:
            _Line(self.device, self._master, self.baud).serve(read_end)
        except VanishedError as error:
            LOG.info("%s: %s", self.path, error)
        except Exception:
            LOG.exception("the emulated controller on %s failed", self.path)
        finally:
            for descriptor in (self._master, self._slave):
                os.close(descriptor)
            select.select([read_end], [], [])  # until close() is called
            os.close(read_end)


class _Line:
    """Bytes between the master's end of a pty and a device, at the pace of the device's clock."""

    def __init__(self, device: MirrorDevice, master: int, baud: int) -> None:
        self._device, self._master = device, master
        self._byte_s = BITS_PER_BYTE / baud if baud else 0.0
        self._order = count()
        self._in: list[tuple[float, int, bytes]] = []  # when it reached the device
        self._out: list[tuple[float, int, bytes]] = []
        self._in_free_s = self._out_free_s = 0.0
        self._greeted = False

    def serve(self, stop: int) -> None:
        """Carry bytes until ``stop`` is closed at its other end; VanishedError once device and bytes are gone."""
        while True:
            heard = [stop] if self._device.hung else [stop, self._master]
            ready, _, _ = select.select(heard, [], [], self._patience())
            if stop in ready:
                return
            if self._master in ready:
                self._take(os.read(self._master, _AT_ONCE))
            while self._in and self._in[0][0] <= self._device.clock.now():
                due, _, data = heapq.heappop(self._in)
                self._schedule(self._device.receive(data), due)  # not from now: waking late is not the device's doing
            self._deliver()
            if self._device.gone and not self._out:
                raise VanishedError("the device went away")

    def _take(self, data: bytes) -> None:
        if not self._greeted:  # what lies in the port: earlier it would be flushed as the port is opened
            self._greeted = True
            self._schedule(self._device.opened(), self._device.clock.now())
        self._in_free_s = max(self._device.clock.now(), self._in_free_s) + len(data) * self._byte_s
        heapq.heappush(self._in, (self._in_free_s, next(self._order), data))

    def _schedule(self, chunks: list[Chunk], since_s: float) -> None:
        for delay_s, data in chunks:
            due = since_s + delay_s
            if self._byte_s:
                due = self._out_free_s = max(due, self._out_free_s) + len(data) * self._byte_s
            heapq.heappush(self._out, (due, next(self._order), data))

    def _deliver(self) -> None:
        """Write what is due; what a user does not take waits."""
        while self._out and self._out[0][0] <= self._device.clock.now():
            due, order, data = heapq.heappop(self._out)
            try:
                written = os.write(self._master, data)
            except BlockingIOError:
                written = 0
            if written < len(data):
                heapq.heappush(self._out, (due, order, data[written:]))
                return

    def _patience(self) -> float | None:
        """Real time until something is due; None where nothing is."""
        waiting = [queue[0][0] for queue in (self._in, self._out) if queue]
        if not waiting:
            return None
        left = (min(waiting) - self._device.clock.now()) / getattr(self._device.clock, "speed", 1.0)
        return left if left > 0 else _RETRY_S if self._out and self._out[0][0] <= min(waiting) else 0.0
