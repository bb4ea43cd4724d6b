"""A camera's control line without a network: an emulated camera in this process, by a clock turned by hand."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from pipeline.rig.camera.headwall_camera import HeadwallCamera
from pipeline.rig.camera.headwall_control import ControlPatience, HeadwallControl
from pipeline.rig.clock import ManualClock
from pipeline.rig.device_errors import DeviceGone
from pipeline.rig.emulator.camera_device import CameraDevice


class CameraLine:
    """A transport to an emulated camera; waiting moves the clock and takes no time."""

    port = "emulated:8100"

    def __init__(self, device: CameraDevice, clock: ManualClock) -> None:
        self._clock = clock
        self._talk = device.connection()
        self._coming: deque[tuple[float, bytes]] = deque()
        self._open = True
        self._say([(chunk.delay_s, chunk.data) for chunk in device.greet()])

    def _say(self, chunks: list[tuple[float, bytes]]) -> None:
        when = self._clock.now()
        for delay_s, data in chunks:
            when += delay_s
            self._coming.append((when, data))

    def write(self, data: bytes, deadline: float) -> None:
        """Hand a command to the camera."""
        if not self._open:
            raise DeviceGone("the line is down")
        chunks, self._open = self._talk.feed(data)
        self._say([(chunk.delay_s, chunk.data) for chunk in chunks])

    def read(self, at_most: int, deadline: float) -> bytes:
        """Wait for the camera's next bytes."""
        if not self._coming and not self._open:
            raise DeviceGone("the connection was lost (closed by the other end)")
        if not self._coming or self._coming[0][0] > deadline:
            self._clock.sleep(deadline - self._clock.now())
            return b""
        when, data = self._coming.popleft()
        self._clock.sleep(when - self._clock.now())
        if data[at_most:]:
            self._coming.appendleft((when, data[at_most:]))
        return data[:at_most]

    def drain(self) -> bytes:
        """Give what has come already."""
        found = b""
        while self._coming and self._coming[0][0] <= self._clock.now():
            found += self._coming.popleft()[1]
        return found

    def close(self) -> None:
        """Hang up."""
        self._open = False
        self._coming.clear()


def control_of(device: CameraDevice, clock: ManualClock, retries: int = 2) -> HeadwallControl:
    """A control client of an emulated camera in this process."""
    return HeadwallControl(
        lambda: CameraLine(device, clock), clock=clock, patience=ControlPatience(5.0, retries), capture_root="/captured"
    )


def wait_for(camera: HeadwallCamera, at_most_s: float) -> None:
    """Let time pass until no capture runs."""
    until = camera.clock.now() + at_most_s
    while camera.is_capturing():
        assert camera.clock.now() < until, f"the capture still runs after {at_most_s:g} s"
        camera.clock.sleep(0.2)


def scene_lines(samples: int = 6, bands: int = 4) -> LinesOf:
    """What an emulated camera sees: numbers that tell time, position, sample and band."""
    return LinesOf(samples, bands)


class LinesOf:
    """Lines that only their own time and position have, kept as they were given."""

    def __init__(self, samples: int, bands: int) -> None:
        self.size = (samples, bands)
        self.given: list[NDArray[np.uint16]] = []

    def __call__(self, positions: NDArray[np.float64], times: NDArray[np.float64]) -> NDArray[np.uint16]:
        """(line, sample, band) uint16."""
        samples, bands = self.size
        seed = np.rint(times * 1e4).astype(np.int64) * 7919 + np.rint(positions[:, 0] * 1e4).astype(np.int64)
        cell = np.arange(samples * bands).reshape(samples, bands) * 31
        lines = ((seed[:, None, None] + cell) % 4096).astype(np.uint16)
        self.given.append(lines)
        return lines
