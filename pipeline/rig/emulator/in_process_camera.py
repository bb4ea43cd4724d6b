"""A control line straight to an emulated camera, in this process: waiting moves the clock and takes no time."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

from pipeline.rig.clock import Clock
from pipeline.rig.device_errors import DeviceGone
from pipeline.rig.emulator.camera_device import CameraDevice
from pipeline.rig.emulator.exchange import Chunk


@dataclass
class InProcessCameraLine:
    """A transport to ``device``; both share the clock."""

    device: CameraDevice
    clock: Clock
    port: str = "emulated camera"
    _coming: deque[tuple[float, bytes]] = field(default_factory=deque, init=False)
    _open: bool = field(default=True, init=False)

    def __post_init__(self) -> None:
        self._talk = self.device.connection()
        self._say(self.device.greet())

    def write(self, data: bytes, deadline: float) -> None:
        """Send all bytes, at once.

        Raises
        ------
        DeviceGone : the camera hung up, or the line is closed.
        """
        self._check_open()
        chunks, self._open = self._talk.feed(data)
        self._say(chunks)

    def read(self, at_most: int, deadline: float) -> bytes:
        """Wait for bytes and give those that are there; none where the deadline passes first.

        Raises
        ------
        DeviceGone : the camera hung up, and all that it had said is read.
        """
        if not self._coming:
            self._check_open()
        if not self._coming or self._coming[0][0] > deadline:
            self.clock.sleep(deadline - self.clock.now())
            return b""
        due_s, data = self._coming.popleft()
        self.clock.sleep(due_s - self.clock.now())
        if len(data) > at_most:
            self._coming.appendleft((due_s, data[at_most:]))
        return data[:at_most]

    def drain(self) -> bytes:
        """Give what is there already."""
        found = b""
        while self._coming and self._coming[0][0] <= self.clock.now():
            found += self._coming.popleft()[1]
        return found

    def close(self) -> None:
        """Hang up; what the camera still had to say is lost."""
        self._open = False
        self._coming.clear()

    def _say(self, chunks: list[Chunk]) -> None:
        due_s = self.clock.now()
        for chunk in chunks:
            due_s += chunk.delay_s
            self._coming.append((due_s, chunk.data))

    def _check_open(self) -> None:
        if not self._open:
            raise DeviceGone(f"the connection to {self.port} was lost (closed by the other end)")
