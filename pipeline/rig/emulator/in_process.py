"""A line straight to an emulated controller, in this process: what it takes is the clock's time and nobody's."""

from __future__ import annotations

import heapq
from dataclasses import dataclass, field
from itertools import count

from pipeline.rig.clock import Clock
from pipeline.rig.device_errors import DeadlinePassed, DeviceGone
from pipeline.rig.emulator.exchange import Chunk, VanishedError
from pipeline.rig.emulator.mirror_device import MirrorDevice
from pipeline.rig.mirror.transactions import BITS_PER_BYTE


@dataclass
class InProcessTransport:
    """A transport to ``device``; both share the clock. ``sent`` are the writes, for whoever checks what was sent.

    ``baud`` paces both directions; 0 does not.
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
        """Send all bytes, which takes their time on the line.

        Raises
        ------
        DeadlinePassed : the port took none until then. DeviceGone : there is no device any more.
        """
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
        """Wait for bytes and give those that are there; none where the deadline passes first.

        Raises
        ------
        DeviceGone : there is no device any more.
        """
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
        """Give what is there already."""
        self._check_open()
        data = b""
        while self._due and self._due[0][0] <= self.clock.now():
            data += heapq.heappop(self._due)[2]
        return data

    def close(self) -> None:
        """Let go of the device; what it still had to say is lost."""
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
