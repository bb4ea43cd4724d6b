"""Emulated devices in this process: lines without ports, with a manual clock."""

from __future__ import annotations

import heapq
from dataclasses import dataclass, field
from itertools import count
from typing import Any

from pipeline.rig.camera.headwall_camera import HeadwallCamera
from pipeline.rig.device_settings import FileServer, SurveyRig
from pipeline.rig.drivers import RigDevices
from pipeline.rig.emulator import Chunk
from pipeline.rig.emulator.camera_device import CameraConnection, CameraDevice
from pipeline.rig.emulator.emulated_rig import EmulatedRig
from pipeline.rig.emulator.mirror_device import MirrorDevice
from pipeline.rig.mirror_controller import MirrorController
from pipeline.rig.transports import BITS_PER_BYTE, Clock, Closing, DeadlinePassed, DeviceGone
from tests.pipeline.rig.mirror_faults import FaultyMirror, VanishedError


class ManualClock:
    """A clock that advances only by sleeping, which takes no real time."""

    def __init__(self, start: float = 0.0) -> None:
        self._now = start

    def now(self) -> float:
        return self._now

    def sleep(self, seconds: float) -> None:
        if seconds > 0:
            self._now += seconds


class Incoming:
    """Data on their way to a driver, possibly with an error; reading advances the clock."""

    clock: Clock

    def __post_init__(self) -> None:
        self.coming: list[tuple[float, int, bytes | Exception]] = []  # by the time at which they can be read
        self._order = count()

    def expect(self, when_s: float, data: bytes | Exception) -> None:
        """Schedule data for a time, after all that is scheduled for the same time."""
        heapq.heappush(self.coming, (when_s, next(self._order), data))

    def read(self, at_most: int, deadline: float) -> bytes:
        """Return the next part, at its time."""
        if not self.coming or self.coming[0][0] > deadline:
            self.clock.sleep(deadline - self.clock.now())
            return b""
        when_s, order, data = heapq.heappop(self.coming)
        self.clock.sleep(when_s - self.clock.now())
        if isinstance(data, Exception):
            raise data
        if data[at_most:]:
            heapq.heappush(self.coming, (when_s, order, data[at_most:]))
        return data[:at_most]

    def drain(self) -> bytes:
        """Return all data that have arrived."""
        found = b""
        while self.coming and self.coming[0][0] <= self.clock.now():
            found += self.read(1 << 20, self.clock.now())
        return found


@dataclass
class InProcessTransport(Incoming):
    """A :class:`~pipeline.rig.transports.Transport` to ``device``; both share the clock.

    ``sent`` has the writes, for tests that check them. ``baud`` paces both directions; 0 does not.
    """

    device: MirrorDevice
    clock: Clock
    baud: int = 0
    port: str = "emulator"
    sent: list[bytes] = field(default_factory=list)
    _free_s: float = field(default=0.0, init=False)  # when the line from the device is free again
    _closed: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        if isinstance(self.device, FaultyMirror):
            self._schedule(self.device.opened())

    def write(self, data: bytes, deadline: float) -> None:
        """Pass the bytes to the device at once."""
        self._check_open()
        self.sent.append(data)
        if getattr(self.device, "hung", False):
            self.clock.sleep(deadline - self.clock.now())
            raise DeadlinePassed(f"{self.port} did not take {len(data)} bytes in time; is the device on?")
        self.clock.sleep(self._seconds(len(data)))
        try:
            self._schedule(self.device.receive(data))
        except VanishedError as error:
            raise self._gone() from error

    def read(self, at_most: int, deadline: float) -> bytes:
        """Return the device's reply up to the deadline."""
        self._check_open()
        if not self.coming and getattr(self.device, "gone", False):
            raise self._gone()
        return super().read(at_most, deadline)

    def drain(self) -> bytes:
        self._check_open()
        return super().drain()

    def close(self) -> None:
        self._closed = True
        self.coming.clear()

    def _schedule(self, chunks: list[Chunk]) -> None:
        now = self.clock.now()
        for delay_s, data in chunks:
            self._free_s = max(now + delay_s, self._free_s if self.baud else 0.0) + self._seconds(len(data))
            self.expect(self._free_s, data)

    def _seconds(self, size: int) -> float:
        return size * BITS_PER_BYTE / self.baud if self.baud else 0.0

    def _check_open(self) -> None:
        if self._closed:
            raise DeviceGone(f"{self.port} is closed; open it again")

    def _gone(self) -> DeviceGone:
        return DeviceGone(f"{self.port} went away; look at the cable and the power, then connect again")


@dataclass
class InProcessCameraLine(Incoming):
    """A :class:`~pipeline.rig.transports.Transport` to ``device``; both share the clock."""

    device: CameraDevice
    clock: Clock
    port: str = "emulated camera"
    _open: bool = field(default=True, init=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        self._talk = CameraConnection(self.device)
        self._say(self.device.greet())

    def write(self, data: bytes, deadline: float) -> None:
        self._check_open()
        chunks, self._open = self._talk.feed(data)
        self._say(chunks)

    def read(self, at_most: int, deadline: float) -> bytes:
        """Return the camera's reply up to the deadline."""
        if not self.coming:
            self._check_open()
        return super().read(at_most, deadline)

    def close(self) -> None:
        self._open = False
        self.coming.clear()

    def _say(self, chunks: list[Chunk]) -> None:
        due_s = self.clock.now()
        for chunk in chunks:
            due_s += chunk.delay_s
            self.expect(due_s, chunk.data)

    def _check_open(self) -> None:
        if not self._open:
            raise DeviceGone(f"the connection to {self.port} was lost (closed by the other end)")


@dataclass
class InProcessRig(Closing):
    """Lines to an emulated rig. Close it, because a thread serves the camera's files through a local socket."""

    rig: EmulatedRig

    def __post_init__(self) -> None:
        self.clock = self.rig.clock  # of the devices and of their drivers
        self.transport = InProcessTransport(self.rig.mirror, self.clock)
        self.server = self.rig.server_kind(self.rig.camera)
        self.files = FileServer(self.server.host, self.server.file_port)

    def camera_line(self) -> InProcessCameraLine:
        """Connect to the camera's control."""
        return InProcessCameraLine(self.rig.camera, self.clock)

    def camera(self) -> HeadwallCamera:
        """Return a driver that is connected to the camera."""
        return HeadwallCamera(self.camera_line, self.files, clock=self.clock)

    def mirror(self, rig: SurveyRig, vector_pairs: int = 1500) -> MirrorController:
        """Connect a driver to the mirror, with a line of its own."""
        self.transport = InProcessTransport(self.rig.mirror, self.clock)
        mirror = MirrorController(self.transport, rig, self.clock, vector_pairs=vector_pairs)
        mirror.connect()
        return mirror

    def devices(self, rig: SurveyRig, vector_pairs: int = 1500) -> RigDevices:
        """Connect drivers to both devices."""
        return RigDevices(self.mirror(rig, vector_pairs), self.camera(), self.clock)

    def devices_of(self, told: Any, *_: object) -> RigDevices:
        """Connect drivers with a survey's settings, in place of `flows.tasks.rig_field.open_devices`."""
        return self.devices(told.rig, told.cost.vector_pairs)

    def close(self) -> None:
        """Close the port for files."""
        self.server.close()
